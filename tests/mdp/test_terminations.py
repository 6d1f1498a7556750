"""When an episode ends."""

import math

import pytest
import torch
from steps import CPU, make_step, standing

from telebip.mdp.terminations import fallen, non_finite, tilted
from telebip.robot import Robot
from telebip.sim.base import SimState


def test_fallen_is_hips_below_the_height_alone(robot: Robot) -> None:
    step = make_step(robot, num_envs=4)
    step.state.qpos[:, 2] = torch.tensor([0.66, 0.41, 0.39, -0.1])
    step.state.qpos[0, :2] = -5.0  # where it stands does not matter
    assert fallen(step, min_hip_height=0.4).tolist() == [False, False, True, True]


@pytest.mark.parametrize("direction", [0.0, 0.7, 2.0, -1.2])
@pytest.mark.parametrize("heading", [0.0, 2.5])
def test_tilted_is_a_lean_of_more_than_the_angle_in_any_direction(robot: Robot, direction: float, heading: float) -> None:
    lean = torch.tensor([0.0, 0.49, 0.51, 1.5, 2.0, 3.1])
    step = make_step(robot, num_envs=6)
    # A rotation by `lean` about the horizontal axis at `direction`, after one by `heading` about z.
    a, b = lean / 2, torch.full((6,), heading / 2)
    cos, sin = math.cos(direction - heading / 2), math.sin(direction - heading / 2)
    step.state.qpos[:, 3:7] = torch.stack([a.cos() * b.cos(), a.sin() * cos, a.sin() * sin, a.cos() * b.sin()], dim=1)
    assert tilted(step, max_tilt=0.5).tolist() == [False, False, True, True, True, True]
    assert tilted(step, max_tilt=1.8).tolist() == [False, False, False, False, True, True]


def test_an_upright_robot_is_not_tilted_whatever_the_rounding(robot: Robot) -> None:
    step = make_step(robot, num_envs=2)
    step.state.qpos[:, 3] = torch.tensor([1.0 - 1e-7, 1.0 + 1e-7])
    assert tilted(step, max_tilt=0.01).tolist() == [False, False]


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("part", ["qpos", "qvel", "foot_force", "joint_force", "joint_power", "joint_net_power"])
def test_non_finite_flags_exactly_the_bad_worlds(robot: Robot, part: str, value: float) -> None:
    state = standing(robot, 5)
    buffer = getattr(state, part)
    buffer[1, 0] = value
    buffer[3, -1] = value
    assert non_finite(state).tolist() == [False, True, False, True, False]


def test_non_finite_sensors_count(robot: Robot) -> None:
    state = SimState.zeros(robot, 3, CPU, sensors=["accelerometer"])
    state.sensors["accelerometer"][1, 2] = math.nan
    assert non_finite(state).tolist() == [False, True, False]


def test_infinities_of_both_signs_do_not_cancel(robot: Robot) -> None:
    state = standing(robot, 2)
    state.qvel[1, :2] = torch.tensor([math.inf, -math.inf])
    assert non_finite(state).tolist() == [False, True]


def test_ordinary_states_are_finite(robot: Robot) -> None:
    state = standing(robot, 64)
    for part in (state.qpos, state.qvel, state.foot_force, state.joint_force, state.joint_power, state.joint_net_power):
        part.normal_(0.0, 1e6, generator=torch.Generator().manual_seed(0))
    assert not non_finite(state).any()
