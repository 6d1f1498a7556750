# pyright: reportAttributeAccessIssue=false
"""The boundary between the MDP and the physics engines."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import mujoco
import torch
from torch import Tensor

from telebip.errors import UserError
from telebip.math import zeros
from telebip.robot import FEET, KEYFRAME, Robot

Backend = Literal["auto", "native", "warp"]

Columns = slice | Tensor
"""Which columns: a slice where they lie side by side, as on most robots, which spares a copy, else their numbers."""

MEANS = ("joint_force", "joint_power", "joint_net_power", "foot_force")
"""Fields of `SimState` that are means over the physics steps of a policy step."""

ENGINE_FAULTS = ("engine_warning", "engine_error", "capacity")
"""What an engine reports of a world itself: a warning, an error, or more contacts or constraints than there is room for."""


@dataclass(frozen=True)
class SimState:
    """State of all worlds after a policy step: float32 views of buffers that the next `step` or `reset` overwrites.

    Forces and power are means over the step's physics steps, so that a 5 ms impact counts for what it carries, not for
    whether it fell on the sampled step. Joints in the order of `Robot.joint_names`.
    """

    qpos: Tensor  # (num_envs, nq): trunk position [m] and quaternion, then the other joints' positions [rad | m]
    qvel: Tensor  # (num_envs, nv): trunk velocity, world frame [m/s], angular velocity, body frame [rad/s], then the others'
    foot_force: Tensor  # (num_envs, 2): vertical force of the ground on the right and the left foot [N]
    joint_force: Tensor  # (num_envs, num_joints): actuator force [N m | N]
    joint_power: Tensor  # (num_envs, num_joints): |actuator force x joint velocity| [W]
    joint_net_power: Tensor  # (num_envs, num_joints): the same with its sign, negative where the actuator brakes [W]
    sensors: dict[str, Tensor]  # (num_envs, size) each: those asked for, at the step's last physics step, before it moved
    joint_columns: Columns  # of the actuated joints in `qpos`; in `qvel` they stand one column further left

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
        """Positions of the actuated joints [rad | m], (num_envs, num_joints)."""
        return self.qpos[:, self.joint_columns]

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
        """Velocities of the actuated joints [rad/s | m/s], (num_envs, num_joints)."""
        return self.qvel[:, shifted(self.joint_columns)]

    @property
    def step_values(self) -> dict[str, Tensor]:
        """What only a step fills, and `reset` and `load` leave at zero: means over the policy step, and sensors."""
        return {name: getattr(self, name) for name in MEANS} | {f"sensors.{name}": v for name, v in self.sensors.items()}

    @staticmethod
    def zeros(robot: Robot, num_envs: int, device: torch.device, sensors: Sequence[str] = ()) -> "SimState":
        """Allocate the buffers, `sensors` those of the robot's of these names."""
        num_joints = len(robot.joint_names)
        sizes = (robot.model.nq, robot.model.nv, len(FEET), num_joints, num_joints, num_joints)
        values = {name: zeros(num_envs, int(robot.model.sensor(name).dim[0]), device=device) for name in sensors}
        numbers = (zeros(num_envs, size, device=device) for size in sizes)
        return SimState(*numbers, sensors=values, joint_columns=columns_on(device, robot))


def columns_on(device: torch.device, robot: Robot) -> Columns:
    """Return `Robot.joint_columns`, to index tensors of `device` with: a recorded CUDA graph cannot bring a list there."""
    columns = robot.joint_columns
    return columns if isinstance(columns, slice) else torch.tensor(columns, device=device)


def shifted(columns: Columns) -> Columns:
    """Return the columns of `qvel` of the joints that have these in `qpos`: the trunk's quaternion has one number more."""
    return slice(columns.start - 1, columns.stop - 1) if isinstance(columns, slice) else columns - 1


