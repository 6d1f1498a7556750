"""The gait clock and the window of the periodic foot reward."""

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from steps import make_world
from torch import Tensor

from telebip.mdp.gait import phase_signals, window_weights
from telebip.mdp.rewards import foot
from telebip.mdp.term import find
from telebip.robot import Robot

PERIOD, STEP_DT, WEIGHT = 0.5, 0.02, 133.416
UNCAPPED = 100.0  # body weights
HALF = math.sqrt(0.5)


def pressed(phase: Tensor, force: Tensor, weight: float) -> Any:
    """A step with these phase signals and foot forces."""
    return SimpleNamespace(phase=phase, state=SimpleNamespace(foot_force=force), world=SimpleNamespace(weight=weight))


def foot_sample(phase: Tensor, force: Tensor, weight: float, cap: float) -> Tensor:
    """The reward of a window of one sample, the newest."""
    memory = {"window": torch.zeros(len(phase), 1)}
    return foot(pressed(phase, force, weight), memory, k_foot=1.0, gamma=0.5, first="newest", cap=cap)


def walked(first_foot: int, gamma: float, first: str) -> Tensor:
    """The reward after a period in which the foot that the phase asks for (or, with 1, the other) carries all of the weight."""
    memory, reward = {"window": torch.zeros(1, 26)}, torch.zeros(1)
    for step in range(26):
        phase = phase_signals(torch.tensor([step * STEP_DT]), PERIOD)
        force = torch.zeros(1, 2)
        force[0, first_foot if phase[0, 0] > 0.0 else 1 - first_foot] = WEIGHT
        reward = foot(pressed(phase, force, WEIGHT), memory, k_foot=0.1, gamma=gamma, first=first, cap=UNCAPPED)  # type: ignore[arg-type]
    return reward


@pytest.mark.parametrize(
    ("time", "p_r"),
    [(0.0, 0.0), (PERIOD / 8, HALF), (PERIOD / 4, 1.0), (PERIOD / 2, 0.0), (3 * PERIOD / 4, -1.0), (5 * PERIOD / 4, 1.0)],
)
def test_phase_signals_are_a_sine_and_its_opposite(time: float, p_r: float) -> None:
    torch.testing.assert_close(phase_signals(torch.tensor([time]), PERIOD), torch.tensor([[p_r, -p_r]]), atol=1e-6, rtol=0.0)


def test_half_a_period_later_the_feet_have_changed_roles() -> None:
    time = torch.linspace(0.0, 2.0, 33)
    torch.testing.assert_close(
        phase_signals(time + PERIOD / 2, PERIOD), phase_signals(time, PERIOD).flip(1), atol=1e-5, rtol=0.0
    )


@pytest.mark.parametrize(("period", "samples"), [(0.5, 26), (0.6, 31)])
def test_window_holds_both_ends_of_one_period(robot: Robot, period: float, samples: int) -> None:
    memory = find("reward", "foot").memory
    assert memory is not None
    (window,) = memory(make_world(robot, num_envs=3, gait_period=period)).values()
    assert torch.equal(window, torch.zeros(3, samples))


def test_newest_sample_weighs_one_and_the_rest_fade() -> None:
    torch.testing.assert_close(window_weights(4, 0.5, "newest"), torch.tensor([1.0, 0.5, 0.25, 0.125]))


def test_read_as_the_article_prints_it_the_oldest_sample_weighs_one() -> None:
    torch.testing.assert_close(window_weights(4, 0.5, "oldest"), torch.tensor([0.125, 0.25, 0.5, 1.0]))


@pytest.mark.parametrize("first", ["newest", "oldest"])
@pytest.mark.parametrize(("gamma", "total"), [(0.8, 4.985), (0.6, 2.5), (0.95, 14.729), (1.0, 26.0)])
def test_weights_sum_to_the_geometric_series(first: str, gamma: float, total: float) -> None:
    assert window_weights(26, gamma, first).sum().item() == pytest.approx(total, abs=1e-3)


def test_foot_sample_weighs_forces_by_phase_in_body_weights() -> None:
    phase = torch.tensor([[0.5, -0.5], [0.5, -0.5], [1.0, -1.0]])
    force = torch.tensor([[200.0, 0.0], [0.0, 200.0], [60.0, 60.0]])
    torch.testing.assert_close(foot_sample(phase, force, 100.0, UNCAPPED), torch.tensor([1.0, -1.0, 0.0]))


def test_capped_forces_do_not_pay_for_pounding() -> None:
    phase = torch.tensor([[0.5, -0.5]]).expand(3, -1)
    force = torch.tensor([[10.0, 0.0], [30.0, 0.0], [350.0, 10.0]])
    torch.testing.assert_close(foot_sample(phase, force, 100.0, 0.2), torch.tensor([0.05, 0.1, 0.05]))


def test_mirroring_the_world_leaves_the_foot_sample_unchanged() -> None:
    generator = torch.Generator().manual_seed(0)
    phase, force = torch.randn(16, 2, generator=generator), 200.0 * torch.rand(16, 2, generator=generator)
    torch.testing.assert_close(
        foot_sample(phase.flip(1), force.flip(1), WEIGHT, UNCAPPED), foot_sample(phase, force, WEIGHT, UNCAPPED)
    )


def test_new_sample_enters_in_front_and_the_oldest_leaves() -> None:
    memory = {"window": torch.tensor([[3.0, 2.0, 1.0], [30.0, 20.0, 10.0]])}
    step = pressed(torch.tensor([[1.0, -1.0]]).expand(2, -1), torch.tensor([[4.0, 0.0], [40.0, 0.0]]), 1.0)
    foot(step, memory, k_foot=0.1, gamma=0.5, first="newest", cap=UNCAPPED)
    torch.testing.assert_close(memory["window"], torch.tensor([[4.0, 3.0, 2.0], [40.0, 30.0, 20.0]]))


@pytest.mark.parametrize("first", ["newest", "oldest"])
def test_walking_in_phase_pays_what_walking_out_of_phase_costs(first: str) -> None:
    in_phase = walked(0, 0.8, first)
    assert in_phase.item() > 0.2
    torch.testing.assert_close(walked(1, 0.8, first), -in_phase)


def test_perfect_stepping_without_discount_sums_the_sine_over_a_period() -> None:
    # sum over k = 0..24 of |sin(2 pi k / 25)| = cot(pi / 50) = 15.895
    assert walked(0, 1.0, "newest").item() == pytest.approx(0.1 / math.tan(math.pi / 50), rel=1e-5)


def test_standing_on_both_feet_earns_nothing() -> None:
    time = torch.arange(26) * STEP_DT
    samples = foot_sample(phase_signals(time, PERIOD), torch.full((26, 2), WEIGHT / 2), WEIGHT, UNCAPPED)
    torch.testing.assert_close(samples, torch.zeros(26))
