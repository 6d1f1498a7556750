# pyright: reportAttributeAccessIssue=false
"""The idealised floor of the cost of transport: the formulas of docs/evaluation.md, with the numbers of the robot's MJCF."""

import re
from dataclasses import dataclass

import mujoco
import numpy as np
import pytest

from telebip import ROOT

G, CLEARANCE = 9.81, 0.02  # m/s^2, m


@dataclass(frozen=True)
class Body:
    """What the floor depends on."""

    mass: float  # of the robot [kg]
    length: float  # from the hip to the ground [m]
    inertia: float  # of a leg about its hip, with the rotor [kg m^2]
    moment: float  # of a leg: mass x distance of its centre from the hip [kg m]
    foot_mass: float  # that the knee lifts [kg]
    armature: float  # of the knee [kg]
    damping: float  # of the knee [N s/m]


@pytest.fixture(scope="module")
def body() -> Body:
    """The numbers of the MJCF, with the legs stretched."""
    model = mujoco.MjModel.from_xml_path(str(ROOT / "assets" / "telebip.xml"))
    data = mujoco.MjData(model)
    data.qpos[:7] = (0, 0, 0.7, 1, 0, 0, 0)
    mujoco.mj_forward(model, data)
    dense = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, dense)
    pitch, knee = (model.joint(f"right_{name}").dofadr[0] for name in ("hip_pitch", "knee"))
    leg = [model.body(f"right_{name}").id for name in ("thigh", "shank", "foot")]
    hip = data.xanchor[model.joint("right_hip_pitch").id]
    return Body(
        mass=float(model.body_subtreemass[1]),
        length=0.7,
        inertia=float(dense[pitch, pitch]),
        moment=float(sum(model.body_mass[i] * (hip - data.xipos[i])[2] for i in leg)),
        foot_mass=float(model.body_mass[leg[1:]].sum()),
        armature=float(model.dof_armature[knee]),
        damping=float(model.dof_damping[knee]),
    )


def floor(body: Body, speed: float, time: float) -> dict[str, float]:
    """Return the parts of the cost of transport, of absolute work, at a speed [m/s] and a time of one step [s]."""
    step = speed * time
    k = np.sqrt(G / body.length)
    at_exchange = 0.5 * step * k / np.tanh(0.5 * k * time)
    angle = np.arcsin(0.5 * step / body.length)
    push_off = 0.5 * (body.mass + body.armature) * (at_exchange * np.tan(angle)) ** 2
    natural = np.sqrt(body.moment * G / body.inertia)
    swinging, standing = angle * natural / np.tan(0.5 * natural * time), at_exchange / body.length
    lifted = body.foot_mass + body.armature
    fall = body.foot_mass * G / lifted
    rise = min(0.5 * time, np.sqrt(2.0 * CLEARANCE / fall))
    up = CLEARANCE / rise + 0.5 * fall * rise
    down = CLEARANCE / rise - 0.5 * fall * rise  # what is left of it at the top, to be braked there, and given anew
    square = (up**2 + up * down + down**2) / 3.0  # mean of the squared speed of either way
    lift = lifted * (up**2 + down**2) + 2.0 * body.damping * square * rise
    work = {"exchange": 2.0 * push_off, "swing": body.inertia * (swinging**2 + standing**2), "lift": lift}
    return {name: float(joules / (body.mass * G * step)) for name, joules in work.items()}


def best(body: Body, speed: float) -> tuple[float, dict[str, float]]:
    """Return the step time of the least cost, and that cost."""
    times = np.arange(0.2, 1.0, 0.005)
    time = float(min(times, key=lambda time: sum(floor(body, speed, time).values())))
    return time, floor(body, speed, time)


def test_the_robot_is_the_one_of_the_documentation(body: Body) -> None:
    assert body.mass == pytest.approx(13.6)
    assert body.inertia == pytest.approx(0.154, abs=5e-4)
    assert body.moment == pytest.approx(0.3445)
    assert (body.foot_mass, body.armature, body.damping) == pytest.approx((0.4, 1.0, 5.0))


def test_limits_of_the_formulas(body: Body) -> None:
    """Small steps: v tan(a) = v s / 2l; a swing of half the natural period needs no push; a slow rise costs twice m g h."""
    short = floor(body, 0.7, 0.01)
    assert short["exchange"] == pytest.approx(0.7**2 * 0.007 / (4 * 0.7**2 * G) * 14.6 / 13.6, rel=1e-3)
    natural = np.pi / np.sqrt(body.moment * G / body.inertia)
    assert natural == pytest.approx(0.670, abs=0.001)
    standing = 0.5 * natural * np.sqrt(G / 0.7) / np.tanh(0.5 * natural * np.sqrt(G / 0.7)) * 0.5 / 0.7
    step = 0.5 * natural
    assert floor(body, 0.5, natural)["swing"] == pytest.approx(body.inertia * standing**2 / (13.6 * G * step), rel=1e-3)
    undamped = floor(Body(**{**body.__dict__, "damping": 0.0}), 0.5, 1.0)
    assert undamped["lift"] == pytest.approx(2 * 0.4 * CLEARANCE / (13.6 * 0.5), rel=1e-6)


def test_the_documentation_has_these_numbers(body: Body) -> None:
    text = (ROOT / "docs" / "evaluation.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (0\.5|0\.7|1\.0) m/s \| (free|0\.30 s) \| (.*) \|$", text, flags=re.MULTILINE)
    assert len(rows) == 6
    for speed, time, cells in rows:
        step_time, parts = best(body, float(speed)) if time == "free" else (0.3, floor(body, float(speed), 0.3))
        numbers = [f"{step_time:.2f}", *(f"{part:.4f}" for part in parts.values()), f"{sum(parts.values()):.3f}"]
        assert cells.split(" | ") == numbers
