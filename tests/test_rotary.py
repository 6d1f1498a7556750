# pyright: reportAttributeAccessIssue=false
"""The robot with rotary knees: alike the telescopic one in all that the comparison holds equal."""

import mujoco
import numpy as np
import pytest

from telebip import ROOT

L, BEND = 0.335, 0.7  # m, rad: a link, and the knee at home
RADIUS = L * np.sin(0.5 * BEND)  # m/rad, by which a turn of the knee shortens the leg


def at_home(name: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_path(str(ROOT / "assets" / f"{name}.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    return model, data


def leg(model: mujoco.MjModel, data: mujoco.MjData, knee: float) -> float:
    """Distance from the right hip to the right foot with the right knee at `knee` [m]."""
    data.joint("right_knee").qpos = knee
    mujoco.mj_kinematics(model, data)
    return float(np.linalg.norm(data.body("right_foot").xpos - data.body("right_hip").xpos))


@pytest.fixture(scope="module")
def robots():
    return at_home("telebip"), at_home("telebip_rotary")


def test_masses_and_joints_are_the_same(robots) -> None:
    (telescopic, _), (rotary, _) = robots
    for body in range(telescopic.nbody):
        name = telescopic.body(body).name
        assert rotary.body(name).mass == telescopic.body(body).mass
    for actuator in range(telescopic.nu):
        name = telescopic.actuator(actuator).name
        if "knee" not in name:
            for field in ("gainprm", "biasprm", "forcerange"):
                assert np.array_equal(getattr(rotary.actuator(name), field), getattr(telescopic.actuator(actuator), field))


def test_legs_at_home_are_equally_long_and_the_feet_below_the_hips(robots) -> None:
    for model, data in robots:
        assert leg(model, data, float(model.key_qpos[0][9])) == pytest.approx(0.63, abs=1e-3)
        below = data.body("right_foot").xpos - data.body("right_hip").xpos
        assert np.allclose(below[:2], 0.0, atol=1e-9)


def test_the_knee_is_the_same_motor_on_another_gear(robots) -> None:
    (telescopic, _), (rotary, data) = robots
    shortened = (leg(rotary, data, BEND - 1e-4) - leg(rotary, data, BEND + 1e-4)) / 2e-4
    assert shortened == pytest.approx(RADIUS, rel=1e-4)
    slide, hinge = telescopic.joint("right_knee"), rotary.joint("right_knee")
    linear, turning = telescopic.actuator("right_knee"), rotary.actuator("right_knee")
    assert turning.forcerange == pytest.approx(RADIUS * linear.forcerange, rel=2e-3)
    assert turning.gainprm[0] == pytest.approx(RADIUS**2 * linear.gainprm[0], rel=2e-3)
    assert turning.biasprm[2] == pytest.approx(RADIUS**2 * linear.biasprm[2], rel=2e-3)
    assert hinge.armature == pytest.approx(RADIUS**2 * slide.armature, rel=2e-3)
    assert hinge.damping == pytest.approx(RADIUS**2 * slide.damping, rel=2e-3)


def test_swinging_a_leg_takes_nearly_the_same_inertia(robots) -> None:
    inertias = []
    for model, data in robots:
        mass = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass)
        pitch = model.joint("right_hip_pitch").dofadr[0]
        inertias.append(mass[pitch, pitch])
    assert inertias[1] == pytest.approx(inertias[0], rel=0.11)
