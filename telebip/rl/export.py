# pyright: reportAttributeAccessIssue=false
"""Export a policy to ONNX: the network with its observation normalisation, and all that is needed to run it elsewhere."""

import contextlib
import json
import logging
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch import Tensor, nn

from telebip import __version__
from telebip.config import to_yaml
from telebip.errors import UserError
from telebip.files import write_atomically
from telebip.mdp.actions import scales
from telebip.mdp.binding import find_term
from telebip.rl.checkpoint import Checkpoint
from telebip.rl.onnx import INPUT, OUTPUT, OnnxPolicy, set_metadata
from telebip.rl.policy import load_network
from telebip.rl.run import git_revision
from telebip.rl.symmetry import Canonical, SymmetricPolicy
from telebip.robot import Robot, load_robot
from telebip.robot_record import describe_robot

MEASUREMENTS = {
    "joint_pos": ("rad | m", "of each joint, in the order of joint_names, zero as in the MJCF"),
    "joint_vel": ("rad/s | m/s", "of each joint"),
    "lin_vel": ("m/s", "of the trunk's frame, midway between the hips, in that frame"),
    "ang_vel": ("rad/s", "of the trunk, in its frame"),
    "quat": ("w x y z", "of the trunk in a frame whose z points up; its heading may start anywhere, and drift"),
}
"""What a robot may have to measure: unit and frame."""

NEEDS = {
    **{"joint_pos": "joint_pos", "joint_vel": "joint_vel", "base_lin_vel": "lin_vel", "base_ang_vel": "ang_vel"},
    **{"base_quat": "quat", "projected_gravity": "quat"},
}
"""Which of these an observation is made of; others are measured as they are."""

TOLERANCE = 1e-5
"""Largest difference between the actions of ONNX and torch that an export may show [-]; see `largest_difference`."""


def export(checkpoint: Checkpoint, path: Path, samples: int = 10_000) -> float:
    """Write `checkpoint`'s policy to `path`, unless it acts differently there.

    Args:
        checkpoint: what to export.
        path: file to write: complete, or not at all.
        samples: number of random observations on which ONNX and torch are compared.

    Returns:
        The largest difference, see `largest_difference` [-].

    Raises:
        UserError: packages are missing, the file cannot be written, or the difference exceeds `TOLERANCE`.
    """
    policy = load_network(checkpoint)
    model = _to_onnx(policy)
    set_metadata(model, describe(checkpoint, load_robot(checkpoint.config.sim.robot)))
    content = model.SerializeToString()
    difference = largest_difference(policy, OnnxPolicy(content), samples)
    if not difference <= TOLERANCE:
        raise UserError(f"not exported: actions of onnxruntime and torch differ by {difference:.1e}, more than {TOLERANCE:.0e}")
    try:
        write_atomically(path, content)
    except OSError as error:
        raise UserError(f"cannot write '{path}': {error.strerror or error}") from error
    return difference


def describe(checkpoint: Checkpoint, robot: Robot) -> dict[str, Any]:
    """Return what one has to know to run the policy on a robot or in another simulator. Lists follow `joint_names`.

    Delays and noise are those of the training: what the policy bears, not what a robot should add.

    Raises:
        UserError: the robot has other joints than the policy moves.
    """
    config, model, names = checkpoint.config, robot.model, checkpoint.joint_names
    if names != list(robot.joint_names):
        raise UserError(f"robot '{config.sim.robot}' has joints {list(robot.joint_names)}; the policy moves {names}")
    return {
        "task": checkpoint.task,
        "joint_names": names,
        "joint_unit": ["m" if slide else "rad" for slide in robot.is_slide],
        "nominal_pose": robot.nominal.tolist(),
        "action_scale": scales(config.actions.scale, robot.joint_names),  # joint target = nominal + scale * action
        "stiffness": model.actuator_gainprm[:, 0].tolist(),
        "damping": (-model.actuator_biasprm[:, 2]).tolist(),
        "force_range": robot.force_range.tolist(),
        # Stiffness and damping: per joint_unit, and per joint_unit/s.
        "force_unit": ["N" if slide else "N m" for slide in robot.is_slide],
        # One frame, its parts in their order. The network takes SI units as they are (scale 1): it normalises itself.
        "observation": [
            {"name": part["name"], "size": part["size"], "scale": 1.0, "unit": part["unit"]}
            for part in checkpoint.observations["policy"]
        ],
        "history": config.observations["policy"].history,  # frames that it takes, one of each policy step, the newest first
        "measures": measures(checkpoint),
        # By how much actions and observations were late in training, from the least to the most [s].
        "action_delay": [
            round(robot.physics_dt * (config.sim.decimation * late + more + jitter), 9)
            for late, more, jitter in zip(
                config.actions.delay, config.actions.physics_delay, config.actions.jitter, strict=True
            )
        ],
        "observation_delay": [
            round(robot.physics_dt * config.sim.decimation * late, 9) for late in config.observations["policy"].delay
        ],
        "physics_dt": robot.physics_dt,  # s
        "step_dt": robot.physics_dt * config.sim.decimation,  # s
        "gait_period": config.gait.period,  # s
        "command_range": {name: list(getattr(config.commands, name)) for name in ("lin_vel_x", "lin_vel_y", "ang_vel_z")},
        "heading_gain": config.commands.heading_gain,  # 1/s
        "heading_limit": config.commands.heading_limit,  # rad/s
        "velocity_gain": config.commands.velocity_gain,  # 1/s
        "velocity_limit": config.commands.velocity_limit,  # m/s
        "iteration": checkpoint.iteration,
        "samples": checkpoint.samples,
        "telebip_version": __version__,
        "git_revision": git_revision(),
        "training_git_revision": _training_revision(checkpoint.path.parent),
        "config": to_yaml(config),
        "robot": describe_robot(robot, config.sim.decimation),
    }


