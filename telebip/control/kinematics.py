# pyright: reportAttributeAccessIssue=false
"""What the model-based walkers know of the robot: where its mass is, how it moves, and what its legs can do.

Everything is measured from the trunk's frame (midway between the hips) and expressed in it, so that joints alone decide it.
A leg is hip roll about x, hip pitch about y through the same point, and a knee that slides along the leg; with the hip-to-foot
vector r, the leg's length l = ||r|| and its length l_0 at knee 0,

    r = l (-sin(pitch), cos(pitch) sin(roll), -cos(pitch) cos(roll)),    l = l_0 - knee.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from telebip.errors import UserError
from telebip.robot import FEET, JOINTS, Robot


@dataclass(frozen=True)
class Motion:
    """Masses and legs of all worlds, trunk frame; legs right, left."""

    com: Tensor  # centre of mass, from the trunk's origin [m], (num_envs, 3)
    com_vel: Tensor  # velocity of the centre of mass less that of the trunk's origin [m/s], (num_envs, 3)
    ang_mom: Tensor  # centroidal angular momentum [kg m^2/s], (num_envs, 3)
    leg: Tensor  # hip to foot centre [m], (num_envs, 2, 3)
    axes: Tensor  # joint axes (hip roll, hip pitch, knee) [-], (num_envs, 2, 3 joints, 3)


class Kinematics:
    """Centre of mass, its velocity, and centroidal angular momentum in closed form; exact for rigid links.

    A leg's bodies move in three groups, the links: one turns with the hip's roll, one with roll and pitch, one slides as well.
    """

    def __init__(self, robot: Robot, device: torch.device) -> None:
        """Read masses, lengths and actuator gains from the model.

        Raises:
            UserError: the legs are not built as the walkers expect.
        """

        def constant(values) -> Tensor:
            return torch.as_tensor(np.asarray(values), dtype=torch.float32, device=device)

        model, data = robot.model, mujoco.MjData(robot.model)
        data.qpos[:] = 0.0
        data.qpos[3] = 1.0  # at the origin with straight legs: every frame is parallel to the trunk's
        mujoco.mj_kinematics(model, data)
        links = np.array([_link(model, body) for body in range(model.nbody)])
        inertial = [_inertial(data, model, np.flatnonzero(links == link)) for link in range(7)]
        hip = data.xanchor[[model.joint(JOINTS[0]).id, model.joint(JOINTS[3]).id]]
        sites = [int(model.sensor(f"{foot}_force").objid[0]) for foot in FEET]
        _check_legs(robot, data, hip, data.site_xpos[sites])

        self.mass = float(sum(mass for mass, _, _ in inertial))  # [kg]
        self.gravity = float(-model.opt.gravity[2])  # [m/s^2]
        self.friction = float(model.geom_friction[robot.floor_id, 0])  # sliding, of the ground [-]
        self.leg_length = float(hip[0, 2] - data.site_xpos[sites[0], 2])  # hip to foot centre at knee 0 [m]
        self.foot_radius = float(max(model.geom_size[model.geom_bodyid == model.site_bodyid[sites[0]], 0]))  # [m]
        self.hip = constant(hip)  # (2, 3) [m]
        self.stiffness = constant(model.actuator_gainprm[:3, 0])  # kp of (roll, pitch, knee) [N m/rad | N/m]
        self.damping = constant(-model.actuator_biasprm[:3, 2])  # kv [N m s/rad | N s/m]
        self.force_limit = constant(robot.force_limit[:3])  # [N m | N]
        self.joint_range = constant(robot.joint_range)  # (6, 2) [rad | m]
        self._mass = constant([mass for mass, _, _ in inertial])[:, None]
        self._trunk = constant(inertial[0][1])
        self._trunk_inertia = constant(inertial[0][2])
        self._link_com = constant([com for _, com, _ in inertial[1:]]).view(2, 3, 3) - self.hip[:, None]
        self._link_inertia = constant([inertia for _, _, inertia in inertial[1:]]).view(2, 3, 3, 3)

    def __call__(self, joint_pos: Tensor, joint_vel: Tensor, base_ang_vel: Tensor) -> Motion:
        r"""Return where the mass is and how it moves.

            c = sum_i m_i p_i / m,    v = sum_i m_i u_i / m,    L_c = sum_i m_i (p_i - c) x u_i + I_i w_i

        with p_i the links' centres of mass and u_i their velocities, relative to those of the trunk's origin.

        Args:
            joint_pos: [rad | m], (num_envs, 6).
            joint_vel: [rad/s | m/s], (num_envs, 6).
            base_ang_vel: angular velocity of the trunk, trunk frame [rad/s], (num_envs, 3).
        """
        pos, vel = joint_pos.unflatten(1, (2, 3)), joint_vel.unflatten(1, (2, 3))
        hip_frame, leg_frame = leg_frames(pos[..., 0], pos[..., 1])
        axes = torch.stack([hip_frame[..., 0], hip_frame[..., 1], leg_frame[..., 2]], dim=2)
        leg = (pos[..., 2:] - self.leg_length) * axes[:, :, 2]

        # Arms from the hip to the links' centres of mass, and how the joints move these.
        frames = torch.stack([hip_frame, leg_frame, leg_frame], dim=2)
        arm = rotate(frames, self._link_com)
        arm[:, :, 2] += pos[..., 2:] * axes[:, :, 2]
        roll_rate = vel[..., :1] * axes[:, :, 0]
        leg_rate = roll_rate + vel[..., 1:2] * axes[:, :, 1]
        rate = torch.stack([roll_rate, leg_rate, leg_rate], dim=2)
        joint_part = torch.linalg.cross(rate, arm)
        joint_part[:, :, 2] += vel[..., 2:] * axes[:, :, 2]

        trunk = self._trunk.expand(len(pos), 1, 3)
        point = torch.cat([trunk, (self.hip[:, None] + arm).flatten(1, 2)], dim=1)
        velocity = torch.linalg.cross(base_ang_vel[:, None].expand_as(point), point)
        velocity[:, 1:] += joint_part.flatten(1, 2)
        momentum = self._mass * velocity
        com = (self._mass * point).sum(1) / self.mass
        spin = base_ang_vel @ self._trunk_inertia + self._spin(frames, rate + base_ang_vel[:, None, None])
        ang_mom = torch.linalg.cross(point - com[:, None], momentum).sum(1) + spin
        return Motion(com=com, com_vel=momentum.sum(1) / self.mass, ang_mom=ang_mom, leg=leg, axes=axes)

    def _spin(self, frames: Tensor, rate: Tensor) -> Tensor:
        """Return the sum of the links' own angular momenta R I R^T w, (num_envs, 3)."""
        return rotate(frames, rotate(self._link_inertia, rotate_back(frames, rate))).sum((1, 2))

    def inverse(self, leg: Tensor) -> Tensor:
        r"""Joint positions that put the foot at `leg` from the hip, the inverse of the leg's equation above.

            roll = atan2(r_y, -r_z),    pitch = asin(-r_x / l),    knee = l_0 - l

        Args:
            leg: r, hip to foot centre, trunk frame [m], (..., 3).

        Returns:
            (roll, pitch, knee) [rad, rad, m], (..., 3), whatever the joints' ranges.
        """
        x, y, z = leg.unbind(-1)
        length = torch.linalg.vector_norm(leg, dim=-1)
        return torch.stack([torch.atan2(y, -z), torch.asin(-x / length), self.leg_length - length], dim=-1)

    def inverse_rate(self, leg: Tensor, leg_vel: Tensor) -> Tensor:
        r"""Joint velocities that move the foot from `leg` at `leg_vel`, the time derivative of `inverse`.

            roll' = (r_y r_z' - r_z r_y') / (r_y^2 + r_z^2),  l' = r.r' / l,  pitch' = (r_x l'/l - r_x') / sqrt(r_y^2 + r_z^2)

        Args:
            leg: r, hip to foot centre, trunk frame [m], (..., 3).
            leg_vel: r' [m/s], (..., 3).

        Returns:
            (roll', pitch', knee') [rad/s, rad/s, m/s], (..., 3).
        """
        (x, y, z), (vx, vy, vz) = leg.unbind(-1), leg_vel.unbind(-1)
        across2 = y * y + z * z
        length2 = across2 + x * x
        stretch = (leg * leg_vel).sum(-1) / length2  # l' / l
        roll, pitch = (y * vz - z * vy) / across2, (x * stretch - vx) * torch.rsqrt(across2)
        return torch.stack([roll, pitch, -stretch * torch.sqrt(length2)], dim=-1)


