"""From a controller's name to a policy that walks an environment's robots."""

from collections.abc import Sequence

import torch

from telebip.control import alip, dcm
from telebip.control.config import load_controller
from telebip.control.kinematics import Kinematics
from telebip.control.walker import Walker
from telebip.env import TelebipEnv
from telebip.errors import UserError, nearest
from telebip.mdp.actions import action_scale

PLACEMENTS = {"alip": alip.foot_placement, "dcm": dcm.foot_placement}


def make_controller(name: str, env: TelebipEnv, overrides: Sequence[str] = ()) -> Walker:
    """Return a model-based walker for all worlds of `env`, at its rate and on its device.

    Args:
        name: one of `PLACEMENTS`, with its parameters in `configs/control/<name>.yaml`.
        env: whose robot walks.
        overrides: `control.key=value`, see `configs/control/walker.yaml`.

    Raises:
        UserError: unknown name, bad override, or a robot whose legs the walkers cannot use.
    """
    if name not in PLACEMENTS:
        raise UserError(f"unknown controller '{name}'; {nearest(name, PLACEMENTS)}")
    return Walker(
        load_controller(name, overrides),
        PLACEMENTS[name],
        Kinematics(env.robot, env.device),
        nominal=torch.as_tensor(env.robot.nominal, dtype=torch.float32, device=env.device),
        action_scale=action_scale(env.cfg.action).to(env.device),
        num_envs=env.num_envs,
        step_dt=env.step_dt,
    )
