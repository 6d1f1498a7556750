"""What happens to the worlds: how they start, pushes, and what differs from world to world.

An event is a function of the step and of a mask (num_envs,) of the worlds that it is for. A "reset" event may change
`step.start_qpos`, relative to the middle of the robot's tile, and `step.start_qvel`; an "end" event sees how an episode ended;
one that declares `fields` may change `step.world.sim.model_fields`; a "step" event may call `step.push_force`.
"""

import math
from typing import Annotated, Literal

import torch
from torch import Tensor

from telebip.math import columns, norm, turn
from telebip.mdp.curriculum import Ramp, progress
from telebip.mdp.fields import nominal, rows_of, write
from telebip.mdp.step import Memory, Step, World
from telebip.mdp.term import Quantity, event
from telebip.robot import FLOOR
from telebip.sim.base import shifted

Range = Annotated[tuple[float, float], Quantity()]
Scale = Annotated[tuple[float, float], Quantity(gt=0, nominal=1.0)]
Ranges = dict[str, list[tuple[float, float]]]
Random = dict[str, Tensor]


def _symmetric(size: int, amplitude: float) -> list[tuple[float, float]]:
    return [(-amplitude, amplitude)] * size


def _pose_random(world: World, *, joint_pos: float, heading: float) -> Ranges:
    return {"joint_pos": _symmetric(world.num_joints, joint_pos), "heading": _symmetric(1, heading)}


@event("reset", random=_pose_random, is_disturbance=False)
def start_pose(
    step: Step,
    mask: Tensor,
    random: Random,
    *,
    joint_pos: Annotated[float, Quantity("rad | m", ge=0)],
    heading: Annotated[float, Quantity("rad", ge=0)],
) -> None:
    """Start standing, with joints uniform +- `joint_pos` about the home pose, facing anywhere within +- `heading`.

    Where a foot comes out lower than at home, to first order in the joints, the robot is lifted by the difference, so that none
    starts in the ground.
    """
    world, qpos = step.world, step.start_qpos
    qpos[:, 2] -= (world.foot_lift @ random["joint_pos"].T).amin(0).clamp(max=0.0)
    qpos[:, 3:7] = turn(qpos[:, 3:7], random["heading"][:, 0])
    qpos[:, step.state.joint_columns] += random["joint_pos"]


def _velocity_random(world: World, *, joint_vel: float, lin_vel: float, ang_vel: float) -> Ranges:
    return {
        "trunk": [*_symmetric(2, lin_vel), (0.0, 0.0), *_symmetric(3, ang_vel)],
        "joint_vel": _symmetric(world.num_joints, joint_vel),
    }


@event("reset", random=_velocity_random, is_disturbance=False)
def start_velocity(
    step: Step,
    mask: Tensor,
    random: Random,
    *,
    joint_vel: Annotated[float, Quantity("rad/s | m/s", ge=0)],
    lin_vel: Annotated[float, Quantity("m/s", ge=0)],
    ang_vel: Annotated[float, Quantity("rad/s", ge=0)],
) -> None:
    """Start in motion: joints, the trunk's horizontal velocity and its rotation are uniform within these bounds."""
    step.start_qvel[:, :6] += random["trunk"]
    step.start_qvel[:, shifted(step.state.joint_columns)] += random["joint_vel"]


def _push_random(world: World, *, force: float, interval: tuple[float, float], **_) -> Ranges:
    return {"interval": [interval], "push": [(0.0, force), (-math.pi, math.pi)]}


def _push_memory(world: World, **_) -> Memory:
    """Time until the next push starts [s], time left of the present one [s], and its force [N]."""
    return {"timer": world.zeros(), "time_left": world.zeros(), "force": world.zeros(2)}