def joint_forces(axes: Tensor, arm: Tensor, force: Tensor) -> Tensor:
    r"""Joint forces of a massless leg that carries `force` at its contact, tau = -J^T f.

    The columns of J are a x arm for a hinge of axis a, with arm from the hip to the contact, and a for the knee's slide.

    Args:
        axes: (roll, pitch, knee) (..., 3 joints, 3).
        arm: hip to contact [m], (..., 3).
        force: of the ground on the foot [N], (..., 3).

    Returns:
        (roll, pitch, knee) [N m, N m, N], (..., 3).
    """
    moment = torch.linalg.cross(arm, force)
    return -(axes * torch.stack([moment, moment, force], dim=-2)).sum(-1)


def leg_frames(roll: Tensor, pitch: Tensor) -> tuple[Tensor, Tensor]:
    """Return the orientations Rx(roll) of the hip link and Rx(roll) Ry(pitch) of the leg in the trunk, each (..., 3, 3)."""
    (sr, cr), (sp, cp) = (roll.sin(), roll.cos()), (pitch.sin(), pitch.cos())
    zero, one = torch.zeros_like(roll), torch.ones_like(roll)
    hip = torch.stack([one, zero, zero, zero, cr, -sr, zero, sr, cr], dim=-1)
    leg = torch.stack([cp, zero, sp, sr * sp, cr, -sr * cp, -cr * sp, sr, cr * cp], dim=-1)
    return hip.unflatten(-1, (3, 3)), leg.unflatten(-1, (3, 3))


