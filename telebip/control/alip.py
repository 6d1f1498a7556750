"""The angular-momentum walker: foot placement from a one-step-ahead prediction of the momentum about the contact.

Y. Gong and J. W. Grizzle, "Zero dynamics, pendulum models, and angular momentum in feedback control of bipedal locomotion",
Journal of Dynamic Systems, Measurement, and Control 144 (2022); "One-step ahead prediction of angular momentum about the
contact point for control of bipedal locomotion: validation in a LIP-inspired controller", ICRA 2021.
"""

import torch
from torch import Tensor

from telebip.control.pendulum import Pendulum, Step, mean_to_end_speed


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
        L*_y = m H v_x k,    L*_x = -m H v_y k - s m H (W / 2) w sinh(w T) / (1 + cosh(w T)),    k = (w T / 2) / tanh(w T / 2)

    where k makes v the mean speed and the last term is the sway of stepping in place. (Gong and Grizzle aim at m H v_x; k is
    the correction from the speed in the middle of the step to the mean.)

    Args:
        pendulum: the present state.
        step: the present step and the wanted walk; touch-down is `step.time_left` away.

    Returns:
        Touch-down relative to the centre of mass then, (t_x, t_y) [m], (2, num_envs).
    """
    mh = pendulum.mass * pendulum.height
    sinh, cosh = torch.sinh(pendulum.rate * step.time), torch.cosh(pendulum.rate * step.time)
    at_touch_down = predict_ang_mom(pendulum, step.time_left) * cosh
    wanted = mh * mean_to_end_speed(pendulum.rate, step.time) * step.velocity
    sway = step.side * mh * (0.5 * step.width) * pendulum.rate * sinh / (1.0 + cosh)
    t_x = at_touch_down[1] - wanted[0]
    t_y = -wanted[1] - sway - at_touch_down[0]
    return torch.stack([t_x, t_y]) / (mh * pendulum.rate * sinh)
