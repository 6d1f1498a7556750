"""The laws of the swing and the stance leg, with numbers that a reader can check by hand."""

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from telebip.control.config import WalkerConfig, load_controller
from telebip.control.legs import Hold, stance_force, swing_path

CFG = load_controller("alip")
WEIGHT = 13.6 * 9.81
HOLD = Hold(
    *(torch.tensor(row)[:, None] for row in ([200.0, 200.0, 6000.0], [6.0, 6.0, 200.0], [50.0, 50.0, 400.0])), step_dt=0.02
)


def path(phase: Tensor, cfg: WalkerConfig = CFG) -> tuple[Tensor, Tensor]:
    rows = len(phase)
    start, target = (torch.tensor(v)[:, None].expand(len(v), rows) for v in ([-0.1, 0.12, 0.002], [0.15, 0.09]))
    return swing_path(start.double(), target.double(), phase.double(), cfg)


def test_the_swing_foot_goes_from_lift_off_over_the_clearance_to_the_target() -> None:
    pos, vel = path(torch.tensor([0.0, 0.5 * CFG.swing_arrival, CFG.swing_arrival, 1.0]))
    torch.testing.assert_close(pos[:, 0], torch.tensor([-0.1, 0.12, 0.002]).double())
    torch.testing.assert_close(pos[:2, 1], torch.tensor([0.025, 0.105]).double())
    torch.testing.assert_close(pos[:2, 2:], torch.tensor([[0.15] * 2, [0.09] * 2]).double())
    assert pos[2, 3].item() == pytest.approx(-CFG.swing_press)
    torch.testing.assert_close(vel[:2, [0, 2, 3]], torch.zeros(2, 3).double(), atol=1e-6, rtol=0.0)
    middle = path(torch.tensor([0.5]), dataclasses.replace(CFG, swing_height=0.06, swing_press=0.0))[0]
    assert middle[2, 0].item() == pytest.approx(0.06, abs=0.003)


def test_the_swing_velocity_is_the_derivative_of_the_path() -> None:
    phase, h = torch.linspace(0.01, 0.99, 25), 1e-4
    ahead, behind = (path(phase + sign * h / CFG.step_time)[0] for sign in (1.0, -1.0))
    torch.testing.assert_close(path(phase)[1], (ahead - behind) / (2.0 * h), atol=1e-3, rtol=0.0)


def force(arm=(0.0, 0.0, 0.654), up=(0.0, 0.0, 1.0), rate=(0.0, 0.0, 0.0), height=CFG.hip_height, sink=0.0) -> Tensor:
    """Return the stance force of one world [N]; `sink` is the speed at which the hips go down [m/s]."""
    row = [torch.tensor(values)[:, None] for values in (arm, up, rate, (height, -sink))]
    return stance_force(*row, weight=WEIGHT, friction=0.8, cfg=CFG)[:, 0]


def test_a_leg_under_the_robot_carries_its_weight() -> None:
    torch.testing.assert_close(force(), torch.tensor([0.0, 0.0, WEIGHT]))


def test_the_force_points_from_the_contact_to_the_centre_of_mass() -> None:
    torch.testing.assert_close(force(arm=(0.1, -0.05, 0.654)) / WEIGHT, torch.tensor([0.1 / 0.654, -0.05 / 0.654, 1.0]))


def test_hips_that_are_low_or_sink_are_lifted() -> None:
    low = force(height=CFG.hip_height - 0.01)[2].item()
    assert low == pytest.approx(WEIGHT + 0.01 * CFG.height_stiffness, rel=1e-3)
    assert force(sink=0.1)[2].item() == pytest.approx(WEIGHT + 0.1 * CFG.height_damping, rel=1e-5)
    assert force(height=0.0)[2].item() == pytest.approx(CFG.force_range[1] * WEIGHT)
    assert force(height=2.0)[2].item() == pytest.approx(CFG.force_range[0] * WEIGHT)


@pytest.mark.parametrize(
    ("up", "rate"),
    [
        ((0.1, 0.0, 0.995), (0.0, 0.0, 0.0)),
        ((0.0, 0.1, 0.995), (0.0, 0.0, 0.0)),
        ((0, 0, 1), (0.5, 0, 0)),
        ((0, 0, 1), (0, 0.5, 0)),
    ],
)
def test_a_leaning_trunk_is_turned_back(up: tuple[float, float, float], rate: tuple[float, float, float]) -> None:
    f = force(up=up, rate=rate)
    contact = torch.tensor([0.0, 0.0, -0.654])
    moment = torch.linalg.cross(contact, f)  # about the centre of mass
    lean = torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0]), torch.tensor(up, dtype=torch.float32))  # axis it leans about
    expected = -CFG.trunk_stiffness * lean - CFG.trunk_damping * torch.tensor(rate, dtype=torch.float32)
    torch.testing.assert_close(moment, expected, atol=1e-3, rtol=1e-5)


def test_the_foot_does_not_ask_for_more_than_friction_gives() -> None:
    f = force(arm=(0.6, -0.6, 0.654))
    bound = CFG.friction_use * 0.8 * WEIGHT
    assert f[:2].tolist() == pytest.approx([bound, -bound])


def test_a_held_target_gives_the_force_on_average() -> None:
    """Where the joint moves on at its velocity, kp (q_target - q) - kv q' has this mean over the 20 ms."""
    pos, vel, wanted = (torch.tensor(row)[:, None] for row in ([0.1, -0.2, 0.03], [0.5, 1.0, -0.2], [5.0, -10.0, -120.0]))
    target = HOLD.target(pos, vel, wanted)
    times = torch.linspace(0.0, 0.02, 101)
    forces = HOLD.stiffness * (target - pos - vel * times) - HOLD.damping * vel
    torch.testing.assert_close(forces.mean(1), wanted[:, 0], atol=1e-3, rtol=0.0)
    torch.testing.assert_close(HOLD.force(target, pos, vel), wanted, atol=1e-3, rtol=0.0)
    assert HOLD.force(target + 1.0, pos, vel).tolist() == HOLD.limit.tolist()
    assert math.isclose(HOLD.force(target - 1.0, pos, vel)[2, 0].item(), -400.0)
