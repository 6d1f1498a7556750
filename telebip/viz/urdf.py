"""The robot as its URDF draws it, read through yourdfpy: one coloured mesh per link, and where the links are."""

from functools import reduce
from pathlib import Path

import numpy as np
import torch
import trimesh
import yourdfpy
from numpy.typing import NDArray
from trimesh.visual import ColorVisuals

from telebip.errors import UserError, nearest
from telebip.math import matrix
from telebip.robot import Robot

Array = NDArray[np.floating]
GREY = (0.7, 0.7, 0.7, 1.0)


def load_urdf(robot: Robot) -> yourdfpy.URDF:
    """Load the URDF that stands beside a robot's MJCF, with the same names of joints, and the trunk as its root.

    Raises:
        UserError: the file is missing or is no URDF, the trunk or an actuated joint is missing, or links form no tree.
    """
    path = robot.path.with_suffix(".urdf")
    if not path.is_file():
        raise UserError(f"drawing the robot takes its URDF, but '{path}' does not exist")
    try:
        urdf = yourdfpy.URDF.load(str(path), build_scene_graph=False, load_meshes=False)
    except Exception as error:  # yourdfpy lets through whatever the XML parser and its own converters raise
        raise UserError(f"'{path}' is not a valid URDF: {error or type(error).__name__}") from error
    trunk = robot.trunk_name
    for kind, name, known in (("link", trunk, urdf.link_map), *(("joint", name, urdf.joint_map) for name in robot.joint_names)):
        if name not in known:
            raise UserError(f"{path}: no {kind} named '{name}'; {nearest(name, known)}")
    _require_tree(urdf, trunk, path)
    return urdf


def _require_tree(urdf: yourdfpy.URDF, trunk: str, path: Path) -> None:
    """Raise a `UserError` unless every link hangs on the trunk by one chain of joints with axes and poses that are numbers."""
    parents: dict[str, str] = {}
    for joint in urdf.robot.joints:
        for link in (joint.parent, joint.child):
            if link not in urdf.link_map:
                raise UserError(f"{path}: joint '{joint.name}' names the link '{link}', which is not there")
        if joint.child in parents or joint.child == trunk:
            raise UserError(f"{path}: joint '{joint.name}' moves link '{joint.child}', which {_why(joint.child, trunk)}")
        values = [joint.axis, np.eye(4) if joint.origin is None else joint.origin]
        if joint.axis is None or not all(np.isfinite(np.asarray(value, dtype=float)).all() for value in values):
            raise UserError(f"{path}: joint '{joint.name}' has an axis or origin that is no number")
        parents[joint.child] = joint.parent
    for link in urdf.link_map:
        chain = [link]
        while chain[-1] in parents and len(chain) <= len(parents):
            chain.append(parents[chain[-1]])
        if chain[-1] != trunk:
            raise UserError(f"{path}: link '{link}' does not hang on link '{trunk}', the trunk")


def _why(link: str, trunk: str) -> str:
    return "is the trunk, and must be the root" if link == trunk else "another joint moves already"


def link_paths(urdf: yourdfpy.URDF) -> dict[str, str]:
    """Return `trunk/right_hip/right_thigh`, say, for every link: links nest as their joints do, so that transforms compose."""
    parents = {joint.child: joint.parent for joint in urdf.robot.joints}

    def path(link: str) -> str:
        return f"{path(parents[link])}/{link}" if link in parents else link

    return {link.name: path(link.name) for link in urdf.robot.links}


def link_mesh(urdf: yourdfpy.URDF, link: str, file: Path) -> trimesh.Trimesh | None:
    """Return all visuals of a link as one mesh in its frame, with colours at the vertices, or None if it has none.

    Args:
        urdf: as `load_urdf` returns it.
        link: name of the link.
        file: the URDF's; paths of its meshes start from its folder, and `package://name/` is taken for it or one above it.

    Raises:
        UserError: a shape is of an unknown kind or has no size, or its file cannot be read.
    """
    palette = {material.name: material.color.rgba for material in urdf.robot.materials if material.color is not None}
    meshes = []
    for visual in urdf.link_map[link].visuals:
        try:
            mesh = _shape(visual.geometry, file.parent)
            if visual.origin is not None:
                mesh.apply_transform(visual.origin)
            if not (len(mesh.vertices) and np.isfinite(mesh.vertices).all()):
                raise ValueError("it has no finite shape")
        except Exception as error:  # of whatever trimesh's readers raise
            raise UserError(f"{file}: link '{link}' cannot be drawn: {error or type(error).__name__}") from error
        material = palette.get(visual.material.name) if visual.material else None
        own = mesh.visual if visual.geometry and visual.geometry.mesh and isinstance(mesh.visual, ColorVisuals) else None
        if material is not None or own is None or not own.defined:
            color = np.round(255 * np.asarray(GREY if material is None else material)).astype(np.uint8)
            mesh.visual = ColorVisuals(mesh, vertex_colors=color)
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
    relative = {robot.trunk_name: base, **joint_transforms(urdf, robot, qpos)}
    paths = link_paths(urdf)
    return {link: reduce(np.matmul, [relative[part] for part in path.split("/")]) for link, path in paths.items()}


def _shape(geometry: yourdfpy.urdf.Geometry | None, folder: Path) -> trimesh.Trimesh:
    if geometry and geometry.sphere:
        return trimesh.creation.icosphere(subdivisions=3, radius=geometry.sphere.radius)
    if geometry and geometry.mesh:
        return _mesh(geometry.mesh, folder)
    if geometry and geometry.box:
        mesh = trimesh.creation.box(extents=geometry.box.size)
    elif geometry and geometry.cylinder:
        mesh = trimesh.creation.cylinder(radius=geometry.cylinder.radius, height=geometry.cylinder.length, sections=32)
    else:
        raise ValueError("it is no box, cylinder, sphere or mesh")
    mesh.unmerge_vertices()  # sharp edges
    return mesh


def _mesh(mesh: yourdfpy.urdf.Mesh, folder: Path) -> trimesh.Trimesh:
    """Read a mesh's file (STL, OBJ, PLY, GLB; COLLADA with pycollada), as one shape, at its scale."""
    file = Path(yourdfpy.filename_handler_magic(mesh.filename, dir=str(folder)))
    if not file.is_file():
        raise ValueError(f"mesh '{mesh.filename}' does not exist in {folder}")
    try:
        shape = trimesh.load(str(file), force="mesh")
    except Exception as error:
        raise ValueError(f"mesh '{file}': {error or type(error).__name__}") from error
    assert isinstance(shape, trimesh.Trimesh)
    shape.apply_scale(1.0 if mesh.scale is None else mesh.scale)
    return shape
