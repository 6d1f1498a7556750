# pyright: reportAttributeAccessIssue=false
"""The walkers' model of the robot, with C MuJoCo as the oracle."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from telebip import ROOT
from telebip.control.kinematics import Kinematics, Motion, cross, joint_forces, rotate, rotate_back
from telebip.errors import UserError
from telebip.robot import Robot, load_robot

WORLDS = 16


@pytest.fixture(scope="module")
def kinematics(robot: Robot) -> Kinematics:
    return Kinematics(robot, torch.device("cpu"))


@pytest.fixture(scope="module")
def states(robot: Robot) -> list[tuple[mujoco.MjData, NDArray[np.float64]]]:
    """Random states anywhere in the joints' ranges, as MuJoCo sees them, each with the trunk's orientation."""
    rng, model, result = np.random.default_rng(0), robot.model, []
    for _ in range(WORLDS):
        data = mujoco.MjData(model)
        quat = rng.normal(size=4)
        joints = rng.uniform(*robot.joint_range.T)
        data.qpos[:] = np.concatenate([rng.normal(size=3), quat / np.linalg.norm(quat), joints])
        data.qvel[:] = rng.normal(size=12) * 2.0
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_subtreeVel(model, data)
        result.append((data, data.xmat[robot.trunk_id].reshape(3, 3)))
    return result


@pytest.fixture(scope="module")
def motion(kinematics: Kinematics, states) -> Motion:
    qpos, qvel = (tensor([getattr(data, name) for data, _ in states]) for name in ("qpos", "qvel"))
    return kinematics(legs(qpos[7:]), legs(qvel[6:]), qvel[3:6])


def tensor(rows) -> Tensor:
    """Rows of worlds as a tensor with the worlds last."""
    return torch.tensor(np.array(rows), dtype=torch.float32).T


def legs(joints: Tensor) -> Tensor:
    """(6, worlds) as (3, 2 legs, worlds)."""
    return joints.unflatten(0, (2, 3)).transpose(0, 1)


def test_masses_and_lengths_come_from_the_model(kinematics: Kinematics) -> None:
    assert kinematics.mass == pytest.approx(13.6)
    assert (kinematics.gravity, kinematics.friction) == (pytest.approx(9.81), pytest.approx(0.8))
    assert (kinematics.leg_length, kinematics.foot_radius) == (pytest.approx(0.67), pytest.approx(0.03))
    torch.testing.assert_close(kinematics.hip[..., 0], torch.tensor([[0.0, 0.0], [-0.1, 0.1], [0.0, 0.0]]))
    assert kinematics.stiffness[:, 0].tolist() == [200.0, 200.0, 6000.0]
    assert kinematics.damping[:, 0].tolist() == [6.0, 6.0, 200.0]


def test_centre_of_mass_and_its_velocity(robot: Robot, states, motion: Motion) -> None:
    trunk = robot.trunk_id
    com = [frame.T @ (data.subtree_com[trunk] - data.qpos[:3]) for data, frame in states]
    vel = [frame.T @ (data.subtree_linvel[trunk] - data.qvel[:3]) for data, frame in states]
    torch.testing.assert_close(motion.com, tensor(com), atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(motion.com_vel, tensor(vel), atol=1e-5, rtol=1e-5)


def test_angular_momentum(robot: Robot, states, motion: Motion) -> None:
    expected = tensor([frame.T @ data.subtree_angmom[robot.trunk_id] for data, frame in states])
    assert expected.abs().mean() > 0.1
    torch.testing.assert_close(motion.ang_mom, expected, atol=1e-5, rtol=1e-4)


def test_legs_reach_from_hip_to_foot(robot: Robot, states, motion: Motion) -> None:
    model = robot.model
    for side, foot in enumerate(("right", "left")):
        hip, site = model.joint(f"{foot}_hip_roll").id, model.site(f"{foot}_foot").id
        leg = [frame.T @ (data.site_xpos[site] - data.xanchor[hip]) for data, frame in states]
        torch.testing.assert_close(motion.leg[:, side], tensor(leg), atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize(("side", "foot"), [(0, "right_foot"), (1, "left_foot")])
def test_joint_forces_are_minus_jacobian_transposed_times_force(
    robot: Robot, states, motion: Motion, side: int, foot: str
) -> None:
    force = torch.randn(3, WORLDS, generator=torch.Generator().manual_seed(1)) * 100.0
    offset = np.array([0.01, -0.02, -0.03])  # from the foot's centre, trunk frame
    expected = []
    for (data, frame), f in zip(states, force.T.double().numpy(), strict=True):
        jacobian = np.empty((3, 12))
        point = data.site(foot).xpos + frame @ offset
        mujoco.mj_jac(robot.model, data, jacobian, None, point, robot.model.body(foot).id)
        expected.append(-jacobian[:, 6 + 3 * side : 9 + 3 * side].T @ frame @ f)
    forces = joint_forces(motion.pitch_axis[:, side], motion.knee_axis[:, side], motion.leg[:, side] + tensor([offset]), force)
    torch.testing.assert_close(forces, tensor(expected), atol=1e-3, rtol=1e-5)


def test_inverse_kinematics_round_trip(kinematics: Kinematics, states, motion: Motion) -> None:
    joints = legs(tensor([data.qpos[7:] for data, _ in states]))
    torch.testing.assert_close(kinematics.inverse(motion.leg), joints, atol=1e-5, rtol=0.0)


@pytest.mark.parametrize(
    ("leg", "joints"),
    [
        ([0.0, 0.0, -0.63], [0.0, 0.0, 0.04]),  # hanging straight down: the nominal pose
        ([-0.3, 0.0, -0.4], [0.0, 0.6435, 0.17]),  # behind, 0.5 m long: pitched forward by asin(3/5)
        ([0.0, 0.3, -0.4], [0.6435, 0.0, 0.17]),  # to the left: rolled positively
    ],
)
def test_inverse_kinematics_of_triangles(kinematics: Kinematics, leg: list[float], joints: list[float]) -> None:
    torch.testing.assert_close(kinematics.inverse(torch.tensor(leg)), torch.tensor(joints), atol=1e-4, rtol=0.0)


def test_inverse_rate_undoes_the_jacobian(robot: Robot, kinematics: Kinematics, states, motion: Motion) -> None:
    for side, foot in enumerate(("right_foot", "left_foot")):
        rows = []
        for data, frame in states:
            jacobian = np.empty((3, 12))
            mujoco.mj_jacSite(robot.model, data, jacobian, None, robot.model.site(foot).id)
            rows.append(frame.T @ jacobian[:, 6 + 3 * side : 9 + 3 * side] @ data.qvel[6 + 3 * side : 9 + 3 * side])
        rate = kinematics.inverse_rate(motion.leg[:, side], tensor(rows))
        joint_vel = tensor([data.qvel[6 + 3 * side : 9 + 3 * side] for data, _ in states])
        torch.testing.assert_close(rate, joint_vel, atol=2e-5, rtol=1e-4)


def test_rotations_and_the_cross_product() -> None:
    a, b = torch.randn(2, 3, 5, generator=torch.Generator().manual_seed(2))
    torch.testing.assert_close(cross(a, b), torch.linalg.cross(a, b, dim=0))
    quarter = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])[:, :, None]  # x to y, y to -x
    torch.testing.assert_close(rotate(quarter, a), torch.stack([-a[1], a[0], a[2]]))
    torch.testing.assert_close(rotate_back(quarter, rotate(quarter, a)), a)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ('<joint name="right_hip_pitch" class="hip_pitch"/>', '<joint name="right_hip_pitch" class="hip_pitch" axis="0 0 1"/>'),
        ('<joint name="left_hip_pitch" class="hip_pitch"/>', '<joint name="left_hip_pitch" class="hip_pitch" pos="0 0 0.1"/>'),
        ('<body name="right_shank" pos="0 0 -0.67">', '<body name="right_shank" pos="0.05 0 -0.67">'),
        ('size="0.03 0.18" pos="0 0 -0.18"', 'size="0.03 0.18" pos="0.01 0 -0.18"'),  # the thighs' mass in front of the axis
        (
            '<geom name="left_shank" type="cylinder" size="0.018 0.225" pos="0 0 0.225" mass="0.3"',
            '<geom name="left_shank" type="cylinder" size="0.018 0.225" pos="0 0 0.225" mass="0.4"',
        ),
    ],
)
def test_other_legs_are_refused(tmp_path: Path, before: str, after: str) -> None:
    text = (ROOT / "assets/telebip.xml").read_text()
    assert before in text
    path = tmp_path / "robot.xml"
    path.write_text(text.replace(before, after))
    with pytest.raises(UserError, match=r"robot\.xml: the model-based walkers need two like legs of hip roll"):
        Kinematics(load_robot(path), torch.device("cpu"))


def test_other_joints_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "robot.xml"
    path.write_text((ROOT / "assets/telebip.xml").read_text().replace("right_knee", "right_shin"))
    with pytest.raises(UserError, match=r"robot\.xml: the model-based walkers need the joints right_hip_roll, .*, left_knee"):
        Kinematics(load_robot(path), torch.device("cpu"))
