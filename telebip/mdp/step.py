"""What terms look at: the worlds' constants, their one state, and a view of the present step."""

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from telebip.math import columns, multiply, over, rotate_inverse, small_rotation, turn, yaw, zeros
from telebip.mdp.gait import phase_signals
from telebip.mdp.ground import Ground
from telebip.robot import Robot
from telebip.sim.base import SimState, Simulator

Memory = dict[str, Tensor]
"""What one term remembers, by name."""


@dataclass(frozen=True)
class World:
    """What is the same in every step. Joints in the order of `robot.joint_names`, feet right and left."""

    robot: Robot
    sim: Simulator  # for the fields of the model: `sim.model` and, with a value per world, `sim.model_fields`
    num_envs: int
    device: torch.device
    step_dt: float  # policy step [s]
    decimation: int  # physics steps per policy step
    episode_length: float  # until the time-out [s]
    gait_period: float  # T [s]
    home_qpos: Tensor  # (nq,)
    nominal: Tensor  # joint positions of the home pose [rad | m], (num_joints,)
    force_range: Tensor  # of the actuators, negative and positive [N m | N], (num_joints, 2)
    action_scale: Tensor  # displacement of a joint target per unit of action [rad | m], (num_joints,)
    foot_lift: Tensor  # by how much each foot rises with each joint in the home pose [m/rad | -], (2, num_joints)
    ground: Ground | None  # None where it is flat, at height 0
    nominal_fields: Mapping[str, Tensor]  # the MJCF's values of `sim.model_fields`, without a dimension for the worlds

    @property
    def num_joints(self) -> int:
        """Number of actuated joints."""
        return len(self.robot.joint_names)

    @property
    def weight(self) -> float:
        """The robot's m g [N]."""
        return self.robot.weight

    @property
    def gait_steps(self) -> int:
        """Policy steps in one gait period, rounded."""
        return round(self.gait_period / self.step_dt)

    def zeros(self, *size: int) -> Tensor:
        """Return zeros (num_envs, *size), for a term's memory."""
        return zeros(self.num_envs, *size, device=self.device)


def lasting() -> Any:
    """Declare a tensor of `EnvState` that outlasts an episode."""
    return field(metadata={"lasting": True})


@dataclass
class EnvState:
    """All that the worlds' future depends on, beside the engine's own state and the generator. Tensors, written in place."""

    episode_length: Tensor  # policy steps since reset, or what a learner has assigned, (num_envs,) long
    has_begun: Tensor  # whether a step has been made since reset, (num_envs,) bool
    last_action: Tensor  # A_{t-1} [-], (num_envs, num_joints)
    command_timer: Tensor  # time until the next command [s], (num_envs,)
    held_wrench_w: Tensor = lasting()  # of `TelebipEnv.push`, (num_envs, 6) [N, N m]
    target_command: Tensor = lasting()  # (vx, vy, yaw rate) without the heading hold, (num_envs, 3) [m/s, m/s, rad/s]
    command: Tensor = lasting()  # with it: what the policy sees and is rewarded for, (num_envs, 3)
    command_is_fixed: Tensor = lasting()  # whether no random commands are given, () bool
    reference_heading: Tensor = lasting()  # starts at the robot's own, turns with the commanded yaw rate [rad], (num_envs,)
    joint_target: Tensor = lasting()  # of the last step [rad | m], (num_envs, num_joints)
    wrench_w: Tensor = lasting()  # on the trunk's centre of mass in the last step, world frame [N, N m], (num_envs, 6)
    random: Tensor = lasting()  # the step's random numbers, (num_envs, numbers)
    tile: Tensor = lasting()  # (type, level) of the terrain on which each robot starts, (num_envs, 2) long
    num_steps: Tensor = lasting()  # since the worlds were made, () long
    samples: Tensor = lasting()  # of the training so far, where the curriculum stands; infinite where it is complete, ()
    memory: dict[str, Memory] = field(default_factory=dict)  # of each term: "rewards.foot", say

    @staticmethod
    def zeros(world: World) -> "EnvState":
        """Allocate it, for worlds that have not begun; `memory` and `random` come with the terms, see `telebip.mdp.binding`."""
        device = world.device
        return EnvState(
            episode_length=torch.zeros(world.num_envs, dtype=torch.long, device=device),
            has_begun=torch.zeros(world.num_envs, dtype=torch.bool, device=device),
            last_action=world.zeros(world.num_joints),
            command_timer=world.zeros(),
            held_wrench_w=world.zeros(6),
            target_command=world.zeros(3),
            command=world.zeros(3),
            command_is_fixed=torch.zeros((), dtype=torch.bool, device=device),
            reference_heading=world.zeros(),
            joint_target=world.zeros(world.num_joints),
            wrench_w=world.zeros(6),
            random=world.zeros(0),
            tile=zeros(world.num_envs, 2, device=device).long(),
            num_steps=torch.zeros((), dtype=torch.long, device=device),
            samples=torch.full((), torch.inf, device=device),
        )

    def items(self) -> Iterator[tuple[str, Tensor]]:
        """Yield every tensor with its name; those of terms as "rewards.foot.window"."""
        for f in dataclasses.fields(self):
            if f.name != "memory":
                yield f.name, getattr(self, f.name)
        for term, memory in self.memory.items():
            yield from ((f"{term}.{name}", value) for name, value in memory.items())

    def clone(self) -> "EnvState":
        """Return a copy that shares nothing."""
        own = {f.name: getattr(self, f.name).clone() for f in dataclasses.fields(self) if f.name != "memory"}
        memory = {term: {name: value.clone() for name, value in part.items()} for term, part in self.memory.items()}
        return EnvState(**own, memory=memory)

    def copy_(self, other: "EnvState") -> None:
        """Take over another one's values, in place."""
        for (_, value), (_, new) in zip(self.items(), other.items(), strict=True):
            value.copy_(new)

    def reset(self, mask: Tensor) -> None:
        """Set to zero what does not outlast an episode, in the worlds where `mask` (num_envs,) holds."""
        own = [getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "memory" and "lasting" not in f.metadata]
        for value in (*own, *(value for memory in self.memory.values() for value in memory.values())):
            value.masked_fill_(over(mask, value), 0)


