"""The reward terms: r = r_cmd + r_diff + r_tq + r_foot + r_T, per policy step, and others that are ours.

Each is a function of the step, and its keyword parameters are what a task's `rewards` give it; the environment sums them. A
term of your own is one more function here, or anywhere: see docs/extending.md.
"""

from typing import Annotated, Literal

import torch
from torch import Tensor

from telebip.math import columns, norm
from telebip.mdp.curriculum import Ramp, progress
from telebip.mdp.gait import window_weights
from telebip.mdp.step import Memory, Step, World
from telebip.mdp.term import Quantity, reward


@reward
def cmd(
    step: Step,
    *,
    k_xy: float,
    sigma_xy: Annotated[float, Quantity("m/s", gt=0)],
    k_w: float,
    sigma_w: Annotated[float, Quantity("rad/s", gt=0)],
) -> Tensor:
    r"""Reward for following the velocity command.

        r_cmd = k_xy exp(-||v_xy_cmd - v_xy|| / sigma_xy) + k_w exp(-|w_cmd - w| / sigma_w)    (article, control reward)

    The norm is not squared: the reward has a cusp at zero error, and sigma is a velocity. (legged_gym's `tracking_sigma`
    divides a squared error; convert before copying values.)

    Args:
        step: its command, and the trunk's velocity and yaw rate in the body frame.
        k_xy: reward at zero error of the velocity [-].
        sigma_xy: error at which that falls to k_xy / e [m/s].
        k_w: reward at zero error of the yaw rate [-].
        sigma_w: error at which that falls to k_w / e [rad/s].

    Returns:
        Reward [-], (num_envs,).
    """
    return _closeness(step.command_error, k_xy, sigma_xy, k_w, sigma_w)


def _closeness(error: Tensor, k_xy: float, sigma_xy: float, k_w: float, sigma_w: float) -> Tensor:
    """Return k_xy exp(-||e_xy|| / sigma_xy) + k_w exp(-|e_w| / sigma_w) of errors (num_envs, 3) [m/s, m/s, rad/s]."""
    return k_xy * torch.exp(-norm(error[:, :2]) / sigma_xy) + k_w * torch.exp(-error[:, 2].abs() / sigma_w)


def _stride(world: World, **_) -> Memory:
    """Errors (vx, vy, yaw rate) of the last gait period, newest first."""
    return {"error": world.zeros(3, world.gait_steps)}


@reward(memory=_stride)
def stride_cmd(
    step: Step,
    memory: Memory,
    *,
    k_xy: float,
    sigma_xy: Annotated[float, Quantity("m/s", gt=0)],
    k_w: float,
    sigma_w: Annotated[float, Quantity("rad/s", gt=0)],
) -> Tensor:
    r"""Reward for following the velocity command on average over a stride.

        r = k_xy exp(-||e_xy|| / sigma_xy) + k_w exp(-|e_w| / sigma_w),    e = mean over one gait period of (cmd - v)

    Not in the article. A walk sways within a stride, and `cmd` hardly sees a small bias of the mean: moving the mean makes one
    part of the stride better and another worse. Here the sway cancels and the bias is left. Steps before the start of the
    episode have no error.

    Args:
        step: its command, and the trunk's velocity and yaw rate in the body frame.
        memory: the errors of the steps.
        k_xy: reward at zero error of the velocity [-].
        sigma_xy: error of the mean at which that falls to k_xy / e [m/s].
        k_w: reward at zero error of the yaw rate [-].
        sigma_w: error of the mean at which that falls to k_w / e [rad/s].

    Returns:
        Reward [-], (num_envs,).
    """
    window = memory["error"]
    window.copy_(torch.cat([step.command_error[:, :, None], window[:, :, :-1]], dim=2))
    return _closeness(window.mean(2), k_xy, sigma_xy, k_w, sigma_w)


@reward
def diff(step: Step, *, k_diff: Annotated[float, Quantity(le=0)]) -> Tensor:
    r"""Penalty on jerky actions: r_diff = k_diff ||A_t - A_{t-1}||, (num_envs,) [-]."""
    return k_diff * norm(step.action - step.last_action)


