"""The two foot placement laws, on the linear inverted pendulum that they are made for."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from telebip.control import alip, dcm
from telebip.control.pendulum import Pendulum, Placement, Step

MASS, HEIGHT, RATE = 13.6, 0.654, (9.81 / 0.654) ** 0.5
TIME, WIDTH = 0.24, 0.2

LAWS = pytest.mark.parametrize("place", [alip.foot_placement, dcm.foot_placement], ids=["alip", "dcm"])


def pendulum(pos: Tensor, vel: Tensor) -> Pendulum:
    """A point mass at constant height: its angular momentum about the contact is m H times its velocity."""
    ones = torch.ones_like(pos[0])
    ang_mom = MASS * HEIGHT * torch.stack([-vel[1], vel[0]])
    return Pendulum(MASS, HEIGHT * ones, RATE * ones, pos, vel, ang_mom)


def step(side: Tensor, time_left: float, velocity: tuple[float, float], kept: float = 0.0) -> Step:
    ones, wanted = torch.ones_like(side), torch.tensor(velocity, dtype=torch.float64)[:, None].expand(2, len(side))
    return Step(side, time_left * ones, wanted, TIME, WIDTH, kept)


def integrate(pos: Tensor, vel: Tensor, time: float, steps: int = 400) -> tuple[Tensor, Tensor]:
    """Move the pendulum, c'' = w^2 c, with the classical Runge-Kutta method."""
    h = time / steps

    def rate(c: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        return v, RATE**2 * c

    for _ in range(steps):
        a = rate(pos, vel)
        b = rate(pos + 0.5 * h * a[0], vel + 0.5 * h * a[1])
        c = rate(pos + 0.5 * h * b[0], vel + 0.5 * h * b[1])
        d = rate(pos + h * c[0], vel + h * c[1])
        pos = pos + h / 6.0 * (a[0] + 2.0 * b[0] + 2.0 * c[0] + d[0])
        vel = vel + h / 6.0 * (a[1] + 2.0 * b[1] + 2.0 * c[1] + d[1])
    return pos, vel


@pytest.fixture
def start() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    return 0.1 * torch.randn(2, 8, generator=generator).double(), 0.5 * torch.randn(2, 8, generator=generator).double()


def after(predict: Callable[[Pendulum, Tensor], Tensor], start: tuple[Tensor, Tensor], time: float) -> Tensor:
    return predict(pendulum(*start), torch.full((8,), time, dtype=torch.float64))


@pytest.mark.parametrize("time", [0.0, 0.05, 0.24])
def test_predictions_agree_with_integration(start: tuple[Tensor, Tensor], time: float) -> None:
    pos, vel = integrate(*start, time)
    torch.testing.assert_close(after(Pendulum.pos_after, start, time), pos)
    ang_mom = MASS * HEIGHT * torch.stack([-vel[1], vel[0]])
    torch.testing.assert_close(after(alip.predict_ang_mom, start, time), ang_mom)
    torch.testing.assert_close(after(dcm.predict_dcm, start, time), pos + vel / RATE)


def orbit(side: float, velocity: tuple[float, float]) -> tuple[Tensor, Tensor]:
    """State just after touch-down of the walk that repeats: x goes from -v T / 2 to v T / 2, y sways to the foot and back."""
    half = 0.5 * RATE * TIME
    x, y = (-0.5 * v * TIME for v in velocity)
    v_x, v_y = (v * half / math.tanh(half) for v in velocity)
    y = y - side * 0.5 * WIDTH  # the sway is symmetric in time about the middle of the step
    v_y = v_y + side * 0.5 * WIDTH * RATE * math.tanh(half)
    return torch.tensor([[x], [y]], dtype=torch.float64), torch.tensor([[v_x], [v_y]], dtype=torch.float64)


def walk(
    place: Placement, state: tuple[Tensor, Tensor], side: Tensor, velocity: tuple[float, float], steps: int, kept: float = 0.0
):
    """Yield the state after each touch-down, relative to the new contact, and the way from the old contact to the new."""
    pos, vel = state
    for _ in range(steps):
        pos, vel = integrate(pos, vel, 0.4 * TIME, 100)  # the law answers the same at any time of the step
        contact = place(pendulum(pos, vel), step(side, 0.6 * TIME, velocity, kept))
        pos, vel = integrate(pos, vel, 0.6 * TIME, 100)
        way = pos + contact
        pos, side = -contact, -side
        yield pos, vel, way


@LAWS
@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("velocity", [(0.7, 0.0), (-0.3, 0.0), (0.0, 0.0), (0.5, 0.2)])
@pytest.mark.parametrize("kept", [0.0, 0.4])
def test_the_periodic_walk_repeats(place: Placement, side: float, velocity: tuple[float, float], kept: float) -> None:
    sides = torch.tensor([side], dtype=torch.float64)
    s = side
    for pos, vel, way in walk(place, orbit(side, velocity), sides, velocity, 6, kept):
        s = -s
        expected_pos, expected_vel = orbit(s, velocity)
        torch.testing.assert_close(pos, expected_pos, atol=1e-9, rtol=0.0)
        torch.testing.assert_close(vel, expected_vel, atol=1e-9, rtol=0.0)
        expected_way = [velocity[0] * TIME, velocity[1] * TIME + s * WIDTH]  # the left foot lands when the left stance begins
        torch.testing.assert_close(way[:, 0], torch.tensor(expected_way, dtype=torch.float64), atol=1e-9, rtol=0.0)


@LAWS
def test_a_disturbed_walk_returns(place: Placement, start: tuple[Tensor, Tensor]) -> None:
    errors = []
    side = torch.ones(8, dtype=torch.float64)
    goal = {s: orbit(s, (0.7, 0.0)) for s in (1.0, -1.0)}
    disturbed = (goal[1.0][0] + 0.1 * start[0], goal[1.0][1] + 0.3 * start[1])
    for k, (pos, vel, _) in enumerate(walk(place, disturbed, side, (0.7, 0.0), 20)):
        pos_goal, vel_goal = goal[-1.0 if k % 2 == 0 else 1.0]
        errors.append(max((pos - pos_goal).abs().max().item(), (vel - vel_goal).abs().max().item()))
    assert errors[0] > 0.02
    assert errors[-1] < 1e-6
    if place is alip.foot_placement:
        assert errors[3] < 0.1 * errors[0]


@pytest.mark.parametrize("kept", [0.0, 0.4, 0.7])
@pytest.mark.parametrize(
    ("place", "predict"),
    [(alip.foot_placement, alip.predict_ang_mom), (dcm.foot_placement, dcm.predict_dcm)],
    ids=["alip", "dcm"],
)
def test_a_step_leaves_the_given_share_of_the_error(
    place: Placement, predict: Callable[[Pendulum, Tensor], Tensor], start: tuple[Tensor, Tensor], kept: float
) -> None:
    side, time = torch.ones(8, dtype=torch.float64), torch.full((8,), TIME, dtype=torch.float64)

    def at_end(pos: Tensor, vel: Tensor) -> Tensor:
        return predict(pendulum(pos, vel), time)

    wanted = {s: at_end(*orbit(s, (0.7, 0.1))) for s in (1.0, -1.0)}
    error = at_end(*start) - wanted[1.0]
    for k, (pos, vel, _) in enumerate(walk(place, start, side, (0.7, 0.1), 5, kept)):
        left = at_end(pos, vel) - wanted[-1.0 if k % 2 == 0 else 1.0]
        torch.testing.assert_close(left, kept * error, atol=1e-7, rtol=0.0)
        error = left


@LAWS
def test_placement_is_its_own_mirror_image(place: Placement, start: tuple[Tensor, Tensor]) -> None:
    side = torch.tensor([1.0, -1.0] * 4, dtype=torch.float64)
    pos, vel = start
    flip = torch.tensor([[1.0], [-1.0]], dtype=torch.float64)
    contact = place(pendulum(pos, vel), step(side, 0.1, (0.7, 0.1)))
    mirrored = place(pendulum(pos * flip, vel * flip), step(-side, 0.1, (0.7, -0.1)))
    torch.testing.assert_close(mirrored, contact * flip)
