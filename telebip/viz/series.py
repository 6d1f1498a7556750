"""What is plotted of a walk: its time series, grouped into plots, with their colours."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from telebip.eval.walk import heading_velocity
from telebip.robot import FEET
from telebip.rollout import Rollout
from telebip.viz.scene import Color

Array = NDArray[np.floating]

RIGHT, LEFT, COMMAND, TOTAL = (235, 110, 80), (80, 160, 235), (170, 170, 170), (240, 200, 80)
PALETTE: tuple[Color, ...] = (TOTAL, (90, 200, 130), (80, 160, 235), (235, 110, 80), (190, 120, 220), (140, 220, 220))
"""Colours of robots, and of terms, in turn."""
SHADES: dict[str, tuple[Color, ...]] = {
    "right": (RIGHT, (250, 180, 90), (215, 90, 150), (190, 150, 60)),
    "left": (LEFT, (110, 220, 210), (130, 120, 235), (70, 190, 130)),
    "": PALETTE,
}
"""Colours of the joints of a side, or of none, in turn."""

Row = Literal["motion", "cost", "gait", "joints", "effort", "reward"]
SHARED: tuple[Row, ...] = ("motion", "cost")
"""Rows in whose plots several robots are compared."""


@dataclass(frozen=True)
class Curve:
    """One line of a plot."""

    values: Array  # (steps,)
    color: Color
    width: float = 1.5  # [points]


@dataclass(frozen=True)
class Plot:
    """Curves that share their axes."""

    row: Row  # of a recording's layout; the plots of a row are its tabs
    title: str  # with the unit
    curves: dict[str, Curve]


def plots(rollout: Rollout, world: int, is_slide: NDArray[np.bool_]) -> dict[str, Plot]:
    """Return the plots of one world, by the names under which a recording keeps them; `is_slide` as in `Robot`.

    Joints share a plot with those of the other side: `right_knee` and `left_knee` are curves of `knee`.
    """
    velocity = heading_velocity(rollout.qpos[:, world], rollout.qvel[:, world])
    command, power = rollout.command[:, world], rollout.joint_power[:, world].sum(-1)
    phase, load = rollout.phase[:, world], rollout.foot_force[:, world] / rollout.weight
    running = running_cost_of_transport(power, velocity, rollout.weight, round(1.0 / rollout.step_dt))

    def pair(values: Array, names: tuple[str, str], width: float = 1.5) -> dict[str, Curve]:
        return {name: Curve(values[:, i], (RIGHT, LEFT)[i], width) for i, name in enumerate(names)}

    def against(command: Array, name: str, values: Array) -> dict[str, Curve]:
        return {"command": Curve(command, COMMAND), name: Curve(values, TOTAL)}

    terms = zip(rollout.reward_names, rollout.reward_terms[:, world].T, strict=True)
    rewards = {name: Curve(values, PALETTE[1 + i % 5]) for i, (name, values) in enumerate(terms)}
    return {
        "speed": Plot("motion", "speed [m/s]", against(command[:, 0], "forward", velocity[:, 0])),
        "side_speed": Plot("motion", "speed to the left [m/s]", against(command[:, 1], "left", velocity[:, 1])),
        "yaw_rate": Plot("motion", "yaw rate [rad/s]", against(command[:, 2], "trunk", rollout.qvel[:, world, 5])),
        "cost_of_transport": Plot("cost", "cost of transport, last second", {"mechanical": Curve(running, TOTAL)}),
        "gait": Plot("gait", "phase, foot force / weight", pair(phase, ("p_r", "p_l"), 0.7) | pair(load, FEET)),
        **_joint_plots(rollout, world, is_slide),
        "power": Plot("effort", "power [W]", {"total": Curve(power, TOTAL)}),
        **_effort_plots(rollout, world, is_slide),
        "reward": Plot("reward", "reward per step", {**rewards, "total": Curve(rollout.reward[:, world], TOTAL)}),
    }


def _joint_plots(rollout: Rollout, world: int, is_slide: NDArray[np.bool_]) -> dict[str, Plot]:
    """Return positions and targets of the joints, in a plot for each pair."""
    found: dict[str, Plot] = {}
    for i, name in enumerate(rollout.joint_names):
        side, kind = split_side(name)
        title = f"{kind.replace('_', ' ')} [{'m' if is_slide[i] else 'rad'}]"
        curves = found.setdefault(kind, Plot("joints", title, {})).curves
        curves[side or "position"] = Curve(rollout.joint_pos[:, world, i], SHADES[side][0])
        curves[f"{side}_target".strip("_")] = Curve(rollout.joint_target[:, world, i], SHADES[side][0], 0.7)
    return found


def _effort_plots(rollout: Rollout, world: int, is_slide: NDArray[np.bool_]) -> dict[str, Plot]:
    """Return the torques of all hinges in one plot, and the forces of all slides in another."""
    plots = {"torque": Plot("effort", "joint torque [N m]", {}), "force": Plot("effort", "joint force [N]", {})}
    for i, name in enumerate(rollout.joint_names):
        curves = plots["force" if is_slide[i] else "torque"].curves
        side, _ = split_side(name)
        shade = sum(split_side(other)[0] == side for other in curves)
        curves[name] = Curve(rollout.joint_force[:, world, i], SHADES[side][shade % len(SHADES[side])])
    return {name: plot for name, plot in plots.items() if plot.curves}


def split_side(joint: str) -> tuple[str, str]:
    """Return a joint's side, `right`, `left` or nothing, and the rest of its name: ("right", "knee") of `right_knee`."""
    side, _, kind = joint.partition("_")
    return (side, kind) if side in ("right", "left") and kind else ("", joint)


def running_cost_of_transport(power: Array, velocity: Array, weight: float, window: int) -> Array:
    r"""Cost of transport of the latest rows, COT_t = mean P / (m g ||mean v||) over the last `window` rows.

    Args:
        power: mechanical power of all joints [W], (steps,).
        velocity: horizontal velocity [m/s], (steps, 2).
        weight: m g [N].
        window: number of rows.

    Returns:
        Cost of transport [-], (steps,); NaN below 0.05 m/s, and until the first window is full.
    """
    speed = np.linalg.norm(running_mean(velocity, window), axis=-1)
    moving = (speed >= 0.05) & (np.arange(len(speed)) >= window - 1)
    return np.where(moving, running_mean(power, window) / (weight * np.where(moving, speed, 1.0)), np.nan)


def running_mean(values: Array, window: int) -> Array:
    """Return the mean of the latest `window` rows, or of as many as there are, for every row of `values` (steps, ...)."""
    sums = np.concatenate([np.zeros_like(values[:1], dtype=float), np.cumsum(values, axis=0, dtype=float)])
    last = np.arange(1, len(values) + 1)
    first = np.maximum(last - window, 0)
    return ((sums[last] - sums[first]).T / (last - first)).T
