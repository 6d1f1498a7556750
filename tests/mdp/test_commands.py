"""Velocity commands: what is drawn, and how the heading hold bends it."""

import math

import pytest
import torch

from telebip.config import CommandConfig
from telebip.mdp.commands import hold_heading, sample_commands

RANGES = CommandConfig(
    lin_vel_x=(0.4, 1.0),
    lin_vel_y=(-0.1, -0.1),
    ang_vel_z=(-0.2, 0.2),
    resampling_time=5.0,
    heading_gain=1.0,
    heading_limit=0.3,
)


def draw(seed: int, num_envs: int = 4096) -> torch.Tensor:
    return sample_commands(num_envs, RANGES, torch.Generator().manual_seed(seed))


def corrected(heading: float, reference: float, gain: float = 1.0, limit: float = 0.3) -> float:
    """The yaw rate that a straight command becomes [rad/s]."""
    command = torch.tensor([[0.7, 0.1, 0.0]])
    return hold_heading(command, torch.tensor([heading]), torch.tensor([reference]), gain, limit)[0, 2].item()


def test_commands_fill_their_ranges_and_stay_inside() -> None:
    commands = draw(seed=0)
    assert commands.shape == (4096, 3)
    for column, (low, high) in zip(commands.T, (RANGES.lin_vel_x, RANGES.lin_vel_y, RANGES.ang_vel_z), strict=True):
        assert low - 1e-6 <= column.min().item() <= low + 0.01 * (high - low) + 1e-6
        assert high - 0.01 * (high - low) - 1e-6 <= column.max().item() <= high + 1e-6
        assert column.mean().item() == pytest.approx((low + high) / 2, abs=0.02)


def test_components_are_drawn_independently() -> None:
    commands = draw(seed=0)
    correlation = torch.corrcoef(commands[:, [0, 2]].T)[0, 1]
    assert abs(correlation.item()) < 0.05


def test_same_seed_same_commands() -> None:
    assert torch.equal(draw(seed=3), draw(seed=3))
    assert not torch.equal(draw(seed=3), draw(seed=4))


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
