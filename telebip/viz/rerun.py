# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
"""Recordings of walks for the rerun viewer: the robots in 3D beside their time series, logged in columns."""

import re
import socket
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import mujoco
import numpy as np
import rerun as rr
import torch
import yourdfpy
from rerun.blueprint import Blueprint

from telebip.errors import UserError
from telebip.math import yaw
from telebip.robot import FEET, FOOT_SENSORS, Robot
from telebip.terrain import Terrain
from telebip.viz.blueprint import walk_layout
from telebip.viz.opengl import has_display
from telebip.viz.scene import ACTUAL, COMMAND, FORCE_SCALE, GROUND_FORCE, PUSH, PUSH_SCALE, SPEED_SCALE, Actor, Color
from telebip.viz.series import PALETTE, SHARED, TOTAL, Plot, plots
from telebip.viz.urdf import Array, joint_transforms, link_mesh, link_paths, load_urdf

FLUSH = 60.0
"""A viewer that takes longer than this for what is left at the end is taken for one that does not answer [s]."""


def record(actors: Sequence[Actor], robot: Robot, file: Path) -> None:
    """Write walks, from `telebip.viz.scene.line_up`, of `robot` to a `.rrd` file, with a prepared layout; its folder is made.

    Raises:
        UserError: the file cannot be written, or the URDF is missing or has shapes that cannot be drawn.
    """
    urdf = drawable(robot)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.open("wb").close()  # rerun writes in a thread of its own and would only log a failure
    except OSError as error:
        raise UserError(f"cannot write recording '{file}': {error.strerror or error}") from error
    stream = rr.RecordingStream("telebip", recording_id=file.stem)
    stream.save(file, default_blueprint=_layout(actors, robot))
    log_walks(stream, actors, robot, urdf)
    stream.disconnect()


def show(actors: Sequence[Actor], robot: Robot, address: str | None = None) -> None:
    """Show walks in a rerun viewer: in the one at `address`, or else in one on this machine, started if there is none.

    Raises:
        UserError: as `record`, or there is no viewer at `address`, or no display for one here.
    """
    urdf = drawable(robot)
    with viewer(_layout(actors, robot), address) as stream:
        log_walks(stream, actors, robot, urdf)


def drawable(robot: Robot) -> yourdfpy.URDF:
    """Load a robot's URDF, and all of its shapes once, so that what cannot be drawn is said before anything is walked.

    Raises:
        UserError: see `load_urdf` and `link_mesh`.
    """
    urdf = load_urdf(robot)
    for link in urdf.link_map:
        link_mesh(urdf, link, robot.path.with_suffix(".urdf"))
    return urdf


@contextmanager
def viewer(layout: Blueprint, address: str | None) -> Iterator[rr.RecordingStream]:
    """Yield a stream into a rerun viewer, and wait at the end until everything has arrived; see `show`.

    Raises:
        UserError: there is no viewer, or not all of it has arrived there.
    """
    url = require_viewer(address)
    stream = rr.RecordingStream("telebip")
    try:
        if url:
            stream.connect_grpc(url, default_blueprint=layout)
        else:
            stream.spawn(default_blueprint=layout)
    except (RuntimeError, OSError, ValueError) as error:
        raise UserError(f"the rerun viewer does not start: {error}") from error
    try:
        yield stream
        stream.flush(timeout_sec=FLUSH)
    except RuntimeError as error:
        raise UserError(f"the rerun viewer at '{address or 'this machine'}' did not take it all: {error}") from error
    finally:
        stream.disconnect()


def require_viewer(address: str | None) -> str | None:
    """Make sure that `show` and `viewer` have somewhere to send to; return its URL if it is not to be started here.

    Raises:
        UserError: no viewer answers at `address`, or without one, there is no display to start a viewer on.
    """
    if not address:
        if not has_display():
            raise UserError(
                "a rerun viewer needs a display; use --connect HOST:PORT with a viewer elsewhere, or play.py --record FILE.rrd"
            )
        return None
    url = address if "://" in address else f"rerun+http://{address}/proxy"
    try:
        place = urlsplit(url)
        host, port = place.hostname or "", place.port or 9876
    except ValueError as error:
        raise UserError(f"'{address}' is no address of a rerun viewer: {error}") from error
    try:
        with socket.create_connection((host, port), timeout=3.0) as connection:  # rerun itself would retry for ever
            speaks = urlsplit(url).scheme != "rerun+http" or _speaks_http2(connection)
    except OSError as error:
        raise UserError(f"no rerun viewer answers at '{address}': {error.strerror or error}") from error
    if not speaks:
        raise UserError(f"what answers at '{address}' is no rerun viewer; its port is 9876, if not chosen otherwise")
    return url