class Simulator(Protocol):
    """Physics of `num_envs` independent worlds. Every backend passes tests/sim/test_conformance.py."""

    num_envs: int
    device: torch.device
    backend: Backend
    """Its name."""
    model: mujoco.MjModel
    """The model that it steps, `Robot.engine_model`: ids of bodies, geoms and so on are this one's."""
    state: SimState
    model_fields: dict[str, Tensor]
    """Live per-world copies of the model fields named at construction, (num_envs, ...); writes act from the next step, with
    what MuJoCo derives from them after `refresh_constants`."""
    faults: Tensor
    """Which of `ENGINE_FAULTS` befell which world in the last `step`: bool, (3, num_envs)."""
    advice: dict[str, str]
    """What the engine says about a kind of `faults`: which setting to change, or its message."""
    memory: dict[str, Tensor]
    """Live tensors, in the engine's own precision: its whole state by MuJoCo's own definition (mjSTATE_INTEGRATION), less what
    `step` sets anew; with `model_fields`, the outcome of a `step` depends on nothing else."""
    memory_before: dict[str, Tensor]
    """Copies of `memory` from before the last `step`."""

    def step(self, targets: Tensor, wrench_w: Tensor) -> SimState:
        """Hold joint `targets` [rad | m] and the trunk wrench for one policy step, and return `state`.

        Args:
            targets: setpoints of the position actuators, (num_envs, num_joints); or one for each physics step,
                (num_envs, decimation, num_joints).
            wrench_w: force and torque on the trunk's centre of mass, world frame [N, N m], (num_envs, 6).
        """
        ...

    def reset(self, mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        """Overwrite the worlds where `mask` (num_envs,) holds with rows of `qpos` (num_envs, nq) and `qvel` (num_envs, nv).

        All else of its state is that of the keyframe `home`. A reset world has no memory: its next step is the same, bit for
        bit, as that of a new simulator in that state.
        """
        ...

    def load(self, memory: Mapping[str, Tensor]) -> None:
        """Go on from a copy of `memory`, bit for bit; `state` has its positions and velocities, see `SimState.step_values`."""
        ...

    def refresh_constants(self, mask: Tensor) -> None:
        """Bring what MuJoCo derives from `model_fields` (mj_setConst) up to date, at least where `mask` (num_envs,) holds."""
        ...


def home_data(model: mujoco.MjModel) -> mujoco.MjData:
    """Return C MuJoCo's data in the keyframe `home`, with the activations, mocap poses and so on that it gives."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key(KEYFRAME).id)
    return data


def require_whole_state(model: mujoco.MjModel, path: Path) -> None:
    """Refuse options with which MuJoCo keeps more than its state: no world could then be reset or gone on from.

    Raises:
        UserError: the MJCF has one.
    """
    for flag in ("sleep", "ipc"):
        if model.opt.enableflags & getattr(mujoco.mjtEnableBit, f"mjENBL_{flag.upper()}"):
            raise UserError(
                f'{path}: take out <flag {flag}="enable"/>: what it remembers is no part of MuJoCo\'s state, so that no world '
                "can be reset, and no run resumed"
            )


def state_fields(model: mujoco.MjModel) -> tuple[str, ...]:
    """Return the fields of MuJoCo's data that are its state (mjSTATE_INTEGRATION), less those that `Simulator.step` sets."""
    renamed = {"warmstart": "qacc_warmstart", "plugin": "plugin_state"}
    fields = []
    for name, value in mujoco.mjtState.__members__.items():
        bit = int(value) & int(mujoco.mjtState.mjSTATE_INTEGRATION)
        is_part = name.startswith("mjSTATE_") and bit.bit_count() == 1 and mujoco.mj_stateSize(model, bit) > 0
        if is_part and value not in (mujoco.mjtState.mjSTATE_CTRL, mujoco.mjtState.mjSTATE_XFRC_APPLIED):
            part = name.removeprefix("mjSTATE_").lower()
            fields.append(renamed.get(part, part))
    return tuple(fields)


def derives(model_fields: Sequence[str]) -> bool:
    """Whether MuJoCo derives anything from these fields of its model, which `Simulator.refresh_constants` must then renew."""
    return not set(mujoco.MjModel._setconst_inputs).isdisjoint(model_fields)
