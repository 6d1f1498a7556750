# pyright: reportAttributeAccessIssue=false
"""The robot: the numbers its comments promise, that it stands, that it is its own mirror image, and what loading refuses."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from telebip import ROOT
from telebip.errors import UserError
from telebip.robot import JOINTS, Robot, load_robot

PARTS = ("hip", "thigh", "shank", "foot")
MJCF = (ROOT / "assets/telebip.xml").read_text()


def mirror_state(qpos: NDArray[np.float64], qvel: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Reflect a state in the plane y = 0: legs change sides, and y, roll and yaw change sign."""
    swap = [3, 4, 5, 0, 1, 2]
    leg = np.array([-1, 1, 1, -1, 1, 1])
    mirrored_qpos = np.concatenate([qpos[:7] * [1, -1, 1, 1, -1, 1, -1], qpos[7:][swap] * leg])
    return mirrored_qpos, np.concatenate([qvel[:6] * [1, -1, 1, -1, 1, -1], qvel[6:][swap] * leg])


def test_masses(robot: Robot) -> None:
    mass = {robot.model.body(i).name: robot.model.body_mass[i] for i in range(1, robot.model.nbody)}
    legs = {f"{side}_{part}": m for side in ("right", "left") for part, m in zip(PARTS, (0.6, 0.8, 0.3, 0.1), strict=True)}
    assert mass == pytest.approx({"trunk": 10.0} | legs)
    assert robot.weight == pytest.approx(13.6 * 9.81)


def test_actuators_drive_the_joints_in_order(robot: Robot) -> None:
    model = robot.model
    assert JOINTS[:3] == ("right_hip_roll", "right_hip_pitch", "right_knee")
    assert tuple(model.joint(i).name for i in range(model.njnt)) == ("root", *JOINTS)
    assert tuple(model.actuator(i).name for i in range(model.nu)) == JOINTS
    assert tuple(model.joint(model.actuator_trnid[i, 0]).name for i in range(model.nu)) == JOINTS


def test_gains_and_limits(robot: Robot) -> None:
    gain, bias = robot.model.actuator_gainprm, robot.model.actuator_biasprm  # force = gain q_target + bias[1] q + bias[2] qd
    np.testing.assert_allclose(gain[:, 0], [200, 200, 6000] * 2)
    np.testing.assert_allclose(bias[:, 1], [-200, -200, -6000] * 2)
    np.testing.assert_allclose(bias[:, 2], [-6, -6, -200] * 2)
    np.testing.assert_allclose(robot.force_limit, [50, 50, 400] * 2)
    np.testing.assert_allclose(robot.model.actuator_forcerange[:, 0], [-50, -50, -400] * 2)
    np.testing.assert_allclose(robot.joint_range, [[-0.6, 0.6], [-1.2, 1.2], [-0.15, 0.20]] * 2)
    np.testing.assert_allclose(robot.nominal, [0, 0, 0.04] * 2)


def test_physics_runs_at_200_hz(robot: Robot) -> None:
    assert robot.physics_dt == 0.005


@pytest.mark.parametrize("knee", [-0.15, 0.0, 0.04, 0.20])
def test_knee_shortens_the_leg_by_its_value(robot: Robot, knee: float) -> None:
    data = mujoco.MjData(robot.model)
    data.qpos[:] = [0, 0, 2, 1, 0, 0, 0, 0, 0, knee, 0, 0, knee]
    mujoco.mj_forward(robot.model, data)
    for side in ("right", "left"):
        np.testing.assert_allclose(
            data.body(f"{side}_foot").xpos - data.body(f"{side}_hip").xpos, [0, 0, knee - 0.67], atol=1e-12
        )


@pytest.mark.parametrize(
    ("joint", "angle", "foot"),
    [
        ("right_hip_pitch", 0.5, [-0.67 * np.sin(0.5), 0.0, -0.67 * np.cos(0.5)]),  # positive pitch: foot to the back
        ("right_hip_roll", 0.5, [0.0, 0.67 * np.sin(0.5), -0.67 * np.cos(0.5)]),  # positive roll: foot to the left
    ],
)
def test_hip_moves_the_foot_on_a_circle(robot: Robot, joint: str, angle: float, foot: list[float]) -> None:
    data = mujoco.MjData(robot.model)
    data.joint(joint).qpos = angle
    mujoco.mj_forward(robot.model, data)
    np.testing.assert_allclose(data.body("right_foot").xpos - data.body("right_hip").xpos, foot, atol=1e-12)


def test_foot_contact_resists_torsion_and_takes_the_ground_s_friction(robot: Robot) -> None:
    model, data = robot.model, mujoco.MjData(robot.model)
    model.geom_friction[robot.floor_id, 0], before = 0.55, model.geom_friction[robot.floor_id, 0]
    data.qpos[:] = robot.home_qpos
    data.qpos[2] -= 0.001
    mujoco.mj_forward(model, data)
    model.geom_friction[robot.floor_id, 0] = before
    assert data.ncon == 2
    assert list(data.contact.dim) == [4, 4]
    np.testing.assert_allclose(data.contact.friction[:, :3], [[0.55, 0.55, 0.03]] * 2)