def _speaks_http2(connection: socket.socket) -> bool:
    """Whether an HTTP/2 preface with empty settings is answered by settings (RFC 9113, 3.4), as rerun's gRPC does."""
    settings = b"\0\0\0" + b"\4" + b"\0" + b"\0\0\0\0"  # length, type, flags, stream
    connection.sendall(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + settings)
    return connection.recv(4)[3:] == settings[3:4]


def log_walks(stream: rr.RecordingStream, actors: Sequence[Actor], robot: Robot, urdf: yourdfpy.URDF) -> None:
    """Log robots below `world/<name>`, and their series below `plot/<name>`."""
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for i, (name, actor) in enumerate(zip(names(actors), actors, strict=True)):
        time = rr.TimeColumn("time", duration=actor.rollout.time)
        stream.log(f"world/{name}", rr.Transform3D(translation=[0.0, actor.lane, 0.0]), static=True)
        if len(actors) > 1:
            above = rr.Points3D([[0.0, 0.0, 0.4]], radii=0.005, colors=[250, 250, 250], labels=[actor.label], show_labels=True)
            stream.log(f"world/{name}/{robot.trunk_name}/label", above, static=True)
        _log_ground(stream, robot, f"world/{name}/ground", actor)
        _log_links(stream, urdf, robot, f"world/{name}", actor, time)
        _log_arrows(stream, robot, f"world/{name}", actor, time)
        own = PALETTE[i % len(PALETTE)] if len(actors) > 1 else None
        _log_series(stream, plots(actor.rollout, actor.world, robot.is_slide), f"plot/{name}", actor.label, time, own)


def _log_ground(stream: rr.RecordingStream, robot: Robot, path: str, actor: Actor, margin: float = 1.5) -> None:
    """Log the terrain, if there is one, up to `margin` [m] beside the robot's way."""
    way = actor.rollout.qpos[:, actor.world, :2].astype(float)
    if robot.terrain:
        stream.log(path, ground_mesh(robot.terrain, way.min(0) - margin, way.max(0) + margin), static=True)


def ground_mesh(terrain: Terrain, low: Array, high: Array) -> rr.Mesh3D:
    """Return the terrain from one corner to the opposite one, (x, y) each [m], the brighter the higher."""
    rows, columns = terrain.heights.shape
    (left, right), (near, far) = (
        np.clip(((np.array(ends) + half) / terrain.resolution).round().astype(int), 0, count - 1)
        for ends, half, count in zip(zip(low, high, strict=True), terrain.half_extent, (columns, rows), strict=True)
    )
    x = np.arange(left, right) * terrain.resolution - terrain.half_extent[0]
    y = np.arange(near, far) * terrain.resolution - terrain.half_extent[1]
    points = np.stack([*np.meshgrid(x, y), terrain.heights[near:far, left:right]], axis=-1)
    corner = (np.arange(len(y) - 1)[:, None] * len(x) + np.arange(len(x) - 1)).ravel()
    faces = np.concatenate([corner[:, None] + [0, 1, len(x) + 1], corner[:, None] + [0, len(x) + 1, len(x)]])
    shade = (150 + 60 * (points[..., 2:] - points[..., 2].min()) / max(float(np.ptp(points[..., 2])), 0.1)).astype(np.uint8)
    colors = np.repeat(shade, 3, axis=-1).reshape(-1, 3)
    return rr.Mesh3D(vertex_positions=points.reshape(-1, 3), triangle_indices=faces, vertex_colors=colors)


def names(actors: Sequence[Actor]) -> list[str]:
    """Return the actors' labels as names of entities, each once."""
    found: list[str] = []
    for actor in actors:
        name = re.sub(r"\W+", "_", actor.label)
        found.append(f"{name}_{len(found) + 1}" if name in found else name)
    return found


def log_mesh(stream: rr.RecordingStream, path: str, urdf: yourdfpy.URDF, link: str, robot: Robot) -> None:
    """Log the shape of a link, if it has one."""
    mesh = link_mesh(urdf, link, robot.path.with_suffix(".urdf"))
    if mesh is not None:
        shape = rr.Mesh3D(
            vertex_positions=mesh.vertices,
            triangle_indices=mesh.faces,
            vertex_normals=mesh.vertex_normals,
            vertex_colors=mesh.visual.vertex_colors,
        )
        stream.log(path, shape, static=True)


