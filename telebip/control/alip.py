"""The angular-momentum walker: foot placement from a one-step-ahead prediction of the momentum about the contact.

Y. Gong and J. W. Grizzle, "Zero dynamics, pendulum models, and angular momentum in feedback control of bipedal locomotion",
Journal of Dynamic Systems, Measurement, and Control 144 (2022); "One-step ahead prediction of angular momentum about the
contact point for control of bipedal locomotion: validation in a LIP-inspired controller", ICRA 2021. Taking back a part of the
error with each step, where they take all of it: the poles of the step-to-step map in X. Xiong and A. Ames, "3-D underactuated
bipedal walking via H-LIP based gait synthesis and stepping stabilization", IEEE Transactions on Robotics 38 (2022).
"""

import torch
from torch import Tensor

from telebip.control.pendulum import Pendulum, Step


def predict_ang_mom(pendulum: Pendulum, time: Tensor) -> Tensor:
    r"""Angular momentum about the present contact after `time`, were the mass to move on at constant height.

        L_y(t) = cosh(w t) L_y + m H w sinh(w t) x,    L_x(t) = cosh(w t) L_x - m H w sinh(w t) y

    Unlike the velocity of the centre of mass it does not jump at touch-down, and the swinging leg hardly disturbs it.

    Args:
        pendulum: the present state.
        time: t [s], (num_envs,).

    Returns:
        (L_x, L_y) [kg m^2/s], (2, num_envs).
    """
    angle = pendulum.rate * time
    gain = pendulum.mass * pendulum.height * pendulum.rate * angle.sinh()
    x, y = pendulum.pos
    return pendulum.ang_mom * angle.cosh() + torch.stack([-gain * y, gain * x])


def foot_placement(pendulum: Pendulum, step: Step) -> Tensor:
    r"""Touch down where the momentum at the end of the *next* step becomes the wanted one.

    The momentum L^ predicted for touch-down is about any contact at that height; over a step that starts t before the new
    contact it becomes L* = cosh(w T) L^ + m H w sinh(w T) (-t_x, or t_y about x), so that

        t_x = (cosh(w T) L^_y - L*_y) / (m H w sinh(w T)),    t_y = (L*_x - cosh(w T) L^_x) / (m H w sinh(w T))
        L* = P(-s) + a (L^ - P(s))
        P_y = m H v_x k,    P_x(s) = -m H v_y k + s m H (W / 2) w sinh(w T) / (1 + cosh(w T)),    k = (w T / 2) / tanh(w T / 2)

    P(s) is the momentum with which the walk that repeats ends a step on side s: k is the speed at the end of a step over its
    mean, so that v is the mean (Gong and Grizzle aim at m H v_x, the speed in the middle, where it is least), and the last term
    is the sway of stepping in place. A step leaves the share a of the momentum's error. At a = 0, Gong and Grizzle's law,
    nothing is left, but the steps that this takes after a push run into the bound of the reach, and throwing the leg so far
    turns the robot. At a = e^{-w T} the answer to an error is smaller by the factor tanh(w T): the DCM walker's, were L just
    m H times the velocity. Arguments and result are those of a `telebip.control.pendulum.Placement`.
    """
    mh, angle = pendulum.mass * pendulum.height, pendulum.rate * step.time
    sinh, cosh = angle.sinh(), angle.cosh()
    at_touch_down = predict_ang_mom(pendulum, step.time_left)
    along, across = mh * (0.5 * angle / torch.tanh(0.5 * angle)) * step.velocity
    sway = step.side * mh * (0.5 * step.width) * pendulum.rate * sinh / (1.0 + cosh)
    error = at_touch_down - torch.stack([sway - across, along])
    wanted = torch.stack([-sway - across, along]) + step.error_kept * error
    missing = wanted - cosh * at_touch_down
    return torch.stack([-missing[1], missing[0]]) / (mh * pendulum.rate * sinh)
