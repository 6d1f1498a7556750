"""What the policy sees: the order of its 33 numbers, and that they do not tell which way the world's x axis points."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from steps import CPU, again, bind, make_step, make_world
from torch import Tensor
from worlds import MakeEnv, quat_mul

from telebip.config import ObservationGroup, load_task
from telebip.errors import UserError
from telebip.math import quat_from_yaw
from telebip.mdp import observations
from telebip.mdp.binding import Binder
from telebip.mdp.groups import Group
from telebip.mdp.step import Step
from telebip.mdp.term import TERMS, find
from telebip.robot import Robot
from telebip.sim.base import SimState, columns_on
from telebip.terrain import Terrain

few = settings(max_examples=50, deadline=None, derandomize=True, database=None)
turns = st.floats(-2 * math.pi, 2 * math.pi)


def random_quats(seed: int) -> Tensor:
    quat = torch.randn(8, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    quat = quat / torch.linalg.vector_norm(quat, dim=1, keepdim=True)
    return quat


def same_rotation(a: Tensor, b: Tensor) -> None:
    torch.testing.assert_close((a * b).sum(1).abs(), torch.ones(len(a), dtype=a.dtype))


def oriented(quat: Tensor, reference: Tensor | None = None) -> Step:
    """A step of trunks with these orientations and reference headings."""
    zero = torch.zeros(len(quat), dtype=quat.dtype)
    world: Any = SimpleNamespace(sim=SimpleNamespace(state=SimpleNamespace(base_quat=quat)), weight=100.0)
    env: Any = SimpleNamespace(
        reference_heading=zero if reference is None else reference, command_timer=zero, has_begun=torch.ones(len(quat)) > 0
    )
    return Step(world, env, zero)


def heading_relative_quat(quat: Tensor, reference: Tensor) -> Tensor:
    return observations.base_quat(oriented(quat, reference))


def test_layout_is_the_article_s(make_env: MakeEnv) -> None:
    layout = make_env(num_envs=1).layout()
    assert list(layout) == ["policy"]
    assert [(part["name"], part["size"]) for part in layout["policy"]] == [
        ("joint_pos", 6),
        ("joint_vel", 6),
        ("last_action", 6),
        ("base_lin_vel", 3),
        ("base_ang_vel", 3),
        ("base_quat", 4),
        ("command", 3),
        ("phase", 2),
    ]
    assert sum(part["size"] for part in layout["policy"]) == 33


def test_observation_is_laid_out_in_this_order(robot: Robot) -> None:
    def row(*values: float) -> Tensor:
        return torch.tensor([values])

    state = SimState(
        qpos=row(90, 91, 92, 93, 94, 95, 96, 11, 12, 13, 14, 15, 16),
        qvel=row(97, 98, 99, 51, 52, 53, 21, 22, 23, 24, 25, 26),
        foot_force=row(100, 101),
        joint_force=row(102, 103, 104, 105, 106, 107),
        joint_power=row(108, 109, 110, 111, 112, 113),
        joint_net_power=row(114, 115, 116, 117, 118, 119),
        sensors={},
        joint_columns=columns_on(CPU, robot),
    )
    step: Any = SimpleNamespace(
        world=replace(make_world(robot), nominal=torch.tensor([0.5, 1.0, 1.5, 2.0, 2.5, 3.0])),
        state=state,
        last_action=row(31, 32, 33, 34, 35, 36),
        joint_pos=state.joint_pos,
        base_lin_vel_b=row(41, 42, 43),
        base_ang_vel_b=state.base_ang_vel_b,
        heading_quat=row(61, 62, 63, 64),
        command=row(71, 72, 73),
        phase=row(81, 82),
    )
    published = load_task("telebip_flat").observations["policy"]
    group = Group("policy", ObservationGroup(published.terms, noise=False), Binder(step))
    expected = [
        10.5,
        11,
        11.5,
        12,
        12.5,
        13,
        *range(21, 27),
        *range(31, 37),
        41,
        42,
        43,
        51,
        52,
        53,
        61,
        62,
        63,
        64,
        71,
        72,
        73,
    ]
    torch.testing.assert_close(group.observe(step), row(*expected, 81, 82))


@pytest.mark.parametrize(
    ("heading", "reference", "expected"),
    [
        (0.0, 0.0, [1.0, 0.0, 0.0, 0.0]),
        (1.3, 1.3, [1.0, 0.0, 0.0, 0.0]),
        (0.5, 0.3, [math.cos(0.1), 0.0, 0.0, math.sin(0.1)]),  # 0.2 rad left of the reference
        (0.3, 0.5, [math.cos(0.1), 0.0, 0.0, -math.sin(0.1)]),
        (3.1, -3.1, [math.cos(math.pi - 3.1), 0.0, 0.0, -math.sin(math.pi - 3.1)]),  # across pi
    ],
)
def test_standing_upright_the_quaternion_is_the_heading_error(heading: float, reference: float, expected: list[float]) -> None:
    quat = heading_relative_quat(quat_from_yaw(torch.tensor([heading])), torch.tensor([reference]))
    torch.testing.assert_close(quat, torch.tensor([expected]), atol=1e-6, rtol=1e-6)


@few
@given(st.integers(0, 2**32 - 1), turns, turns)
def test_turning_the_world_about_z_changes_nothing(seed: int, reference: float, turn: float) -> None:
    quat = random_quats(seed)
    psi, delta = (torch.full((8,), angle, dtype=torch.float64) for angle in (reference, turn))
    turned = heading_relative_quat(quat_mul(quat_from_yaw(delta), quat), psi + delta)
    # Compared as rotations: within rounding of w = 0 the sign may fall either way.
    same_rotation(turned, heading_relative_quat(quat, psi))
    assert (turned[:, 0] >= 0.0).all()


@few
@given(st.integers(0, 2**32 - 1), turns)
def test_q_and_minus_q_look_the_same(seed: int, reference: float) -> None:
    quat, psi = random_quats(seed), torch.full((8,), reference, dtype=torch.float64)
    torch.testing.assert_close(heading_relative_quat(-quat, psi), heading_relative_quat(quat, psi))


def test_tilt_is_seen_in_the_reference_frame() -> None:
    # Facing +y and pitched forward by 0.4 rad looks like facing +x and pitched by as much.
    pitch = torch.tensor([[math.cos(0.2), 0.0, math.sin(0.2), 0.0]])
    facing_y = torch.tensor([math.pi / 2])
    torch.testing.assert_close(heading_relative_quat(quat_mul(quat_from_yaw(facing_y), pitch), facing_y), pitch)


def test_noise_leaves_alone_what_the_policy_knows_exactly(make_env: MakeEnv) -> None:
    noise = {"joint_pos": 0.1, "joint_vel": 0.2, "base_lin_vel": 0.3, "base_ang_vel": 0.4, "base_quat": 0.5}
    env = make_env(*(f"observations.policy.{name}.noise={amplitude}" for name, amplitude in noise.items()), num_envs=1)
    amplitudes = [part.noise for part in env.groups["policy"].parts for _ in range(part.size)]
    assert amplitudes == [0.1] * 6 + [0.2] * 6 + [0.0] * 6 + [0.3] * 3 + [0.4] * 3 + [0.5] * 4 + [0.0] * 5


@few
@given(st.integers(0, 2**32 - 1))
def test_gravity_is_the_world_s_downward_axis_as_the_trunk_sees_it(seed: int) -> None:
    step = oriented(random_quats(seed))
    down = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64).expand(8, -1)
    torch.testing.assert_close(observations.projected_gravity(step), step.to_body(down))


def test_pitched_forward_gravity_points_forward() -> None:
    step = oriented(torch.tensor([[math.cos(0.2), 0.0, math.sin(0.2), 0.0]]))
    torch.testing.assert_close(
        observations.projected_gravity(step), torch.tensor([[math.sin(0.4), 0.0, -math.cos(0.4)]]), atol=1e-6, rtol=0.0
    )


def test_a_push_is_seen_in_body_weights_and_in_the_trunk_s_frame() -> None:
    step = oriented(quat_from_yaw(torch.tensor([math.pi / 2])))  # facing y
    step.env.wrench_w = torch.tensor([[0.0, 50.0, 20.0, 9.0, 9.0, 9.0]])  # of 100 N of weight; torques do not count
    torch.testing.assert_close(observations.push_force(step), torch.tensor([[0.5, 0.0, 0.2]]), atol=1e-6, rtol=0.0)
    step.env.has_begun.fill_(False)  # it pushed the robot of the episode before
    assert not observations.push_force(again(step)).any()


def test_foot_forces_are_in_body_weights(robot: Robot) -> None:
    step = make_step(robot)
    step.state.foot_force[0] = torch.tensor([0.25, 2.0]) * robot.weight
    torch.testing.assert_close(observations.foot_force(step), torch.tensor([[0.25, 2.0]]))


def test_height_is_that_of_the_hips(robot: Robot) -> None:
    step = make_step(robot, num_envs=2)
    step.state.qpos[1, :3] = torch.tensor([5.0, -3.0, 0.5])
    torch.testing.assert_close(observations.base_height(step), torch.tensor([[0.66], [0.5]]))


def test_friction_is_the_ground_s_in_each_world(robot: Robot) -> None:
    step = make_step(robot, num_envs=3, fields=("geom_friction",))
    floor = step.world.sim.model_fields["geom_friction"][:, robot.floor_id]
    floor[:, 0] = torch.tensor([0.3, 0.7, 1.1])
    torch.testing.assert_close(observations.friction(step), torch.tensor([[0.3], [0.7], [1.1]]))


def test_friction_that_no_event_changes_is_the_mjcf_s(robot: Robot) -> None:
    friction = observations.friction(make_step(robot, num_envs=2))
    torch.testing.assert_close(friction, torch.full((2, 1), robot.model.geom_friction[robot.floor_id, 0]).float())


def test_a_sensor_is_named_in_the_task_and_read_as_it_is(robot: Robot) -> None:
    step = make_step(robot, num_envs=2)
    step.state.sensors["gyro"] = torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    params = {"term": "sensor", "sensor": "gyro", "mirror": "axial", "noise": 0.0}
    group = Group("policy", ObservationGroup({"rates": params}), Binder(step))
    assert torch.equal(group.observe(step), step.state.sensors["gyro"])
    (part,) = group.parts
    assert (part.name, part.size, part.image) == ("rates", 3, ([0, 1, 2], [-1.0, 1.0, -1.0]))


def test_a_sensor_of_the_mjcf_measures_what_the_state_says(make_env: MakeEnv) -> None:
    sensor = "observations.policy.gyro={term: sensor, sensor: gyro, mirror: axial}"
    env = make_env(sensor, "sim.decimation=1", calm=True)
    (*_, part) = env.layout()["policy"]
    assert (part["name"], part["size"], part["mirror"]) == ("gyro", 3, ([0, 1, 2], [-1.0, 1.0, -1.0]))
    for _ in range(3):
        before = env.sim.state.base_ang_vel_b.clone()
        obs = env.step(torch.ones(4, 6))[0]["policy"]
    # "At the step's last physics step, before it moved".
    torch.testing.assert_close(obs[:, -3:], before, atol=1e-5, rtol=0.0)
    assert before.abs().max() > 0.01


def test_an_unknown_sensor_is_one_line(make_env: MakeEnv) -> None:
    with pytest.raises(UserError, match=r"no sensor named 'giro'; did you mean 'gyro'\?"):
        make_env("observations.policy.gyro={term: sensor, sensor: giro}")


def test_every_observation_says_its_unit_and_how_it_is_mirrored() -> None:
    assert find("observation", "joint_pos").unit
    for name, term in TERMS["observation"].items():
        if term.function.__module__ == observations.__name__:
            assert term.unit, name
            assert term.mirror != "none", name


SCAN = {"forward": (-0.2, 0.4), "aside": 0.1, "spacing": 0.1, "missing": 0.0}

BELOW = 0.1 * (1.0 - 0.5) - 0.1 * (2.975 - 0.5)  # half a metre from the platform; at the tile's edge the ground is at 0


def on_a_slope(robot: Robot) -> Step:
    """Robots at x = 1 m on ground that rises with x by 0.1 m a metre: one heading along x, the other along y."""
    slope = {"slope_up": {"angle": (math.atan(0.1), math.atan(0.1))}}
    terrain = replace(load_task("telebip_flat").terrain, types=slope, levels=1, start_level=(0, 0))
    step = make_step(robot.on(Terrain(terrain)), num_envs=2)
    step.state.qpos[:, :3] = torch.tensor([1.0, 0.0, 0.7])
    step.state.qpos[1, 3:7] = torch.tensor([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)])
    return step


def test_a_height_scan_turns_with_the_heading(robot: Robot) -> None:
    step = on_a_slope(robot)
    scan = observations.height_scan(step, {}, **SCAN)
    assert scan.shape == (2, 7 * 3)
    below = BELOW - 0.7
    ahead, aside = torch.linspace(-0.2, 0.4, 7)[:, None], torch.linspace(-0.1, 0.1, 3)
    torch.testing.assert_close(scan[0].view(7, 3), below + 0.1 * ahead.expand(7, 3), atol=1e-4, rtol=0.0)
    torch.testing.assert_close(
        scan[1].view(7, 3), below - 0.1 * aside.expand(7, 3), atol=1e-4, rtol=0.0
    )  # uphill is on the right


def test_a_height_scan_of_flat_ground_is_the_height_of_the_trunk(robot: Robot) -> None:
    step = make_step(robot, num_envs=2)
    torch.testing.assert_close(observations.height_scan(step, {}, **SCAN), torch.full((2, 21), -0.66))


def test_missing_points_of_a_height_scan_are_as_high_as_the_ground_below(robot: Robot) -> None:
    step = on_a_slope(robot)
    drawn = {"missing": torch.full((2, 21), 0.5)}
    drawn["missing"][:, 4] = 0.1
    seen, whole = observations.height_scan(step, drawn, **{**SCAN, "missing": 0.2}), observations.height_scan(step, {}, **SCAN)
    torch.testing.assert_close(seen[:, 4], -observations.base_height(step)[:, 0])
    rest = [i for i in range(21) if i != 4]  # point 4 is 0.1 m behind
    assert torch.equal(seen[:, rest], whole[:, rest]) and (whole[0, 4] - seen[0, 4]).abs() > 0.005


def test_the_mirror_image_of_a_height_scan_swaps_right_and_left(robot: Robot) -> None:
    step = on_a_slope(robot)
    group = Group("policy", ObservationGroup({"height_scan": {**SCAN, "noise": 0.0}}), Binder(step))
    (image,) = (part.image for part in group.parts)
    assert not isinstance(image, str)
    order, sign = image
    seen = group.observe(step)[1]
    assert sign == [1.0] * 21
    torch.testing.assert_close(seen[order].view(7, 3), seen.view(7, 3).flip(1))


def test_heights_are_above_the_ground(robot: Robot) -> None:
    height = observations.base_height(on_a_slope(robot))
    torch.testing.assert_close(height, torch.full((2, 1), 0.7 - BELOW), atol=1e-4, rtol=0.0)


def test_a_model_value_is_what_an_event_has_added_to_the_model_and_zero_where_none_does(robot: Robot) -> None:
    step = make_step(robot, 3, fields=("body_ipos",))
    trunk = robot.model.body("trunk").id
    step.world.sim.model_fields["body_ipos"][:, trunk] += torch.tensor([[0.0, 0.0, 0.0], [0.01, 0.02, 0.03], [0.0, -0.01, 0.0]])
    seen = bind(step, "observation", "model_value", field="body_ipos", names=["trunk"], column=None, mirror="polar")(step)
    torch.testing.assert_close(
        seen, torch.tensor([[0.0, 0.0, 0.0], [0.01, 0.02, 0.03], [0.0, -0.01, 0.0]]), atol=1e-6, rtol=0.0
    )
    one = bind(step, "observation", "model_value", field="body_ipos", names=["trunk"], column=1, mirror="same")(step)
    assert one.shape == (3, 1) and one[1].item() == pytest.approx(0.02)
    none = bind(step, "observation", "model_value", field="body_mass", names=["trunk"], column=None, mirror="same")(step)
    assert torch.equal(none, torch.zeros(3, 1))
    with pytest.raises(UserError, match=r"no field 'body_mas' in MuJoCo's model; did you mean 'body_mass'\?"):
        bind(step, "observation", "model_value", field="body_mas", names=None, column=None, mirror="same")(step)


def test_the_action_delay_is_told_in_seconds(robot: Robot) -> None:
    step = make_step(robot, 2)
    assert torch.equal(bind(step, "observation", "action_delay")(step), torch.zeros(2, 1))
    step.env.memory["actions"] = {"delay": torch.tensor([0.0, 3.0])}
    torch.testing.assert_close(bind(step, "observation", "action_delay")(step), torch.tensor([[0.0], [0.015]]))
