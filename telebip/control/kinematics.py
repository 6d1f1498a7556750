# pyright: reportAttributeAccessIssue=false
"""What the model-based walkers know of the robot: where its mass is, how it moves, and what its legs can do.

Everything is measured from the trunk's frame (midway between the hips) and expressed in it, so that joints alone decide it.
A leg is hip roll about x, hip pitch about y through the same point, and a knee that slides along the leg. With k the unit
vector from foot to hip, the leg's length l and its length l_0 at knee 0, the foot lies at r from the hip:

    r = -l k,    k = (sin(pitch), -sin(roll) cos(pitch), cos(roll) cos(pitch)),    l = l_0 - knee

Inside the walkers worlds come last and components first, as in (3, num_envs): a number per world then multiplies a vector as it
is, and each component is contiguous. Of several legs the shape is (3, 2, num_envs), right and left.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from telebip.errors import UserError
from telebip.robot import FEET, Robot, moments_of_mass

JOINTS = tuple(f"{side}_{joint}" for side in ("right", "left") for joint in ("hip_roll", "hip_pitch", "knee"))
"""The joints of a robot that the walkers can use, in the order of its actuators."""


@dataclass(frozen=True)
class Motion:
    """Masses and legs of all worlds, trunk frame."""

    com: Tensor  # centre of mass, from the trunk's origin [m], (3, num_envs)
    com_vel: Tensor  # velocity of the centre of mass less that of the trunk's origin [m/s], (3, num_envs)
    ang_mom: Tensor  # centroidal angular momentum [kg m^2/s], (3, num_envs)
    leg: Tensor  # r, hip to foot centre [m], (3, 2, num_envs)
    pitch_axis: Tensor  # of the hip pitch joints [-], (3, 2, num_envs); the roll joints' is x
    knee_axis: Tensor  # k, of the knees [-], (3, 2, num_envs)


class Kinematics:
    """Centre of mass, its velocity, and centroidal angular momentum in closed form.

    Trunk and hip links are one body, since a hip link is round about its roll axis; thigh and shank are rods along the leg. For
    a robot built so, which is checked, nothing is approximated.
    """

    def __init__(self, robot: Robot, device: torch.device) -> None:
        """Read masses, lengths and actuator gains from the model.

        Raises:
            UserError: the robot has other joints, or its legs are not built as the walkers expect.
        """
        if robot.joint_names != JOINTS or robot.model.nv != 12:
            raise UserError(f"{robot.path}: the model-based walkers need the joints {', '.join(JOINTS)} and no others")

        def constant(values) -> Tensor:
            return torch.as_tensor(np.asarray(values), dtype=torch.float32, device=device)

        model, data = robot.model, mujoco.MjData(robot.model)
        data.qpos[:] = 0.0
        data.qpos[3] = 1.0  # at the origin with straight legs: every frame is parallel to the trunk's
        mujoco.mj_kinematics(model, data)
        sites = [int(model.sensor(f"{foot}_force").objid[0]) for foot in FEET]
        hip = data.xanchor[[model.joint(JOINTS[0]).id, model.joint(JOINTS[3]).id]]
        links = np.array([_link(model, body) for body in range(model.nbody)])

        def moments(of_links: Sequence[int], origin: NDArray) -> NDArray:
            return moments_of_mass(model, data, origin)[np.isin(links, of_links)].sum(0)

        roll, thigh, shank = right = [moments([link], hip[0]) for link in (1, 2, 3)]
        _check_legs(robot, data, hip, data.site_xpos[sites], right, [moments([link], hip[1]) for link in (4, 5, 6)])

        self.gravity = float(-model.opt.gravity[2])  # [m/s^2]
        self.friction = float(model.geom_friction[robot.floor_id, 0])  # sliding, of the ground [-]
        self.foot_radius = float(max(model.geom_size[model.geom_bodyid == model.site_bodyid[sites[0]], 0]))  # [m]
        self.leg_length = float(hip[0, 2] - data.site_xpos[sites[0], 2])  # l_0 [m]
        self.hip = constant(hip.T[:, :, None])  # (3, 2, 1) [m]
        self.stiffness = constant(model.actuator_gainprm[:3, 0, None])  # kp of roll, pitch, knee [N m/rad | N/m], (3, 1)
        self.damping = constant(-model.actuator_biasprm[:3, 2, None])  # kv [N m s/rad | N s/m], (3, 1)
        self.force_limit = constant(robot.force_limit[:3, None])  # [N m | N], (3, 1)
        self.joint_range = constant(robot.joint_range[:, :, None])  # (6, 2, 1) [rad | m]

        # The trunk with the hip links, then one leg: masses, first and second moments along the leg, at knee 0.
        upper, leg = moments([0, 1, 4], np.zeros(3)), thigh + shank
        self._leg_mass, self._shank_mass = float(leg[3, 3]), float(shank[3, 3])
        self.mass = float(upper[3, 3]) + 2.0 * self._leg_mass  # [kg]
        self._thigh_moment = float(thigh[2, 3])
        self._shank_height = float(shank[2, 3]) / self._shank_mass
        self._across = float(leg[1, 1] + leg[2, 2]) - self._shank_mass * self._shank_height**2
        self._along = float(leg[0, 0] + leg[1, 1])
        self._roll_inertia = float(roll[1, 1] + roll[2, 2])
        self._upper_moment = constant(upper[:3, 3:])
        self._upper_inertia = constant(np.trace(upper[:3, :3]) * np.eye(3) - upper[:3, :3])
        self._straight_com = constant((upper[:3, 3:] + self._leg_mass * hip.sum(0)[:, None]) / self.mass)

    def __call__(self, joint_pos: Tensor, joint_vel: Tensor, ang_vel: Tensor) -> Motion:
        r"""Return where the mass is and how it moves, from the momentum P and the angular momentum L about the trunk's origin.

        A leg's mass m_leg has the first moment S = sum m z and the second I = sum m z^2 + I_across along k, from the hip at h.
        With w the trunk's and W the leg's angular velocity, a = w x h and n = W x k,

            P = w x (m_u c_u) + sum_legs P_leg,    P_leg = m_leg a + S n + m_shank knee' k
            L = I_u w + sum_legs (I_roll roll' x^ + h x P_leg + k x (S a + I n) + I_along (k . W) k)
            m c = m_u c_u + sum_legs (m_leg h + S k),    v = P / m,    L_c = L - m c x v

        where u stands for trunk and hip links.

        Args:
            joint_pos: (roll, pitch, knee) [rad, rad, m], (3, 2, num_envs).
            joint_vel: [rad/s, rad/s, m/s], (3, 2, num_envs).
            ang_vel: w, trunk frame [rad/s], (3, num_envs).
        """
        (roll, pitch, knee), (roll_vel, pitch_vel, knee_vel) = joint_pos, joint_vel
        sr, cr = roll.sin(), roll.cos()
        pitch_axis, k = torch.stack([torch.zeros_like(sr), cr, sr]), leg_axis(roll, pitch)
        leg_rate = ang_vel[:, None] + pitch_vel * pitch_axis
        leg_rate[0] += roll_vel
        n, a = cross(leg_rate, k), cross(ang_vel[:, None], self.hip)
        shank = self._shank_height + knee
        first = self._thigh_moment + self._shank_mass * shank
        second = self._across + self._shank_mass * shank * shank
        p_leg = self._leg_mass * a + first * n + (self._shank_mass * knee_vel) * k
        along = self._along * (k * leg_rate).sum(0)
        l_leg = cross(self.hip, p_leg) + cross(k, first * a + second * n) + along * k

        com = self._straight_com + (first * k).sum(1) / self.mass
        momentum = cross(ang_vel, self._upper_moment) + p_leg.sum(1)
        ang_mom = self._upper_inertia @ ang_vel + l_leg.sum(1) - cross(com, momentum)
        ang_mom[0] += self._roll_inertia * roll_vel.sum(0)
        leg = (knee - self.leg_length) * k
        return Motion(com, momentum / self.mass, ang_mom, leg, pitch_axis, knee_axis=k)

    def inverse(self, leg: Tensor) -> Tensor:
        r"""Joint positions that put the foot at `leg` from the hip, the inverse of the leg's equation above.

            roll = atan2(r_y, -r_z),    pitch = asin(-r_x / l),    knee = l_0 - l

        Args:
            leg: r, hip to foot centre, trunk frame [m], (3, ...).

        Returns:
            (roll, pitch, knee) [rad, rad, m], (3, ...), whatever the joints' ranges.
        """
        x, y, z = leg
        length = (leg * leg).sum(0).sqrt()
        return torch.stack([torch.atan2(y, -z), torch.asin(-x / length), self.leg_length - length])

    def inverse_rate(self, leg: Tensor, leg_vel: Tensor) -> Tensor:
        r"""Joint velocities that move the foot from `leg` at `leg_vel`, the time derivative of `inverse`.

            roll' = (r_y r_z' - r_z r_y') / (r_y^2 + r_z^2),  l' = r.r' / l,  pitch' = (r_x l'/l - r_x') / sqrt(r_y^2 + r_z^2)

        Args:
            leg: r, hip to foot centre, trunk frame [m], (3, ...).
            leg_vel: r' [m/s], (3, ...).

        Returns:
            (roll', pitch', knee') [rad/s, rad/s, m/s], (3, ...).
        """
        (x, y, z), (vx, vy, vz) = leg, leg_vel
        across2 = y * y + z * z
        length2 = across2 + x * x
        stretch = (leg * leg_vel).sum(0) / length2  # l' / l
        roll, pitch = (y * vz - z * vy) / across2, (x * stretch - vx) * torch.rsqrt(across2)
        return torch.stack([roll, pitch, -stretch * length2.sqrt()])


def leg_axis(roll: Tensor, pitch: Tensor) -> Tensor:
    """Return k, the unit vector from foot to hip, trunk frame, (3, ...); see the module's equation."""
    return torch.stack([pitch.sin(), -roll.sin() * pitch.cos(), roll.cos() * pitch.cos()])


def joint_forces(pitch_axis: Tensor, knee_axis: Tensor, arm: Tensor, force: Tensor) -> Tensor:
    r"""Joint forces of a massless leg that carries `force` at its contact, tau = -J^T f.

    The columns of J are a x arm for a hinge of axis a, with arm from the hip to the contact, and the axis itself for a slide.

    Args:
        pitch_axis: of hip pitch, (3, ...); that of hip roll is x.
        knee_axis: of the knee's slide, (3, ...).
        arm: hip to contact [m], (3, ...).
        force: of the ground on the foot [N], (3, ...).

    Returns:
        (roll, pitch, knee) [N m, N m, N], (3, ...).
    """
    moment = cross(arm, force)
    return -torch.stack([moment[0], (pitch_axis * moment).sum(0), (knee_axis * force).sum(0)])


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Return a x b, components first, (3, ...)."""
    (ax, ay, az), (bx, by, bz) = a, b
    return torch.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def rotate(frame: Tensor, vec: Tensor) -> Tensor:
    """Return R v, components first: R (3, 3, ...), v (3, ...)."""
    return (frame * vec).sum(1)


def rotate_back(frame: Tensor, vec: Tensor) -> Tensor:
    """Return R^T v, components first: R (3, 3, ...), v (3, ...)."""
    return (frame * vec[:, None]).sum(0)


def _link(model: mujoco.MjModel, body: int) -> int:
    """Return 1 + the place in `JOINTS` of the last joint between the trunk and this body; 0 for the trunk, -1 for the world."""
    while body:
        joints = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
        for name in (model.joint(joint).name for joint in reversed(joints)):
            return 1 + JOINTS.index(name) if name in JOINTS else 0
        body = model.body_parentid[body]
    return -1


def _check_legs(
    robot: Robot, data: mujoco.MjData, hip: NDArray, foot: NDArray, right: list[NDArray], left: list[NDArray]
) -> None:
    """Raise if the legs, of these moments of mass, are not mirror images, of rods and round hip links along the right axes."""
    joints = [robot.model.joint(name).id for name in JOINTS]
    as_expected = (
        np.allclose(data.xaxis[joints], np.concatenate([np.eye(3)] * 2))
        and np.allclose(data.xanchor[joints][[1, 4]], hip)
        and np.allclose(hip[0], hip[1] * [1, -1, 1])
        and np.allclose((foot - hip)[:, :2], 0.0)
        and np.allclose(right, left)
        and all(_is_round(link, axis) for link, axis in zip(right, (0, 2, 2), strict=True))
        and np.allclose(right[0][:3, 3], 0.0)
    )
    if not as_expected:
        raise UserError(
            f"{robot.path}: the model-based walkers need two like legs of hip roll (x), hip pitch (y) through the same point, "
            "and a knee along the leg (z), with the foot and all mass on the leg's axis"
        )


def _is_round(moments: NDArray, axis: int) -> bool:
    """Whether moments of mass are the same in all directions across an axis through their origin, and no others are there."""
    (a, b), others = (i for i in range(3) if i != axis), moments - np.diag(np.diag(moments))
    others[[axis, 3], [3, axis]] = 0.0
    return np.allclose(others, 0.0, atol=1e-9) and np.isclose(moments[a, a], moments[b, b])
