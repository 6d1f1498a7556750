# pyright: reportAttributeAccessIssue=false
"""The robots and their ground as the MJCF draws them, through mjviser, with arrows for pushes, ground forces and speeds."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import viser
from mjviser import ViserMujocoScene
from numpy.typing import NDArray

from telebip.robot import FOOT_SENSORS, Robot
from telebip.viz.scene import ACTUAL, COMMAND, FORCE_SCALE, GROUND_FORCE, LANE, PUSH, PUSH_SCALE, SPEED_SCALE, Color

Array = NDArray[np.floating]

DISTANCE, AZIMUTH, ELEVATION = 2.6, 130.0, 15.0  # of the camera at first [m, deg, deg]
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Pose:
    """One robot at one moment, world frame, and what acts on it."""

    label: str  # above its head, where it is not empty
    qpos: Array  # (nq,)
    qvel: Array  # (nv,)
    command: Array  # forward, left, yaw rate [m/s, m/s, rad/s], (3,)
    foot_force: Array  # right and left [N], (2,)
    push_w: Array  # (3,) [N]


class Scene:
    """What is drawn of a robot's model: every geom, with materials and textures, a height field among them."""

    def __init__(self, server: viser.ViserServer, robot: Robot) -> None:
        """Send the shapes of the robot and its ground."""
        model = copy.copy(robot.model)  # mjviser changes its colours and sizes of contacts and frames
        self._server, self._robot, self._data = server, robot, mujoco.MjData(model)
        self._drawn = ViserMujocoScene(server, model, num_envs=1)
        self._sites = [int(model.sensor(name).objid[0]) for name in FOOT_SENSORS]
        is_flat = (model.geom_type[model.geom_bodyid == 0] == mujoco.mjtGeom.mjGEOM_PLANE).all()
        self.lane = LANE if is_flat else 0.0  # m between robots; on other ground they stand where they are
        self.followed = 0  # which robot the camera follows
        self.shows_arrows = True
        self._arrows = {name: self._add_arrows(name, color) for name, color in ARROWS.items()}
        self._labels: list[viser.LabelHandle] = []

    def add_gui(self) -> None:
        """Add the controls of the camera, and of contacts, forces, inertias and frames, where the GUI is being built."""
        self._drawn.create_scene_gui(DISTANCE, AZIMUTH, ELEVATION)
        with self._server.gui.add_folder("Contacts, inertia, frames", expand_by_default=False):
            self._drawn.create_overlay_gui()

    def draw(self, poses: Sequence[Pose]) -> None:
        """Show robots, at least one, side by side on flat ground."""
        data, robot = self._data, self._robot
        places, turns, arrows = [], [], {name: [] for name in ARROWS}
        for i, pose in enumerate(poses):
            data.qpos[:] = pose.qpos
            data.qpos[1] += self.lane * (0.5 * (len(poses) - 1) - i)
            mujoco.mj_kinematics(data.model, data)
            places.append(data.xpos.copy())
            turns.append(data.xmat.reshape(-1, 3, 3).copy())
            trunk, facing = data.xpos[robot.trunk_id], data.xmat[robot.trunk_id].reshape(3, 3)[:2, 0]
            for name, start, arrow in _arrows_of(pose, trunk, facing, data.site_xpos[self._sites]):
                arrows[name].append((start, start + arrow))
        self.followed = min(self.followed, len(poses) - 1)
        scene = self._drawn
        scene.num_envs, scene.env_idx = len(poses), self.followed
        with self._server.atomic():
            scene.update_from_arrays(
                np.array(places),
                np.array(turns),
                qpos=np.array([pose.qpos for pose in poses]),
                qvel=np.array([pose.qvel for pose in poses]),
            )
            # As mjviser does, move the world below the camera: a camera that is moved could not be turned by hand.
            origin = places[self.followed][robot.trunk_id] if scene.camera_tracking_enabled else np.zeros(3)
            for name, handle in self._arrows.items():
                handle.points = (np.array(arrows[name]).reshape(-1, 2, 3) - origin).astype(np.float32)
                handle.visible = self.shows_arrows
            self._draw_labels([pose.label for pose in poses], [place[robot.trunk_id] - origin for place in places])
        self._server.flush()

    def _draw_labels(self, labels: Sequence[str], places: Sequence[Array]) -> None:
        while len(self._labels) > len(labels):
            self._labels.pop().remove()
        for i, (label, place) in enumerate(zip(labels, places, strict=True)):
            if i == len(self._labels):
                self._labels.append(self._server.scene.add_label(f"/labels/{i}", label))
            self._labels[i].text, self._labels[i].visible = label, bool(label)
            self._labels[i].position = place + 0.45 * UP

    def _add_arrows(self, name: str, color: Color) -> viser.ArrowsHandle:
        nowhere = np.zeros((0, 2, 3), np.float32)
        return self._server.scene.add_arrows(
            f"/arrows/{name}", nowhere, color, shaft_radius=0.015, head_radius=0.03, head_length=0.06
        )


ARROWS: dict[str, Color] = {"push": PUSH, "ground force": GROUND_FORCE, "command": COMMAND, "speed": ACTUAL}


def _arrows_of(pose: Pose, trunk: Array, facing: Array, feet: Array) -> list[tuple[str, Array, Array]]:
    """Return (kind, where it starts, the arrow) [m] of what acts on a robot and where it goes; of nothing, no arrow."""
    (ahead_x, ahead_y), (vx, vy, _) = facing / np.linalg.norm(facing), pose.command
    wanted = np.array([ahead_x * vx - ahead_y * vy, ahead_y * vx + ahead_x * vy, 0.0])
    found = [
        ("push", trunk + 0.1 * UP, PUSH_SCALE * pose.push_w),
        ("command", trunk + 0.30 * UP, SPEED_SCALE * wanted),
        ("speed", trunk + 0.27 * UP, SPEED_SCALE * pose.qvel[:3] * [1.0, 1.0, 0.0]),
        *(("ground force", foot, FORCE_SCALE * force * UP) for foot, force in zip(feet, pose.foot_force, strict=True)),
    ]
    return [entry for entry in found if np.linalg.norm(entry[2]) > 0.01]
