"""What the policy sees: the order of its 33 numbers, and that they do not tell which way the world's x axis points."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from worlds import quat_mul

from telebip.config.schema import NoiseConfig
from telebip.math import quat_from_yaw
from telebip.mdp.observations import LAYOUT, heading_relative_quat, noise_amplitude, observation
from telebip.sim.base import SimState

few = settings(max_examples=50, deadline=None, derandomize=True, database=None)
turns = st.floats(-2 * math.pi, 2 * math.pi)


def random_quats(seed: int) -> torch.Tensor:
    quat = torch.randn(8, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    quat = quat / torch.linalg.vector_norm(quat, dim=1, keepdim=True)
    return quat


def same_rotation(a: torch.Tensor, b: torch.Tensor) -> None:
    torch.testing.assert_close((a * b).sum(1).abs(), torch.ones(len(a), dtype=a.dtype))


def test_layout_is_the_article_s() -> None:
    assert list(LAYOUT.items()) == [
        ("joint_pos", 6),
        ("joint_vel", 6),
        ("last_action", 6),
        ("base_lin_vel", 3),
        ("base_ang_vel", 3),
        ("base_quat", 4),
        ("command", 3),
        ("phase", 2),
    ]
    assert sum(LAYOUT.values()) == 33


def test_observation_is_laid_out_in_this_order() -> None:
    def row(*values: float) -> torch.Tensor:
        return torch.tensor([values])

    state = SimState(
        qpos=row(90, 91, 92, 93, 94, 95, 96, 11, 12, 13, 14, 15, 16),
        qvel=row(97, 98, 99, 51, 52, 53, 21, 22, 23, 24, 25, 26),
        foot_force=row(100, 101),
        joint_force=row(102, 103, 104, 105, 106, 107),
        joint_power=row(108, 109, 110, 111, 112, 113),
        joint_net_power=row(114, 115, 116, 117, 118, 119),
    )
    obs = observation(
        state,
        nominal=torch.tensor([0.5, 1.0, 1.5, 2.0, 2.5, 3.0]),
        last_action=row(31, 32, 33, 34, 35, 36),
        base_lin_vel_b=row(41, 42, 43),
        quat=row(61, 62, 63, 64),
        command=row(71, 72, 73),
        phase=row(81, 82),
    )
    expected = [
        10.5,
        11,
        11.5,
        12,
        12.5,
        13,
        *range(21, 27),
        *range(31, 37),
        41,
        42,
        43,
        51,
        52,
        53,
        61,
        62,
        63,
        64,
        71,
        72,
        73,
    ]
    torch.testing.assert_close(obs, row(*expected, 81, 82))


@pytest.mark.parametrize(
    ("heading", "reference", "expected"),
    [
        (0.0, 0.0, [1.0, 0.0, 0.0, 0.0]),
        (1.3, 1.3, [1.0, 0.0, 0.0, 0.0]),
        (0.5, 0.3, [math.cos(0.1), 0.0, 0.0, math.sin(0.1)]),  # 0.2 rad left of the reference
        (0.3, 0.5, [math.cos(0.1), 0.0, 0.0, -math.sin(0.1)]),
        (3.1, -3.1, [math.cos(math.pi - 3.1), 0.0, 0.0, -math.sin(math.pi - 3.1)]),  # across pi
    ],
)
def test_standing_upright_the_quaternion_is_the_heading_error(heading: float, reference: float, expected: list[float]) -> None:
    quat = heading_relative_quat(quat_from_yaw(torch.tensor([heading])), torch.tensor([reference]))
    torch.testing.assert_close(quat, torch.tensor([expected]), atol=1e-6, rtol=1e-6)


@few
@given(st.integers(0, 2**32 - 1), turns, turns)
def test_turning_the_world_about_z_changes_nothing(seed: int, reference: float, turn: float) -> None:
    quat = random_quats(seed)
    psi, delta = (torch.full((8,), angle, dtype=torch.float64) for angle in (reference, turn))
    turned = heading_relative_quat(quat_mul(quat_from_yaw(delta), quat), psi + delta)
    # Compared as rotations: within rounding of w = 0 the sign may fall either way.
    same_rotation(turned, heading_relative_quat(quat, psi))
    assert (turned[:, 0] >= 0.0).all()


@few
@given(st.integers(0, 2**32 - 1), turns)
def test_q_and_minus_q_look_the_same(seed: int, reference: float) -> None:
    quat, psi = random_quats(seed), torch.full((8,), reference, dtype=torch.float64)
    torch.testing.assert_close(heading_relative_quat(-quat, psi), heading_relative_quat(quat, psi))


def test_tilt_is_seen_in_the_reference_frame() -> None:
    # Facing +y and pitched forward by 0.4 rad looks like facing +x and pitched by as much.
    pitch = torch.tensor([[math.cos(0.2), 0.0, math.sin(0.2), 0.0]])
    facing_y = torch.tensor([math.pi / 2])
    torch.testing.assert_close(heading_relative_quat(quat_mul(quat_from_yaw(facing_y), pitch), facing_y), pitch)


def test_noise_leaves_alone_what_the_policy_knows_exactly() -> None:
    cfg = NoiseConfig(enabled=True, joint_pos=0.1, joint_vel=0.2, base_lin_vel=0.3, base_ang_vel=0.4, base_quat=0.5)
    expected = [0.1] * 6 + [0.2] * 6 + [0.0] * 6 + [0.3] * 3 + [0.4] * 3 + [0.5] * 4 + [0.0] * 5
    torch.testing.assert_close(noise_amplitude(cfg), torch.tensor(expected))
