"""Recordings for the rerun viewer: the robot in 3D, loaded through yourdfpy, beside its time series."""

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
import trimesh
import yourdfpy
from numpy.typing import NDArray

from telebip.errors import UserError
from telebip.eval.rollout import Rollout
from telebip.eval.walk import heading_velocity
from telebip.robot import FEET, JOINTS

ROBOT = "world/robot"
FORCE_SCALE = 0.003  # m of arrow per N


def record(rollout: Rollout, urdf: Path, file: Path, world: int = 0) -> None:
    """Write one world of a rollout to a `.rrd` file, with a prepared layout.

    Args:
        rollout: what happened.
        urdf: the robot; its joints carry the names of `telebip.robot.JOINTS`.
        file: where to write.
        world: which world.

    Raises:
        UserError: the file cannot be written, or the URDF is missing or has shapes a recording cannot show.
    """
    if not urdf.is_file():
        raise UserError(f"a recording needs the robot as URDF, but '{urdf}' does not exist")
    robot = yourdfpy.URDF.load(str(urdf))
    stream = rr.RecordingStream("telebip", recording_id=file.stem)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.open("wb").close()  # rerun writes in a thread of its own and would only log a failure
        stream.save(file, default_blueprint=_blueprint())
    except OSError as error:
        raise UserError(f"cannot write recording '{file}': {error.strerror or error}") from error
    _log_robot(stream, robot)
    time = rr.TimeColumn("time", duration=rollout.time)
    _log_motion(stream, robot, rollout, world, time)
    _log_series(stream, rollout, world, time)
    stream.flush()
    stream.disconnect()


def link_paths(robot: yourdfpy.URDF) -> dict[str, str]:
    """Return the entity path of every link: links nest as their joints do, so that transforms compose."""
    parents = {joint.child: joint.parent for joint in robot.robot.joints}

    def path(link: str) -> str:
        return f"{path(parents[link])}/{link}" if link in parents else f"{ROBOT}/{link}"

    return {link.name: path(link.name) for link in robot.robot.links}


def _log_robot(stream: rr.RecordingStream, robot: yourdfpy.URDF) -> None:
    """Log what does not move: axes, links' shapes, names of the series."""
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    colors = {material.name: material.color.rgba for material in robot.robot.materials if material.color is not None}
    for link in robot.robot.links:
        for visual in link.visuals:
            mesh = _mesh(visual.geometry)
            mesh.apply_transform(np.eye(4) if visual.origin is None else visual.origin)
            color = colors.get(visual.material.name, [0.7, 0.7, 0.7, 1.0]) if visual.material else [0.7, 0.7, 0.7, 1.0]
            stream.log(
                f"{link_paths(robot)[link.name]}/{visual.name}",
                rr.Mesh3D(
                    vertex_positions=mesh.vertices,
                    triangle_indices=mesh.faces,
                    vertex_normals=mesh.vertex_normals,
                    albedo_factor=list(color),
                ),
                static=True,
            )


def _mesh(geometry: yourdfpy.urdf.Geometry | None) -> trimesh.Trimesh:
    if geometry is None:
        raise UserError("a URDF visual has no geometry")
    if geometry.box is not None:
        mesh = trimesh.creation.box(extents=geometry.box.size)
    elif geometry.cylinder is not None:
        mesh = trimesh.creation.cylinder(radius=geometry.cylinder.radius, height=geometry.cylinder.length, sections=32)
    elif geometry.sphere is not None:
        return trimesh.creation.icosphere(subdivisions=3, radius=geometry.sphere.radius)
    else:
        raise UserError("a recording shows URDF shapes of type box, cylinder and sphere only")
    mesh.unmerge_vertices()  # sharp edges
    return mesh


def _log_motion(stream: rr.RecordingStream, robot: yourdfpy.URDF, rollout: Rollout, world: int, time: rr.TimeColumn) -> None:
    """Log where the trunk and every link are, and the forces on them."""
    qpos, paths = rollout.qpos[:, world], link_paths(robot)
    _log_transform(stream, paths[str(robot.base_link)], time, qpos[:, :3], qpos[:, 3:7])
    for joint in robot.robot.joints:
        origin = np.eye(4) if joint.origin is None else joint.origin
        motion = np.zeros((len(qpos), 3))
        quat = np.tile([1.0, 0.0, 0.0, 0.0], (len(qpos), 1))
        if joint.name in JOINTS:
            q = qpos[:, 7 + JOINTS.index(joint.name), None].astype(float)
            axis = np.asarray(joint.axis, dtype=float)[None]
            if joint.type == "prismatic":
                motion = q * axis
            else:
                quat = np.concatenate([np.cos(q / 2), np.sin(q / 2) * axis], axis=1)
        # An origin's rotation applies to the motion too; ours have none, which keeps the quaternion as it is.
        if not np.allclose(origin[:3, :3], np.eye(3)):
            raise UserError(f"joint '{joint.name}': a recording needs joint origins without rotation")
        _log_transform(stream, paths[joint.child], time, origin[:3, 3] + motion, quat)
    feet = foot_positions(robot, qpos)
    for i, foot in enumerate(FEET):
        force = np.zeros((len(qpos), 3))
        force[:, 2] = FORCE_SCALE * rollout.foot_force[:, world, i]
        _log_arrows(stream, f"world/ground_force/{foot}", time, feet[i], force, [40, 160, 90])
    trunk = qpos[:, :3] + np.array([0.0, 0.0, 0.1])
    _log_arrows(stream, "world/push", time, trunk, 2.0 * FORCE_SCALE * rollout.push_w[:, world], [220, 40, 40])


