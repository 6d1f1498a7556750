# pyright: reportAttributeAccessIssue=false
"""Pictures of robots without a window, through MuJoCo's renderer and whatever OpenGL the machine has."""

import copy
from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from telebip.errors import UserError
from telebip.robot import FOOT_SENSORS, Robot
from telebip.viz.opengl import how_to_get_opengl
from telebip.viz.scene import Color

Array = NDArray[np.floating]
Image = NDArray[np.uint8]


class Renderer:
    """Draws robots and arrows into one scene, seen by one camera. A context manager: leaving it frees the OpenGL context."""

    def __init__(self, robot: Robot, size: tuple[int, int], extent: float = 2.0, shadow_size: int = 2048) -> None:
        """Open an OpenGL context.

        Args:
            robot: whose model is drawn.
            size: width and height of the pictures [pixels].
            extent: how far shadows reach [m].
            shadow_size: of the map of shadows [pixels], into which most of the time goes without a GPU.

        Raises:
            UserError: there is no OpenGL.
        """
        self.model, self.data = copy.copy(robot.model), mujoco.MjData(robot.model)
        self.model.vis.global_.offwidth, self.model.vis.global_.offheight = size
        self.model.stat.extent, self.model.vis.quality.shadowsize = extent, shadow_size
        self.size = size
        self._foot_sites = [int(self.model.sensor(sensor).objid[0]) for sensor in FOOT_SENSORS]
        self._camera, self._option = mujoco.MjvCamera(), mujoco.MjvOption()
        try:
            self._renderer = mujoco.Renderer(self.model, height=size[1], width=size[0])
        except (RuntimeError, ImportError, AttributeError, mujoco.FatalError) as error:
            raise UserError(f"cannot render without OpenGL ({error}); {how_to_get_opengl()}") from error

    def __enter__(self) -> "Renderer":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Free the OpenGL context."""
        self._renderer.close()

    def look_at(self, point: Sequence[float], distance: float, azimuth: float, elevation: float) -> None:
        """Point the camera at `point` [m] from `distance` [m], looking along `azimuth` and `elevation` [deg]."""
        self._camera.lookat = point
        self._camera.distance, self._camera.azimuth, self._camera.elevation = distance, azimuth, elevation

    def place(self, poses: Sequence[Array]) -> Array:
        """Start a scene: the floor, and a robot for every row of qpos (nq) in `poses`; return their feet [m], (n, 2, 3)."""
        feet = []
        for i, qpos in enumerate(poses):
            self.data.qpos[:] = qpos
            mujoco.mj_forward(self.model, self.data)
            feet.append(self.data.site_xpos[self._foot_sites])  # a copy
            if i == 0:
                self._renderer.update_scene(self.data, self._camera, self._option)
            else:
                robot, scene = mujoco.mjtCatBit.mjCAT_DYNAMIC, self._renderer.scene
                mujoco.mjv_addGeoms(self.model, self.data, self._option, mujoco.MjvPerturb(), robot, scene)
        return np.array(feet)

    def arrow(self, start: Array, end: Array, color: Color, radius: float = 0.012) -> None:
        """Add an arrow; see `add_arrow`."""
        add_arrow(self._renderer.scene, start, end, color, radius)

    def label(self, point: Array, text: str) -> None:
        """Write a line of text at a point [m]."""
        _add(self._renderer.scene, mujoco.mjtGeom.mjGEOM_LABEL, point, (255, 255, 255)).label = text

    def render(self) -> Image:
        """Return the picture, (height, width, 3)."""
        return self._renderer.render()

    def project(self, points: Array) -> Array:
        """Return where points [m] (n, 3) lie in the picture, as the camera of the scene sees them [pixels], (n, 2)."""
        camera, other = self._renderer.scene.camera  # of the two eyes
        forward, up = np.array(camera.forward), np.array(camera.up)
        offset = points - 0.5 * (np.array(camera.pos) + np.array(other.pos))
        scale = self.size[1] * camera.frustum_near / (camera.frustum_top - camera.frustum_bottom)
        right_down = scale * (offset @ np.stack([np.cross(forward, up), -up], axis=-1)) / (offset @ forward)[:, None]
        return 0.5 * np.array(self.size) + right_down


def add_arrow(scene: mujoco.MjvScene, start: Array, end: Array, color: Color, radius: float) -> None:
    """Add an arrow between two points [m] to a scene, unless they are closer than a centimetre."""
    if np.linalg.norm(end - start) < 0.01:
        return
    geom = _add(scene, mujoco.mjtGeom.mjGEOM_ARROW, np.zeros(3), color)
    mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_ARROW, radius, start.astype(float), end.astype(float))
    geom.size[2] *= 2.0  # MuJoCo draws an arrow half as long as its size says


def _add(scene: mujoco.MjvScene, kind: int, point: Array, color: Color) -> mujoco.MjvGeom:
    scene.ngeom += 1
    geom = scene.geoms[scene.ngeom - 1]
    rgba = np.array([*color, 255], dtype=np.float32) / 255.0
    mujoco.mjv_initGeom(geom, kind, np.full(3, 0.01), point.astype(float), np.eye(3).ravel(), rgba)
    return geom
