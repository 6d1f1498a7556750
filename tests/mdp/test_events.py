"""What happens to the worlds: how they start, pushes and kicks, and what differs from world to world."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from steps import again, bind, everywhere, fills, make_step
from torch import Tensor

from telebip import ROOT
from telebip.config import load_task
from telebip.errors import UserError
from telebip.math import yaw
from telebip.mdp.binding import Binder, Events, model_fields_of
from telebip.mdp.step import Step
from telebip.robot import Robot, load_robot
from telebip.terrain import Terrain

POSE = {"joint_pos": 0.02, "heading": math.pi}
VELOCITY = {"joint_vel": 0.1, "lin_vel": 0.2, "ang_vel": 0.3}
PUSH: dict[str, Any] = {"force": 50.0, "duration": 0.1, "interval": (0.4, 0.4), "ramp": (0.0, 0.0)}
FIELDS = ("geom_friction", "body_mass", "body_inertia", "actuator_gainprm", "actuator_biasprm", "dof_damping", "body_ipos")


def started(robot: Robot, seed: int = 0, num_envs: int = 2048, **amplitudes: float) -> tuple[Tensor, Tensor]:
    """Initial qpos and qvel."""
    step = make_step(robot, num_envs)
    for name, given in (("start_pose", POSE), ("start_velocity", VELOCITY)):
        params = {key: amplitudes.get(key, value) for key, value in given.items()}
        bind(step, "event", name, seed, **params)(step, everywhere(step))
    return step.start_qpos, step.start_qvel


def clearance(qpos: Tensor) -> Tensor:
    """Height of the feet's lowest points above the ground, trunk upright: z - (0.67 - knee) cos(roll) cos(pitch) - 0.03 [m]."""
    roll, pitch, knee = qpos[:, 7:].reshape(-1, 2, 3).unbind(-1)
    return qpos[:, 2:3] - (0.67 - knee) * torch.cos(roll) * torch.cos(pitch) - 0.03


@pytest.mark.parametrize("amplitude", [0.0, 0.02, 0.1])
def test_no_foot_starts_in_the_ground_nor_far_above_it(robot: Robot, amplitude: float) -> None:
    qpos, _ = started(robot, joint_pos=amplitude)
    lowest = clearance(qpos).amin(1)
    assert lowest.min().item() > -1e-6
    # Both knees shorter by the amplitude, and both hips at its end: (0.63 - a)(1 - cos^2 a) more.
    assert lowest.max().item() < amplitude + 0.63 * (1.0 - math.cos(amplitude) ** 2) + 1e-6


def test_no_foot_of_a_robot_with_rotary_knees_starts_in_the_ground_by_more_than_the_second_order() -> None:
    robot = load_robot(ROOT / "tests" / "robots" / "rotary_knee.xml")
    qpos, _ = started(robot)
    _, pitch, knee = qpos[:, 7:].reshape(-1, 2, 3).unbind(-1)
    home = robot.home_qpos[2] - 0.335 * 2.0 * math.cos(0.35)
    height = qpos[:, 2:3] - 0.335 * (torch.cos(pitch) + torch.cos(pitch + knee)) - home  # but for the roll, cos(0.02)
    # At home each part of the leg leans by 0.35 rad; the second order of 0.04 rad is 0.67 m x 0.04^2 / 2.
    assert height.amin(1).min().item() > -5.4e-4
    assert height.amin(1).min().item() < 1e-3
    assert (qpos[:, 2] - robot.home_qpos[2]).max().item() > 1e-3


def test_longer_legs_lift_the_robot_by_the_longer_one_alone(robot: Robot) -> None:
    qpos, _ = started(robot)
    longer = (0.04 - qpos[:, [9, 12]]).amax(1).clamp(min=0.0)
    torch.testing.assert_close(qpos[:, 2], 0.66 + longer)


