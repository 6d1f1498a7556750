"""telebip: reinforcement learning for legged robots, on MuJoCo Warp and on plain CPUs.

    import telebip
    env = telebip.make("telebip_flat", num_envs=64)

What is listed in `__all__` is imported at its first use: `import telebip` alone touches neither torch nor an engine.
"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_PACKAGE = Path(__file__).resolve().parent

ROOT = _PACKAGE if (_PACKAGE / "configs").is_dir() else _PACKAGE.parent
"""Folder that holds `assets/` and `configs/`: the repository, or the package itself where a wheel was installed."""

if TYPE_CHECKING:
    from telebip.api import load_policy, make
    from telebip.config import TaskConfig, load_task, task_names
    from telebip.env import TelebipEnv
    from telebip.errors import UserError
    from telebip.mdp.step import Step
    from telebip.mdp.term import Quantity, event, observation, reward, termination
    from telebip.rl.train import Trainer
    from telebip.robot import Robot, load_robot
    from telebip.rollout import Rollout, roll_out

_HOMES = {
    "api": ("load_policy", "make"),
    "config": ("TaskConfig", "load_task", "task_names"),
    "env": ("TelebipEnv",),
    "errors": ("UserError",),
    "mdp.step": ("Step",),
    "mdp.term": ("Quantity", "event", "observation", "reward", "termination"),
    "rl.train": ("Trainer",),
    "robot": ("Robot", "load_robot"),
    "rollout": ("Rollout", "roll_out"),
}
"""Module -> the public names that it has."""

__all__ = [
    "Quantity",
    "Robot",
    "Rollout",
    "Step",
    "TaskConfig",
    "TelebipEnv",
    "Trainer",
    "UserError",
    "event",
    "load_policy",
    "load_robot",
    "load_task",
    "make",
    "observation",
    "reward",
    "roll_out",
    "task_names",
    "termination",
]


def __getattr__(name: str) -> Any:
    for module, names in _HOMES.items():
        if name in names:
            return getattr(import_module(f"telebip.{module}"), name)
    raise AttributeError(f"module 'telebip' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