@event("step", random=_push_random, memory=_push_memory)
def push(
    step: Step,
    mask: Tensor,
    memory: Memory,
    random: Random,
    *,
    force: Annotated[float, Quantity("N", ge=0, nominal=0.0)],
    duration: Annotated[float, Quantity("s", gt=0)],
    interval: Annotated[tuple[float, float], Quantity("s", gt=0)],
    ramp: Ramp,
) -> None:
    """Push the trunk's centre of mass horizontally, again and again.

    Args:
        step: the step that begins.
        mask: all worlds.
        memory: the timers.
        random: each world's next interval, magnitude and direction.
        force: magnitudes are uniform in 0..force [N], in a random direction.
        duration: of a push [s].
        interval: between the starts of two pushes, uniform [s].
        ramp: samples between which forces grow from nothing to all of it.
    """
    start, time_left = step.is_due(memory["timer"], random["interval"][:, 0]), memory["time_left"]
    time_left -= step.world.step_dt
    time_left.masked_fill_(start, duration)
    magnitude, direction = random["push"].split(1, dim=1)
    drawn = progress(step.env.samples, ramp) * magnitude * columns(torch.cos(direction), torch.sin(direction))
    kept = torch.where(start[:, None], drawn, memory["force"])
    memory["force"].copy_(kept.masked_fill(time_left[:, None] < 0.5 * step.world.step_dt, 0.0))
    step.push_force(memory["force"])


@event("end", random=lambda world: {"level": [(0.0, 1.0)]})
def terrain_level(step: Step, mask: Tensor, random: Random) -> None:
    """Let robots that cope go on to a harder level of their terrain, and those that do not to an easier one.

    Up, where the robot has left its tile. Down, where it came less than half as far as commanded, or than the tile's edge, if
    that is nearer. From beyond the last level back to any, so that none is forgotten. (legged_gym's game-inspired curriculum,
    Rudin et al. 2021, https://arxiv.org/abs/2109.11978, section 3.2)
    """
    ground, tile = step.world.ground, step.env.tile
    if ground is None:
        return
    edge, walked = 0.5 * ground.size, ground.distance(step.state.base_pos, tile)
    commanded = norm(step.command[:, :2]) * step.world.episode_length
    harder = (walked > edge) & ~step.fallen
    easier = ~harder & (walked < 0.5 * commanded.clamp(max=edge))
    level = tile[:, 1] + harder.long() - easier.long()
    anywhere = (random["level"][:, 0] * ground.levels).long().clamp(max=ground.levels - 1)
    level = torch.where(level < ground.levels, level.clamp(min=0), anywhere)
    tile[:, 1] = torch.where(mask, level, tile[:, 1])


@event("reset", "once", random=lambda world, *, range: {"friction": [range]}, fields=lambda **_: ("geom_friction",))
def friction(step: Step, mask: Tensor, random: Random, *, range: Annotated[tuple[float, float], Quantity(gt=0)]) -> None:
    """Draw the sliding friction of the ground [-].

    The floor needs `priority="1"` in the MJCF, so that its friction wins over the foot's.
    """
    sim = step.world.sim
    value = sim.model_fields["geom_friction"][:, sim.model.geom(FLOOR).id, 0]
    torch.where(mask, random["friction"][:, 0].to(value.dtype), value, out=value)


def _mass_random(world: World, *, scale: tuple[float, float], inertia: tuple[float, float], bodies: list[str] | None) -> Ranges:
    number = len(nominal(world, "body_mass", rows_of(world, "body_mass", bodies)))
    return {"mass": [scale] * number, "inertia": [inertia] * number}


@event("reset", "once", random=_mass_random, fields=lambda **_: ("body_mass", "body_inertia"))
def mass(
    step: Step, mask: Tensor, random: Random, *, scale: Scale, inertia: Scale = (1.0, 1.0), bodies: list[str] | None = None
) -> None:
    """Scale mass and inertia of each body, those named or all, by a factor of its own; with `inertia`, that by another one too.

    With one factor, the body is of another density; `inertia` tells that the mass lies elsewhere in it.
    """
    rows = rows_of(step.world, "body_mass", bodies)
    factor = random["mass"]
    write(step.world, "body_mass", rows, factor * nominal(step.world, "body_mass", rows), mask)
    factor = (factor * random["inertia"])[:, :, None]
    write(step.world, "body_inertia", rows, factor * nominal(step.world, "body_inertia", rows), mask)


