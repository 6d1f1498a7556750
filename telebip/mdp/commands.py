"""The velocity command: when a new one is given, and the heading hold."""

from torch import Tensor

from telebip.math import columns, wrap_angle


def hold_heading(command: Tensor, heading: Tensor, reference: Tensor, gain: float, limit: float) -> Tensor:
    r"""Turn the yaw-rate command towards the reference heading.

        w = w_cmd + clip(k (psi_ref - psi), -limit, limit)

    A reward on yaw rate alone lets the heading drift; with k = 0 this is the article's MDP.

    Args:
        command: (vx, vy, yaw rate) [m/s, m/s, rad/s], (num_envs, 3).
        heading: psi of the robot [rad], (num_envs,).
        reference: psi_ref, the integral of the commanded yaw rate [rad], (num_envs,).
        gain: k [1/s].
        limit: bound of the correction [rad/s].

    Returns:
        The command that the policy sees and is rewarded for, (num_envs, 3).
    """
    correction = (gain * wrap_angle(reference - heading)).clamp(-limit, limit)
    return columns(command[:, :2], command[:, 2] + correction)
