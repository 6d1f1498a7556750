"""Which commands are given, and how the holds bend them."""

import math

import pytest
import torch
from steps import fills, make_step
from worlds import NEVER_FALL, MakeEnv

from telebip.math import wrap_angle
from telebip.mdp.binding import Binder
from telebip.mdp.commands import VelocityCommands, hold_heading, hold_velocity, turn_to
from telebip.mdp.step import Step
from telebip.robot import Robot


def corrected(heading: float, reference: float, gain: float = 1.0, limit: float = 0.3) -> float:
    """The yaw rate that a straight command becomes [rad/s]."""
    command = torch.tensor([[0.7, 0.1, 0.0]])
    return hold_heading(command, torch.tensor([heading]), torch.tensor([reference]), gain, limit)[0, 2].item()


@pytest.mark.parametrize(
    ("heading", "reference", "correction"),
    [
        (0.0, 0.0, 0.0),
        (0.0, 0.1, 0.1),  # the reference lies to the left: turn left
        (0.1, 0.0, -0.1),
        (0.0, 2.0, 0.3),  # clipped
        (0.0, -2.0, -0.3),
        (3.1, -3.1, 2 * math.pi - 6.2),  # the short way round, left through pi: 0.083
        (-3.1, 3.1, 6.2 - 2 * math.pi),
        (0.5 + 4 * math.pi, 0.6, 0.1),
    ],
)
def test_heading_hold_turns_the_short_way_and_no_faster_than_its_limit(
    heading: float, reference: float, correction: float
) -> None:
    assert corrected(heading, reference) == pytest.approx(correction, abs=1e-5)


def test_gain_scales_the_correction_before_it_is_clipped() -> None:
    assert corrected(0.0, 0.1, gain=2.0) == pytest.approx(0.2)
    assert corrected(0.0, 0.1, gain=5.0) == pytest.approx(0.3)
    assert corrected(0.0, 0.1, gain=0.0) == 0.0


def test_correction_adds_to_the_yaw_rate_alone() -> None:
    command = torch.tensor([[0.7, 0.1, 0.2], [-0.5, -0.1, -0.2]])
    result = hold_heading(command, torch.tensor([0.0, 0.0]), torch.tensor([0.1, 9.0]), gain=1.0, limit=0.3)
    # 9 rad is 2.717 rad left of straight ahead, more than the limit.
    torch.testing.assert_close(result, torch.tensor([[0.7, 0.1, 0.3], [-0.5, -0.1, 0.1]]))
    torch.testing.assert_close(command, torch.tensor([[0.7, 0.1, 0.2], [-0.5, -0.1, -0.2]]))


def test_velocity_hold_makes_up_for_the_lag_within_its_limit() -> None:
    command = torch.tensor([[0.7, 0.1, 0.2], [0.7, 0.1, 0.2]])
    held = hold_velocity(command, torch.tensor([[0.1, -0.04], [1.0, -1.0]]), gain=0.5, limit=0.15)
    torch.testing.assert_close(held, torch.tensor([[0.75, 0.08, 0.2], [0.85, -0.05, 0.2]]))


def test_a_robot_that_stands_lags_behind_as_far_as_counts(make_env: MakeEnv) -> None:
    hold = ("commands.velocity_gain=0.5", "commands.velocity_limit=0.1", "commands.heading_gain=0")
    env = make_env(*hold, NEVER_FALL, "episode.length=60", calm=True)
    env.set_command(0.5, 0.0, 0.0)
    way = torch.zeros(4, 2)
    for _ in range(10):
        env.step(torch.zeros(4, 6))
        way += 0.02 * (torch.tensor([0.5, 0.0]) - env.view().base_lin_vel_b[:, :2])
    torch.testing.assert_close(env.state.command[:, :2], torch.tensor([0.5, 0.0]) + 0.5 * way)
    for _ in range(100):
        env.step(torch.zeros(4, 6))
    lag = env.state.memory["commands"]["lag"]
    assert (lag.abs() <= 0.2 + 1e-6).all()  # 0.1 m/s over 0.5 1/s
    torch.testing.assert_close(env.state.command[:, :2], torch.tensor([0.5, 0.0]) + 0.5 * lag)
    env.episode_length_buf = torch.tensor([200, env.max_episode_length - 1, 200, 200])
    env.step(torch.zeros(4, 6))  # the end of an episode ends its lag
    assert env.state.memory["commands"]["lag"][1].abs().max() < 0.02


