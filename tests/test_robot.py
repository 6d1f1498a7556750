# pyright: reportAttributeAccessIssue=false
"""The robot: the numbers its comments promise, that it stands, that it is its own mirror image, and what loading refuses."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from telebip import ROOT
from telebip.errors import UserError
from telebip.robot import FOOT_SENSORS, JointMirror, Robot, load_robot

PARTS = ("hip", "thigh", "shank", "foot")
MJCF = (ROOT / "assets/telebip.xml").read_text()


JOINTS = ("right_hip_roll", "right_hip_pitch", "right_knee", "left_hip_roll", "left_hip_pitch", "left_knee")
FOLDER = ROOT / "tests" / "robots"
LEFT_KNEE = '<joint name="left_knee" class="knee"/>'
POSITION = '<position name="left_knee" joint="left_knee" class="knee"/>'
GENERAL = (
    '<general name="left_knee" joint="left_knee" forcerange="-400 400" biastype="affine" gainprm="6000" '
    'biasprm="0 -6000 -200"/>'
)
LEFT_SHANK = '<geom name="left_shank" type="cylinder" size="0.018 0.225" pos="0 0 0.225" mass="0.3"'


def edited(tmp_path: Path, text: str, edits: dict[str, str]) -> Path:
    """Write an MJCF in which the keys of `edits` are replaced by their values."""
    for old, new in edits.items():
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "edited.xml"
    path.write_text(text)
    return path


def mirror_state(
    robot: Robot, qpos: NDArray[np.float64], qvel: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Reflect a state in the plane y = 0: joints as `Robot.mirror` says, and y, roll and yaw change sign."""
    assert isinstance(robot.mirror, JointMirror)
    order, sign = robot.mirror.order, np.array(robot.mirror.sign)
    mirrored_qpos = np.concatenate([qpos[:7] * [1, -1, 1, 1, -1, 1, -1], qpos[7:][order] * sign])
    return mirrored_qpos, np.concatenate([qvel[:6] * [1, -1, 1, -1, 1, -1], qvel[6:][order] * sign])


def foot_force(data: mujoco.MjData) -> NDArray[np.float64]:
    return np.concatenate([data.sensor(name).data for name in FOOT_SENSORS])


def test_masses(robot: Robot) -> None:
    mass = {robot.model.body(i).name: robot.model.body_mass[i] for i in range(1, robot.model.nbody)}
    legs = {f"{side}_{part}": m for side in ("right", "left") for part, m in zip(PARTS, (0.6, 0.8, 0.3, 0.1), strict=True)}
    assert mass == pytest.approx({"trunk": 10.0} | legs)
    assert robot.weight == pytest.approx(13.6 * 9.81)


def test_joints_are_those_of_the_actuators_in_their_order(robot: Robot) -> None:
    model = robot.model
    assert robot.joint_names == JOINTS
    assert tuple(model.joint(i).name for i in range(model.njnt)) == ("root", *JOINTS)
    assert tuple(model.joint(model.actuator_trnid[i, 0]).name for i in range(model.nu)) == JOINTS
    assert robot.joint_columns == slice(7, 13)
    assert list(robot.is_slide) == [False, False, True] * 2


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
    force = foot_force(data)
    assert force[0] == pytest.approx(force[1], rel=1e-6)
    assert force.sum() == pytest.approx(13.6 * 9.81, rel=0.02)


def test_the_engines_model_has_the_same_bodies_and_only_what_the_physics_needs(robot: Robot) -> None:
    """That it moves the same, bit for bit, is in tests/sim/test_conformance.py."""
    model, engine = robot.model, robot.engine_model()
    assert [engine.geom(i).name for i in range(engine.ngeom)] == ["floor", "trunk", "right_foot", "left_foot"]
    assert [engine.sensor(i).name for i in range(engine.nsensor)] == ["right_foot_ground_force", "left_foot_ground_force"]
    assert (engine.ncam, engine.nlight) == (0, 0)
    assert (engine.nq, engine.nv, engine.nu, engine.nbody) == (model.nq, model.nv, model.nu, model.nbody)
    for name in ("body_mass", "body_inertia", "body_ipos", "body_iquat", "dof_armature", "dof_invweight0", "jnt_range"):
        np.testing.assert_array_equal(getattr(engine, name), getattr(model, name), err_msg=name)


