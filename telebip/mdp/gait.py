"""The gait clock and the window of the periodic foot reward."""

import math

import torch
from torch import Tensor

from telebip.math import columns, norm


def clock_rate(command: Tensor, period: float, max_stride: float) -> Tensor:
    r"""How fast the gait clock runs, so that no stride is longer than a leg likes to make it.

        T(v) = min(T, L / ||v_xy_cmd||),    rate = T / T(v) = max(1, T ||v_xy_cmd|| / L)

    Not in the article, whose period is the same at all speeds. Slow steps waste little energy at low speeds, and need strides
    that are too long at high ones: see the cheapest times of a step in docs/evaluation.md.

    Args:
        command: commanded (vx, vy, ...) without the holds' corrections [m/s], (num_envs, 2 or more).
        period: T, the longest period [s].
        max_stride: L, the longest stride, of two steps [m].

    Returns:
        Seconds of the clock per second [-], (num_envs,).
    """
    return (period / max_stride * norm(command[:, :2])).clamp(min=1.0)


def phase_signals(time: Tensor, period: float) -> Tensor:
    r"""Phase signals that ask the feet to carry the robot in turn.

        p_r(t) = sin(2 pi t / T),    p_l(t) = sin(2 pi t / T + pi) = -p_r(t)                  (article, phase signals)

    Args:
        time: time of the gait clock since the start of the episode [s], (num_envs,).
        period: T [s].

    Returns:
        (p_r, p_l) [-], (num_envs, 2). Positive where the foot is asked to press on the ground.
    """
    p_r = torch.sin(2.0 * math.pi / period * time)
    return columns(p_r, -p_r)


def window_weights(length: int, gamma: float, first: str, device: torch.device | str = "cpu") -> Tensor:
    r"""Weight gamma^l of each sample in the window, newest sample first.

    The article writes tau_l = t - N + l dt, which makes l = 0 the oldest sample, so that old samples weigh most; it does not
    say whether that is meant. Both readings are offered:

    - first "newest": weights 1, gamma, gamma^2, ... from the newest sample back in time: recent forces count most.
    - first "oldest": the article's formula as it stands; the newest sample weighs gamma^N.

    Args:
        length: N + 1.
        gamma: discount of the window, 0 < gamma <= 1 [-].
        first: "newest" or "oldest", the sample that has l = 0.
        device: where they live.

    Returns:
        Weights [-], (length,), in the order of the window (newest first).
    """
    weights = gamma ** torch.arange(length, device=device)
    return weights if first == "newest" else weights.flip(0)