def rotate(frame: Tensor, vec: Tensor) -> Tensor:
    """Return R v for matrices R (..., 3, 3) and vectors v (..., 3)."""
    return (frame * vec.unsqueeze(-2)).sum(-1)


def rotate_back(frame: Tensor, vec: Tensor) -> Tensor:
    """Return R^T v for matrices R (..., 3, 3) and vectors v (..., 3)."""
    return (frame * vec.unsqueeze(-1)).sum(-2)


def _link(model: mujoco.MjModel, body: int) -> int:
    """Return 1 + the place in `JOINTS` of the last joint between the trunk and this body; 0 for the trunk, -1 for the world."""
    while body:
        joints = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
        for name in (model.joint(joint).name for joint in reversed(joints)):
            return 1 + JOINTS.index(name) if name in JOINTS else 0
        body = model.body_parentid[body]
    return -1


def _inertial(data: mujoco.MjData, model: mujoco.MjModel, bodies: NDArray[np.int_]) -> tuple[float, NDArray, NDArray]:
    """Return mass, centre of mass and inertia about it of bodies that move as one, in the model's present pose."""
    mass = model.body_mass[bodies]
    com = mass @ data.xipos[bodies] / mass.sum()
    inertia = np.zeros((3, 3))
    for body, m in zip(bodies, mass, strict=True):
        frame, offset = data.ximat[body].reshape(3, 3), data.xipos[body] - com
        inertia += frame @ np.diag(model.body_inertia[body]) @ frame.T
        inertia += m * (offset @ offset * np.eye(3) - np.outer(offset, offset))
    return float(mass.sum()), com, inertia


def _check_legs(robot: Robot, data: mujoco.MjData, hip: NDArray, foot: NDArray) -> None:
    joints = [robot.model.joint(name).id for name in JOINTS]
    as_expected = (
        np.allclose(data.xaxis[joints], np.concatenate([np.eye(3)] * 2))
        and np.allclose(data.xanchor[joints][[1, 4]], hip)
        and np.allclose((foot - hip)[:, :2], 0.0)
        and np.allclose(hip[0], hip[1] * [1, -1, 1])
    )
    if not as_expected:
        raise UserError(
            f"{robot.path}: the model-based walkers need legs of hip roll (x), hip pitch (y) through the same point, "
            "and a knee along the leg (z) above the foot"
        )
