"""Random draws: initial states, pushes, ground friction, commands, noise. All from one seeded generator per environment."""

import math

import torch
from torch import Tensor

from telebip.config import TaskConfig
from telebip.math import columns, quat_from_yaw, zeros
from telebip.mdp.observations import noise_amplitude

KNEES = slice(2, None, 3)

Ranges = dict[str, list[tuple[float, float]]]


def ranges(cfg: TaskConfig) -> Ranges:
    """Return what a step may draw for a world, and the bounds of each of its numbers."""
    episode, push, command = cfg.episode, cfg.disturbance.push, cfg.command

    def symmetric(size: int, amplitude: float) -> list[tuple[float, float]]:
        return [(-amplitude, amplitude)] * size

    return {
        "joint_offset": symmetric(6, episode.reset_joint_pos),  # from the home pose [rad | m]
        "heading": symmetric(1, episode.reset_heading),  # [rad]
        "qvel": [  # [m/s, rad/s, rad/s | m/s]
            *symmetric(2, episode.reset_lin_vel),
            (0.0, 0.0),
            *symmetric(3, episode.reset_ang_vel),
            *symmetric(6, episode.reset_joint_vel),
        ],
        "friction": [cfg.disturbance.friction.range],
        "push_interval": [push.interval],  # [s]
        "push": [(0.0, push.force), (-math.pi, math.pi)],  # magnitude [N], direction [rad]
        "noise": [(-float(amplitude), float(amplitude)) for amplitude in noise_amplitude(cfg.disturbance.noise)],
        "command": [command.lin_vel_x, command.lin_vel_y, command.ang_vel_z],  # [m/s, m/s, rad/s]
    }


class Draws:
    """Numbers, uniform in their ranges, for all worlds: `draws[name]` is (num_envs, size), and `draw` writes new ones to it.

    Every world gets its own numbers at every step, needed or not, so that shapes are static and what happens to one world
    changes nothing for the others. Each is one of 65,536 values, evenly spaced from the low bound on: four of them come from
    64 random bits, in a third of the time of four floats.
    """

    def __init__(self, ranges: Ranges, num_envs: int, device: torch.device) -> None:
        """Allocate them on `device`."""
        low, high = torch.tensor([bound for bounds in ranges.values() for bound in bounds], device=device).unbind(1)
        self._middle, self._spacing = 0.5 * (low + high), (high - low) / 2**16
        self._values = zeros(num_envs, len(low), device=device)
        self._bits = torch.zeros(-(-self._values.numel() // 4), dtype=torch.int64, device=device)
        self._numbers = self._bits.view(torch.int16)[: self._values.numel()].view(self._values.T.shape).T
        self._parts = dict(zip(ranges, self._values.split([len(bounds) for bounds in ranges.values()], dim=1), strict=True))

    def draw(self, generator: torch.Generator) -> None:
        """Draw all anew."""
        self._bits.random_(-(2**63), None, generator=generator)
        self._values.copy_(self._numbers).mul_(self._spacing).add_(self._middle)  # the numbers are -32768 to 32767

    def __getitem__(self, name: str) -> Tensor:
        """Return the present numbers of a range, (num_envs, size)."""
        return self._parts[name]


def uniform(shape: tuple[int, ...], low: float, high: float, generator: torch.Generator) -> Tensor:
    """Draw from [low, high) on the generator's device."""
    return low + (high - low) * torch.rand(shape, generator=generator, device=generator.device)


def initial_qpos(home_qpos: Tensor, joint_offset: Tensor, heading: Tensor) -> Tensor:
    """Return standing positions about the home pose.

    Where a leg comes out longer than at home, the robot is lifted by the difference, so that no foot starts in the ground. (A
    rotary knee is taken for one that lengthens the leg by 1 m per rad: more than it does.)

    Args:
        home_qpos: (13,).
        joint_offset: joint positions from home [rad | m], (num_envs, 6).
        heading: [rad], (num_envs, 1).

    Returns:
        qpos (num_envs, 13), as in `SimState`.
    """
    lift = -torch.minimum(*joint_offset[:, KNEES].split(1, dim=1)).clamp(max=0.0)
    x_y = home_qpos[:2].expand(len(lift), -1)
    return columns(x_y, home_qpos[2] + lift, quat_from_yaw(heading[:, 0]), home_qpos[7:] + joint_offset)


def push_force(push: Tensor) -> Tensor:
    """Return horizontal forces [N], (num_envs, 2), from magnitude and direction (num_envs, 2) [N, rad]."""
    magnitude, direction = push.split(1, dim=1)
    return magnitude * columns(torch.cos(direction), torch.sin(direction))
