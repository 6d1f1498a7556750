"""A still picture of a walk: the robot at equal intervals, all in one scene."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from telebip.errors import UserError
from telebip.robot import Robot
from telebip.viz.render import Array, Renderer
from telebip.viz.scene import Actor


def strobe(
    actor: Actor, robot: Robot, file: Path, interval: float = 0.55, poses: int = 6, size: tuple[int, int] = (1600, 560)
) -> None:
    """Render the last `poses` poses of a walk, `interval` apart, side by side as they stood on the ground.

    Args:
        actor: who walked.
        robot: its model.
        file: an image file; the suffix decides the format.
        interval: time between poses [s]; a multiple of the gait period would freeze the legs.
        poses: how many.
        size: width and height of the picture [pixels].

    Raises:
        UserError: there is no OpenGL to render with, or the file cannot be written.
    """
    stride = max(1, round(interval / actor.rollout.step_dt))
    rows = actor.rollout.qpos[::-1, actor.world][: stride * poses : stride][::-1].astype(float)
    centre, along = rows[:, :2].mean(0), rows[-1, :2] - rows[0, :2]
    span = float(np.linalg.norm(along))
    azimuth = float(np.degrees(np.arctan2(along[1], along[0]))) + 108.0
    with Renderer(robot, size, extent=2.0 + 2.0 * span, shadow_size=4096) as renderer:
        renderer.look_at([*centre, 0.4], distance=1.0 + 0.5 * span, azimuth=azimuth, elevation=-9.0)
        renderer.place(list(rows))
        picture = Image.fromarray(renderer.render())
    _save(picture, file)


def side_by_side(poses: Sequence[Array], robot: Robot, file: Path, size: tuple[int, int] = (1200, 640)) -> None:
    """Render poses (nq) of the robot beside each other, seen from the front left.

    Raises:
        UserError: there is no OpenGL to render with, or the file cannot be written.
    """
    height = float(robot.home_qpos[2])
    rows = [np.concatenate([[0.0, 1.2 * height * (0.5 * (len(poses) - 1) - i)], qpos[2:]]) for i, qpos in enumerate(poses)]
    with Renderer(robot, size, extent=4.0 * height) as renderer:
        renderer.look_at([0.0, 0.0, 0.7 * height], distance=3.2 * height, azimuth=205.0, elevation=-12.0)
        renderer.place(rows)
        _save(Image.fromarray(renderer.render()), file)


def _save(picture: Image.Image, file: Path) -> None:
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        picture.save(file)
    except (OSError, ValueError) as error:
        raise UserError(f"cannot write picture '{file}': {error}") from error