def test_positions_vary_about_home_within_their_amplitudes(robot: Robot) -> None:
    qpos, _ = started(robot)
    torch.testing.assert_close(qpos[:, :2], torch.zeros(2048, 2))
    fills(qpos[:, 7:] - torch.as_tensor(robot.nominal).float(), -0.02, 0.02)


def test_trunk_starts_upright_with_any_heading(robot: Robot) -> None:
    quat = started(robot)[0][:, 3:7]
    torch.testing.assert_close(torch.linalg.vector_norm(quat, dim=1), torch.ones(2048))
    torch.testing.assert_close(quat[:, 1:3], torch.zeros(2048, 2))
    fills(yaw(quat)[:, None], -math.pi, math.pi)


def test_velocities_stay_within_their_amplitudes(robot: Robot) -> None:
    _, qvel = started(robot)
    fills(qvel[:, :2], -0.2, 0.2)
    torch.testing.assert_close(qvel[:, 2], torch.zeros(2048))
    fills(qvel[:, 3:6], -0.3, 0.3)
    fills(qvel[:, 6:], -0.1, 0.1)


def test_without_amplitudes_every_world_starts_at_home(robot: Robot) -> None:
    qpos, qvel = started(robot, 0, 3, **dict.fromkeys([*POSE, *VELOCITY], 0.0))
    torch.testing.assert_close(qpos, torch.as_tensor(robot.home_qpos).float().expand(3, -1))
    torch.testing.assert_close(qvel, torch.zeros(3, 12))


def test_same_seed_same_states(robot: Robot) -> None:
    for first, second, other in zip(*(started(robot, seed) for seed in (1, 1, 2)), strict=True):
        assert torch.equal(first, second)
        assert not torch.equal(first, other)


def pushes(step: Step, **params: Any) -> Tensor:
    """Horizontal forces [N] of the first push of each world, whose time comes at once."""
    event = bind(step, "event", "push", **(PUSH | params))
    event(again(step, age=1), everywhere(step))  # a world that has just begun waits for an interval
    assert not step.env.wrench_w[:, 2:].any()  # at the centre of mass
    return step.env.wrench_w[:, :2]


def test_pushes_are_uniform_in_magnitude_and_direction(robot: Robot) -> None:
    force = pushes(make_step(robot, 4096))
    magnitude = torch.linalg.vector_norm(force, dim=1)
    fills(magnitude[:, None], 0.0, 50.0)
    assert magnitude.mean().item() == pytest.approx(25.0, abs=1.0)
    fills(torch.atan2(force[:, 1], force[:, 0])[:, None], -math.pi, math.pi)
    torch.testing.assert_close(force.mean(0), torch.zeros(2), atol=1.5, rtol=0.0)


def test_a_push_points_where_its_direction_says(robot: Robot) -> None:
    step = make_step(robot, 3)
    binder = Binder(step)
    event = binder.bind("event", "events", "push", PUSH)
    draws = binder.allocate()
    draws.part("events.push.push").copy_(torch.tensor([[10.0, 0.0], [10.0, math.pi / 2], [0.0, 1.0]]))
    event(again(step, age=1), everywhere(step))
    force = step.env.wrench_w[:, :2]
    torch.testing.assert_close(force, torch.tensor([[10.0, 0.0], [0.0, 10.0], [0.0, 0.0]]), atol=1e-5, rtol=0.0)


@pytest.mark.parametrize(("samples", "share"), [(0.0, 0.0), (2000.0, 0.5), (4000.0, 1.0)])
def test_pushes_grow_with_the_training(robot: Robot, samples: float, share: float) -> None:
    full, step = make_step(robot, 8), make_step(robot, 8)
    step.env.samples.fill_(samples)
    torch.testing.assert_close(pushes(step, ramp=(1000.0, 3000.0)), share * pushes(full))


