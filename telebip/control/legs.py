"""Laws of the two legs, as functions of one step's geometry; which leg swings and which one stands is the caller's business."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from telebip.control.config import WalkerConfig


@dataclass(frozen=True)
class Hold:
    """How a position actuator turns a target, held for one policy step, into a force: kp (q_target - q) - kv q'."""

    stiffness: Tensor  # kp of (roll, pitch, knee) [N m/rad | N/m], (3, 1)
    damping: Tensor  # kv [N m s/rad | N s/m], (3, 1)
    limit: Tensor  # [N m | N], (3, 1)
    step_dt: float  # [s]

    def target(self, pos: Tensor, vel: Tensor, force: Tensor) -> Tensor:
        r"""Target that gives `force` on average over the step, q + q' dt / 2 + (tau + kv q') / kp.

        The joint moves on while the target stays: half a step's motion makes up for it.
        """
        return pos + 0.5 * self.step_dt * vel + (force + self.damping * vel) / self.stiffness

    def force(self, target: Tensor, pos: Tensor, vel: Tensor) -> Tensor:
        """Mean force over the step that a target will give, the inverse of `target` within the actuators' limits."""
        force = self.stiffness * (target - pos - 0.5 * self.step_dt * vel) - self.damping * vel
        return torch.minimum(torch.maximum(force, -self.limit), self.limit)


def swing_path(start: Tensor, target: Tensor, phase: Tensor, cfg: WalkerConfig) -> tuple[Tensor, Tensor]:
    r"""Where the swing foot should be, and how fast it should move.

        (x, y) = start + f (target - start),    f = (1 - cos(pi min(sigma / a, 1))) / 2
        z = h sin(pi sigma) - d sigma^3 + z_start (1 - f)

    Args:
        start: foot at lift-off: (x, y) from the centre of mass, z over the stance foot [m], (3, num_envs).
        target: touch-down (x, y) from the centre of mass [m], (2, num_envs).
        phase: sigma, fraction of the step that has passed, (num_envs,).
        cfg: h is `swing_height`, d `swing_press`, a `swing_arrival`, and the step lasts `step_time`.

    Returns:
        Position as `start` [m] and velocity [m/s], (3, num_envs) each.
    """
    a, h, d = cfg.swing_arrival, cfg.swing_height, cfg.swing_press
    angle = math.pi / a * phase.clamp(max=a)
    f, f_rate = 0.5 - 0.5 * angle.cos(), 0.5 * math.pi / a * angle.sin()
    path = torch.cat([target - start[:2], -start[2:]])
    pos, vel = start + f * path, f_rate * path
    pos[2] += h * torch.sin(math.pi * phase) - d * phase**3
    vel[2] += math.pi * h * torch.cos(math.pi * phase) - 3.0 * d * phase**2
    return pos, vel / cfg.step_time


def stance_force(
    arm: Tensor, up: Tensor, rate: Tensor, hip: Tensor, weight: float, friction: float, cfg: WalkerConfig
) -> Tensor:
    r"""Force of the ground on the stance foot that holds the hips' height and keeps the trunk upright, plan frame.

        f_z = m g + k_h (h_0 - h) - d_h h',    M_x = k_r e_y - d_r w_x,    M_y = -k_r e_x - d_r w_y
        f_x = (x f_z - M_y) / H,    f_y = (y f_z + M_x) / H

    With M = 0 the force points from the contact to the centre of mass, (x, y, H) from it; the rest turns the trunk.

    Args:
        arm: contact to centre of mass, (x, y, H) [m], (3, num_envs).
        up: e, the trunk's z axis [-], (3, num_envs).
        rate: w, angular velocity of the trunk [rad/s], (3, num_envs).
        hip: height h of the hips over the contact and its rate h' [m, m/s], (2, num_envs).
        weight: m g [N].
        friction: mu, sliding friction of the ground [-].
        cfg: the stance leg's gains and bounds.

    Returns:
        f [N], (3, num_envs), with f_z within `force_range` and the horizontal parts within `friction_use` mu f_z.
    """
    low, high = cfg.force_range
    lift = cfg.height_stiffness * (cfg.hip_height - hip[0]) - cfg.height_damping * hip[1]
    f_z = (weight + lift).clamp(low * weight, high * weight)
    m_x = cfg.trunk_stiffness * up[1] - cfg.trunk_damping * rate[0]
    m_y = -cfg.trunk_stiffness * up[0] - cfg.trunk_damping * rate[1]
    horizontal = (arm[:2] * f_z + torch.stack([-m_y, m_x])) / arm[2]
    bound = cfg.friction_use * friction * f_z
    return torch.cat([torch.minimum(torch.maximum(horizontal, -bound), bound), f_z[None]])
