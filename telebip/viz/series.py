"""What is plotted of a walk: its time series, grouped into plots, with their colours."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telebip.eval.rollout import Rollout
from telebip.eval.walk import heading_velocity
from telebip.robot import FEET, JOINTS
from telebip.viz.scene import Color

Array = NDArray[np.floating]

RIGHT, LEFT, COMMAND, TOTAL = (235, 110, 80), (80, 160, 235), (170, 170, 170), (240, 200, 80)
PALETTE: tuple[Color, ...] = (TOTAL, (90, 200, 130), (80, 160, 235), (235, 110, 80), (190, 120, 220), (140, 220, 220))
"""Colours of robots, and of terms, in turn."""

SHARED = ("speed", "side_speed", "yaw_rate", "cost_of_transport")
"""Plots in which several robots are compared."""


@dataclass(frozen=True)
class Curve:
    """One line of a plot."""

    values: Array  # (steps,)
    color: Color
    width: float = 1.5  # [points]


@dataclass(frozen=True)
class Plot:
    """Curves that share their axes."""

    title: str  # with the unit
    curves: dict[str, Curve]


def plots(rollout: Rollout, world: int) -> dict[str, Plot]:
    """Return the plots of one world, by the names under which a recording keeps them."""
    velocity = heading_velocity(rollout.qpos[:, world], rollout.qvel[:, world])
    command, power = rollout.command[:, world], rollout.joint_power[:, world].sum(-1)
    yaw_rate = rollout.qvel[:, world, 5]
    phase, load = rollout.phase[:, world], rollout.foot_force[:, world] / rollout.weight
    position, target = rollout.qpos[:, world, 7:], rollout.joint_target[:, world]
    force, colors = rollout.joint_force[:, world], (RIGHT, LEFT)
    running = running_cost_of_transport(power, velocity, rollout.weight, round(1.0 / rollout.step_dt))

    def pair(values: Array, names: tuple[str, str], width: float = 1.5) -> dict[str, Curve]:
        return {name: Curve(values[:, i], colors[i], width) for i, name in enumerate(names)}

    def joint(kind: str) -> Plot:
        unit = "m" if kind == "knee" else "rad"
        rows = [i for i, name in enumerate(JOINTS) if name.endswith(kind)]
        sides = pair(position[:, rows], ("right", "left"))
        return Plot(f"{kind.replace('_', ' ')} [{unit}]", sides | pair(target[:, rows], ("right_target", "left_target"), 0.7))

    hips = [i for i, name in enumerate(JOINTS) if not name.endswith("knee")]
    knees = [i for i, name in enumerate(JOINTS) if name.endswith("knee")]
    shades = ((235, 110, 80), (250, 180, 90), (80, 160, 235), (110, 220, 210))
    terms = zip(rollout.reward_names, rollout.reward_terms[:, world].T, strict=True)
    return {
        "speed": Plot("speed [m/s]", {"command": Curve(command[:, 0], COMMAND), "forward": Curve(velocity[:, 0], TOTAL)}),
        "side_speed": Plot(
            "speed to the left [m/s]", {"command": Curve(command[:, 1], COMMAND), "left": Curve(velocity[:, 1], TOTAL)}
        ),
        "yaw_rate": Plot("yaw rate [rad/s]", {"command": Curve(command[:, 2], COMMAND), "trunk": Curve(yaw_rate, TOTAL)}),
        "gait": Plot("phase, foot force / weight", pair(phase, ("p_r", "p_l"), 0.7) | pair(load, FEET)),
        "hip_pitch": joint("hip_pitch"),
        "hip_roll": joint("hip_roll"),
        "knee": joint("knee"),
        "torque": Plot("hip torque [N m]", {JOINTS[i]: Curve(force[:, i], shades[k]) for k, i in enumerate(hips)}),
        "knee_force": Plot("knee force [N]", pair(force[:, knees], ("right", "left"))),
        "power": Plot("power [W]", {"total": Curve(power, TOTAL)}),
        "cost_of_transport": Plot("cost of transport, last second", {"mechanical": Curve(running, TOTAL)}),
        "reward": Plot(
            "reward per step",
            {
                **{name: Curve(values, PALETTE[1 + i % 5]) for i, (name, values) in enumerate(terms)},
                "total": Curve(rollout.reward[:, world], TOTAL),
            },
        ),
    }


def running_cost_of_transport(power: Array, velocity: Array, weight: float, window: int, slowest: float = 0.05) -> Array:
    r"""Cost of transport of the latest rows, COT_t = mean P / (m g ||mean v||) over the last `window` rows.

    Args:
        power: mechanical power of all joints [W], (steps,).
        velocity: horizontal velocity [m/s], (steps, 2).
        weight: m g [N].
        window: number of rows.
        slowest: below this mean speed the quotient says nothing [m/s].

    Returns:
        Cost of transport [-], (steps,); NaN below `slowest`, and until the first window is full: the robot gathers speed.
    """
    speed = np.linalg.norm(running_mean(velocity, window), axis=-1)
    moving = (speed >= slowest) & (np.arange(len(speed)) >= window - 1)
    return np.where(moving, running_mean(power, window) / (weight * np.where(moving, speed, 1.0)), np.nan)


def running_mean(values: Array, window: int) -> Array:
    """Return the mean of the latest `window` rows, or of as many as there are, for every row of `values` (steps, ...)."""
    sums = np.concatenate([np.zeros_like(values[:1], dtype=float), np.cumsum(values, axis=0, dtype=float)])
    last = np.arange(1, len(values) + 1)
    first = np.maximum(last - window, 0)
    return ((sums[last] - sums[first]).T / (last - first)).T
