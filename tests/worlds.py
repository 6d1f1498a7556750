"""What tests do to worlds: act, observe, put robots into states."""

from collections.abc import Callable

import torch
from torch import Tensor

from telebip.env import TelebipEnv

MakeEnv = Callable[..., TelebipEnv]
"""Of the fixture `make_env`."""

NEVER_FALL = "episode.min_hip_height=0"
PHASE, LAST_ACTION = slice(31, 33), slice(12, 18)


def random_actions(steps: int, num_envs: int, scale: float = 1.0, seed: int = 0) -> Tensor:
    return scale * torch.randn(steps, num_envs, 6, generator=torch.Generator().manual_seed(seed))


def observe(env: TelebipEnv) -> Tensor:
    return env.get_observations()["policy"]


def put(env: TelebipEnv, worlds: list[int], qpos: Tensor, qvel: Tensor) -> None:
    """Put the listed worlds into rows of `qpos` and `qvel`."""
    mask = torch.zeros(env.num_envs, dtype=torch.bool)
    mask[worlds] = True
    env.sim.reset(mask, qpos, qvel)


def put_low(env: TelebipEnv, worlds: list[int]) -> None:
    """Put the hips of the listed worlds at 0.3 m, below the 0.4 m that count as a fall."""
    qpos = env.sim.state.qpos.clone()
    qpos[:, 2] = 0.3
    put(env, worlds, qpos, torch.zeros(env.num_envs, 12))
