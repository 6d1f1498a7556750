# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
"""The URDF describes the robot of the MJCF: names, masses, inertias, joints, limits, shapes and forward kinematics."""

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from yourdfpy import URDF

from telebip import ROOT
from telebip.robot import Robot

JOINTS = ("right_hip_roll", "right_hip_pitch", "right_knee", "left_hip_roll", "left_hip_pitch", "left_knee")
LINKS = [
    "trunk", "right_hip", "right_thigh", "right_shank", "right_foot", "left_hip", "left_thigh", "left_shank", "left_foot"
]  # fmt: skip


@pytest.fixture(scope="module")
def urdf() -> URDF:
    return URDF.load(str(ROOT / "assets/telebip.urdf"), load_meshes=False)


def matrix(quat: NDArray[np.float64]) -> NDArray[np.float64]:
    result = np.zeros(9)
    mujoco.mju_quat2Mat(result, quat)
    return result.reshape(3, 3)


def test_links_are_the_bodies(urdf: URDF, robot: Robot) -> None:
    assert list(urdf.link_map) == LINKS
    assert [robot.model.body(i).name for i in range(1, robot.model.nbody)] == LINKS


@pytest.mark.parametrize("name", LINKS)
def test_mass_centre_and_inertia(urdf: URDF, robot: Robot, name: str) -> None:
    body, inertial = robot.model.body(name), urdf.link_map[name].inertial
    assert inertial.mass == pytest.approx(body.mass[0], rel=1e-6)
    np.testing.assert_allclose(inertial.origin[:3, 3], body.ipos, atol=1e-9)
    principal = matrix(body.iquat)
    expected = principal @ np.diag(body.inertia) @ principal.T
    axes = inertial.origin[:3, :3]
    np.testing.assert_allclose(axes @ inertial.inertia @ axes.T, expected, rtol=1e-6, atol=1e-6 * expected.max())


@pytest.mark.parametrize("name", JOINTS)
def test_joint_type_axis_and_limits(urdf: URDF, robot: Robot, name: str) -> None:
    model, joint = robot.model, urdf.joint_map[name]
    reference = model.joint(name)
    kinds = {"revolute": mujoco.mjtJoint.mjJNT_HINGE, "prismatic": mujoco.mjtJoint.mjJNT_SLIDE}
    assert int(kinds[joint.type]) == reference.type[0]
    np.testing.assert_allclose(joint.axis, reference.axis)
    np.testing.assert_allclose([joint.limit.lower, joint.limit.upper], reference.range)
    np.testing.assert_allclose([-joint.limit.effort, joint.limit.effort], model.actuator(name).forcerange)
    child = model.body(reference.bodyid[0])
    assert (joint.child, joint.parent) == (child.name, model.body(child.parentid[0]).name)


def test_actuated_joints_are_in_the_order_of_the_actions(urdf: URDF, robot: Robot) -> None:
    assert tuple(urdf.actuated_joint_names) == robot.joint_names == JOINTS


def test_forward_kinematics_of_every_link(urdf: URDF, robot: Robot) -> None:
    data, rng = mujoco.MjData(robot.model), np.random.default_rng(0)
    for _ in range(100):
        joints = rng.uniform(robot.joint_range[:, 0], robot.joint_range[:, 1])
        data.qpos[:] = [0, 0, 0, 1, 0, 0, 0, *joints]
        mujoco.mj_kinematics(robot.model, data)
        urdf.update_cfg(joints)
        for name in LINKS:
            pose = urdf.get_transform(name, "trunk")
            np.testing.assert_allclose(pose[:3, 3], data.body(name).xpos, rtol=0, atol=1e-6)
            np.testing.assert_allclose(pose[:3, :3], data.body(name).xmat.reshape(3, 3), rtol=0, atol=1e-6)


def test_every_geom_of_a_body_is_a_visual_of_the_same_size_and_place(urdf: URDF, robot: Robot) -> None:
    visuals = {visual.name: (link.name, visual) for link in urdf.link_map.values() for visual in link.visuals}
    geoms = {robot.model.geom(i).name: robot.model.geom(i) for i in range(robot.model.ngeom) if i != robot.floor_id}
    assert visuals.keys() == geoms.keys()
    for name, geom in geoms.items():
        link, visual = visuals[name]
        assert link == robot.model.body(geom.bodyid[0]).name
        np.testing.assert_allclose(visual.origin[:3, 3], geom.pos, atol=1e-9)
        kind, shape = mujoco.mjtGeom(geom.type[0]), visual.geometry
        if kind == mujoco.mjtGeom.mjGEOM_BOX:
            np.testing.assert_allclose(shape.box.size, 2 * geom.size)
        elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
            np.testing.assert_allclose([shape.cylinder.radius, shape.cylinder.length], [geom.size[0], 2 * geom.size[1]])
            np.testing.assert_allclose(np.abs(visual.origin[:3, 2]), np.abs(matrix(geom.quat)[:, 2]), atol=1e-6)
        else:
            assert kind == mujoco.mjtGeom.mjGEOM_SPHERE
            assert shape.sphere.radius == pytest.approx(geom.size[0])


def test_what_collides_is_the_trunk_and_the_feet(urdf: URDF, robot: Robot) -> None:
    model = robot.model
    colliding = {model.geom(i).name for i in range(model.ngeom) if model.geom_contype[i] or model.geom_conaffinity[i]}
    assert colliding == {"floor", "trunk", "right_foot", "left_foot"}
    assert {shape.name for link in urdf.link_map.values() for shape in link.collisions} == colliding - {"floor"}
