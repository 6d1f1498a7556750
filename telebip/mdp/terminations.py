"""When an episode ends, besides its time limit."""

from typing import Annotated

import torch
from torch import Tensor

from telebip.mdp.step import Step
from telebip.mdp.term import Quantity, termination
from telebip.sim.base import SimState


@termination
def fallen(step: Step, *, min_hip_height: Annotated[float, Quantity("m", ge=0)]) -> Tensor:
    """Whether the hips are lower than `min_hip_height` [m] above the ground: bool, (num_envs,)."""
    return step.base_height < min_hip_height


@termination
def tilted(step: Step, *, max_tilt: Annotated[float, Quantity("rad", gt=0, le=3.2)]) -> Tensor:
    """Whether the trunk leans by more than `max_tilt` [rad] in any direction: bool, (num_envs,)."""
    return torch.acos((-step.projected_gravity[:, 2]).clamp(-1.0, 1.0)) > max_tilt


def non_finite(state: SimState) -> Tensor:
    """Whether a world's position, velocity or forces hold a NaN or an infinity: bool, (num_envs,). Always a fault."""
    parts = (state.qpos, state.qvel, *state.step_values.values())
    return ~torch.stack([part.sum(1) for part in parts]).isfinite().all(0)
