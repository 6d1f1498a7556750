"""Quaternions (w, x, y, z) and frames, batched over leading dimensions, and how the tensors of all worlds lie in memory.

A tensor (num_envs, size) lies column by column: what is one number of every world is one stretch of memory, over which a
processor's vector unit passes in one go. Row by row, an operation on a column hops through memory, and takes up to ten times as
long (docs/tried.md). Shapes and values know nothing of it.
"""

import torch
from torch import Tensor


def zeros(num_envs: int, *size: int, device: torch.device) -> Tensor:
    """Return zeros (num_envs, *size) that lie column by column."""
    return torch.zeros(*size, num_envs, device=device).movedim(-1, 0)


def columns(*parts: Tensor) -> Tensor:
    """Join (num_envs,) and (num_envs, size) side by side into a new tensor that lies column by column."""
    return torch.cat([part.reshape(len(part), -1).T for part in parts]).T


def over(mask: Tensor, values: Tensor) -> Tensor:
    """Return `mask` (num_envs,) with as many dimensions as `values` (num_envs, ...), to choose between its rows."""
    return mask.view(-1, *[1] * (values.dim() - 1))


def norm(vec: Tensor) -> Tensor:
    """Return the Euclidean norm of `vec` (..., n), (...); `vector_norm` takes thirty times as long on columns."""
    return vec.square().sum(-1).sqrt()


def rotate_inverse(quat: Tensor, vec: Tensor) -> Tensor:
    """Express `vec` (..., 3), given in the world frame, in the frame whose orientation is the unit `quat` (..., 4).

    v_b = v - 2 w (u x v) + 2 u x (u x v), with quat = (w, u).
    """
    quat, vec = quat.movedim(-1, 0), vec.movedim(-1, 0)
    w, u = quat[:1], quat[1:]
    t = 2.0 * torch.linalg.cross(u, vec, dim=0)
    return (vec - w * t + torch.linalg.cross(u, t, dim=0)).movedim(0, -1)


def multiply(first: Tensor, second: Tensor) -> Tensor:
    """Return the product of the quaternions `first` and `second` (..., 4): turned by `second` as seen from `first`."""
    (w, x, y, z), (a, b, c, d) = first.unbind(-1), second.unbind(-1)
    product = [
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    ]
    return torch.stack(product).movedim(0, -1)


def small_rotation(angles: Tensor) -> Tensor:
    """Return the unit quaternion (1, angles / 2), normalised, of small `angles` [rad] about x, y and z (..., 3); (..., 4)."""
    half = 0.5 * angles.movedim(-1, 0)
    quat = torch.cat([torch.ones_like(half[:1]), half])
    return (quat / quat.square().sum(0).sqrt()).movedim(0, -1)


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
    return torch.stack([torch.cos(half), zero, zero, torch.sin(half)]).movedim(0, -1)


def turn(quat: Tensor, angle: Tensor) -> Tensor:
    """Return `quat` (..., 4) turned about the world's z axis by `angle` [rad] (...): q_z q, with q_z of half the angle.

    (c, 0, 0, s) q = c (w, x, y, z) + s (-z, -y, x, w)
    """
    half = 0.5 * angle
    w, x, y, z = quat.unbind(-1)
    turned = torch.cos(half) * quat.movedim(-1, 0) + torch.sin(half) * torch.stack([-z, -y, x, w])
    return turned.movedim(0, -1)


def wrap_angle(angle: Tensor) -> Tensor:
    """Return `angle` [rad] wrapped to [-pi, pi)."""
    return torch.remainder(angle + torch.pi, 2.0 * torch.pi) - torch.pi
