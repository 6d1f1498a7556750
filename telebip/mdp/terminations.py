"""When an episode ends."""

import torch
from torch import Tensor

from telebip.sim.base import SimState


def fallen(state: SimState, min_hip_height: float) -> Tensor:
    """Whether the hips are below `min_hip_height` [m]: bool, (num_envs,). The trunk's frame lies midway between them."""
    return state.base_pos[:, 2] < min_hip_height


def non_finite(state: SimState) -> Tensor:
    """Whether a world's position, velocity or forces hold a NaN or an infinity: bool, (num_envs,)."""
    parts = (state.qpos, state.qvel, *state.step_means)
    return ~torch.stack([part.sum(1) for part in parts]).isfinite().all(0)


def timed_out(episode_length: Tensor, max_episode_length: int) -> Tensor:
    """Whether the episode has reached its time limit: bool, (num_envs,). The learner bootstraps the value there."""
    return episode_length >= max_episode_length
