"""How the heading hold bends the velocity command."""

import math

import pytest
import torch

from telebip.mdp.commands import hold_heading


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