def test_the_engines_model_keeps_what_its_sensors_look_at(tmp_path: Path) -> None:
    more = """<rangefinder name="range" site="imu"/><framepos name="eye" objtype="camera" objname="track"/></sensor>"""
    robot = load_robot(edited(tmp_path, MJCF, {"</sensor>": more}))
    plain, seeing, eye = robot.engine_model(["gyro"]), robot.engine_model(["range"]), robot.engine_model(["eye"])
    assert [plain.sensor(i).name for i in range(plain.nsensor)] == ["gyro", "right_foot_ground_force", "left_foot_ground_force"]
    assert seeing.ngeom == robot.model.ngeom > plain.ngeom  # rays end at what collides with nothing, too
    assert (eye.ncam, plain.ncam) == (1, 0)


def test_robot_is_its_own_mirror_image(robot: Robot) -> None:
    model = robot.model
    for part in PARTS:
        right, left = model.body(f"right_{part}"), model.body(f"left_{part}")
        np.testing.assert_allclose(left.pos, right.pos * [1, -1, 1])
        np.testing.assert_allclose(left.ipos, right.ipos * [1, -1, 1])
        np.testing.assert_allclose(left.inertia, right.inertia)
        assert left.mass == right.mass


@pytest.mark.parametrize("path", ["assets/telebip.xml", "tests/robots/rotary_knee.xml", "tests/robots/ten_joints.xml"])
def test_mirrored_start_gives_the_mirrored_motion(path: str) -> None:
    robot = load_robot(ROOT / path)
    model, rng = robot.model, np.random.default_rng(0)
    qpos, qvel = robot.home_qpos.copy(), rng.normal(0.0, 0.3, model.nv)
    qpos[7:] += rng.uniform(-0.03, 0.03, model.nu)
    ends = []
    for start in ((qpos, qvel), mirror_state(robot, qpos, qvel)):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = start
        data.ctrl[:] = robot.nominal
        mujoco.mj_step(model, data, nstep=40)
        ends.append((data.qpos.copy(), data.qvel.copy(), foot_force(data)))
    (end_qpos, end_qvel, end_force), mirrored = ends
    assert abs(end_qpos[1]) > 0.003  # it did move sideways
    assert abs(end_force[0] - end_force[1]) > 1.0  # and stood harder on one foot
    for got, expected in zip(mirrored, (*mirror_state(robot, end_qpos, end_qvel), end_force[::-1]), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-5)


def test_mirror_of_telebip(robot: Robot) -> None:
    """The legs change places; a roll to the right becomes one to the left, a pitch and a knee stay what they are."""
    assert robot.mirror == JointMirror([3, 4, 5, 0, 1, 2], [-1.0, 1.0, 1.0, -1.0, 1.0, 1.0])


def test_mirror_of_ten_joints() -> None:
    mirror = load_robot(FOLDER / "ten_joints.xml").mirror
    assert mirror == JointMirror([5, 6, 7, 8, 9, 0, 1, 2, 3, 4], [-1.0, -1.0, 1.0, 1.0, 1.0] * 2)  # yaw and roll