def test_two_pushes_add_up_and_leave_a_held_force_alone(robot: Robot) -> None:
    step = make_step(robot, 8)
    step.env.wrench_w[:, 2] = 7.0
    binder = Binder(step)
    events = [binder.bind("event", "events", name, PUSH | {"term": "push"}) for name in ("one", "two")]
    binder.allocate().draw(torch.Generator().manual_seed(0))
    for event in events:
        event(again(step, age=1), everywhere(step))
    memory = step.env.memory
    assert not torch.equal(memory["events.one"]["force"], memory["events.two"]["force"])
    torch.testing.assert_close(step.env.wrench_w[:, :2], memory["events.one"]["force"] + memory["events.two"]["force"])
    assert (step.env.wrench_w[:, 2] == 7.0).all()


@pytest.mark.parametrize("size", [2, 3])
def test_an_event_of_one_s_own_adds_a_force_to_what_acts_already(robot: Robot, size: int) -> None:
    step = make_step(robot, 2)
    step.env.wrench_w[:] = 1.0
    for _ in range(2):
        step.push_force(torch.tensor([[2.0, 3.0, 4.0], [0.0, 0.0, 0.0]])[:, :size])
    expected = torch.tensor([[5.0, 7.0, 9.0 if size == 3 else 1.0, 1.0, 1.0, 1.0], [1.0] * 6])
    assert torch.equal(step.env.wrench_w, expected)


HALF = torch.tensor([True, False] * 4)
"""Of eight worlds, every other one."""


def changed(step: Step, name: str, **params: Any) -> dict[str, Tensor]:
    """Let an event happen in every other world, and return what it wrote there, by field; nothing else may change."""
    before = {field: live.clone() for field, live in step.world.sim.model_fields.items()}
    bind(step, "event", name, **params)(step, HALF)
    after = step.world.sim.model_fields
    for field, live in after.items():
        assert torch.equal(live[~HALF], before[field][~HALF])
    declared = set(model_fields_of({name: params}))
    assert {field for field, live in after.items() if not torch.equal(live, before[field])} <= declared
    return {field: live[HALF] for field, live in after.items() if not torch.equal(live, before[field])}


def nominal(step: Step, field: str) -> Tensor:
    return step.world.nominal_fields[field]


def test_friction_is_the_sliding_friction_of_the_ground(robot: Robot) -> None:
    step = make_step(robot, 8, fields=FIELDS)
    (friction,) = changed(step, "friction", range=(0.3, 0.9)).values()
    drawn = friction[:, robot.floor_id, 0].clone()
    assert len(drawn.unique()) == 4
    assert ((drawn >= 0.3) & (drawn <= 0.9)).all()
    friction[:, robot.floor_id, 0] = nominal(step, "geom_friction")[robot.floor_id, 0]
    assert torch.equal(friction, nominal(step, "geom_friction").expand_as(friction))


@pytest.mark.parametrize("bodies", [None, ["trunk"], ["right_shank", "trunk"]])
@pytest.mark.parametrize("inertia", [(1.0, 1.0), (0.6, 0.8)])
def test_mass_and_inertia_are_scaled_by_a_factor_for_each_body(
    robot: Robot, bodies: list[str] | None, inertia: tuple[float, float]
) -> None:
    step = make_step(robot, 8, fields=FIELDS)
    written = changed(step, "mass", scale=(0.5, 2.0), inertia=inertia, bodies=bodies)
    heavy = [robot.model.body(name).id for name in bodies or [robot.model.body(i).name for i in range(1, robot.model.nbody)]]
    factor = written["body_mass"][:, heavy] / nominal(step, "body_mass")[heavy]
    assert len(factor.unique()) == 4 * len(heavy)
    assert ((factor > 0.5) & (factor < 2.0)).all()
    about = written["body_inertia"][:, heavy] / nominal(step, "body_inertia")[heavy] / factor[:, :, None]
    torch.testing.assert_close(about, about[:, :, :1].expand_as(about))  # on all axes alike
    assert (about > inertia[0] - 1e-6).all() and (about < inertia[1] + 1e-6).all()
    assert len(about[:, :, 0].round(decimals=5).unique()) == (4 * len(heavy) if inertia[0] < inertia[1] else 1)
    others = [i for i in range(robot.model.nbody) if i not in heavy]
    for field in ("body_mass", "body_inertia"):
        assert torch.equal(written[field][:, others], nominal(step, field)[others].expand_as(written[field][:, others]))