class Step:
    """One policy step of all worlds, as terms see it. Right side first wherever there are two.

    "step" events see the time before the physics; terminations and rewards the time after it, before resets; observations the
    time after resets. What is derived from the state is computed at its first use, once.
    """

    def __init__(self, world: World, env: EnvState, action: Tensor) -> None:
        """Look at the present values of `env` and of the simulator, and at the action A_t (num_envs, num_joints)."""
        self.world, self.env, self.action = world, env, action
        self.state: SimState = world.sim.state

    @cached_property
    def measured(self) -> "Step":
        """The same step as the robot's sensors tell it, see `Measured`; itself where no event gives them errors."""
        return Measured(self) if Measured.ERRORS & self.env.memory.keys() else self

    @cached_property
    def fallen(self) -> Tensor:
        """Whether the episode ends here by a termination or a fault, bool, (num_envs,); set before rewards are called."""
        return torch.zeros_like(self.env.has_begun)

    @property
    def command(self) -> Tensor:
        """Command (vx, vy, yaw rate), body frame, the heading hold's correction included [m/s, m/s, rad/s], (num_envs, 3)."""
        return self.env.command

    @cached_property
    def command_error(self) -> Tensor:
        """By how much the command exceeds the trunk's velocity and yaw rate, body frame [m/s, m/s, rad/s], (num_envs, 3)."""
        return self.command - columns(self.base_lin_vel_b[:, :2], self.base_ang_vel_b[:, 2])

    @property
    def last_action(self) -> Tensor:
        """Action A_{t-1}, of the step before [-], (num_envs, num_joints)."""
        return self.env.last_action

    @cached_property
    def is_new(self) -> Tensor:
        """Whether no step of the episode has been made yet, bool, (num_envs,)."""
        return ~self.env.has_begun

    @cached_property
    def time(self) -> Tensor:
        """Time since the start of the episode [s], (num_envs,)."""
        return self.env.episode_length * self.world.step_dt

    @cached_property
    def phase(self) -> Tensor:
        """Phase signals (p_r, p_l) [-], (num_envs, 2)."""
        return phase_signals(self.time, self.world.gait_period)

    @cached_property
    def base_height(self) -> Tensor:
        """Height of the trunk's frame, midway between the hips, above the ground below it [m], (num_envs,)."""
        x, y, z = self.state.base_pos.unbind(1)
        return z - self.ground_height(x, y)

    def ground_height(self, x: Tensor, y: Tensor) -> Tensor:
        """Return the height of the ground at points of the world [m], (...)."""
        return self.world.ground.height(x, y) if self.world.ground else torch.zeros_like(x)

    @property
    def joint_pos(self) -> Tensor:
        """Positions of the actuated joints [rad | m], (num_envs, num_joints)."""
        return self.state.joint_pos

    @property
    def base_quat(self) -> Tensor:
        """Orientation of the trunk in the world, w x y z, (num_envs, 4)."""
        return self.state.base_quat

    @cached_property
    def base_lin_vel_b(self) -> Tensor:
        """Velocity of the trunk's frame, body frame [m/s], (num_envs, 3)."""
        return rotate_inverse(self.state.base_quat, self.state.base_lin_vel_w)

    @property
    def base_ang_vel_b(self) -> Tensor:
        """Angular velocity of the trunk, body frame [rad/s], (num_envs, 3)."""
        return self.state.base_ang_vel_b

    @cached_property
    def projected_gravity(self) -> Tensor:
        """Unit vector of gravity, body frame: (0, 0, -1) where the trunk is upright [-], (num_envs, 3)."""
        w, x, y, z = self.base_quat.unbind(1)
        return torch.stack([2.0 * (w * y - x * z), -2.0 * (w * x + y * z), 2.0 * (x * x + y * y) - 1.0]).T

    @cached_property
    def start_qpos(self) -> Tensor:
        """Where worlds that are being reset will start, (num_envs, nq): the home pose, which "reset" events may change."""
        return self.world.home_qpos[:, None].repeat(1, self.world.num_envs).T

    @cached_property
    def start_qvel(self) -> Tensor:
        """With which velocities they will, (num_envs, nv): at rest."""
        return self.world.zeros(self.state.qvel.shape[1])

    @cached_property
    def heading(self) -> Tensor:
        """Heading of the trunk in the world [rad], (num_envs,)."""
        return yaw(self.base_quat)

    @cached_property
    def heading_lin_vel(self) -> Tensor:
        """Velocity of the trunk's frame along its heading and to the left of it, horizontal [m/s], (num_envs, 2)."""
        cos, sin, (vx, vy, _) = torch.cos(self.heading), torch.sin(self.heading), self.state.base_lin_vel_w.unbind(1)
        return columns(cos * vx + sin * vy, cos * vy - sin * vx)

    @cached_property
    def heading_quat(self) -> Tensor:
        r"""Orientation of the trunk relative to the reference heading, w x y z with w >= 0, (num_envs, 4).

            q_rel = q_z(-psi_ref) q

        It equals the article's base quaternion where the robot starts facing x and walks straight, and does not tell the
        policy which way x points. q and -q are the same rotation and give the same result.
        """
        quat = turn(self.base_quat, -self.env.reference_heading)
        return torch.where(quat[:, :1] < 0.0, -quat, quat)

    def is_due(self, timer: Tensor, interval: Tensor) -> Tensor:
        """Let a step pass on a timer (num_envs,), a term's memory, and return where its time was over, bool, (num_envs,).

        There, and where an episode begins, it starts anew from `interval` (num_envs,) [s].
        """
        due = (timer <= 0.0) & ~self.is_new
        torch.where(due | self.is_new, interval, timer, out=timer)
        timer -= self.world.step_dt
        return due

    def to_body(self, vector_w: Tensor) -> Tensor:
        """Express vectors (num_envs, 3) of the world frame in the trunk's."""
        return rotate_inverse(self.state.base_quat, vector_w)

    def push_force(self, force_w: Tensor) -> None:
        """Let a force (num_envs, 2) or (num_envs, 3) [N], world frame, act on the trunk's centre of mass in the coming step."""
        self.env.wrench_w[:, : force_w.shape[1]] += force_w


