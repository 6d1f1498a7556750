"""How well a robot walked: speed, heading, cost of transport, falls, and the rhythm of its feet."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telebip.eval.rollout import Rollout

Array = NDArray[np.floating]


@dataclass(frozen=True)
class WalkSummary:
    """Means over worlds and time, after the first `skipped` seconds."""

    worlds: int
    duration: float  # s, walked in all
    skipped: float  # s, left out at the start
    command: tuple[float, float, float]  # m/s, m/s, rad/s
    speed: tuple[float, float]  # forward and leftward along the heading [m/s]
    speed_spread: float  # standard deviation of the worlds' mean forward speeds [m/s]
    lin_vel_error: float  # mean ||v_cmd - v||, with the velocity along and to the left of the heading [m/s]
    yaw_rate: float  # rad/s
    yaw_drift_deg: float  # mean absolute deviation from the reference heading at the end [deg]
    cost_of_transport: float  # see `cost_of_transport`
    cost_of_transport_article: float  # the article's formula, see there
    gait_period: float  # see `gait_period` [s]
    falls: int


def summarise(rollout: Rollout, skip: float) -> WalkSummary:
    """Summarise a rollout, leaving out its first `skip` seconds, in which the robot gathers speed (falls count throughout)."""
    kept = slice(min(round(skip / rollout.step_dt), len(rollout.time) - 1), None)
    velocity = heading_velocity(rollout.qpos[kept], rollout.qvel[kept])
    power = rollout.joint_power[kept].sum(-1)
    command = rollout.command[kept].mean((0, 1), dtype=float)
    error = np.linalg.norm(rollout.command[kept][..., :2] - velocity, axis=-1)
    drift = _wrap(_yaw(rollout.qpos[-1, :, 3:7]) - rollout.reference_heading[-1])
    return WalkSummary(
        worlds=rollout.qpos.shape[1],
        duration=float(rollout.time[-1]),
        skipped=kept.start * rollout.step_dt,
        command=(float(command[0]), float(command[1]), float(command[2])),
        speed=(float(velocity[..., 0].mean()), float(velocity[..., 1].mean())),
        speed_spread=float(velocity[..., 0].mean(0).std()),
        lin_vel_error=float(error.mean()),
        yaw_rate=float(rollout.qvel[kept][..., 5].mean()),
        yaw_drift_deg=float(np.degrees(np.abs(drift)).mean()),
        cost_of_transport=cost_of_transport(power, velocity, rollout.weight),
        cost_of_transport_article=cost_of_transport_article(power, velocity, rollout.weight),
        gait_period=gait_period(rollout.foot_force[kept], rollout.step_dt),
        falls=int(rollout.fallen.sum()),
    )


def heading_velocity(qpos: Array, qvel: Array) -> Array:
    """Return the trunk's horizontal velocity along and to the left of its heading [m/s], (..., 2)."""
    psi = _yaw(qpos[..., 3:7])
    vx, vy = qvel[..., 0], qvel[..., 1]
    return np.stack([np.cos(psi) * vx + np.sin(psi) * vy, np.cos(psi) * vy - np.sin(psi) * vx], axis=-1)


def cost_of_transport(power: Array, velocity: Array, weight: float) -> float:
    r"""Mechanical cost of transport, COT = mean(sum_i |tau_i qd_i|) / (m g mean ||v||).

    Args:
        power: sum_i |tau_i qd_i|, averaged over physics steps [W], (steps, num_envs).
        velocity: horizontal velocity [m/s], (steps, num_envs, 2).
        weight: m g [N].

    Returns:
        Joules per newton of weight and metre [-]; infinite for a robot that does not move.
    """
    speed = np.linalg.norm(velocity.mean(0), axis=-1).mean()
    return float(power.mean() / (weight * speed)) if speed > 0 else float("inf")


def cost_of_transport_article(power: Array, velocity: Array, weight: float) -> float:
    r"""The article's literal formula, COT = (mean(sum_i |tau_i qd_i|) + ||v||) / (m g ||v||), which is larger by 1 / (m g).

    It adds a speed to a power; it is reported to be compared with the article's tables. Arguments as in `cost_of_transport`.
    """
    return cost_of_transport(power, velocity, weight) + 1.0 / weight


def gait_period(foot_force: Array, step_dt: float, longest: float = 1.5) -> float:
    r"""Period of the gait: the lag of the first high peak of the autocorrelation of q_rf - q_lf.

    The difference of the feet alternates in sign within one stride, so that one stride, not one step, is its period.

    Args:
        foot_force: normal forces on the right and the left foot [N], (steps, num_envs, 2).
        step_dt: time between rows [s].
        longest: longest period looked for [s].

    Returns:
        Period [s], refined between samples by a parabola; NaN if there are fewer than two periods or no rhythm.
    """
    signal = foot_force[..., 0] - foot_force[..., 1]
    signal = signal - signal.mean(0)
    lags = min(round(longest / step_dt), len(signal) // 2)
    energy = (signal * signal).mean()
    if lags < 3 or energy <= 0.0:
        return float("nan")
    correlation = np.array([(signal[: len(signal) - k] * signal[k:]).mean() / energy for k in range(lags + 1)])
    inner = correlation[1:-1]
    peaks = 1 + np.flatnonzero((inner > correlation[:-2]) & (inner >= correlation[2:]) & (inner > 0.3))
    if not len(peaks):
        return float("nan")
    k = peaks[np.flatnonzero(correlation[peaks] >= 0.9 * correlation[peaks].max())[0]]
    left, middle, right = correlation[k - 1 : k + 2]
    return float((k + 0.5 * (left - right) / (left - 2.0 * middle + right)) * step_dt)


def _yaw(quat: Array) -> Array:
    w, x, y, z = np.moveaxis(quat, -1, 0)
    return np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def _wrap(angle: Array) -> Array:
    return np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi
