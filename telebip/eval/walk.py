"""How well a robot walked: speed, heading, cost of transport and falls."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from telebip.eval.gait import rhythm
from telebip.math import wrap_angle, yaw
from telebip.rollout import Rollout

Array = NDArray[np.floating]


@dataclass(frozen=True)
class WalkSummary:
    """Means over worlds and time, after the first `skipped` seconds."""

    worlds: int
    duration: float  # s, walked in all
    skipped: float  # s, left out at the start
    command: tuple[float, ...]  # m/s, m/s, rad/s
    speed: tuple[float, float]  # forward and leftward along the heading [m/s]
    speed_spread: float  # standard deviation of the worlds' mean forward speeds [m/s]
    speed_ci95: float  # half width of the 95 % interval of the mean forward speed over worlds [m/s]
    lin_vel_error: float  # mean ||v_cmd - v||, with the velocity along and to the left of the heading [m/s]
    lin_vel_rms_error: float  # root of the mean of ||v_cmd - v||^2 [m/s]
    yaw_rate: float  # rad/s
    yaw_drift_deg: float  # mean absolute deviation from the reference heading at the end [deg]
    cost_of_transport: float  # of |power|, see `cost_of_transport`
    cost_of_transport_article: float  # the article's formula, see there
    cost_of_transport_positive: float  # of positive power alone: braking costs nothing and gives nothing back
    joint_cost_of_transport: tuple[float, ...]  # of |power|, each actuator's share, in the order of `Rollout.joint_names`
    gait_period: float  # see `telebip.eval.gait.rhythm` [s]
    falls: int
    worlds_fallen: int  # of which there are at most `worlds`


def summarise(rollout: Rollout, skip: float) -> WalkSummary:
    """Summarise a rollout, leaving out its first `skip` seconds, in which the robot gathers speed (falls count throughout)."""
    kept = rollout.after(skip)
    velocity = heading_velocity(kept.qpos, kept.qvel)
    positive = 0.5 * (kept.joint_power + kept.joint_net_power)  # max(x, 0) = (|x| + x) / 2
    error = np.linalg.norm(kept.command[..., :2] - velocity, axis=-1)
    drift = wrap_angle(torch.as_tensor(_yaw(rollout.qpos[-1]) - rollout.reference_heading[-1]))
    speeds = velocity[..., 0].mean(0, dtype=float)
    worlds = len(speeds)
    joints = [cost_of_transport(power, velocity, rollout.weight) for power in np.moveaxis(kept.joint_power, -1, 0)]
    return WalkSummary(
        worlds=worlds,
        duration=float(rollout.time[-1]),
        skipped=(len(rollout.time) - len(kept.time)) * rollout.step_dt,
        command=tuple(kept.command.mean((0, 1), dtype=float).tolist()),
        speed=(float(speeds.mean()), float(velocity[..., 1].mean(dtype=float))),
        speed_spread=float(speeds.std()),
        speed_ci95=1.96 * float(speeds.std(ddof=1)) / math.sqrt(worlds) if worlds > 1 else float("nan"),
        lin_vel_error=float(error.mean()),
        lin_vel_rms_error=float(np.sqrt((error**2).mean())),
        yaw_rate=float(kept.qvel[..., 5].mean()),
        yaw_drift_deg=float(drift.abs().rad2deg().mean()),
        cost_of_transport=sum(joints),
        cost_of_transport_article=sum(joints) + 1.0 / rollout.weight,
        cost_of_transport_positive=cost_of_transport(positive.sum(-1), velocity, rollout.weight),
        joint_cost_of_transport=tuple(joints),
        gait_period=rhythm(kept.foot_force, rollout.step_dt)[0],
        falls=int(rollout.fallen.sum()),
        worlds_fallen=int(rollout.fallen.any(0).sum()),
    )


def heading_velocity(qpos: Array, qvel: Array) -> Array:
    """Return the trunk's horizontal velocity along and to the left of its heading [m/s], (..., 2)."""
    psi, vx, vy = _yaw(qpos), qvel[..., 0], qvel[..., 1]
    return np.stack([np.cos(psi) * vx + np.sin(psi) * vy, np.cos(psi) * vy - np.sin(psi) * vx], axis=-1)


def cost_of_transport(power: Array, velocity: Array, weight: float) -> float:
    r"""Mechanical cost of transport, COT = mean(P) / (m g mean ||v||), with P = sum_i |tau_i qd_i| unless said otherwise.

    The article's literal formula, COT = (mean(P) + ||v||) / (m g ||v||), adds a speed to a power and is larger by 1 / (m g).

    Args:
        power: P, averaged over physics steps [W], (steps, num_envs).
        velocity: horizontal velocity [m/s], (steps, num_envs, 2).
        weight: m g [N].

    Returns:
        Joules per newton of weight and metre [-]; infinite for a robot that does not move.
    """
    speed = np.linalg.norm(velocity.mean(0), axis=-1).mean()
    return float(power.mean() / (weight * speed)) if speed > 0 else float("inf")


def _yaw(qpos: Array) -> Array:
    return yaw(torch.as_tensor(qpos[..., 3:7])).numpy()