def _com_random(world: World, *, offset: float, bodies: list[str]) -> Ranges:
    return {"offset": _symmetric(3 * len(bodies), offset)}


@event("reset", "once", random=_com_random, fields=lambda **_: ("body_ipos",))
def com(
    step: Step, mask: Tensor, random: Random, *, offset: Annotated[float, Quantity("m", ge=0, nominal=0.0)], bodies: list[str]
) -> None:
    """Move the centre of mass of each of these bodies, uniform within +- `offset` on each axis of its frame."""
    rows = rows_of(step.world, "body_ipos", bodies)
    moved = random["offset"].unflatten(1, (-1, 3)) + nominal(step.world, "body_ipos", rows)
    write(step.world, "body_ipos", rows, moved, mask)


def _gains_random(world: World, *, kp: tuple[float, float], kv: tuple[float, float]) -> Ranges:
    return {"kp": [kp] * world.sim.model.nu, "kv": [kv] * world.sim.model.nu}


@event("reset", "once", random=_gains_random, fields=lambda **_: ("actuator_gainprm", "actuator_biasprm"))
def gains(step: Step, mask: Tensor, random: Random, *, kp: Scale, kv: Scale) -> None:
    """Scale the stiffness kp and the damping kv of each position actuator, each by a factor of its own."""
    for field, column, factor in (
        ("actuator_gainprm", 0, random["kp"]),
        ("actuator_biasprm", 1, random["kp"]),
        ("actuator_biasprm", 2, random["kv"]),
    ):
        index = slice(None), column
        write(step.world, field, index, factor * nominal(step.world, field, index), mask)


def _field_random(world: World, *, field: str, range: tuple[float, float], names: list[str] | None, **_) -> Ranges:
    return {"field": [range] * len(nominal(world, field, rows_of(world, field, names)))}


@event("reset", "once", random=_field_random, fields=lambda *, field, **_: (field,))
def model_field(
    step: Step,
    mask: Tensor,
    random: Random,
    *,
    field: str,
    range: Range,
    operation: Literal["scale", "add", "set"] = "scale",
    names: list[str] | None = None,
    column: int | None = None,
) -> None:
    """Change any field of MuJoCo's model, with one number per row: each body's, joint's, geom's or actuator's own.

    What MuJoCo derives from the field follows. An event's entry needs a name of its own:
    `foot_friction: {term: model_field, field: geom_friction, names: [right_foot, left_foot], column: 0, range: [0.8, 1.2]}`.

    Args:
        step: the step of the reset.
        mask: worlds that draw anew.
        random: a number for each row.
        field: as in `mujoco.MjModel`: body_mass, dof_damping, dof_armature, body_ipos, geom_friction, ...
        range: of the number.
        operation: what to do with the MJCF's value: scale it, add to it, or set it.
        names: of the bodies, joints, geoms, sites or actuators; all if not given.
        column: which number of each row, where it has several; all if not given.
    """
    rows = rows_of(step.world, field, names)
    index = rows if column is None else (rows, column)
    value = nominal(step.world, field, index)
    number = random["field"].view(*random["field"].shape, *[1] * (value.dim() - 1))
    if operation == "set":
        number = number + torch.zeros_like(value)
    elif operation == "add":
        number = number + value
    else:
        number = number * value
    write(step.world, field, index, number, mask)


def _kick_random(world: World, *, lin_vel: float, ang_vel: float) -> Ranges:
    return {"kick": _symmetric(3, lin_vel) + _symmetric(3, ang_vel)}


@event("interval", random=_kick_random)
def kick(
    step: Step,
    mask: Tensor,
    random: Random,
    *,
    lin_vel: Annotated[float, Quantity("m/s", ge=0, nominal=0.0)],
    ang_vel: Annotated[float, Quantity("rad/s", ge=0, nominal=0.0)],
) -> None:
    """Change the trunk's velocity at once, about all six axes, uniform within these bounds."""
    live = step.world.sim.memory["qvel"]
    live[:, :6] += random["kick"].masked_fill(~mask[:, None], 0.0)
    step.state.qvel.copy_(live)


