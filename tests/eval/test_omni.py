"""Commands in all directions: which are walked, and how what is measured is counted."""

import math
from typing import Any

import numpy as np
import pytest

from telebip.eval.omni import LIMITS, OmniProtocol, _row, fastest, ladder

PROTOCOL = OmniProtocol()


def test_the_grid_spans_the_ranges_and_holds_every_combination() -> None:
    grid = PROTOCOL.grid
    assert len(set(grid)) == 7 * 5 * 5
    assert [(min(column), max(column)) for column in zip(*grid, strict=True)] == [(-0.6, 1.2), (-0.4, 0.4), (-0.8, 0.8)]


def test_the_circle_starts_forward_and_goes_left() -> None:
    circle = OmniProtocol(directions=4, direction_speed=0.5).circle
    np.testing.assert_allclose(circle, [(0.5, 0, 0), (0, 0.5, 0), (-0.5, 0, 0), (0, -0.5, 0)], atol=1e-12)


def test_random_commands_are_of_the_grids_ranges_and_the_same_every_time() -> None:
    commands = PROTOCOL.random_commands()
    assert len(commands) == 40
    assert commands == PROTOCOL.random_commands() != OmniProtocol(seed=2).random_commands()
    assert (np.abs(commands) <= [1.2, 0.4, 0.8]).all()
    assert min(vx for vx, _, _ in commands) >= -0.6


def test_a_ladder_goes_up_in_even_steps() -> None:
    np.testing.assert_allclose(ladder("backward")[:3], [(-0.1, 0, 0), (-0.2, 0, 0), (-0.3, 0, 0)], atol=1e-12)
    np.testing.assert_allclose(ladder("turn_left")[-1], (0.0, 0.0, 3.0))
    assert PROTOCOL.num_envs == 16 * (175 + 3 + 12 + sum(len(ladder(name)) for name in LIMITS) + 20)


def row(command: tuple[float, float, float], error: float = 0.0, falls: int = 0) -> dict[str, Any]:
    name = "yaw_rate_error_radps" if command[2] else "lin_vel_error_mps"
    return {"command": list(command), "lin_vel_error_mps": 0.0, "yaw_rate_error_radps": 0.0, "falls": falls} | {name: error}


def test_the_fastest_is_the_last_before_the_first_that_is_not_followed() -> None:
    followed = [row((-0.5, 0.0, 0.0), 0.049), row((-1.0, 0.0, 0.0), 0.099)]
    assert fastest(followed) == 1.0
    assert fastest([*followed, row((-1.5, 0.0, 0.0), 0.16), row((-2.0, 0.0, 0.0))]) == 1.0  # off by more than a tenth
    assert fastest([*followed, row((-1.5, 0.0, 0.0), falls=1), row((-2.0, 0.0, 0.0))]) == 1.0
    assert fastest([row((0.0, 0.0, 1.0), math.nan, falls=16)]) == 0.0
    assert fastest([row((0.0, 0.0, 1.0), 0.09)]) == 1.0


def test_a_row_by_hand() -> None:
    velocity = np.array([[0.4, 0.03, 0.5], [0.34, 0.0, 0.46], [9.0, 9.0, 9.0]])
    result = _row((0.4, 0.0, 0.5), velocity, np.array([0.2, 0.1, 9.0]), np.array([False, False, True]))
    assert (result["command"], result["falls"], result["worlds"]) == ([0.4, 0.0, 0.5], 1, 3)
    assert result["mean"] == pytest.approx([0.37, 0.015, 0.48])  # of those that did not fall
    assert result["lin_vel_error_mps"] == pytest.approx((0.03 + 0.06) / 2)
    assert result["yaw_rate_error_radps"] == pytest.approx((0.0 + 0.04) / 2)
    assert result["power_mps"] == pytest.approx(0.15)
    assert result["cot_mechanical"] == pytest.approx(0.15 / ((math.hypot(0.4, 0.03) + 0.34) / 2), abs=1e-5)


def test_turning_in_place_has_no_cost_of_transport_and_all_fallen_no_error() -> None:
    still = _row((0.0, 0.0, 0.5), np.zeros((1, 3)), np.array([0.1]), np.array([False]))
    assert math.isnan(still["cot_mechanical"])
    assert still["yaw_rate_error_radps"] == pytest.approx(0.5)
    fallen = _row((0.4, 0.0, 0.0), np.zeros((1, 3)), np.array([0.1]), np.array([True]))
    assert math.isnan(fallen["lin_vel_error_mps"])