def foot_positions(robot: yourdfpy.URDF, qpos: NDArray[np.floating]) -> list[np.ndarray]:
    """Return the feet's centres in the world [m], one (steps, 3) array for each of `FEET`."""
    positions = [np.empty((len(qpos), 3)) for _ in FEET]
    for step, row in enumerate(qpos):
        robot.update_cfg(dict(zip(JOINTS, row[7:], strict=True)))
        w, x, y, z = row[3:7]
        base = trimesh.transformations.quaternion_matrix([w, x, y, z])[:3, :3]
        for i, foot in enumerate(FEET):
            positions[i][step] = row[:3] + base @ robot.get_transform(foot)[:3, 3]
    return positions


def _log_transform(stream: rr.RecordingStream, path: str, time: rr.TimeColumn, translation, quat_wxyz) -> None:
    stream.send_columns(
        path,
        indexes=[time],
        columns=rr.Transform3D.columns(translation=translation, quaternion=np.roll(quat_wxyz, -1, axis=1)),
    )


def _log_arrows(stream: rr.RecordingStream, path: str, time: rr.TimeColumn, origins, vectors, color) -> None:
    stream.log(path, rr.Arrows3D.from_fields(colors=[color], radii=[0.008]), static=True)
    stream.send_columns(path, indexes=[time], columns=rr.Arrows3D.columns(origins=origins, vectors=vectors))


def _log_series(stream: rr.RecordingStream, rollout: Rollout, world: int, time: rr.TimeColumn) -> None:
    velocity = heading_velocity(rollout.qpos[:, world], rollout.qvel[:, world])
    power = rollout.joint_power[:, world].sum(-1)
    series = {
        "speed/command": rollout.command[:, world, 0],
        "speed/forward": velocity[:, 0],
        "yaw_rate/command": rollout.command[:, world, 2],
        "yaw_rate/trunk": rollout.qvel[:, world, 5],
        "phase/p_r": rollout.phase[:, world, 0],
        "phase/p_l": rollout.phase[:, world, 1],
        **{f"foot_force/{foot}": rollout.foot_force[:, world, i] for i, foot in enumerate(FEET)},
        **{f"joint_pos/{joint}": rollout.qpos[:, world, 7 + i] for i, joint in enumerate(JOINTS)},
        **{f"joint_target/{joint}": rollout.joint_target[:, world, i] for i, joint in enumerate(JOINTS)},
        **{f"joint_force/{joint}": rollout.joint_force[:, world, i] for i, joint in enumerate(JOINTS)},
        "power/total": power,
        "reward/total": rollout.reward[:, world],
    }
    for path, values in series.items():
        stream.send_columns(f"plot/{path}", indexes=[time], columns=rr.Scalars.columns(scalars=values))


def _blueprint() -> rrb.Blueprint:
    def plot(name: str, *paths: str) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(name=name, origin="/plot", contents=[f"/plot/{path}/**" for path in paths])

    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(
                name="robot",
                origin="/world",
                background=[205, 215, 226],
                line_grid=rrb.LineGrid3D(visible=True, spacing=0.5, color=[120, 130, 140]),
                eye_controls=rrb.EyeControls3D(
                    position=[1.2, -2.0, 0.8], look_target=[0.0, 0.0, 0.45], tracking_entity=f"/{ROBOT}/trunk"
                ),
            ),
            rrb.Vertical(
                plot("speed [m/s]", "speed"),
                plot("phase signals", "phase"),
                plot("foot force [N]", "foot_force"),
                rrb.Tabs(
                    plot("joint position [rad | m]", "joint_pos"),
                    plot("joint target [rad | m]", "joint_target"),
                    plot("joint force [N m | N]", "joint_force"),
                    plot("yaw rate [rad/s]", "yaw_rate"),
                    plot("power [W]", "power"),
                    plot("reward per step", "reward"),
                ),
            ),
            column_shares=[3, 2],
        ),
        collapse_panels=True,
    )