@pytest.mark.parametrize(
    ("edits", "reason"),
    [
        ({'joint name="left_knee"': 'joint name="knee_l"', 'joint="left_knee"': 'joint="knee_l"'}, "no joint 'left_knee'"),
        ({'name="left_hip_roll" class="hip_roll"': 'name="left_hip_roll" class="hip_pitch"'}, "axes of joints"),
        ({'body name="left_hip" pos="0 0.1 0"': 'body name="left_hip" pos="0 0.12 0"'}, "places of the feet's touch sensors"),
        (
            {'name="left_hip_pitch" class="hip_pitch"/>': 'name="left_hip_pitch" pos="0 0 -0.05" class="hip_pitch"/>'},
            "anchors of",
        ),
        ({LEFT_SHANK: LEFT_SHANK.replace("0.3", "0.4")}, "masses of joints"),
        ({'name="trunk" type="box" pos="0 0 0.1"': 'name="trunk" type="box" pos="0 0.02 0.1"'}, "masses of body 'trunk'"),
        ({'0 0 0.04  0 0 0.04"': '0 0.1 0.04  0 0 0.04"', '-0.15 0.20"': '-0.15 0.20"'}, "places of the feet's touch sensors"),
        ({LEFT_KNEE: LEFT_KNEE.replace("/", ' range="-0.15 0.1"/')}, "ranges of joints"),
        ({LEFT_KNEE: LEFT_KNEE.replace("/", ' damping="7"/')}, "damping of joints"),
        ({'joint="left_knee" class="knee"': 'joint="left_knee" class="knee" forcerange="-300 300"'}, "force limits of joints"),
        ({'joint="left_knee" class="knee"': 'joint="left_knee" class="knee" kp="5000"'}, "gains of joints"),
        ({'qpos="0 0 0.66  1 0 0 0': 'qpos="0 0 0.66  0.995 0.0998 0 0'}, "body 'trunk' leans to one side"),
        (
            {
                '    <position name="left_knee" joint="left_knee" class="knee"/>\n': "",
                '<actuatorfrc name="left_knee_force" actuator="left_knee"/>': "",
                '<actuatorpos name="left_knee_pos" actuator="left_knee"/>': "",
                '<actuatorvel name="left_knee_vel" actuator="left_knee"/>': "",
                '0 0 0.04 0 0 0.04"/>': '0 0 0.04 0 0"/>',
            },
            "only one actuator on joints",
        ),
    ],
)
def test_why_a_robot_is_not_its_mirror_image_is_told(tmp_path: Path, edits: dict[str, str], reason: str) -> None:
    mirror = load_robot(edited(tmp_path, MJCF, edits)).mirror
    assert isinstance(mirror, str)
    assert mirror.startswith(reason)


def test_mirror_does_not_depend_on_the_home_pose_s_place_and_heading(tmp_path: Path, robot: Robot) -> None:
    turned = {'qpos="0 0 0.66  1 0 0 0': f'qpos="3 -2 0.66  {np.cos(0.6)} 0 0 {np.sin(0.6)}'}
    assert load_robot(edited(tmp_path, MJCF, turned)).mirror == robot.mirror


def test_mirror_takes_the_side_from_the_end_of_the_name_too(tmp_path: Path) -> None:
    text = (FOLDER / "four_joints.xml").read_text()
    path = tmp_path / "suffix.xml"
    path.write_text(re.sub(r"(right|left)_(hip_pitch|knee|spring)", r"\2_\1", text))
    robot = load_robot(path)
    assert robot.joint_names == ("hip_pitch_right", "knee_right", "hip_pitch_left", "knee_left")
    assert robot.mirror == JointMirror([2, 3, 0, 1], [1.0] * 4)


def test_joints_without_an_actuator_are_left_out(robot: Robot) -> None:
    robot = load_robot(FOLDER / "four_joints.xml")
    assert robot.joint_names == ("right_hip_pitch", "right_knee", "left_hip_pitch", "left_knee")  # not the actuators' names
    assert robot.model.nq == 7 + 6
    assert robot.joint_columns == [7, 8, 10, 11]
    np.testing.assert_allclose(robot.nominal, [0.0, 0.04] * 2)
    np.testing.assert_allclose(robot.force_limit, [60.0, 300.0] * 2)
    assert robot.mirror == JointMirror([2, 3, 0, 1], [1.0] * 4)


def test_the_actuators_order_is_that_of_the_joints(tmp_path: Path) -> None:
    lines = [f'<position name="{name}" joint="{name}" class="{name.split("_", 1)[1]}"/>' for name in JOINTS]
    text = re.sub(r"<actuator>.*</actuator>", f"<actuator>{''.join(lines[::-1])}</actuator>", MJCF, flags=re.DOTALL)
    robot = load_robot(edited(tmp_path, text, {}))
    assert robot.joint_names == JOINTS[::-1]
    assert robot.joint_columns == [12, 11, 10, 9, 8, 7]
    np.testing.assert_allclose(robot.nominal, [0.04, 0, 0] * 2)
    assert robot.mirror == JointMirror([3, 4, 5, 0, 1, 2], [1.0, 1.0, -1.0] * 2)


