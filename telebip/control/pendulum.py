"""The linear inverted pendulum: what both walkers predict with, and what they are told about the step."""

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Pendulum:
    """A point mass at constant height over the stance foot's contact, in the plan frame (x along the heading, z up)."""

    mass: float  # m [kg]
    height: Tensor  # H, centre of mass above the contact [m], (num_envs,)
    rate: Tensor  # w = sqrt(g / H) [1/s], (num_envs,)
    pos: Tensor  # (x, y), centre of mass minus contact [m], (2, num_envs)
    vel: Tensor  # (v_x, v_y) of the centre of mass [m/s], (2, num_envs)
    ang_mom: Tensor  # (L_x, L_y) about the contact [kg m^2/s], (2, num_envs)

    def pos_after(self, time: Tensor) -> Tensor:
        """Return (x, y) after `time` [s] (num_envs,): x cosh(w t) + (v_x / w) sinh(w t), likewise y; (2, num_envs)."""
        angle = self.rate * time
        return self.pos * angle.cosh() + self.vel * (angle.sinh() / self.rate)


@dataclass(frozen=True)
class Step:
    """The present step, and what the walk should become."""

    side: Tensor  # s, +1 in left stance and -1 in right stance, (num_envs,)
    time_left: Tensor  # r, until touch-down [s], (num_envs,)
    velocity: Tensor  # wanted (v_x, v_y) [m/s], (2, num_envs)
    time: float  # T, of every step [s]
    width: float  # W, lateral distance of the feet when walking in place [m]
    error_kept: float  # a, share of the momentum's or the DCM's error that the next step leaves [-]


Placement = Callable[[Pendulum, Step], Tensor]
"""A foot placement law: from the present pendulum and step to where to touch down, `Step.time_left` from now.

It returns t = (t_x, t_y), relative to the centre of mass at that time [m], (2, num_envs).
"""
