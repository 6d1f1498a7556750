"""What a training switches on little by little."""

import math

import pytest
import torch

from telebip.mdp.curriculum import progress


def share_at(samples: float, between: tuple[float, float]) -> float:
    return float(progress(torch.tensor(samples), between))


@pytest.mark.parametrize(
    ("samples", "expected"), [(0.0, 0.0), (4e6, 0.0), (5e6, 0.25), (7e6, 0.75), (8e6, 1.0), (1e9, 1.0), (math.inf, 1.0)]
)
def test_a_share_is_linear_between_its_ends(samples: float, expected: float) -> None:
    assert share_at(samples, (4e6, 8e6)) == pytest.approx(expected)


def test_a_ramp_of_no_length_is_a_step() -> None:
    assert share_at(0.0, (0.0, 0.0)) == 1.0
    assert (share_at(3e6 - 1, (3e6, 3e6)), share_at(3e6, (3e6, 3e6))) == (0.0, 1.0)
