"""Interquartile means and intervals, by hand, and what the intervals really cover."""

import math

import numpy as np
import pytest
from scipy.stats import trim_mean

from telebip.eval.statistics import bootstrap_interval, estimate, interquartile_mean, share_interval


@pytest.mark.parametrize(
    ("scores", "mean"),
    [
        ([7.0], 7.0),
        ([1.0, 2.0, 9.0], 4.0),  # too few to leave any out
        ([0.0, 1.0, 2.0, 99.0], 1.5),
        ([5.0, 1.0, 2.0, 3.0, 900.0], 10.0 / 3.0),  # the middle three
        ([8.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0], 4.5),
    ],
)
def test_the_interquartile_mean_leaves_out_a_quarter_at_each_end(scores: list[float], mean: float) -> None:
    assert interquartile_mean(scores) == pytest.approx(mean)


def test_several_tasks_are_pooled_and_resampled_each_for_itself() -> None:
    low, high = [0.0, 0.0, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0]
    assert interquartile_mean(low, high) == 0.5
    assert bootstrap_interval(low, high) == (0.5, 0.5)  # drawn from both together, the mean would vary
    first, last = bootstrap_interval([*low, *high])
    assert (first, last) == (0.0, 1.0)


def test_the_interval_is_that_of_all_resamples_of_five() -> None:
    """Five values have 5^5 = 3125 resamples, all as likely."""
    scores = np.array([0.1, 0.4, 0.5, 0.9, 1.6])
    draws = np.stack(np.meshgrid(*[np.arange(5)] * 5), axis=-1).reshape(-1, 5)
    exact = np.percentile(trim_mean(scores[draws], 0.25, axis=1), [2.5, 97.5])
    assert bootstrap_interval(scores.tolist()) == pytest.approx(exact.tolist(), abs=0.03)


def test_one_or_two_seeds_have_no_interval() -> None:
    assert estimate([0.5]).value == 0.5
    assert math.isnan(estimate([0.5]).low)
    assert math.isnan(estimate([0.5, 0.7]).high)
    assert math.isnan(estimate([]).value)
    found = estimate([0.5, 0.6, 0.7])
    assert (found.value, found.low, found.high) == pytest.approx((0.6, 0.5, 0.7))
    assert found.seeds == 3


@pytest.mark.parametrize(
    ("successes", "number", "low", "high"),
    [(64, 64, 0.9434, 1.0), (0, 64, 0.0, 0.0566), (61, 64, 0.8710, 0.9839), (5, 10, 0.2366, 0.7634)],
)
def test_wilson_s_interval(successes: int, number: int, low: float, high: float) -> None:
    """64 of 64: 64 / (64 + z^2); 5 of 10 is in many textbooks."""
    assert share_interval(successes, number) == pytest.approx((low, high), abs=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize(("seeds", "normal", "outlier"), [(3, 0.75, 0.75), (5, 0.90, 0.90), (10, 0.93, 0.93), (20, 0.94, 0.95)])
def test_the_interval_covers_as_often_as_the_documentation_says(seeds: int, normal: float, outlier: float) -> None:
    """Populations: normal, and one in which every fifth seed is off by five standard deviations. 1000 trials: +- 2 %."""
    rng = np.random.default_rng(0)
    for expected, off in ((normal, 0.0), (outlier, 5.0)):
        population = rng.normal(size=1_000_001) + off * (rng.random(1_000_001) < 0.2)
        truth = interquartile_mean(population.tolist())
        intervals = [bootstrap_interval(rng.choice(population, seeds).tolist()) for _ in range(1000)]
        assert np.mean([low <= truth <= high for low, high in intervals]) == pytest.approx(expected, abs=0.025)
