"""The robot as its URDF draws it, read through yourdfpy: one coloured mesh per link, and where the links are."""

from functools import reduce

import numpy as np
import torch
import trimesh
import yourdfpy
from numpy.typing import NDArray
from trimesh.visual import ColorVisuals

from telebip.errors import UserError, nearest
from telebip.math import matrix
from telebip.robot import TRUNK, Robot

Array = NDArray[np.floating]
GREY = (0.7, 0.7, 0.7, 1.0)


def load_urdf(robot: Robot) -> yourdfpy.URDF:
    """Load the URDF that stands beside a robot's MJCF, with the same names of joints.

    Raises:
        UserError: the file is missing or is no URDF, or the trunk or an actuated joint is missing.
    """
    path = robot.path.with_suffix(".urdf")
    if not path.is_file():
        raise UserError(f"drawing the robot takes its URDF, but '{path}' does not exist")
    try:
        urdf = yourdfpy.URDF.load(str(path), build_scene_graph=False, load_meshes=False)
    except Exception as error:  # yourdfpy lets through whatever the XML parser and its own converters raise
        raise UserError(f"'{path}' is not a valid URDF: {error}") from error
    for kind, name, known in (("link", TRUNK, urdf.link_map), *(("joint", name, urdf.joint_map) for name in robot.joint_names)):
        if name not in known:
            raise UserError(f"{path}: no {kind} named '{name}'; {nearest(name, known)}")
    return urdf


def link_paths(urdf: yourdfpy.URDF) -> dict[str, str]:
    """Return `trunk/right_hip/right_thigh`, say, for every link: links nest as their joints do, so that transforms compose."""
    parents = {joint.child: joint.parent for joint in urdf.robot.joints}

    def path(link: str) -> str:
        return f"{path(parents[link])}/{link}" if link in parents else link

    return {link.name: path(link.name) for link in urdf.robot.links}


def link_mesh(urdf: yourdfpy.URDF, link: str) -> trimesh.Trimesh | None:
    """Return all visuals of a link as one mesh in its frame, with colours at the vertices, or None if it has none.

    Raises:
        UserError: a shape is none of box, cylinder and sphere.
    """
    palette = {material.name: material.color.rgba for material in urdf.robot.materials if material.color is not None}
    meshes = []
    for visual in urdf.link_map[link].visuals:
        mesh = _shape(visual.geometry)
        if visual.origin is not None:
            mesh.apply_transform(visual.origin)
        color = palette.get(visual.material.name, GREY) if visual.material else GREY
        mesh.visual = ColorVisuals(mesh, vertex_colors=np.round(255 * np.asarray(color)).astype(np.uint8))
        meshes.append(mesh)
    return trimesh.util.concatenate(meshes) if meshes else None  # pyright: ignore[reportReturnType]


def joint_transforms(urdf: yourdfpy.URDF, robot: Robot, qpos: Array) -> dict[str, Array]:
    r"""Return the pose of every link in its parent's frame, T = T_origin(joint) M(q), by the child's name.

    M(q) slides by q along the axis of a prismatic joint and turns by q about the axis u of a revolute one (Rodrigues):
    R = 1 + sin(q) [u]x + (1 - cos(q)) [u]x^2. Joints that only the URDF has stay at zero. From `qpos` (steps, nq) of `robot`;
    homogeneous matrices, (steps, 4, 4) each.
    """
    columns = {robot.model.joint(i).name: int(robot.model.jnt_qposadr[i]) for i in range(1, robot.model.njnt)}
    transforms = {}
    for joint in urdf.robot.joints:
        motion = np.tile(np.eye(4), (len(qpos), 1, 1))
        if joint.name in columns:
            q = qpos[:, columns[joint.name]].astype(float)
            axis = np.asarray(joint.axis, dtype=float)
            if joint.type == "prismatic":
                motion[:, :3, 3] = q[:, None] * axis
            else:
                cross = np.cross(np.eye(3), axis)  # [u]x
                turn, versine = np.sin(q)[:, None, None], 1.0 - np.cos(q)[:, None, None]
                motion[:, :3, :3] += turn * cross + versine * (cross @ cross)
        transforms[joint.child] = (np.eye(4) if joint.origin is None else joint.origin) @ motion
    return transforms


def link_poses(urdf: yourdfpy.URDF, robot: Robot, qpos: Array) -> dict[str, Array]:
    """Return the pose of every link in the world, as homogeneous matrices (steps, 4, 4); arguments as of `joint_transforms`."""
    base = np.tile(np.eye(4), (len(qpos), 1, 1))
    base[:, :3, :3] = matrix(torch.as_tensor(qpos[:, 3:7], dtype=torch.float64)).numpy()
    base[:, :3, 3] = qpos[:, :3]
    relative = {TRUNK: base, **joint_transforms(urdf, robot, qpos)}
    paths = link_paths(urdf)
    return {link: reduce(np.matmul, [relative[part] for part in path.split("/")]) for link, path in paths.items()}


def _shape(geometry: yourdfpy.urdf.Geometry | None) -> trimesh.Trimesh:
    if geometry and geometry.sphere:
        return trimesh.creation.icosphere(subdivisions=3, radius=geometry.sphere.radius)
    if geometry and geometry.box:
        mesh = trimesh.creation.box(extents=geometry.box.size)
    elif geometry and geometry.cylinder:
        mesh = trimesh.creation.cylinder(radius=geometry.cylinder.radius, height=geometry.cylinder.length, sections=32)
    else:
        raise UserError("a drawing shows URDF shapes of type box, cylinder and sphere only")
    mesh.unmerge_vertices()  # sharp edges
    return mesh