def _log_links(
    stream: rr.RecordingStream, urdf: yourdfpy.URDF, robot: Robot, root: str, actor: Actor, time: rr.TimeColumn
) -> None:
    """Log the links' shapes, the trunk's pose in the lane, and every other link's in its parent's."""
    qpos, paths = actor.rollout.qpos[:, actor.world], link_paths(urdf)
    for link, path in paths.items():
        log_mesh(stream, f"{root}/{path}", urdf, link, robot)
    trunk = rr.Transform3D.columns(translation=qpos[:, :3], quaternion=np.roll(qpos[:, 3:7], -1, axis=1))
    stream.send_columns(f"{root}/{robot.trunk_name}", indexes=[time], columns=trunk)
    for link, pose in joint_transforms(urdf, robot, qpos).items():
        columns = rr.Transform3D.columns(translation=pose[:, :3, 3], mat3x3=pose[:, :3, :3])
        stream.send_columns(f"{root}/{paths[link]}", indexes=[time], columns=columns)


def _log_arrows(stream: rr.RecordingStream, robot: Robot, root: str, actor: Actor, time: rr.TimeColumn) -> None:
    """Log ground forces at the feet, the push on the trunk, and above it the commanded and the actual velocity."""
    rollout, world = actor.rollout, actor.world
    qpos, up = rollout.qpos[:, world], np.array([0.0, 0.0, 1.0])
    trunk = qpos[:, :3].astype(float)

    def arrows(path: str, origins: Array, vectors: Array, color: Color, radius: float = 0.012) -> None:
        stream.log(f"{root}/{path}", rr.Arrows3D.from_fields(colors=[color], radii=[radius]), static=True)
        stream.send_columns(f"{root}/{path}", indexes=[time], columns=rr.Arrows3D.columns(origins=origins, vectors=vectors))

    feet = _foot_positions(robot, qpos)
    for i, foot in enumerate(FEET):
        force = FORCE_SCALE * rollout.foot_force[:, world, i, None] * up
        arrows(f"ground_force/{foot}", feet[:, i], force, GROUND_FORCE, radius=0.022)  # thicker than the shank
    arrows("push", trunk + 0.1 * up, PUSH_SCALE * rollout.push_w[:, world], PUSH)
    psi, (vx, vy, _) = yaw(torch.as_tensor(qpos[:, 3:7])).numpy(), rollout.command[:, world].T
    wanted = np.stack([np.cos(psi) * vx - np.sin(psi) * vy, np.sin(psi) * vx + np.cos(psi) * vy, 0.0 * vx], axis=-1)
    actual = rollout.qvel[:, world, :3] * [1.0, 1.0, 0.0]
    arrows("velocity/command", trunk + 0.30 * up, SPEED_SCALE * wanted, COMMAND)
    arrows("velocity/actual", trunk + 0.27 * up, SPEED_SCALE * actual, ACTUAL)


def _foot_positions(robot: Robot, qpos: Array) -> Array:
    """Return where the feet's touch sensors are in the world [m], (steps, 2, 3), for rows of `qpos` (steps, nq)."""
    data, sites = mujoco.MjData(robot.model), [int(robot.model.sensor(name).objid[0]) for name in FOOT_SENSORS]
    feet = []
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_kinematics(robot.model, data)
        feet.append(data.site_xpos[sites])  # a copy
    return np.array(feet)


def _log_series(
    stream: rr.RecordingStream, shown: Mapping[str, Plot], root: str, label: str, time: rr.TimeColumn, own: Color | None
) -> None:
    """Log plots; curves that several robots share a plot with tell whose they are, by name and by each one's `own` colour."""
    for name, plot in shown.items():
        for curve_name, curve in plot.curves.items():
            path, color = f"{root}/{name}/{curve_name}", own if own and curve.color == TOTAL else curve.color
            is_shared = own and plot.row in SHARED and curve_name != "command"
            title = f"{label}: {curve_name}" if is_shared else curve_name
            stream.log(path, rr.SeriesLines(colors=[color], names=[title], widths=[curve.width]), static=True)
            stream.send_columns(path, indexes=[time], columns=rr.Scalars.columns(scalars=curve.values))


def _layout(actors: Sequence[Actor], robot: Robot) -> Blueprint:
    return walk_layout(names(actors), plots(actors[0].rollout, actors[0].world, robot.is_slide))
