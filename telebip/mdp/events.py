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
Scale = Annotated[tuple[float, float], Quantity(gt=0)]
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
    force: Annotated[float, Quantity("N", ge=0)],
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


@event("reset", "once", random=lambda world, *, scale, **_: {"mass": [scale]}, fields=lambda **_: ("body_mass", "body_inertia"))
def mass(step: Step, mask: Tensor, random: Random, *, scale: Scale, bodies: list[str] | None = None) -> None:
    """Scale the mass and the inertia of bodies, all by one factor: those named, or the whole robot."""
    for field in ("body_mass", "body_inertia"):
        rows = rows_of(step.world, field, bodies)
        value = nominal(step.world, field, rows)
        write(step.world, field, rows, random["mass"].view(-1, *[1] * value.dim()) * value, mask)


@event(
    "reset",
    "once",
    random=lambda world, *, kp, kv: {"gains": [kp, kv]},
    fields=lambda **_: ("actuator_gainprm", "actuator_biasprm"),
)
def gains(step: Step, mask: Tensor, random: Random, *, kp: Scale, kv: Scale) -> None:
    """Scale the stiffness kp and the damping kv of all position actuators, each by one factor."""
    kp_factor, kv_factor = random["gains"].split(1, dim=1)
    for field, column, factor in (
        ("actuator_gainprm", 0, kp_factor),
        ("actuator_biasprm", 1, kp_factor),
        ("actuator_biasprm", 2, kv_factor),
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
    lin_vel: Annotated[float, Quantity("m/s", ge=0)],
    ang_vel: Annotated[float, Quantity("rad/s", ge=0)],
) -> None:
    """Change the trunk's velocity at once, about all six axes, uniform within these bounds."""
    live = step.world.sim.memory["qvel"]
    live[:, :6] += random["kick"].masked_fill(~mask[:, None], 0.0)
    step.state.qvel.copy_(live)
