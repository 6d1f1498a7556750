"""From a checkpoint to a policy."""

from collections.abc import Sequence

import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict

from telebip.config.schema import SimConfig
from telebip.control.policy import Policy
from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.rl.checkpoint import Checkpoint
from telebip.rl.layout import described, obs_groups, width
from telebip.rl.networks import actor_cfg
from telebip.rl.onnx import OnnxPolicy
from telebip.rl.symmetry import Canonical, SymmetricPolicy
from telebip.robot import Robot
from telebip.robot_record import describe_robot, differences, obstacles


def load_policy(checkpoint: Checkpoint, device: str | torch.device) -> Policy:
    """Return the checkpoint's deterministic policy: torch's network, or onnxruntime's where the checkpoint is an ONNX file.

    Raises:
        UserError: the weights do not fit the configuration they came with.
    """
    if checkpoint.is_onnx:
        return OnnxPolicy(checkpoint.path, device)
    return load_network(checkpoint, device)


def load_network(checkpoint: Checkpoint, device: str | torch.device = "cpu") -> MLPModel | SymmetricPolicy:
    """Return the checkpoint's network in evaluation mode.

    Raises:
        UserError: it is an ONNX file, or the weights do not fit the configuration they came with.
    """
    if checkpoint.is_onnx:
        raise UserError(f"'{checkpoint.path}' is an ONNX file already; export needs a checkpoint (.pt) or a run folder")
    config, layout = checkpoint.config, {"policy": checkpoint.observations["policy"]}
    obs = TensorDict({"policy": torch.zeros(1, width(layout, config, "policy"))}, batch_size=[1])
    actor = MLPModel(obs, obs_groups(layout), "actor", len(checkpoint.joint_names), **actor_cfg(config.ppo))
    try:
        actor.load_state_dict(checkpoint.policy_weights)
    except (RuntimeError, KeyError, TypeError, AttributeError) as error:
        raise UserError(f"checkpoint '{checkpoint.path}': its weights do not fit its configuration") from error
    policy = actor
    if config.ppo.symmetry == "phase":
        policy = SymmetricPolicy(actor, Canonical(config, layout, checkpoint.joint_mirror))
    return policy.to(device).eval()


def require_robot(checkpoint: Checkpoint, sim: SimConfig, robot: Robot, allow_robot_change: bool = False) -> list[str]:
    """Refuse a robot that the checkpoint's policy cannot mean: with other joints, or moved at another rate.

    Args:
        checkpoint: of the policy.
        sim: names the robot, and says how many physics steps a policy step has.
        robot: the robot.
        allow_robot_change: whether it may be another one nevertheless, as long as it has as many joints.

    Returns:
        In what it differs from the robot trained on, a line each.

    Raises:
        UserError: it is such a robot.
    """
    theirs, own = checkpoint.robot_record, describe_robot(robot, sim.decimation)
    reasons = obstacles(theirs, own)
    fits = len(theirs["joint_names"]) == len(own["joint_names"])
    if reasons and not (fits and allow_robot_change):
        raise UserError(
            f"checkpoint '{checkpoint.path}' was trained on another robot than '{sim.robot}': {'; '.join(reasons)}"
            + "; go on with --allow-robot-change" * fits
        )
    return differences(theirs, own)


def require_fit(
    checkpoint: Checkpoint, env: TelebipEnv, groups: Sequence[str] = ("policy",), allow_robot_change: bool = False
) -> None:
    """Refuse an environment in which the checkpoint's networks would see or move something else than they have learned with.

    Raises:
        UserError: the robot is another one, see `require_robot`, or what is in one of `groups`.
    """
    require_robot(checkpoint, env.cfg.sim, env.robot, allow_robot_change)
    for group in groups:
        seen, given = (
            described(layout, config, group)
            for layout, config in ((checkpoint.observations, checkpoint.config), (env.layout(), env.cfg))
        )
        if seen != given:
            raise UserError(f"checkpoint '{checkpoint.path}' sees observations.{group} as {seen}; here it is {given}")