@pytest.mark.parametrize("bodies", [["trunk"], ["right_shank", "trunk"]])
def test_the_centre_of_mass_of_a_body_is_moved_on_each_axis(robot: Robot, bodies: list[str]) -> None:
    step = make_step(robot, 4096, fields=FIELDS)
    bind(step, "event", "com", offset=0.03, bodies=bodies)(step, everywhere(step))
    moved = step.world.sim.model_fields["body_ipos"] - nominal(step, "body_ipos")
    rows = [robot.model.body(name).id for name in bodies]
    fills(moved[:, rows].flatten(1), -0.03, 0.03)
    moved[:, rows] = 0.0
    assert not moved.any()


def test_gains_scale_stiffness_and_damping_of_each_actuator_by_factors_of_its_own(robot: Robot) -> None:
    step = make_step(robot, 8, fields=FIELDS)
    written = changed(step, "gains", kp=(0.8, 1.2), kv=(0.5, 0.7))
    kp = written["actuator_gainprm"][:, :, 0] / nominal(step, "actuator_gainprm")[:, 0]
    kv = written["actuator_biasprm"][:, :, 2] / nominal(step, "actuator_biasprm")[:, 2]
    for factor, low, high in ((kp, 0.8, 1.2), (kv, 0.5, 0.7)):
        assert len(factor.unique()) == factor.numel() == 24
        assert ((factor >= low) & (factor <= high)).all()
    # tau = kp (q_target - q) - kv qd: the gain and the bias have the same kp.
    assert torch.equal(written["actuator_biasprm"][:, :, 1], -written["actuator_gainprm"][:, :, 0])
    for field, columns in (("actuator_gainprm", [0]), ("actuator_biasprm", [1, 2])):
        rest = [i for i in range(written[field].shape[2]) if i not in columns]
        assert torch.equal(written[field][:, :, rest], nominal(step, field)[:, rest].expand(4, -1, -1))


@pytest.mark.parametrize(
    ("operation", "apply"),
    [("scale", lambda old, x: old * x), ("add", lambda old, x: old + x), ("set", lambda old, x: 0.0 * old + x)],
)
def test_any_field_of_the_model_is_changed_row_by_row(robot: Robot, operation: str, apply: Any) -> None:
    step = make_step(robot, 8, fields=FIELDS)
    params = {"term": "model_field", "field": "dof_damping", "range": (2.0, 3.0), "operation": operation}
    (damping,) = changed(step, "joints", **params, names=["right_knee", "left_hip_roll"], column=None).values()
    rows = [int(robot.model.joint(name).dofadr[0]) for name in ("right_knee", "left_hip_roll")]
    old = nominal(step, "dof_damping")
    drawn = step.env.random[HALF].to(damping.dtype)
    assert drawn.shape == (4, 2)
    assert not torch.equal(drawn[:, 0], drawn[:, 1])  # a number for each
    torch.testing.assert_close(damping[:, rows], apply(old[rows], drawn))
    others = [i for i in range(robot.model.nv) if i not in rows]
    assert torch.equal(damping[:, others], old[others].expand(4, -1))