def measures(checkpoint: Checkpoint) -> list[dict[str, Any]]:
    """Return what a robot must measure for the policy: each with its unit, its frame and what needs it.

    `noise` is the largest amplitude with which the policy was trained, in the unit of the observation.
    """
    policy, commands = checkpoint.config.observations["policy"], checkpoint.config.commands
    found: dict[str, dict[str, Any]] = {}

    def need(name: str, unit: str, frame: str, user: str, noise: float) -> None:
        entry = found.setdefault(name, {"name": name, "unit": unit, "frame": frame, "for": [], "noise": 0.0})
        entry["for"].append(user)
        entry["noise"] = max(entry["noise"], noise)

    for part in checkpoint.observations["policy"]:
        params = policy.terms[part["name"]]
        term = find_term("observation", part["name"], params)
        if term.is_sensed:
            name = NEEDS.get(term.name, str(part["name"]))
            unit, frame = MEASUREMENTS.get(name, (part["unit"], ""))
            need(name, unit, frame, part["name"], params["noise"] if policy.noise else 0.0)
    if any(part["name"] == "command" for part in checkpoint.observations["policy"]):
        holds = {"quat": ("heading hold", commands.heading_gain), "lin_vel": ("velocity hold", commands.velocity_gain)}
        for name, (user, gain) in holds.items():
            if gain:
                unit, frame = MEASUREMENTS[name]
                need(name, unit, frame, user, 0.0)
    return list(found.values())


def largest_difference(policy: MLPModel | SymmetricPolicy, exported: OnnxPolicy, samples: int) -> float:
    r"""Compare two policies on random observations, twice as wide as those of training.

        max |a_torch - a_onnx| / max(1, |a_torch|)

    Absolute for actions up to 1, which scale to joint targets a few decimetres or half a radian from the nominal pose, and
    relative beyond, where float32 itself resolves no more.
    """
    actor = _actor(policy)
    obs = torch.randn(samples, actor.obs_dim, generator=torch.Generator().manual_seed(0))
    if actor.obs_normalization:
        obs = actor.obs_normalizer.inverse(2.0 * obs)  # type: ignore[operator]
    with torch.inference_mode():
        expected = policy(TensorDict({"policy": obs}, batch_size=[samples]))
    difference = (expected - torch.from_numpy(exported.act(obs.numpy()))).abs() / expected.abs().clamp(min=1.0)
    return float(difference.max())


class _Mirrored(nn.Module):
    """`SymmetricPolicy` on the plain vector of the group "policy"."""

    def __init__(self, network: nn.Module, canonical: Canonical) -> None:
        super().__init__()
        self.network, self.canonical = network, canonical

    def forward(self, obs: Tensor) -> Tensor:
        mirrored = self.canonical.is_mirrored(obs)
        return self.canonical.act(self.network(self.canonical.observe("policy", obs, mirrored)), mirrored)


def _actor(policy: MLPModel | SymmetricPolicy) -> MLPModel:
    return policy.learned if isinstance(policy, SymmetricPolicy) else policy  # type: ignore[return-value]


def _to_onnx(policy: MLPModel | SymmetricPolicy) -> Any:
    """Return the deterministic policy as an `onnx.ModelProto` with any number of observations."""
    try:
        import onnx  # noqa: F401
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise UserError(f"exporting needs the package {error.name}: pip install 'telebip[export]'") from error
    network = _actor(policy).as_onnx(verbose=False)
    if isinstance(policy, SymmetricPolicy):
        network = _Mirrored(network, policy.canonical)
    with _quiet():
        program = torch.onnx.export(
            network.eval(),
            (torch.zeros(2, _actor(policy).obs_dim),),
            dynamo=True,
            input_names=[INPUT],
            output_names=[OUTPUT],
            dynamic_shapes=({0: "num_envs"},),
            verbose=False,
        )
    assert program is not None
    return program.model_proto


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence the exporter, which reports the packages that it does without."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)


def _training_revision(run_dir: Path) -> str | None:
    """Return the git revision that the run folder's last start noted down, or None where there is no such note."""
    try:
        return json.loads((run_dir / "run.json").read_text(encoding="utf-8"))["starts"][-1]["git_revision"]
    except (OSError, ValueError, LookupError, TypeError):
        return None
