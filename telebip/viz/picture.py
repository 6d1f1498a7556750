# pyright: reportAttributeAccessIssue=false
"""A still picture of a walk: the robot at equal intervals, all in one scene."""

import copy
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image

from telebip.errors import UserError
from telebip.eval.rollout import Rollout
from telebip.robot import Robot


def strobe(
    rollout: Rollout,
    robot: Robot,
    file: Path,
    world: int = 0,
    interval: float = 0.55,
    poses: int = 6,
    size: tuple[int, int] = (1600, 560),
) -> None:
    """Render the last `poses` poses of one world, `interval` apart, side by side as they stood on the ground.

    Args:
        rollout: what happened.
        robot: its model.
        file: an image file; the suffix decides the format.
        world: which world.
        interval: time between poses [s]; a multiple of the gait period would freeze the legs, so it should not be one.
        poses: how many.
        size: width and height of the picture [pixels].

    Raises:
        UserError: there is no OpenGL to render with, or the file cannot be written.
    """
    stride = max(1, round(interval / rollout.step_dt))
    rows = rollout.qpos[:, world][::-1][: stride * poses : stride][::-1].astype(np.float64)
    centre, along = rows[:, :3].mean(0), rows[-1, :2] - rows[0, :2]
    span = float(np.linalg.norm(along))
    model, data = copy.copy(robot.model), mujoco.MjData(robot.model)
    model.vis.global_.offwidth, model.vis.global_.offheight = size
    model.stat.extent = 2.0 + 2.0 * span  # reach of the shadows
    try:
        renderer = mujoco.Renderer(model, height=size[1], width=size[0])
    except (RuntimeError, AttributeError, mujoco.FatalError) as error:
        raise UserError(
            f"cannot render: no OpenGL ({error}); on Debian, install libegl1 or libosmesa6 (MUJOCO_GL=osmesa)"
        ) from error

    camera = mujoco.MjvCamera()
    camera.lookat = [*centre[:2], 0.4]
    camera.distance = 1.0 + 0.5 * span
    camera.azimuth = float(np.degrees(np.arctan2(along[1], along[0]))) + 108.0
    camera.elevation = -9.0
    option = mujoco.MjvOption()
    for i, qpos in enumerate(rows):
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        if i == 0:
            renderer.update_scene(data, camera, option)
        else:
            mujoco.mjv_addGeoms(model, data, option, mujoco.MjvPerturb(), mujoco.mjtCatBit.mjCAT_DYNAMIC, renderer.scene)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(renderer.render()).save(file)
    except (OSError, ValueError) as error:
        raise UserError(f"cannot write picture '{file}': {error}") from error
    finally:
        renderer.close()