@pytest.mark.parametrize(
    "path", ["assets/telebip.xml", *(f"tests/robots/{n}.xml" for n in ("rotary_knee", "ten_joints", "four_joints"))]
)
def test_foot_lift_is_the_derivative_of_the_feet_s_heights(path: str) -> None:
    robot, step = load_robot(ROOT / path), 1e-6
    model, data = robot.model, mujoco.MjData(robot.model)
    sites = [model.sensor(name).objid[0] for name in FOOT_SENSORS]
    heights = {}
    for j in range(model.nu):
        for sign in (-1.0, 1.0):
            data.qpos[:] = robot.home_qpos
            data.joint(robot.joint_names[j]).qpos += sign * step
            mujoco.mj_kinematics(model, data)
            heights[j, sign] = data.site_xpos[sites, 2].copy()
    expected = [(heights[j, 1.0] - heights[j, -1.0]) / (2.0 * step) for j in range(model.nu)]
    np.testing.assert_allclose(robot.foot_lift, np.transpose(expected), atol=1e-8)


def test_a_telescopic_knee_lifts_its_foot_by_its_value(robot: Robot) -> None:
    np.testing.assert_allclose(robot.foot_lift, [[0, 0, 1, 0, 0, 0], [0, 0, 0, 0, 0, 1]], atol=1e-12)


@pytest.mark.parametrize("name", ["ten_joints", "four_joints"])
def test_robots_of_the_tests_stand(name: str) -> None:
    robot = load_robot(FOLDER / f"{name}.xml")
    data = mujoco.MjData(robot.model)
    data.qpos[:], data.ctrl[:] = robot.home_qpos, robot.nominal
    mujoco.mj_step(robot.model, data, nstep=round(1.0 / robot.physics_dt))
    np.testing.assert_allclose(data.qpos, robot.home_qpos, atol=0.03)
    assert foot_force(data).sum() == pytest.approx(robot.weight, rel=0.02)
    assert np.abs(data.qvel).max() < 0.05


def test_relative_path_is_found_from_any_working_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert load_robot("assets/telebip.xml").path == ROOT / "assets/telebip.xml"


