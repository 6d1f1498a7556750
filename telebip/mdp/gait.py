"""The gait clock and the window of the periodic foot reward."""

import math

import torch
from torch import Tensor

from telebip.math import columns


def phase_signals(time: Tensor, period: float) -> Tensor:
    r"""Phase signals that ask the feet to carry the robot in turn.

        p_r(t) = sin(2 pi t / T),    p_l(t) = sin(2 pi t / T + pi) = -p_r(t)                  (article, phase signals)

    Args:
        time: time since the start of the episode [s], (num_envs,).
        period: T [s].

    Returns:
        (p_r, p_l) [-], (num_envs, 2). Positive where the foot is asked to press on the ground.
    """
    p_r = torch.sin(2.0 * math.pi / period * time)
    return columns(p_r, -p_r)


def window_length(period: float, step_dt: float) -> int:
    """Return the number of samples in the foot reward's sum over l = 0..N, N + 1, where N steps are one gait period."""
    return round(period / step_dt) + 1


def window_weights(length: int, gamma: float, first: str) -> Tensor:
    r"""Weight gamma^l of each sample in the window, newest sample first.

    The article writes tau_l = t - N + l dt, which makes l = 0 the oldest sample, so that old samples weigh most; it does not
    say whether that is meant. Both readings are offered:

    - first "newest": weights 1, gamma, gamma^2, ... from the newest sample back in time: recent forces count most.
    - first "oldest": the article's formula as it stands; the newest sample weighs gamma^N.

    Args:
        length: N + 1.
        gamma: discount of the window, 0 < gamma <= 1 [-].
        first: "newest" or "oldest", the sample that has l = 0.

    Returns:
        Weights [-], (length,), in the order of the window (newest first).
    """
    weights = gamma ** torch.arange(length)
    return weights if first == "newest" else weights.flip(0)


def foot_sample(phase: Tensor, foot_force: Tensor, weight: float, cap: float) -> Tensor:
    r"""One sample of the foot reward.

        p_r q_rf + p_l q_lf,    q = min(force / (m g), cap)                                  (article, foot reward; cap: ours)

    A reward proportional to the force pays for pounding: landing hard in phase earns more than carrying the weight steadily.
    With a cap, all that counts is which foot is on the ground.

    Args:
        phase: (p_r, p_l) [-], (num_envs, 2).
        foot_force: normal forces on the right and the left foot [N], (num_envs, 2).
        weight: m g [N]; dividing by it makes the term independent of the robot's size.
        cap: force that counts at most, in body weights [-]; one that is never reached gives the article's reward.

    Returns:
        Sample [-], (num_envs,).
    """
    return (phase * (foot_force / weight).clamp(max=cap)).sum(1)


def push_sample(window: Tensor, sample: Tensor) -> Tensor:
    """Return `window` (num_envs, length) with `sample` (num_envs,) at its front and its oldest entry dropped."""
    return columns(sample, window[:, :-1])
