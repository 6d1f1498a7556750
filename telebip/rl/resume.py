"""Whether a training can go on from a checkpoint, and what of it the learner takes over."""

from rsl_rl.algorithms import PPO

from telebip.config.schema import PpoConfig
from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.rl.checkpoint import Checkpoint
from telebip.rl.layout import seen
from telebip.rl.policy import require_fit, require_robot


def require_complete(checkpoint: Checkpoint) -> None:
    """Refuse a checkpoint of a policy alone, and one of a task with terms that are not there.

    Raises:
        UserError: it is one.
    """
    if "optimizer_state_dict" not in checkpoint.learner:
        raise UserError(f"checkpoint '{checkpoint.path}' holds the policy alone; resume from a model_<iteration>.pt")
    if checkpoint.missing:
        raise UserError(
            f"checkpoint '{checkpoint.path}' cannot be resumed without {', '.join(checkpoint.missing)}: go on with the program "
            "that defines them, as the run was started"
        )


def require_same(checkpoint: Checkpoint, env: TelebipEnv, allow_robot_change: bool = False) -> list[str]:
    """Refuse a checkpoint whose networks saw something else than those of `env` will, or on another robot.

    A run goes on bit for bit, so that any difference of the robot is refused, unless `allow_robot_change`.

    Returns:
        In what the robots differ, a line each.

    Raises:
        UserError: it is one.
    """
    found = require_robot(checkpoint, env.cfg.sim, env.robot, allow_robot_change)
    if found and not allow_robot_change:
        more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
        raise UserError(
            f"checkpoint '{checkpoint.path}' was trained on another robot than '{env.cfg.sim.robot}': {found[0]}{more}; go on "
            "with --allow-robot-change"
        )
    require_fit(checkpoint, env, list(seen(env.layout())), allow_robot_change)
    return found


def load_learner(learner: PPO, checkpoint: Checkpoint, ppo: PpoConfig) -> None:
    """Give a learner the checkpoint's networks and optimiser, and its learning rate unless `ppo` asks for another one.

    Raises:
        UserError: the networks are others.
    """
    try:
        learner.load(checkpoint.learner, load_cfg=None, strict=True)
    except (RuntimeError, KeyError, ValueError) as error:
        raise UserError(f"checkpoint '{checkpoint.path}' cannot be resumed: {' '.join(str(error).split())[:120]}") from error
    before = checkpoint.config.ppo
    if (ppo.learning_rate, ppo.schedule) != (before.learning_rate, before.schedule):
        learner.learning_rate = ppo.learning_rate
        for group in learner.optimizer.param_groups:
            group["lr"] = ppo.learning_rate
