"""What is plotted follows the joints that a robot has."""

from dataclasses import replace
from typing import Any, get_args

import numpy as np
import pytest
import rerun.blueprint as rrb

from telebip.rollout import Rollout
from telebip.viz.blueprint import walk_layout
from telebip.viz.series import LEFT, RIGHT, Plot, Row, plots, running_cost_of_transport, split_side

NAMES = ("waist", "right_hip", "left_hip", "right_ankle", "left_ankle", "left_arm")


@pytest.fixture(scope="module")
def other(walking: Rollout) -> dict[str, Plot]:
    """Plots of a robot with other joints, of which the ankles are slides."""
    is_slide = np.array(["ankle" in name for name in NAMES])
    return plots(replace(walking, joint_names=NAMES), 1, is_slide)


@pytest.mark.parametrize(
    ("joint", "parts"),
    [
        ("right_knee", ("right", "knee")),
        ("left_hip_roll", ("left", "hip_roll")),
        ("waist", ("", "waist")),
        ("left_", ("", "left_")),
    ],
)
def test_a_joint_has_a_side_and_a_kind(joint: str, parts: tuple[str, str]) -> None:
    assert split_side(joint) == parts


def test_joints_of_both_sides_share_a_plot(other: dict[str, Plot], walking: Rollout) -> None:
    shown = {name: plot for name, plot in other.items() if plot.row == "joints"}
    assert [plot.title for plot in shown.values()] == ["waist [rad]", "hip [rad]", "ankle [m]", "arm [rad]"]
    assert list(shown["hip"].curves) == ["right", "right_target", "left", "left_target"]
    assert list(shown["waist"].curves) == ["position", "target"]
    assert list(shown["arm"].curves) == ["left", "left_target"]
    np.testing.assert_array_equal(shown["ankle"].curves["left"].values, walking.qpos[:, 1, 7 + 4])
    np.testing.assert_array_equal(shown["hip"].curves["right_target"].values, walking.joint_target[:, 1, 1])


def test_torques_of_hinges_and_forces_of_slides_are_apart(other: dict[str, Plot], walking: Rollout) -> None:
    assert list(other["torque"].curves) == ["waist", "right_hip", "left_hip", "left_arm"]
    assert list(other["force"].curves) == ["right_ankle", "left_ankle"]
    colors = [curve.color for curve in other["torque"].curves.values()]
    assert colors[1:3] == [RIGHT, LEFT]
    assert len(set(colors)) == 4
    np.testing.assert_array_equal(other["force"].curves["right_ankle"].values, walking.joint_force[:, 1, 3])


def test_a_robot_of_hinges_has_no_plot_of_forces(walking: Rollout) -> None:
    assert "force" not in plots(walking, 0, np.zeros(6, dtype=bool))


def views(part: Any) -> list[str]:
    """Return the titles of all time series below a part of a layout."""
    if isinstance(part, rrb.TimeSeriesView):
        return [str(part.name)]
    return [title for each in part.contents for title in views(each)] if isinstance(part.contents, tuple) else []


@pytest.mark.parametrize("robots", [["RL"], ["RL", "zero"]])
def test_a_layout_has_a_view_for_every_plot(other: dict[str, Plot], robots: list[str]) -> None:
    shown = views(walk_layout(robots, other).root_container)
    titles = {row: [plot.title for plot in other.values() if plot.row == row] for row in get_args(Row)}
    details = [title for row in ("gait", "joints", "effort", "reward") for title in titles[row]]
    assert shown == [*titles["motion"], *titles["cost"], *details * len(robots)]


def test_the_cost_of_transport_is_of_the_last_window() -> None:
    power, velocity = np.array([0.0, 10.0, 20.0, 30.0]), np.array([[0.5, 0.0]] * 3 + [[1.5, 0.0]])
    cost = running_cost_of_transport(power, velocity, weight=100.0, window=2)
    np.testing.assert_allclose(cost, [np.nan, 0.1, 0.3, 0.25])  # 5 W / (100 N x 0.5 m/s), ...
