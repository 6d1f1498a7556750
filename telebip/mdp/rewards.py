"""The reward modules: r = r_cmd + r_diff + r_tq + r_foot + r_T, per policy step, and r_energy, which is ours.

Each term is a pure function; `REWARDS` at the end is the list that the environment sums, beside the YAML that holds every
coefficient. To add a term, mark its function with `reward_term` and weigh it in the YAML, `reward.extra`; see docs/rewards.md.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from telebip.config.schema import RewardConfig
from telebip.errors import UserError, nearest
from telebip.math import norm
from telebip.mdp.context import StepContext


def velocity_tracking(lin_vel_b: Tensor, command: Tensor, k_xy: float, sigma_xy: float) -> Tensor:
    r"""Reward for following the planar velocity command, the first part of r_cmd.

        k_xy exp(-||v_xy_cmd - v_xy|| / sigma_xy)                                            (article, control reward)

    The norm is not squared: the reward has a cusp at zero error, and sigma is a velocity. (legged_gym's `tracking_sigma`
    divides a squared error; convert before copying values.)

    Args:
        lin_vel_b: base linear velocity, body frame [m/s], (num_envs, 3).
        command: (vx, vy, yaw rate), body frame [m/s, m/s, rad/s], (num_envs, 3).
        k_xy: reward at zero error [-].
        sigma_xy: error at which the reward falls to k_xy / e [m/s].

    Returns:
        Reward [-], (num_envs,).
    """
    error = norm(command[:, :2] - lin_vel_b[:, :2])
    return k_xy * torch.exp(-error / sigma_xy)


def yaw_rate_tracking(ang_vel_b: Tensor, command: Tensor, k_w: float, sigma_w: float) -> Tensor:
    r"""Reward for following the yaw-rate command, the second part of r_cmd.

        k_w exp(-|w_cmd - w| / sigma_w)                                                      (article, control reward)

    Args:
        ang_vel_b: base angular velocity, body frame [rad/s], (num_envs, 3).
        command: (vx, vy, yaw rate), body frame [m/s, m/s, rad/s], (num_envs, 3).
        k_w: reward at zero error [-].
        sigma_w: error at which the reward falls to k_w / e [rad/s].

    Returns:
        Reward [-], (num_envs,).
    """
    return k_w * torch.exp(-(command[:, 2] - ang_vel_b[:, 2]).abs() / sigma_w)


def action_difference(action: Tensor, last_action: Tensor, k_diff: float) -> Tensor:
    r"""Penalty on jerky actions: r_diff = k_diff ||A_t - A_{t-1}||.

    Args:
        action: A_t [-], (num_envs, 6).
        last_action: A_{t-1} [-], (num_envs, 6).
        k_diff: coefficient, not positive [-].

    Returns:
        Reward [-], (num_envs,).
    """
    return k_diff * norm(action - last_action)


def torque(joint_force: Tensor, force_limit: Tensor, k_tq: float) -> Tensor:
    r"""Penalty on actuator effort: r_tq = k_tq ||tau_t / tau_limit||.

    The article's ||tau_t|| would add N m of the hips to N of the prismatic knees; each entry is divided by its actuator's
    force limit first, so that the norm is dimensionless and 1 means one saturated actuator.

    Args:
        joint_force: actuator forces, mean over the policy step [N m | N], (num_envs, 6).
        force_limit: force limits of the actuators [N m | N], (6,).
        k_tq: coefficient, not positive [-].

    Returns:
        Reward [-], (num_envs,).
    """
    return k_tq * norm(joint_force / force_limit)


def periodic_foot_force(window: Tensor, weights: Tensor, k_foot: float) -> Tensor:
    r"""Reward for pressing with the foot whose phase signal is positive, over one gait period.

        r_foot = k_foot sum_{l=0..N} gamma^l [p_r(tau_l) q_rf(tau_l) + p_l(tau_l) q_lf(tau_l)]   (article, foot reward)

    See `telebip.mdp.gait` for the samples (forces in body weights) and for the two readings of the index l. Samples from
    before the start of the episode are zero.

    Args:
        window: samples p_r q_rf + p_l q_lf, newest first [-], (num_envs, N + 1).
        weights: gamma^l in the window's order [-], (N + 1,).
        k_foot: coefficient [-].

    Returns:
        Reward [-], (num_envs,).
    """
    return k_foot * (window @ weights)


def energy(joint_power: Tensor, weight: float, k_energy: float) -> Tensor:
    r"""Penalty on mechanical power: r_energy = k_energy sum_i |tau_i qd_i| / (m g).

    The power over the weight is the speed at which a cost of transport of 1 would be paid for: cost of transport times speed.
    Not in the article. From the first sample on it teaches a robot that cannot walk yet to hold still, so it is ramped up.

    Args:
        joint_power: |tau_i qd_i|, mean over the policy step [W], (num_envs, 6).
        weight: m g [N].
        k_energy: coefficient, not positive [s/m].

    Returns:
        Reward [-], (num_envs,).
    """
    return k_energy * joint_power.sum(1) / weight


def termination(fallen: Tensor, k_termination: float) -> Tensor:
    r"""Penalty on a fall: r_T = k_T where the robot has fallen, else 0. A time-out is not a fall.

    Args:
        fallen: bool, (num_envs,).
        k_termination: -1 in the article [-].

    Returns:
        Reward [-], (num_envs,).
    """
    return k_termination * fallen.float()


REWARDS: dict[str, Callable[[StepContext, RewardConfig], Tensor]] = {
    "cmd": lambda s, c: (
        velocity_tracking(s.base_lin_vel_b, s.command, c.cmd.k_xy, c.cmd.sigma_xy)
        + yaw_rate_tracking(s.state.base_ang_vel_b, s.command, c.cmd.k_w, c.cmd.sigma_w)
    ),
    "diff": lambda s, c: action_difference(s.action, s.last_action, c.diff.k_diff),
    "tq": lambda s, c: torque(s.state.joint_force, s.force_limit, c.tq.k_tq),
    "foot": lambda s, c: periodic_foot_force(s.foot_window, s.foot_weights, c.foot.k_foot),
    "energy": lambda s, c: s.energy_share * energy(s.state.joint_power, s.weight, c.energy.k_energy),
    "termination": lambda s, c: termination(s.fallen, c.termination.k_termination),
}


Term = Callable[[StepContext], Tensor]
"""A reward as a function of the step: (num_envs,)."""

EXTRA: dict[str, Term] = {}
"""Terms that a task may weigh by name in `reward.extra`; `reward_term` enters them."""


def reward_term(function: Term) -> Term:
    """Let tasks weigh `function` by its name: with `reward.extra: {name: weight}` they add weight * function(step).

    Raises:
        ValueError: a term of `REWARDS` has this name.
    """
    if function.__name__ in REWARDS:
        raise ValueError(f"a reward term of telebip is called '{function.__name__}'")
    EXTRA[function.__name__] = function
    return function


def reward_terms(cfg: RewardConfig) -> dict[str, Term]:
    """Return every term of a task, weights applied: those of `REWARDS`, then those of `reward.extra`.

    Raises:
        UserError: `reward.extra` names a function that is not there.
    """
    for name in cfg.extra:
        if name not in EXTRA:
            hint = nearest(name, EXTRA) if EXTRA else "no function is"
            raise UserError(f"reward.extra.{name}: no function '{name}' is marked @reward_term; {hint} (see docs/rewards.md)")
    own = {name: lambda s, term=term: term(s, cfg) for name, term in REWARDS.items()}
    return own | {name: lambda s, term=EXTRA[name], weight=weight: weight * term(s) for name, weight in cfg.extra.items()}
