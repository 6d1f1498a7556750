"""What is observed: one function per term, in SI units and without noise, which the group adds (`telebip.mdp.groups`).

A task lists the terms of a group in the order in which they are seen. A term declares its unit and how the plane y = 0 mirrors
it (`telebip.mdp.mirror`); its size is that of what it returns.
"""

from typing import Annotated, Literal

import torch
from torch import Tensor

from telebip.errors import UserError, nearest
from telebip.mdp.fields import rows_of
from telebip.mdp.step import Step, World
from telebip.mdp.term import Image, Quantity, observation
from telebip.robot import FLOOR


@observation(unit="rad | m, relative to the nominal pose", mirror="joints")
def joint_pos(step: Step) -> Tensor:
    """Joint positions, relative to the nominal pose [rad | m], (num_envs, num_joints)."""
    return step.joint_pos - step.world.nominal


@observation(unit="rad/s | m/s", mirror="joints")
def joint_vel(step: Step) -> Tensor:
    """Joint velocities [rad/s | m/s], (num_envs, num_joints)."""
    return step.state.joint_vel


@observation(unit="output of the previous step", mirror="joints", is_sensed=False)
def last_action(step: Step) -> Tensor:
    """The previous action [-], (num_envs, num_joints)."""
    return step.last_action


@observation(unit="m/s, velocity of the trunk's frame (midway between the hips), in that frame", mirror="polar")
def base_lin_vel(step: Step) -> Tensor:
    """Linear velocity of the trunk, body frame [m/s], (num_envs, 3). No sensor of a real robot measures it."""
    return step.base_lin_vel_b


@observation(unit="rad/s, in the trunk's frame", mirror="axial")
def base_ang_vel(step: Step) -> Tensor:
    """Angular velocity of the trunk, body frame [rad/s], (num_envs, 3)."""
    return step.base_ang_vel_b


@observation(unit="w x y z with w >= 0, trunk relative to the reference heading", mirror="quat")
def base_quat(step: Step) -> Tensor:
    """Orientation of the trunk relative to the reference heading, w x y z, (num_envs, 4); see `Step.heading_quat`."""
    return step.heading_quat


@observation(unit="unit vector of gravity in the trunk's frame", mirror="polar")
def projected_gravity(step: Step) -> Tensor:
    """Direction of gravity, body frame: (0, 0, -1) where the trunk is upright [-], (num_envs, 3)."""
    return step.projected_gravity


@observation(unit="m/s forward, m/s left, rad/s", mirror="command", is_sensed=False)
def command(step: Step) -> Tensor:
    """The command (vx, vy, yaw rate), the heading hold's correction included [m/s, m/s, rad/s], (num_envs, 3)."""
    return step.command


@observation(unit="sin(2 pi t / gait_period) and its negative, t since the start", mirror="feet", is_sensed=False)
def phase(step: Step) -> Tensor:
    """Phase signals (p_r, p_l) [-], (num_envs, 2)."""
    return step.phase


@observation(unit="body weights, right and left", mirror="feet")
def foot_force(step: Step) -> Tensor:
    """Normal ground forces over the robot's weight, mean over the policy step [-], (num_envs, 2)."""
    return step.state.foot_force / step.world.weight


@observation(unit="sliding friction coefficient of the ground", mirror="same")
def friction(step: Step) -> Tensor:
    """Sliding friction of the ground [-], (num_envs, 1); the MJCF's where no event changes it."""
    floor = step.world.sim.model.geom(FLOOR).id
    field = step.world.sim.model_fields.get("geom_friction")
    if field is None:
        return step.world.zeros(1) + float(step.world.sim.model.geom_friction[floor, 0])
    return field[:, floor, :1].float()


@observation(unit="body weights, in the trunk's frame", mirror="polar")
def push_force(step: Step) -> Tensor:
    """Force that pushed the trunk in the episode's last step, over the robot's weight, body frame [-], (num_envs, 3)."""
    force_w = step.env.wrench_w[:, :3].masked_fill(step.is_new[:, None], 0.0)
    return step.to_body(force_w) / step.world.weight


@observation(unit="m above the ground", mirror="same")
def base_height(step: Step) -> Tensor:
    """Height of the trunk's frame, midway between the hips, above the ground below it [m], (num_envs, 1)."""
    return step.base_height[:, None]


def _scan_size(*, forward: tuple[float, float], aside: float, spacing: float, **_) -> tuple[int, int]:
    """Return how many points a scan has along the heading, and how many across it."""
    return round((forward[1] - forward[0]) / spacing) + 1, 2 * round(aside / spacing) + 1


