"""Whether a training can go on from a checkpoint, and what of it the learner takes over."""

from rsl_rl.algorithms import PPO

from telebip.config.schema import PpoConfig
from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.rl.checkpoint import Checkpoint, robot_properties
from telebip.rl.layout import seen
from telebip.rl.policy import require_fit


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


def require_same(checkpoint: Checkpoint, env: TelebipEnv) -> None:
    """Refuse a checkpoint whose networks saw something else than those of `env` will, or on another robot.

    Raises:
        UserError: it is one.
    """
    require_fit(checkpoint, env, list(seen(env.layout())))
    own = robot_properties(env.robot)
    for name, value in checkpoint.robot.items():
        if own.get(name) != value:
            raise UserError(
                f"checkpoint '{checkpoint.path}' was trained on another robot than '{env.cfg.sim.robot}': its {name} is "
                f"{value}, not {own.get(name)}"
            )


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