def test_missing_file_is_named() -> None:
    with pytest.raises(
        UserError, match=r"^robot file 'assets/telebop\.xml' does not exist; if it has moved, .* sim\.robot=FILE$"
    ):
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
        ({'name="right_foot_force"': 'name="right_force"'}, "no sensor named 'right_foot_force'; valid: 'accelerometer'"),
        ({'key name="home"': 'key name="house"'}, "no key named 'home'; valid: 'house'"),
        ({'geom name="floor"': 'geom name="ground"'}, "no geom named 'floor'"),
        ({'forcerange="-400 400"': ""}, "actuator 'right_knee' needs a forcerange"),
        ({'range="-0.15 0.20" ': ""}, "joint 'right_knee' needs a range"),
        ({'<position name="left_knee"': '<motor name="left_knee"'}, "actuator 'left_knee' must be a position actuator"),
        (
            {'<position name="left_knee"': '<intvelocity kp="9" actrange="-1 1" name="left_knee"'},
            "'left_knee' must act at once",
        ),
        ({'<position name="left_knee"': '<position gear="0" name="left_knee"'}, "actuator 'left_knee' has a gear of 0"),
        ({'name="left_knee" joint="left_knee"': 'name="left_knee" site="imu"'}, "actuator 'left_knee' must drive one joint"),
        ({'joint="left_knee"': 'joint="right_knee"'}, "joint 'right_knee' has a second actuator, 'left_knee'"),
        ({'joint name="right_hip_roll"': 'joint type="ball" range="0 1" name="right_hip_roll"'}, "must be a hinge or a slide"),
        (
            {'<touch name="left_foot_force" site': '<accelerometer name="left_foot_force" site'},
            "'left_foot_force' must be a touch",
        ),
        ({'<freejoint name="root"/>': ""}, "keyframe"),
        ({"<option ": '<option gravity="0 0 0" '}, "option gravity is '0 0 0'; it must point down"),
        ({"<option ": '<option gravity="0 -9.81 0" '}, "option gravity is '0 -9.81 0'"),
        ({"<option ": '<option gravity="0 0 9.81" '}, "option gravity is '0 0 9.81'"),
        ({'timestep="0.005"': 'timestep="1e-9"'}, "option timestep is 1e-09 s"),
        ({"<option ": '<option><flag contact="disable"/></option><option '}, "option flag contact is disabled"),
        ({"<option ": '<option><flag actuation="disable"/></option><option '}, "option flag actuation is disabled"),
        ({"<option ": '<option actuatorgroupdisable="0" '}, "actuator 'right_hip_roll' is disabled with its group"),
        ({'forcerange="-400 400"': 'forcerange="-400 0"'}, "actuator 'right_knee' has forcerange \"-400 0\""),
        ({'forcerange="-400 400"': 'forcerange="10 400"'}, "actuator 'right_knee' has forcerange \"10 400\""),
        ({'kp="6000"': 'kp="6000" ctrlrange="-0.1 0.02"'}, "actuator 'right_knee' clips targets to ctrlrange \"-0.1 0.02\""),
        ({POSITION: GENERAL.replace("0 -6000 -200", "30 -6000 -200")}, "actuator 'left_knee' adds the force 30"),
        (
            {'range="-0.15 0.20"': 'range="0.05 0.20"'},
            "joint 'right_knee' stands at 0.04 in keyframe 'home', outside of its range",
        ),
        ({'<freejoint name="root"/>': '<joint type="free" damping="3"/>'}, "the free joint of body 'trunk' has damping 3"),
        (
            {'<freejoint name="root"/>': '<joint type="free" armature="0.1"/>'},
            "the free joint of body 'trunk' has armature 0.1",
        ),
        ({'<geom name="floor"': '<geom name="floor" euler="0.1 0 0"'}, "geom 'floor' is tilted"),
        ({'<geom name="floor"': '<geom name="floor" pos="0 0 -0.2"'}, "geom 'floor' lies at z = -0.2"),
        (
            {
                'force" site="right_foot"': 'force" site="left"',
                'force" site="left_foot"': 'force" site="right_foot"',
                'site="left"': 'site="left_foot"',
            },
            "sensor 'right_foot_force' is on the left foot",
        ),
        (
            {'force" site="right_foot"': 'force" site="imu"'},
            "sensor 'right_foot_force' is on site 'imu' of body 'trunk', which is no foot",
        ),
        ({'force" site="right_foot"': 'force" site="left_foot"'}, "both feet's sensors are on body 'left_foot'"),
        (
            {'contype="2" conaffinity="3" condim': 'contype="4" conaffinity="4" condim'},
            "no geom of body 'right_foot' collides with geom 'floor'",
        ),
        (
            {'force" site="right_foot"': 'force" cutoff="20" site="right_foot"'},
            "sensor 'right_foot_force' has a cutoff of 20 N",
        ),
        ({'armature="1"': 'armature="nan"'}, "dof_armature of joint 'right_knee' is not finite"),
        ({'kp="6000"': 'kp="nan"'}, "actuator_gainprm of actuator 'right_knee' is not finite"),
    ],
)
def test_mjcf_that_breaks_the_contract_is_refused(tmp_path: Path, edits: dict[str, str], part: str) -> None:
    path = edited(tmp_path, MJCF, edits)
    with pytest.raises(UserError) as caught:
        load_robot(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert part in message
    assert len(message.splitlines()) == 1


def test_a_robot_without_actuators_is_refused(tmp_path: Path) -> None:
    text = re.sub(r"<actuator>.*</actuator>", "", MJCF, flags=re.DOTALL)
    text = re.sub(r"<actuator(frc|pos|vel).*?/>", "", text).replace('ctrl="0 0 0.04 0 0 0.04"', "")
    with pytest.raises(UserError, match="expected position actuators"):
        load_robot(edited(tmp_path, text, {}))