class Measured(Step):
    r"""The step as a robot's sensors tell it, with the errors that events have drawn (`telebip.mdp.events`).

        joint_pos      q + b                                            encoder_bias: b
        base_ang_vel   R(q_imu)^T w + b_g                               imu_orientation: q_imu, gyro_bias: b_g
        base_lin_vel   R(q_imu)^T v
        base_quat      q_z(b_g,z t) q q_imu q_f                         attitude_error: q_f

    The heading is the gyro's integral, which nothing corrects: to first order in the tilt it drifts by the bias about z, since
    the start of the episode. Roll and pitch are corrected by gravity; what is left is q_f. What follows from the orientation,
    projected gravity and heading, follows from the measured one. All else is as it is.
    """

    ERRORS = frozenset(("encoder_bias", "imu_orientation", "gyro_bias", "attitude_error"))
    """Names in `EnvState.memory`."""

    def __init__(self, true: Step) -> None:
        """Measure `true`."""
        super().__init__(true.world, true.env, true.action)
        self._true = true

    @cached_property
    def joint_pos(self) -> Tensor:
        """Positions of the actuated joints [rad | m], (num_envs, num_joints)."""
        error = self.env.memory.get("encoder_bias")
        return self._true.joint_pos + error["bias"] if error else self._true.joint_pos

    @cached_property
    def base_ang_vel_b(self) -> Tensor:
        """Angular velocity in the sensor's frame [rad/s], (num_envs, 3)."""
        value, error = self._in_sensor_frame(self._true.base_ang_vel_b), self.env.memory.get("gyro_bias")
        return value + error["bias"] if error else value

    @cached_property
    def base_lin_vel_b(self) -> Tensor:
        """Velocity of the trunk's frame, in the sensor's frame [m/s], (num_envs, 3)."""
        return self._in_sensor_frame(self._true.base_lin_vel_b)

    @cached_property
    def base_quat(self) -> Tensor:
        """Orientation that the attitude filter tells, w x y z, (num_envs, 4)."""
        quat, memory = self._true.base_quat, self.env.memory
        for name in ("imu_orientation", "attitude_error"):
            if name in memory:
                quat = multiply(quat, small_rotation(memory[name]["angles"]))
        return turn(quat, memory["gyro_bias"]["bias"][:, 2] * self.time) if "gyro_bias" in memory else quat

    def _in_sensor_frame(self, vector_b: Tensor) -> Tensor:
        error = self.env.memory.get("imu_orientation")
        return rotate_inverse(small_rotation(error["angles"]), vector_b) if error else vector_b
