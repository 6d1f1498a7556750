"""The robot's mirror symmetry: right and left change places at the plane y = 0, and so do the phase signals."""

import torch
from torch import Tensor

from telebip.mdp.observations import LAYOUT

_JOINTS = ([3, 4, 5, 0, 1, 2], [-1, 1, 1] * 2)  # the legs change places; a roll to the right becomes one to the left
_POLAR, _AXIAL = ([0, 1, 2], [1, -1, 1]), ([0, 1, 2], [-1, 1, -1])  # vectors, and axes of rotation

MIRROR: dict[str, tuple[list[int], list[int]]] = {
    "joint_pos": _JOINTS,
    "joint_vel": _JOINTS,
    "last_action": _JOINTS,
    "base_lin_vel": _POLAR,
    "base_ang_vel": _AXIAL,
    "base_quat": ([0, 1, 2, 3], [1, -1, 1, -1]),
    "command": ([0, 1, 2], [1, -1, -1]),
    "phase": ([1, 0], [1, 1]),
}
"""For each part of the observation: which entry takes each place, and its sign."""


def mirror_map(parts: list[str]) -> tuple[Tensor, Tensor]:
    """Return the indices and signs that mirror a concatenation of `parts`: x[:, indices] * signs."""
    indices: list[int] = []
    signs: list[int] = []
    for part in parts:
        order, sign = MIRROR[part]
        indices += [len(signs) + i for i in order]
        signs += sign
    return torch.tensor(indices), torch.tensor(signs, dtype=torch.float32)


OBSERVATION = mirror_map(list(LAYOUT))
ACTION = mirror_map(["last_action"])
PHASE_RIGHT = sum(LAYOUT.values()) - LAYOUT["phase"]
"""Column of p_r."""
