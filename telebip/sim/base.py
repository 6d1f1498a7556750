"""The boundary between the MDP and the physics engines."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Protocol

import torch
from torch import Tensor

from telebip.math import zeros

Backend = Literal["auto", "native", "warp"]

ENGINE_FAULTS = ("engine_warning", "engine_error", "capacity")
"""What an engine reports of a world itself: a warning, an error, or more contacts or constraints than there is room for."""


@dataclass(frozen=True)
class SimState:
    """State of all worlds after a policy step: float32 views of buffers that the next `step` or `reset` overwrites.

    Forces and power are means over the step's physics steps, so that a 5 ms impact counts for what it carries, not for
    whether it fell on the sampled step; `reset` leaves them at zero. Joints in the order of `telebip.robot.JOINTS`.
    """

    qpos: Tensor  # (num_envs, 13): trunk position [m] and quaternion, joint positions [rad | m]
    qvel: (
        Tensor  # (num_envs, 12): trunk velocity, world frame [m/s], angular velocity, body frame [rad/s], joints [rad/s | m/s]
    )
    foot_force: Tensor  # (num_envs, 2): normal ground force on the right and the left foot [N]
    joint_force: Tensor  # (num_envs, 6): actuator force [N m | N]
    joint_power: Tensor  # (num_envs, 6): |actuator force x joint velocity| [W]
    joint_net_power: Tensor  # (num_envs, 6): actuator force x joint velocity, negative where the actuator brakes [W]

    @property
    def base_pos(self) -> Tensor:
        """Position of the trunk's frame, midway between the hips, in the world [m], (num_envs, 3)."""
        return self.qpos[:, :3]

    @property
    def base_quat(self) -> Tensor:
        """Orientation of the trunk in the world, w x y z, (num_envs, 4)."""
        return self.qpos[:, 3:7]

    @property
    def joint_pos(self) -> Tensor:
        """Joint positions [rad | m], (num_envs, 6)."""
        return self.qpos[:, 7:]

    @property
    def base_lin_vel_w(self) -> Tensor:
        """Velocity of the trunk's frame, world frame [m/s], (num_envs, 3)."""
        return self.qvel[:, :3]

    @property
    def base_ang_vel_b(self) -> Tensor:
        """Angular velocity of the trunk, body frame [rad/s], (num_envs, 3)."""
        return self.qvel[:, 3:6]

    @property
    def joint_vel(self) -> Tensor:
        """Joint velocities [rad/s | m/s], (num_envs, 6)."""
        return self.qvel[:, 6:]

    @property
    def step_means(self) -> tuple[Tensor, ...]:
        """The buffers that hold means over a policy step."""
        return self.foot_force, self.joint_force, self.joint_power, self.joint_net_power

    @staticmethod
    def zeros(num_envs: int, device: torch.device) -> "SimState":
        """Allocate the buffers."""
        return SimState(*(zeros(num_envs, size, device=device) for size in (13, 12, 2, 6, 6, 6)))


class Simulator(Protocol):
    """Physics of `num_envs` independent worlds. Every backend passes tests/sim/test_conformance.py."""

    num_envs: int
    device: torch.device
    state: SimState
    model_fields: dict[str, Tensor]
    """Live per-world copies of the model fields named at construction, (num_envs, ...); writes act from the next step."""
    backend: Backend
    """Its name."""
    faults: Tensor
    """Which of `ENGINE_FAULTS` befell which world in the last `step`: bool, (3, num_envs)."""
    advice: dict[str, str]
    """What the engine says about a kind of `faults`: which setting to change, or its message."""
    memory: dict[str, Tensor]
    """Live tensors, in the engine's own precision, of all else that the outcome of a `step` depends on."""
    memory_before: dict[str, Tensor]
    """Copies of `memory` from before the last `step`."""

    def step(self, targets: Tensor, wrench_w: Tensor) -> SimState:
        """Hold joint `targets` (num_envs, 6) [rad | m] and the trunk wrench for one policy step, and return `state`.

        Args:
            targets: setpoints of the six position actuators.
            wrench_w: force and torque on the trunk's centre of mass, world frame [N, N m], (num_envs, 6).
        """
        ...

    def write(self, targets: Tensor, wrench_w: Tensor) -> None:
        """Set the inputs of `step`, and do no more; for `advance`."""
        ...

    def advance(self) -> None:
        """Run the engine's physics steps of one policy step and nothing else, to measure `step` against.

        The worlds go where `step` with the inputs last written would take them; `state` need not follow.
        """
        ...

    def reset(self, mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        """Overwrite the worlds where `mask` (num_envs,) holds with rows of `qpos` (num_envs, 13) and `qvel` (num_envs, 12).

        A reset world has no memory: its next step is the same, bit for bit, as that of a new simulator in that state.
        """
        ...

    def load(self, memory: Mapping[str, Tensor]) -> None:
        """Go on from a copy of `memory`, bit for bit; `state` has its positions and velocities, and means of zero."""
        ...
