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