def test_a_column_of_a_field_is_changed_alone(robot: Robot) -> None:
    step = make_step(robot, 8, fields=FIELDS)
    params = {"field": "body_ipos", "range": (-0.02, 0.02), "operation": "add", "names": ["trunk"], "column": 0}
    (ipos,) = changed(step, "model_field", **params).values()
    moved = ipos - nominal(step, "body_ipos")
    assert (moved[:, robot.trunk_id, 0].abs() <= 0.02).all()
    assert len(moved[:, robot.trunk_id, 0].unique()) == 4
    moved[:, robot.trunk_id, 0] = 0.0
    assert not moved.any()


def test_a_whole_field_has_a_number_for_each_row(robot: Robot) -> None:
    step = make_step(robot, 8, fields=FIELDS)
    params = {"field": "body_mass", "range": (0.9, 1.1), "operation": "scale", "names": None, "column": None}
    (mass,) = changed(step, "model_field", **params).values()
    factor = (mass / nominal(step, "body_mass"))[:, 1:]
    assert len(factor.unique()) == factor.numel()


def test_names_and_rows_that_there_are_not(robot: Robot) -> None:
    step = make_step(robot, fields=FIELDS)
    with pytest.raises(UserError, match=r"no body named 'trunc' .*valid: .*'trunk'"):
        bind(step, "event", "mass", scale=(0.9, 1.1), inertia=(1.0, 1.0), bodies=["trunc"])(step, everywhere(step))
    with pytest.raises(UserError, match="rows of field 'opt_gravity' have no names; leave out `names`"):
        params = {"field": "opt_gravity", "range": (0.9, 1.1), "operation": "scale", "names": ["x"], "column": None}
        bind(step, "event", "model_field", **params)


def test_a_kick_changes_the_velocity_of_the_trunk_within_its_bounds(robot: Robot) -> None:
    step = make_step(robot, 2048)
    live = step.world.sim.memory["qvel"]
    live[:] = torch.arange(12.0, dtype=live.dtype)
    before = live.clone()
    mask = torch.arange(2048) % 2 == 0
    bind(step, "event", "kick", lin_vel=0.5, ang_vel=2.0)(step, mask)
    assert torch.equal(live[~mask], before[~mask])
    assert torch.equal(live[:, 6:], before[:, 6:])
    fills((live - before)[mask][:, :3], -0.5, 0.5)
    fills((live - before)[mask][:, 3:6], -2.0, 2.0)
    assert torch.equal(step.state.qvel, live.float())  # what the next step starts with is seen


def test_an_event_at_intervals_waits_for_the_time_that_was_drawn(robot: Robot) -> None:
    step = make_step(robot, 64)
    binder = Binder(step)
    entries = {"kick": {"lin_vel": 1.0, "ang_vel": 0.0, "interval": (0.1, 0.2)}}
    events, draws = Events(entries, binder), binder.allocate()
    assert not events.change_the_model
    generator, happened = torch.Generator().manual_seed(0), []
    for age in range(100):
        draws.draw(generator)
        before = step.world.sim.memory["qvel"].clone()
        events.happen("step", again(step, age))
        happened.append((step.world.sim.memory["qvel"] != before).any(1))
    gaps = torch.cat([torch.diff(torch.nonzero(times)[:, 0], prepend=torch.zeros(1)) for times in torch.stack(happened).T])
    assert set(gaps.tolist()) == {6, 7, 8, 9, 10}  # steps of 0.02 s: the first at which the time is over
    assert len(gaps) > 64 * 8


def test_an_interval_starts_anew_with_an_episode(robot: Robot) -> None:
    step = make_step(robot, 3)
    binder = Binder(step)
    events = Events({"kick": {"lin_vel": 1.0, "ang_vel": 0.0, "interval": (0.11, 0.11)}}, binder)
    draws = binder.allocate()
    happened, generator = [], torch.Generator().manual_seed(0)
    for time in range(9):
        draws.draw(generator)
        if time == 4:
            step.env.reset(torch.tensor([False, True, False]))
        before = step.world.sim.memory["qvel"].clone()
        events.happen("step", again(step))
        happened.append((step.world.sim.memory["qvel"] != before).any(1).tolist())
        step.env.has_begun.fill_(True)
    due = [time == 6 for time in range(9)]  # after 0.11 s; in the second world 0.08 s later
    assert happened == [[at, False, at] for at in due]


