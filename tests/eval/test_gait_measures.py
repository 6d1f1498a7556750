"""The rhythm of the feet: synthetic forces with known answers."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from telebip.eval.gait import rhythm, summarise_gait, symmetry_index

STEP_DT, WEIGHT = 0.02, 130.0  # s, N


def period_of(foot_force: NDArray[np.floating], step_dt: float) -> float:
    return rhythm(foot_force, step_dt)[0]


def feet(period: float, steps: int = 500) -> NDArray[np.floating]:
    """Return ground forces of two feet that carry the robot in turn, (steps, 1, 2)."""
    swing = np.sin(2.0 * np.pi * STEP_DT * np.arange(steps) / period)
    return 65.0 * np.stack([1.0 + swing, 1.0 - swing], axis=-1)[:, None]


@pytest.mark.parametrize("period", [0.5, 0.6, 0.75])
def test_gait_period_is_one_stride(period: float) -> None:
    assert period_of(feet(period), STEP_DT) == pytest.approx(period, abs=1e-3)


@pytest.mark.parametrize("period", [0.48, 0.6])
def test_gait_period_of_feet_that_are_on_or_off(period: float) -> None:
    right = (np.arange(500) * STEP_DT % period < 0.5 * period - 1e-9)[:, None]
    assert period_of(130.0 * np.stack([right, ~right], axis=-1), STEP_DT) == pytest.approx(period, abs=1e-3)


def test_gait_period_needs_a_rhythm_and_two_periods() -> None:
    assert math.isnan(period_of(np.full((500, 2, 2), 65.0), STEP_DT))
    assert math.isnan(period_of(np.random.default_rng(0).normal(65.0, 30.0, (500, 2, 2)), STEP_DT))
    assert math.isnan(period_of(feet(0.5, steps=40), STEP_DT))  # 0.8 s


def pulses(period: float, shift: float = 0.5, left: float = 1.0, steps: int = 1000) -> NDArray[np.floating]:
    """Return a half-sine pulse of one foot each period, and of the left foot `shift` periods later, `left` times as high."""
    turns = STEP_DT * np.arange(steps) / period

    def pulse(turns: NDArray[np.floating]) -> NDArray[np.floating]:
        return 260.0 * np.clip(np.sin(2.0 * np.pi * turns), 0.0, None)

    return np.stack([pulse(turns), left * pulse(turns - shift)], axis=-1)[:, None]


@pytest.mark.parametrize("period", [0.5, 0.6])  # half of 0.5 s is not a whole number of samples
def test_feet_that_do_the_same_half_a_period_later_are_symmetric(period: float) -> None:
    assert symmetry_index(pulses(period), period, STEP_DT) == pytest.approx(1.0, abs=2e-3)
    assert rhythm(pulses(period), STEP_DT) == pytest.approx((period, 1.0), abs=2e-3)


def test_a_lighter_foot_a_late_foot_and_a_lame_foot_are_less_symmetric() -> None:
    lighter = symmetry_index(pulses(0.5, left=0.5), 0.5, STEP_DT)
    assert lighter == pytest.approx(2 * 0.5 / (1 + 0.25), abs=2e-3)  # 2 a b / (a^2 + b^2)
    assert symmetry_index(pulses(0.5, shift=0.6), 0.5, STEP_DT) < 0.9
    assert symmetry_index(pulses(0.5, left=0.0), 0.5, STEP_DT) == pytest.approx(0.0, abs=1e-6)
    assert symmetry_index(pulses(0.5, shift=0.0), 0.5, STEP_DT) < 0.3  # hopping on both feet


def test_regularity_falls_with_what_differs_from_stride_to_stride() -> None:
    generator = np.random.default_rng(0)
    clean = pulses(0.5, steps=2000)
    alternating = np.diff(clean, axis=-1)
    noise = generator.normal(0.0, alternating.std() / math.sqrt(2), clean.shape)  # of the difference: as strong as the signal
    assert rhythm(clean + noise, STEP_DT)[1] == pytest.approx(0.5, abs=0.05)  # signal / (signal + noise)


def test_gait_of_feet_that_are_on_or_off() -> None:
    step = np.arange(1000) % 25
    phase = step / 25
    right = np.where(step < 15, 100.0, 0.0)
    left = np.where((step + 12) % 25 < 15, 100.0, 0.0)
    knees = 0.04 + 0.03 * np.sin(2.0 * np.pi * phase)
    summary = summarise_gait(
        np.stack([right, left], -1)[:, None], np.stack([knees, knees], -1)[:, None], 0.7, 100.0, STEP_DT, clock=0.5
    )
    assert summary["period_s"] == pytest.approx(0.5, abs=1e-3)
    assert summary["duty_factor"] == pytest.approx(15 / 25)
    assert summary["double_support"] == pytest.approx(5 / 25)
    assert summary["flight"] == 0.0
    assert summary["peak_force_bw"] == pytest.approx(1.0)
    assert summary["stride_length_m"] == pytest.approx(0.35, abs=1e-3)
    assert summary["knee_stroke_m"] == pytest.approx(0.06, abs=1e-3)


def test_a_robot_without_prismatic_knees_has_no_stroke() -> None:
    summary = summarise_gait(feet(0.5), np.zeros((500, 1, 0)), 0.7, WEIGHT, STEP_DT, clock=0.5)
    assert math.isnan(summary["knee_stroke_m"])
    assert summary["period_s"] == pytest.approx(0.5, abs=1e-3)
