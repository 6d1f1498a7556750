"""The DCM walker: foot placement from the divergent component of motion.

J. Englsberger, C. Ott and A. Albu-Schaeffer, "Three-dimensional bipedal walking control based on divergent component of
motion", IEEE Transactions on Robotics 31 (2015). Placing the foot at an offset from the predicted DCM: M. Khadiv et al.,
"Walking control based on step timing adaptation", IEEE Transactions on Robotics 36 (2020), here at a fixed step time.
"""

import torch
from torch import Tensor

from telebip.control.pendulum import Pendulum, Step


def predict_dcm(pendulum: Pendulum, time: Tensor) -> Tensor:
    r"""Divergent component of motion after `time`, relative to the present contact, xi(t) = (c + c' / w) e^{w t}.

    Args:
        pendulum: the present state, c = (x, y).
        time: t [s], (num_envs,).

    Returns:
        xi [m], (2, num_envs).
    """
    return (pendulum.pos + pendulum.vel / pendulum.rate) * torch.exp(pendulum.rate * time)


def dcm_offset(rate: Tensor, step: Step, side: Tensor) -> Tensor:
    r"""Offset of the DCM from a new contact at touch-down that repeats from step to step.

        b(s) = (v_x T / (e^{w T} - 1), v_y T / (e^{w T} - 1) - s W / (1 + e^{w T}))

    Over a step the offset grows by e^{w T} and the contact moves on by v T, and by W to the other side.

    Args:
        rate: w [1/s], (num_envs,).
        step: the wanted walk.
        side: s of the new contact, +1 left and -1 right, (num_envs,).

    Returns:
        b [m], (2, num_envs).
    """
    growth = torch.exp(rate * step.time)
    offset = step.velocity * (step.time / (growth - 1.0))
    offset[1] -= side * step.width / (1.0 + growth)
    return offset


def foot_placement(pendulum: Pendulum, step: Step) -> Tensor:
    r"""Touch down at the repeating offset from the DCM of that time.

        p = xi_T - b(-s) - a (e^{-w T} xi_T - b(s)),    t = p - c_T

    The share a of the DCM's error xi_T - e^{w T} b(s) stays at the end of the next step; Englsberger's law has a = 0.
    Arguments and result are those of a `telebip.control.pendulum.Placement`.
    """
    dcm = predict_dcm(pendulum, step.time_left)
    present, coming = (dcm_offset(pendulum.rate, step, side) for side in (step.side, -step.side))
    error = dcm * torch.exp(-pendulum.rate * step.time) - present
    return dcm - coming - step.error_kept * error - pendulum.pos_after(step.time_left)
