"""Quaternions and headings, against rotation matrices and angles known by hand."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from worlds import quat_mul

from telebip.math import quat_from_yaw, rotate_inverse, turn, wrap_angle, yaw

HALF = math.sqrt(0.5)
IDENTITY = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)

angles = st.floats(-10.0, 10.0)
seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=50, deadline=None, derandomize=True, database=None)


def random_quats(seed: int, count: int = 4) -> Tensor:
    quat = torch.randn(count, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return quat / torch.linalg.vector_norm(quat, dim=1, keepdim=True)


def conjugate(quat: Tensor) -> Tensor:
    return quat * torch.tensor([1.0, -1.0, -1.0, -1.0], dtype=quat.dtype)


def matrix(quat: Tensor) -> Tensor:
    """The rotation matrix R of a quaternion, v_w = R v_b, written out from its textbook entries."""
    w, x, y, z = quat.tolist()
    return torch.tensor(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ],
        dtype=torch.float64,
    )


@few
@given(seeds)
def test_rotate_inverse_is_the_transposed_rotation_matrix(seed: int) -> None:
    quat = random_quats(seed)
    vec = torch.randn(4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed + 1))
    expected = torch.stack([matrix(q).T @ v for q, v in zip(quat, vec, strict=True)])
    torch.testing.assert_close(rotate_inverse(quat, vec), expected)
    torch.testing.assert_close(rotate_inverse(-quat, vec), expected)


def test_north_lies_to_the_right_of_a_robot_that_faces_west() -> None:
    facing_minus_x = torch.tensor([[0.0, 0.0, 0.0, 1.0]])
    torch.testing.assert_close(
        rotate_inverse(facing_minus_x, torch.tensor([[0.0, 2.0, 3.0]])), torch.tensor([[0.0, -2.0, 3.0]])
    )


@pytest.mark.parametrize(
    ("quat", "heading"),
    [
        ([1.0, 0.0, 0.0, 0.0], 0.0),
        ([HALF, 0.0, 0.0, HALF], math.pi / 2),
        ([HALF, 0.0, 0.0, -HALF], -math.pi / 2),
        ([math.cos(0.1), 0.0, 0.0, math.sin(0.1)], 0.2),
        ([-math.cos(0.1), 0.0, 0.0, -math.sin(0.1)], 0.2),
        ([HALF, HALF, 0.0, 0.0], 0.0),  # roll by 90 degrees leaves the x axis where it is
        ([math.cos(0.3), 0.0, math.sin(0.3), 0.0], 0.0),  # pitch tips it within its vertical plane
        ([0.0, 1.0, 0.0, 0.0], 0.0),  # on its back, still facing x
    ],
)
def test_yaw_of_known_orientations(quat: list[float], heading: float) -> None:
    result = yaw(torch.tensor([quat], dtype=torch.float64))
    torch.testing.assert_close(result, torch.tensor([heading], dtype=torch.float64), atol=1e-12, rtol=0.0)


def test_yaw_facing_backward_is_pi_in_size() -> None:
    assert yaw(torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)).abs().item() == pytest.approx(math.pi)


@few
@given(angles, st.floats(-1.2, 1.2), st.floats(-1.2, 1.2))
def test_yaw_comes_back_through_pitch_and_roll(heading: float, pitch: float, roll: float) -> None:
    def about(axis: int, angle: float) -> Tensor:
        quat = torch.zeros(4, dtype=torch.float64)
        quat[0], quat[axis] = math.cos(angle / 2), math.sin(angle / 2)
        return quat

    quat = quat_mul(quat_from_yaw(torch.tensor(heading, dtype=torch.float64)), quat_mul(about(2, pitch), about(1, roll)))
    difference = yaw(quat).item() - heading
    assert math.sin(difference) == pytest.approx(0.0, abs=1e-9)
    assert math.cos(difference) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize(
    ("angle", "wrapped"),
    [
        (0.0, 0.0),
        (math.pi, -math.pi),
        (-math.pi, -math.pi),
        (3.0, 3.0),
        (-3.0, -3.0),
        (math.pi + 0.25, -math.pi + 0.25),
        (-math.pi - 0.25, math.pi - 0.25),
        (2 * math.pi, 0.0),
        (3 * math.pi, -math.pi),
        (-5 * math.pi, -math.pi),
        (20 * math.pi + 1.0, 1.0),
    ],
)
def test_wrap_angle_at_its_borders(angle: float, wrapped: float) -> None:
    result = wrap_angle(torch.tensor([angle], dtype=torch.float64))
    torch.testing.assert_close(result, torch.tensor([wrapped], dtype=torch.float64), atol=1e-12, rtol=0.0)


@few
@given(st.floats(-1e4, 1e4))
def test_wrapped_angle_is_the_same_direction_within_half_a_turn(angle: float) -> None:
    wrapped = wrap_angle(torch.tensor(angle, dtype=torch.float64)).item()
    assert abs(wrapped) <= math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-9)


@few
@given(seeds, angles)
def test_turning_is_a_product_with_a_rotation_about_z(seed: int, angle: float) -> None:
    quat, about_z = random_quats(seed), torch.full((4,), angle, dtype=torch.float64)
    torch.testing.assert_close(turn(quat, about_z), quat_mul(quat_from_yaw(about_z), quat))
