"""What a training switches on little by little."""

import pytest

from telebip.mdp.curriculum import ramp


@pytest.mark.parametrize(("samples", "share"), [(0, 0.0), (4e6, 0.0), (5e6, 0.25), (7e6, 0.75), (8e6, 1.0), (1e9, 1.0)])
def test_ramp_is_linear_between_its_ends(samples: float, share: float) -> None:
    assert ramp(samples, (4e6, 8e6)) == pytest.approx(share)


def test_a_ramp_of_no_length_is_a_step() -> None:
    assert ramp(0, (0.0, 0.0)) == 1.0
    assert (ramp(3e6 - 1, (3e6, 3e6)), ramp(3e6, (3e6, 3e6))) == (0.0, 1.0)
