"""Quaternions (w, x, y, z) and frames, batched over leading dimensions."""

import torch
from torch import Tensor


def rotate_inverse(quat: Tensor, vec: Tensor) -> Tensor:
    """Express `vec` (..., 3), given in the world frame, in the frame whose orientation is the unit `quat` (..., 4).

    v_b = v - 2 w (u x v) + 2 u x (u x v), with quat = (w, u).
    """
    w, u = quat[..., :1], quat[..., 1:]
    t = 2.0 * torch.linalg.cross(u, vec)
    return vec - w * t + torch.linalg.cross(u, t)


def matrix(quat: Tensor) -> Tensor:
    """Return the rotation matrix, body to world, of the unit `quat` (..., 4); (..., 3, 3)."""
    w, x, y, z = quat.unbind(-1)
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return torch.stack([entry for row in rows for entry in row], dim=-1).unflatten(-1, (3, 3))


def yaw(quat: Tensor) -> Tensor:
    """Return the heading [rad] of the body's x axis projected on the ground, (...): atan2(R_10, R_00)."""
    w, x, y, z = quat.unbind(-1)
    return torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def quat_from_yaw(angle: Tensor) -> Tensor:
    """Return the rotation by `angle` [rad] (...) about z, (..., 4)."""
    half, zero = 0.5 * angle, torch.zeros_like(angle)
    return torch.stack([torch.cos(half), zero, zero, torch.sin(half)], dim=-1)


def turn(quat: Tensor, angle: Tensor) -> Tensor:
    """Return `quat` (..., 4) turned about the world's z axis by `angle` [rad] (...): q_z q, with q_z of half the angle.

    (c, 0, 0, s) q = c (w, x, y, z) + s (-z, -y, x, w)
    """
    half = 0.5 * angle[..., None]
    w, x, y, z = quat.unbind(-1)
    return torch.cos(half) * quat + torch.sin(half) * torch.stack([-z, -y, x, w], dim=-1)


def wrap_angle(angle: Tensor) -> Tensor:
    """Return `angle` [rad] wrapped to [-pi, pi)."""
    return torch.remainder(angle + torch.pi, 2.0 * torch.pi) - torch.pi