@pytest.mark.parametrize(
    ("goal", "reference", "rate"),
    [
        (0.3, 0.0, 0.3),  # k = 1 /s
        (0.0, 0.3, -0.3),
        (2.0, 0.0, 0.8),  # as fast as is commanded at all
        (3.0, -3.0, -(2 * math.pi - 6.0)),  # the short way round, right through pi
        (-2.0, 0.0, -0.5),
    ],
)
def test_a_heading_command_turns_the_short_way_within_the_range(goal: float, reference: float, rate: float) -> None:
    turned = turn_to(torch.tensor([goal]), torch.tensor([reference]), stiffness=1.0, limits=(-0.5, 0.8))
    assert turned.item() == pytest.approx(rate, abs=1e-5)


RANGES = ((-0.6, 1.2), (-0.4, 0.4), (-0.8, 0.8))


def drawn(step: Step, standing: float = 0.0, forward: float = 0.0, heading: float = 0.0) -> VelocityCommands:
    """Commands of worlds that begin, given once."""
    binder = Binder(step)
    commands = VelocityCommands(binder, RANGES, 5.0, standing=standing, forward=forward, heading=heading, heading_stiffness=1.0)
    binder.allocate().draw(torch.Generator().manual_seed(0))
    commands.update(step)
    return commands


def test_without_shares_all_commands_fill_their_ranges(robot: Robot) -> None:
    step = make_step(robot, 4096)
    drawn(step)
    for column, (low, high) in zip(step.env.target_command.T, RANGES, strict=True):
        fills(column[:, None], low, high)
    assert step.env.random.shape == (4096, 3)
    assert not step.env.memory


def test_each_share_gets_its_kind_of_command(robot: Robot) -> None:
    step = make_step(robot, 8192)
    step.env.reference_heading.fill_(0.5)
    drawn(step, standing=0.1, forward=0.25, heading=0.4)
    vx, vy, rate = step.env.target_command.T
    standing, forward = (step.env.target_command == 0.0).all(1), (vy == 0.0) & (rate == 0.0) & (vx != 0.0)
    turning = step.env.memory["commands"]["has_heading"]
    assert not (turning & (standing | forward)).any()
    for kind, share in ((standing, 0.1), (forward, 0.25 * 0.9), (turning, 0.4 * 0.75 * 0.9)):
        assert kind.float().mean().item() == pytest.approx(share, abs=4.0 * math.sqrt(share * (1.0 - share) / 8192))
    fills(vx[forward, None], 0.0, 1.2)
    goal = step.env.memory["commands"]["heading"]
    torch.testing.assert_close(rate[turning], wrap_angle(goal - 0.5)[turning].clamp(-0.8, 0.8))
    free = ~(standing | forward | turning)
    fills(vx[free, None], -0.6, 1.2)
    fills(rate[free, None], -0.8, 0.8)


def test_straight_ahead_stays_in_a_range_that_is_all_backward(robot: Robot) -> None:
    step = make_step(robot, 64)
    binder = Binder(step)
    commands = VelocityCommands(binder, ((-0.5, -0.2), (0.0, 0.0), (0.0, 0.0)), 5.0, forward=1.0)
    binder.allocate().draw(torch.Generator().manual_seed(0))
    commands.update(step)
    torch.testing.assert_close(step.env.target_command[:, 0], torch.full((64,), -0.2))


def test_a_heading_command_is_reached_and_a_set_command_ends_it(make_env: MakeEnv) -> None:
    headings = ("commands.rel_heading_envs=1", "commands.ang_vel_z=[-0.8,0.8]", "commands.heading_control_stiffness=2")
    env = make_env(*headings, "commands.resampling_time=60", "episode.length=60", NEVER_FALL, calm=True)
    goal = env.state.memory["commands"]["heading"].clone()
    left = wrap_angle(goal - env.state.reference_heading)
    for _ in range(50):
        env.step(torch.zeros(4, 6))
    assert (wrap_angle(goal - env.state.reference_heading).abs() < left.abs()).all()
    assert (env.state.target_command[:, 2].abs() <= 0.8).all()
    for _ in range(300):
        env.step(torch.zeros(4, 6))
    torch.testing.assert_close(wrap_angle(goal - env.state.reference_heading), torch.zeros(4), atol=0.01, rtol=0.0)
    env.set_command(0.5, 0.0, 0.25)
    env.step(torch.zeros(4, 6))
    assert env.state.target_command.tolist() == [[0.5, 0.0, 0.25]] * 4
