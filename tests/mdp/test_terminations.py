"""When an episode ends."""

import math

import pytest
import torch

from telebip.mdp.terminations import fallen, non_finite, timed_out
from telebip.sim.base import SimState


def standing(num_envs: int) -> SimState:
    state = SimState.zeros(num_envs, torch.device("cpu"))
    state.qpos[:, 2], state.qpos[:, 3] = 0.66, 1.0
    return state


def test_fallen_is_hips_below_the_height_alone() -> None:
    state = standing(4)
    state.qpos[:, 2] = torch.tensor([0.66, 0.41, 0.39, -0.1])
    state.qpos[0, :2] = -5.0  # where it stands does not matter
    assert fallen(state, 0.4).tolist() == [False, False, True, True]


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("part", ["qpos", "qvel", "foot_force", "joint_force", "joint_power", "joint_net_power"])
def test_non_finite_flags_exactly_the_bad_worlds(part: str, value: float) -> None:
    state = standing(5)
    buffer = getattr(state, part)
    buffer[1, 0] = value
    buffer[3, -1] = value
    assert non_finite(state).tolist() == [False, True, False, True, False]


def test_infinities_of_both_signs_do_not_cancel() -> None:
    state = standing(2)
    state.qvel[1, :2] = torch.tensor([math.inf, -math.inf])
    assert non_finite(state).tolist() == [False, True]


def test_ordinary_states_are_finite() -> None:
    state = standing(64)
    for part in (state.qpos, state.qvel, state.foot_force, state.joint_force, state.joint_power, state.joint_net_power):
        part.normal_(0.0, 1e6, generator=torch.Generator().manual_seed(0))
    assert not non_finite(state).any()


def test_time_is_up_at_the_last_step() -> None:
    assert timed_out(torch.tensor([0, 499, 500, 501]), 500).tolist() == [False, False, True, True]