@reward
def tq(step: Step, *, k_tq: Annotated[float, Quantity(le=0)]) -> Tensor:
    r"""Penalty on actuator effort: r_tq = k_tq ||tau_t / tau_limit||, (num_envs,) [-].

    The article's ||tau_t|| would add N m of the hips to N of the prismatic knees; each entry is divided by its actuator's
    force limit first, that of the force's sign, so that the norm is dimensionless and 1 means one saturated actuator.
    """
    force, (low, high) = step.state.joint_force, step.world.force_range.unbind(1)
    return k_tq * norm(force / torch.where(force < 0.0, -low, high))


def _foot_window(world: World, **_) -> Memory:
    """Samples p_r q_rf + p_l q_lf of the last gait period, newest first: l = 0..N, where N steps are one period."""
    return {"window": world.zeros(world.gait_steps + 1)}


@reward(memory=_foot_window)
def foot(
    step: Step,
    memory: Memory,
    *,
    k_foot: float,
    gamma: Annotated[float, Quantity(gt=0, le=1)],
    first: Literal["newest", "oldest"],
    cap: Annotated[float, Quantity("body weights", gt=0)],
) -> Tensor:
    r"""Reward for pressing with the foot whose phase signal is positive, over one gait period.

        r_foot = k_foot sum_{l=0..N} gamma^l [p_r(tau_l) q_rf(tau_l) + p_l(tau_l) q_lf(tau_l)]   (article, foot reward)
        q = min(force / (m g), cap)                                                              (cap: ours)

    A reward proportional to the force pays for pounding: landing hard in phase earns more than carrying the weight steadily.
    With a cap, all that counts is which foot is on the ground. Samples from before the start of the episode are zero.

    Args:
        step: its phase signals and foot forces.
        memory: the window of samples.
        k_foot: coefficient [-].
        gamma: discount of the window [-].
        first: the sample that has l = 0, see `telebip.mdp.gait.window_weights`.
        cap: force that counts at most, in body weights [-]; one that is never reached gives the article's reward.

    Returns:
        Reward [-], (num_envs,).
    """
    force = (step.state.foot_force / step.world.weight).clamp(max=cap)
    window = memory["window"]
    window.copy_(columns((step.phase * force).sum(1), window[:, :-1]))
    return k_foot * (window @ window_weights(window.shape[1], gamma, first, window.device))


@reward
def energy(step: Step, *, k_energy: Annotated[float, Quantity("s/m", le=0)], ramp: Ramp) -> Tensor:
    r"""Penalty on mechanical power: r_energy = k_energy sum_i |tau_i qd_i| / (m g), (num_envs,) [-].

    The power over the weight is the speed at which a cost of transport of 1 would be paid for: cost of transport times speed.
    Not in the article. From the first sample on it teaches a robot that cannot walk yet to hold still, so it is ramped up.
    """
    return progress(step.env.samples, ramp) * (k_energy / step.world.weight) * step.state.joint_power.sum(1)


@reward
def cot(
    step: Step,
    *,
    k_cot: Annotated[float, Quantity(le=0)],
    min_speed: Annotated[float, Quantity("m/s", gt=0)],
    ramp: Ramp,
) -> Tensor:
    r"""Penalty on the cost of transport: r_cot = k_cot sum_i |tau_i qd_i| / (m g max(||v_xy_cmd||, min_speed)).

    Not in the article. `energy` prices a second of walking, this a metre, so that slow walking is priced as high as fast
    walking is. The speed is the commanded one: with its own the robot could walk faster than it is told, and be paid for it.

    Args:
        step: its command, and the power of the joints.
        k_cot: reward at a cost of transport of 1 [-].
        min_speed: commanded speed below which the price is that of a second [m/s].
        ramp: samples between which the term grows from nothing to all of it.

    Returns:
        Reward [-], (num_envs,).
    """
    cost = step.state.joint_power.sum(1) / (step.world.weight * norm(step.command[:, :2]).clamp(min=min_speed))
    return progress(step.env.samples, ramp) * k_cot * cost


@reward
def termination(step: Step, *, k_termination: Annotated[float, Quantity(le=0)]) -> Tensor:
    r"""Penalty on a fall: r_T = k_T where the episode ends by a termination (-1 in the article), else 0, (num_envs,) [-].

    A time-out is none.
    """
    return k_termination * step.fallen.float()