def test_when_an_event_happens_is_the_task_s_choice(robot: Robot) -> None:
    step = make_step(robot, 4, fields=FIELDS)
    binder = Binder(step)
    entries = {
        "friction": {"range": (0.5, 1.1), "when": "reset"},
        "mass": {"scale": (0.9, 1.1), "inertia": (1.0, 1.0), "bodies": None, "when": "once"},
    }
    events = Events(entries, binder)
    binder.allocate().draw(torch.Generator().manual_seed(0))
    assert events.change_the_model
    fields = step.world.sim.model_fields
    events.happen("reset", step)
    assert torch.equal(fields["body_mass"], nominal(step, "body_mass").expand(4, -1))
    assert len(fields["geom_friction"][:, robot.floor_id, 0].unique()) == 4
    events.happen("once", step)
    assert len(fields["body_mass"][:, robot.trunk_id].unique()) == 4


def on_tiles(robot: Robot, tiles: list[list[int]], away: list[tuple[float, float]]) -> Step:
    """Robots on tiles (type, level) of 6 m, three levels, that far away from their middles; commanded 0.5 m/s for 10 s."""
    terrain = replace(
        load_task("telebip_flat").terrain,
        types={"boxes": {"height": (0.0, 0.0), "width": 0.4}, "waves": {"height": (0.0, 0.0), "length": 1.0}},
        levels=3,
        start_level=(0, 2),
    )
    step = make_step(robot.on(Terrain(terrain)), len(tiles))
    assert step.world.ground
    step.env.tile[:] = torch.tensor(tiles)
    step.env.command[:, 0] = 0.5
    step.state.qpos[:, :2] = step.world.ground.origin(step.env.tile)[:, :2] + torch.tensor(away)
    return step


def test_the_level_goes_up_where_the_tile_is_left_and_down_where_the_robot_comes_not_half_as_far(robot: Robot) -> None:
    tiles = [[0, 1], [1, 1], [0, 1], [1, 1], [0, 0], [0, 1], [0, 1]]
    away = [(3.1, 0.0), (0.5, -3.1), (1.4, 0.0), (1.6, 0.0), (0.0, 0.0), (3.1, 0.0), (3.1, 0.0)]
    step = on_tiles(robot, tiles, away)
    step.fallen[5] = True  # it has left its tile, but it fell
    mask = everywhere(step)
    mask[6] = False
    bind(step, "event", "terrain_level")(step, mask)
    assert step.env.tile.tolist() == [[0, 2], [1, 2], [0, 0], [1, 1], [0, 0], [0, 1], [0, 1]]


def test_a_robot_that_is_to_stand_keeps_its_level(robot: Robot) -> None:
    step = on_tiles(robot, [[0, 1], [0, 1]], [(0.0, 0.0), (0.3, 0.0)])
    step.env.command[:, 0] = torch.tensor([0.0, 0.05])  # half of 0.5 m is less than 0.3 m
    bind(step, "event", "terrain_level")(step, everywhere(step))
    assert step.env.tile[:, 1].tolist() == [1, 1]


def test_from_the_last_level_it_goes_back_to_any(robot: Robot) -> None:
    step = on_tiles(robot, [[0, 2]] * 600, [(3.1, 0.0)] * 600)
    bind(step, "event", "terrain_level")(step, everywhere(step))
    counts = torch.bincount(step.env.tile[:, 1], minlength=3)
    assert len(counts) == 3 and counts.min() > 150


def test_on_flat_ground_there_are_no_levels(robot: Robot) -> None:
    step = make_step(robot, 2)
    bind(step, "event", "terrain_level")(step, everywhere(step))
    assert not step.env.tile.any()
