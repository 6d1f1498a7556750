"""From a controller's name to a policy that walks an environment's robots, and to the observations that it needs."""

from collections.abc import Sequence
from dataclasses import replace

from telebip.config import TaskConfig
from telebip.control import alip, dcm
from telebip.control.config import load_controller
from telebip.control.walker import ESTIMATE, Walker
from telebip.env import TelebipEnv
from telebip.errors import UserError, nearest
from telebip.mdp.term import ObservationGroup

PLACEMENTS = {"alip": alip.foot_placement, "dcm": dcm.foot_placement}


def with_estimate(cfg: TaskConfig) -> TaskConfig:
    """Return the task with the group of observations that the walkers read, `estimate`.

    Each of its terms has the noise that the group `policy` has for it, and none where that group lacks it.
    """
    policy = cfg.observations["policy"]
    noise = {params.get("term", name): params.get("noise", 0.0) for name, params in policy.terms.items()}
    terms = {name: {"noise": noise.get(name, 0.0)} for name in ESTIMATE}
    estimate = ObservationGroup(terms, noise=policy.noise, loss=policy.loss)
    return replace(cfg, observations={**cfg.observations, "estimate": estimate})


def make_controller(name: str, env: TelebipEnv, overrides: Sequence[str] = ()) -> Walker:
    """Return a model-based walker for all worlds of `env`, at its rate and on its device.

    Args:
        name: one of `PLACEMENTS`, with its parameters in `configs/control/<name>.yaml`.
        env: whose robot walks; of a task that `with_estimate` has returned.
        overrides: `control.key=value`, see `configs/control/walker.yaml`.

    Raises:
        UserError: unknown name, bad override, or a robot whose legs the walkers cannot use.
    """
    if name not in PLACEMENTS:
        raise UserError(f"unknown controller '{name}'; {nearest(name, PLACEMENTS)}")
    return Walker(load_controller(name, overrides), PLACEMENTS[name], env)