def test_home_pose_touches_the_ground_and_stands(robot: Robot) -> None:
    model, data = robot.model, mujoco.MjData(robot.model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    mujoco.mj_forward(model, data)
    for side in ("right", "left"):
        assert data.geom(f"{side}_foot").xpos[2] - model.geom(f"{side}_foot").size[0] == pytest.approx(0.0, abs=1e-9)
    mujoco.mj_step(model, data, nstep=60)
    # Each knee carries half of all but its own shank and foot: 6.4 kg * 9.81 / (6000 N/m) = 10.5 mm.
    np.testing.assert_allclose(data.qpos[[9, 12]], 0.04 + 0.0105, atol=1e-3)
    assert data.qpos[2] == pytest.approx(0.66 - 0.0105, abs=0.01)  # the feet sink in a little
    np.testing.assert_allclose(data.qpos[:2], 0.0, atol=1e-3)
    force = data.sensordata[list(robot.foot_sensor_adr)]
    assert force[0] == pytest.approx(force[1], rel=1e-6)
    assert force.sum() == pytest.approx(13.6 * 9.81, rel=0.02)


def test_the_engines_model_has_the_same_bodies_and_only_what_the_physics_needs(robot: Robot) -> None:
    """That it moves the same, bit for bit, is in tests/sim/test_conformance.py."""
    model, engine = robot.model, robot.engine_model
    assert [engine.geom(i).name for i in range(engine.ngeom)] == ["floor", "trunk", "right_foot", "left_foot"]
    assert [engine.sensor(i).name for i in range(engine.nsensor)] == ["right_foot_force", "left_foot_force"]
    assert (engine.nq, engine.nv, engine.nu, engine.nbody) == (model.nq, model.nv, model.nu, model.nbody)
    for name in ("body_mass", "body_inertia", "body_ipos", "body_iquat", "dof_armature", "dof_invweight0", "jnt_range"):
        np.testing.assert_array_equal(getattr(engine, name), getattr(model, name), err_msg=name)
    assert engine.geom(robot.engine_floor_id).name == "floor"


def test_robot_is_its_own_mirror_image(robot: Robot) -> None:
    model = robot.model
    for part in PARTS:
        right, left = model.body(f"right_{part}"), model.body(f"left_{part}")
        np.testing.assert_allclose(left.pos, right.pos * [1, -1, 1])
        np.testing.assert_allclose(left.ipos, right.ipos * [1, -1, 1])
        np.testing.assert_allclose(left.inertia, right.inertia)
        assert left.mass == right.mass


def test_mirrored_start_gives_the_mirrored_motion(robot: Robot) -> None:
    model, rng = robot.model, np.random.default_rng(0)
    qpos, qvel = robot.home_qpos.copy(), rng.normal(0.0, 0.3, 12)
    qpos[7:] += rng.uniform(-0.03, 0.03, 6)
    ends = []
    for start in ((qpos, qvel), mirror_state(qpos, qvel)):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = start
        data.ctrl[:] = robot.nominal
        mujoco.mj_step(model, data, nstep=40)
        ends.append((data.qpos.copy(), data.qvel.copy(), data.sensordata[list(robot.foot_sensor_adr)]))
    (end_qpos, end_qvel, end_force), mirrored = ends
    assert abs(end_qpos[1]) > 0.005  # it did move sideways
    assert abs(end_force[0] - end_force[1]) > 1.0  # and stood harder on one foot
    for got, expected in zip(mirrored, (*mirror_state(end_qpos, end_qvel), end_force[::-1]), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-5)


def test_relative_path_is_found_from_any_working_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert load_robot("assets/telebip.xml").path == ROOT / "assets/telebip.xml"


def test_missing_file_is_named() -> None:
    with pytest.raises(UserError, match=r"^robot file 'assets/telebop\.xml' does not exist$"):
        load_robot("assets/telebop.xml")


@pytest.mark.parametrize("text", ["<mujoco><worldbody>", "", "no xml", "<robot/>", "<mujoco><worldboddy/></mujoco>"])
def test_broken_mjcf_is_one_line_that_names_the_file(tmp_path: Path, text: str) -> None:
    path = tmp_path / "broken.xml"
    path.write_text(text)
    with pytest.raises(UserError) as caught:
        load_robot(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("edits", "part"),
    [
        ({'joint name="left_knee"': 'joint name="knee"', 'joint="left_knee"': 'joint="knee"'}, "no joint named 'left_knee'"),
        (
            {'position name="left_knee"': 'position name="motor"', 'actuator="left_knee"': 'actuator="motor"'},
            "no actuator named",
        ),
        ({'name="right_foot_force"': 'name="right_force"'}, "no sensor named 'right_foot_force'; valid: 'accelerometer'"),
        ({'key name="home"': 'key name="house"'}, "no key named 'home'; valid: 'house'"),
        ({'body name="trunk"': 'body name="torso"'}, "no body named 'trunk'"),
        ({'geom name="floor"': 'geom name="ground"'}, "no geom named 'floor'"),
        ({'forcerange="-400 400"': ""}, "actuator 'right_knee' needs a forcerange"),
        ({'range="-0.15 0.20" ': ""}, "joint 'right_knee' needs a range"),
        ({'<position name="left_knee"': '<motor name="left_knee"'}, "actuator 'left_knee' must be a position actuator"),
        (
            {'<touch name="left_foot_force" site': '<accelerometer name="left_foot_force" site'},
            "'left_foot_force' must be a touch",
        ),
        ({'<body name="trunk"': '<body name="base"', '<body name="right_hip"': '<body name="trunk"'}, "that of body 'trunk'"),
        ({'name="right_': 'name="tmp_', 'name="left_': 'name="right_', 'name="tmp_': 'name="left_'}, "in this order"),
        ({'<freejoint name="root"/>': ""}, "keyframe"),
    ],
)
def test_mjcf_that_breaks_the_contract_is_refused(tmp_path: Path, edits: dict[str, str], part: str) -> None:
    text = MJCF
    for old, new in edits.items():
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "edited.xml"
    path.write_text(text)
    with pytest.raises(UserError) as caught:
        load_robot(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert part in message
    assert len(message.splitlines()) == 1