def _scan_image(**parameters) -> Image:
    """Right and left change places in each row of a scan."""
    rows, across = _scan_size(**parameters)
    return [row * across + i for row in range(rows) for i in reversed(range(across))], [1.0] * (rows * across)


def _scan_random(world: World, *, missing: float = 0.0, **parameters) -> dict[str, list[tuple[float, float]]]:
    rows, across = _scan_size(**parameters)
    return {"missing": [(0.0, 1.0)] * (rows * across) if missing else []}


@observation(
    unit="m, ground relative to the trunk's frame, point by point from back to front, from right to left",
    mirror=_scan_image,
    random=_scan_random,
)
def height_scan(
    step: Step,
    random: dict[str, Tensor],
    *,
    forward: Annotated[tuple[float, float], Quantity("m", ge=-5, le=5)],
    aside: Annotated[float, Quantity("m", ge=0, le=5)],
    spacing: Annotated[float, Quantity("m", ge=0.01, le=5)],
    missing: Annotated[float, Quantity(ge=0, le=1)] = 0.0,
) -> Tensor:
    """Heights of the ground around the robot, relative to the trunk's frame [m], (num_envs, points).

    Args:
        step: the present step.
        random: which points are missing.
        forward: from where to where along the robot's heading [m].
        aside: how far to each side of it [m].
        spacing: between neighbouring points [m].
        missing: share of the points that are not seen, anew in every step; they are as high as the ground below the robot [-].
    """
    rows, across = _scan_size(forward=forward, aside=aside, spacing=spacing)
    point = torch.arange(rows * across, device=step.world.device)
    ahead, left = forward[0] + spacing * (point // across), spacing * (point % across - across // 2)
    x, y, z = step.state.base_pos[:, :, None].unbind(1)  # (num_envs, 1) each
    c, s = torch.cos(step.heading)[:, None], torch.sin(step.heading)[:, None]
    seen = step.ground_height(x + c * ahead - s * left, y + s * ahead + c * left) - z
    return torch.where(random["missing"] < missing, -step.base_height[:, None], seen) if missing else seen


@observation(unit="as the MJCF's sensor", mirror=lambda *, sensor, mirror: mirror, sensors=lambda *, sensor, mirror: (sensor,))
def sensor(step: Step, *, sensor: str, mirror: Literal["polar", "axial", "quat", "feet", "same", "none"] = "none") -> Tensor:
    """A sensor of the MJCF by its name, as at the last physics step of the policy step, (num_envs, its size).

    Args:
        step: the present step.
        sensor: its name in the MJCF.
        mirror: what it measures, for `ppo.symmetry`; "none" if it has no mirror image.
    """
    return step.state.sensors[sensor]


@observation(unit="s, until an action reaches the motors", mirror="same")
def action_delay(step: Step) -> Tensor:
    """By how much the episode's actions are late, without jitter [s], (num_envs, 1)."""
    memory = step.env.memory.get("actions")
    late = memory["delay"] if memory else step.world.zeros()
    return late[:, None] * (step.world.step_dt / step.world.decimation)


@observation(unit="as the MJCF's", mirror=lambda *, field, names, column, mirror: mirror)
def model_value(
    step: Step,
    *,
    field: str,
    names: list[str] | None = None,
    column: int | None = None,
    mirror: Literal["polar", "feet", "same", "none"] = "none",
) -> Tensor:
    """A field of MuJoCo's model in each world, less the MJCF's value: what an event has drawn, for a critic, (num_envs, size).

    Zeros where no event changes the field.

    Args:
        step: the present step.
        field: as in `mujoco.MjModel`.
        names: of the bodies, joints, geoms, sites or actuators; all if not given.
        column: which number of each row, where it has several; all if not given.
        mirror: what it is, for `ppo.symmetry`; "none" if it has no mirror image.

    Raises:
        UserError: there is no such field, or no part of such a name.
    """
    world, model = step.world, step.world.sim.model
    if not hasattr(model, field):
        raise UserError(f"no field '{field}' in MuJoCo's model; {nearest(field, dir(model))}")
    rows = rows_of(world, field, names)
    index = (slice(None), rows) if column is None else (slice(None), rows, column)
    if field not in world.sim.model_fields:
        return world.zeros(*getattr(model, field).shape)[index].flatten(1)
    return (world.sim.model_fields[field][index] - world.nominal_fields[field][index[1:]]).flatten(1).float()
