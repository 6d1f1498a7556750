# pyright: reportAttributeAccessIssue=false
"""Export a policy to ONNX: the network with its observation normalisation, and all that is needed to run it elsewhere."""

import contextlib
import json
import logging
import os
import warnings
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import mujoco
import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch import Tensor, nn

from telebip import __version__
from telebip.config import to_yaml
from telebip.errors import UserError
from telebip.mdp.observations import LAYOUT
from telebip.rl.checkpoint import Checkpoint
from telebip.rl.onnx import INPUT, OUTPUT, OnnxPolicy, set_metadata
from telebip.rl.policy import load_network
from telebip.rl.run import git_revision
from telebip.rl.symmetry import Canonical, SymmetricPolicy
from telebip.robot import JOINTS, Robot, load_robot

TOLERANCE = 1e-5
"""Largest difference between the actions of ONNX and torch that an export may show [-]; see `largest_difference`."""

OBSERVATION_UNITS = {
    "joint_pos": "relative to nominal_pose, in joint_unit",
    "joint_vel": "joint_unit per second",
    "last_action": "output of the previous step",
    "base_lin_vel": "m/s, velocity of the trunk's frame (midway between the hips), in that frame",
    "base_ang_vel": "rad/s, in the trunk's frame",
    "base_quat": "w x y z with w >= 0, trunk relative to the reference heading",
    "command": "m/s forward, m/s left, rad/s",
    "phase": "sin(2 pi t / gait_period) and its negative, t since the start",
}


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
    partial = path.with_name(path.name + ".partial")
    try:
        partial.write_bytes(content)
        os.replace(partial, path)
    except OSError as error:
        raise UserError(f"cannot write '{path}': {error.strerror or error}") from error
    return difference


def describe(checkpoint: Checkpoint, robot: Robot) -> dict[str, Any]:
    """Return what one has to know to run the policy on a robot or in another simulator. Lists follow `joint_names`."""
    config, model = checkpoint.config, robot.model
    slides = [model.joint(name).type[0] == mujoco.mjtJoint.mjJNT_SLIDE for name in JOINTS]
    scale = asdict(config.action)
    return {
        "task": checkpoint.task,
        "joint_names": list(JOINTS),
        "joint_unit": ["m" if slide else "rad" for slide in slides],
        "nominal_pose": robot.nominal.tolist(),
        "action_scale": [scale[name.split("_", 1)[1]] for name in JOINTS],  # joint target = nominal + scale * action
        "stiffness": model.actuator_gainprm[:, 0].tolist(),
        "damping": (-model.actuator_biasprm[:, 2]).tolist(),
        "force_limit": robot.force_limit.tolist(),
        "force_unit": ["N" if slide else "N m" for slide in slides],  # stiffness and damping: per joint_unit, per joint_unit/s
        # The network takes SI units as they are (scale 1); its normalisation is inside.
        "observation": [
            {"name": name, "size": size, "scale": 1.0, "unit": OBSERVATION_UNITS[name]} for name, size in LAYOUT.items()
        ],
        "physics_dt": robot.physics_dt,  # s
        "step_dt": robot.physics_dt * config.sim.decimation,  # s
        "gait_period": config.gait.period,  # s
        "command_range": {name: list(getattr(config.command, name)) for name in ("lin_vel_x", "lin_vel_y", "ang_vel_z")},
        "heading_gain": config.command.heading_gain,  # 1/s
        "heading_limit": config.command.heading_limit,  # rad/s
        "iteration": checkpoint.iteration,
        "samples": checkpoint.samples,
        "telebip_version": __version__,
        "git_revision": git_revision(),
        "training_git_revision": _training_revision(checkpoint.path.parent),
        "config": to_yaml(config),
    }


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
    """`SymmetricPolicy` on plain tensors."""

    def __init__(self, network: nn.Module, canonical: Canonical) -> None:
        super().__init__()
        self.network, self.canonical = network, canonical

    def forward(self, obs: Tensor) -> Tensor:
        seen, mirrored = self.canonical.observe(obs)
        return self.canonical.act(self.network(seen), mirrored)


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