def _encoder_random(world: World, *, hinge: float, slide: float) -> Ranges:
    amplitudes = [slide if is_slide else hinge for is_slide in world.robot.is_slide]
    return {"bias": [(-amplitude, amplitude) for amplitude in amplitudes]}


@event(
    "reset",
    random=_encoder_random,
    memory=lambda world, **_: {"bias": world.zeros(world.num_joints)},
    memory_name="encoder_bias",
)
def encoder_bias(
    step: Step,
    mask: Tensor,
    memory: Memory,
    random: Random,
    *,
    hinge: Annotated[float, Quantity("rad", ge=0, nominal=0.0)],
    slide: Annotated[float, Quantity("m", ge=0, nominal=0.0)],
) -> None:
    """Let every encoder be off by a constant, uniform within +- `hinge` or +- `slide` by the kind of its joint.

    Policy and motor controller read the same encoder: the one sees q + b, and the other's torque is
    kp (q_target - (q + b)) - kv qd, so that the engine is given q_target - b.
    """
    _draw(memory["bias"], random["bias"], mask)


@event(
    "reset",
    random=lambda world, *, angle: {"angles": _symmetric(3, angle)},
    memory=lambda world, **_: {"angles": world.zeros(3)},
    memory_name="imu_orientation",
)
def imu_orientation(
    step: Step,
    mask: Tensor,
    memory: Memory,
    random: Random,
    *,
    angle: Annotated[float, Quantity("rad", ge=0, le=1, nominal=0.0)],
) -> None:
    """Mount the inertial measurement unit askew, by up to +- `angle` about each axis of the trunk; see `Measured`."""
    _draw(memory["angles"], random["angles"], mask)


@event(
    "reset",
    random=lambda world, *, rate: {"bias": _symmetric(3, rate)},
    memory=lambda world, **_: {"bias": world.zeros(3)},
    memory_name="gyro_bias",
)
def gyro_bias(
    step: Step, mask: Tensor, memory: Memory, random: Random, *, rate: Annotated[float, Quantity("rad/s", ge=0, nominal=0.0)]
) -> None:
    """Let the gyro be off by a constant, uniform within +- `rate` on each axis: so does the heading drift, see `Measured`."""
    _draw(memory["bias"], random["bias"], mask)


@event(
    "step",
    random=lambda world, **_: {"noise": _symmetric(2, 1.0)},
    memory=lambda world, **_: {"angles": world.zeros(3)},
    memory_name="attitude_error",
)
def attitude_error(
    step: Step,
    mask: Tensor,
    memory: Memory,
    random: Random,
    *,
    tilt: Annotated[float, Quantity("rad", ge=0, le=1, nominal=0.0)],
    time: Annotated[float, Quantity("s", gt=0)],
) -> None:
    r"""Let roll and pitch that the attitude filter tells wander about the truth, as accelerations disturb its sense of gravity.

        e_0 = 0,    e_t = rho e_{t-1} + tilt sqrt(3 (1 - rho^2)) u,    rho = exp(-dt / time),    u uniform in -1..1

    on each of the two axes: a Gauss-Markov process (Brown and Hwang, Introduction to Random Signals, section 4.5) of standard
    deviation `tilt` [rad] and correlation time `time` [s].
    """
    rho = math.exp(-step.world.step_dt / time)
    angles = memory["angles"][:, :2]
    angles.mul_(rho).add_(random["noise"], alpha=tilt * math.sqrt(3.0 * (1.0 - rho * rho)))


def _draw(value: Tensor, drawn: Tensor, mask: Tensor) -> None:
    """Write new numbers (num_envs, size) in the worlds where `mask` holds."""
    torch.where(mask[:, None], drawn, value, out=value)
