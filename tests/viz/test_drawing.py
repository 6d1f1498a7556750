"""Drawings say what the task, the robot and the rollout say."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from telebip.config import load_task
from telebip.errors import UserError
from telebip.robot import Robot
from telebip.rollout import Rollout
from telebip.viz.drawing import AXIS_COLORS, LEARNING, draw_control_loop, draw_learning, draw_robot, draw_stride
from telebip.viz.scene import line_up


def words(figure: Figure) -> str:
    return "\n".join(text.get_text() for axes in figure.axes for text in axes.texts)


def test_the_control_loop_has_the_tasks_numbers(robot: Robot) -> None:
    task, observation = load_task("telebip_flat"), {"joint_pos": 6, "projected_gravity": 3, "command": 3}
    text = words(draw_control_loop(task, robot, observation))
    observed = "observation (12)\njoint pos 6, projected gravity 3\ncommand 3"
    for part in ("50 Hz", "200 Hz, 4 steps of 5 ms", observed, "6 joint\n", "512-256-128", *task.rewards):
        assert part in text
    other = load_task("telebip_flat", ["sim.decimation=2", "ppo.hidden_dims=[64]"])
    other = words(draw_control_loop(other, robot, observation))
    for part in ("100 Hz", "200 Hz, 2 steps of 5 ms", "\n64\n"):
        assert part in other


def test_a_stride_is_the_end_of_the_walk(walking: Rollout, robot: Robot) -> None:
    figure = draw_stride(line_up([("RL", walking)])[0], robot, seconds=1.0)
    panels = {axes.get_title(loc="left"): axes for axes in figure.axes}
    assert len(panels) == 6
    (right,) = [line for line in panels["knee [m]"].lines if line.get_label() == "right"]
    np.testing.assert_array_equal(right.get_ydata(), walking.qpos[-50:, 0, 9])
    assert [line.get_label() for line in panels["reward per step"].lines] == [*walking.reward_names, "total"]


def test_learning_curves_are_drawn_over_samples() -> None:
    curves = {"samples": [1e6, 2e6, 4e6], **{name: [3.0 * i, 2.0, float("nan")] for i, name in enumerate(LEARNING)}}
    figure = draw_learning(curves, "telebip_flat")
    for axes, name in zip(figure.axes, LEARNING, strict=True):
        np.testing.assert_array_equal(axes.lines[0].get_xdata(), [1.0, 2.0, 4.0])
        np.testing.assert_array_equal(axes.lines[0].get_ydata(), curves[name])


def test_six_axes_are_drawn_beside_the_robot(robot: Robot, tmp_path: Path) -> None:
    try:
        picture = np.asarray(draw_robot(robot, (500, 360))).astype(int)
    except UserError as error:
        pytest.skip(str(error))
    for color in AXIS_COLORS.values():
        strongest, weakest = int(np.argmax(color)), int(np.argmin(color))
        near = np.abs(picture - np.array(color)).max(-1) < 60
        near &= picture[..., strongest] - picture[..., weakest] > 80
        assert near[:, :250].sum() > 60, color
        assert near[:, 250:].sum() > 60, color
