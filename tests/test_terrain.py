# pyright: reportAttributeAccessIssue=false
"""The ground: what tiles look like, that the engines' surface is what is computed, and how robots start on it and leave it."""

import math
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from worlds import NEVER_FALL, ROUGH, MakeEnv, random_actions, same

from telebip import ROOT
from telebip.config import load_task
from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.mdp.ground import Ground
from telebip.mdp.term import TERMS, find
from telebip.robot import Robot
from telebip.terrain import Terrain, TerrainConfig, Tile

FLAT = load_task("telebip_flat").terrain
HEIGHT = {"height": (0.1, 0.2)}


def of(**types: dict[str, Any]) -> TerrainConfig:
    """Three levels of small tiles."""
    return replace(FLAT, types=types, levels=3, start_level=(0, 2), size=2.0, platform=0.4)


def tile(name: str, difficulty: float = 1.0, **parameters: Any) -> Callable[[float, float], float]:
    """The height of a tile of 4 m with a platform of 1 m as a function of x and y, at its nodes."""
    edge = np.arange(-1.975, 2.0, 0.05)
    x, y = np.meshgrid(edge, edge)
    heights = find("terrain", name).function(Tile(x, y, 1.0, difficulty, np.random.default_rng(0)), **parameters)
    assert heights.shape == x.shape
    return lambda x, y: float(heights[np.abs(edge - y).argmin(), np.abs(edge - x).argmin()])


@pytest.mark.parametrize(("name", "sign"), [("slope_up", 1.0), ("slope_down", -1.0)])
def test_slopes_lead_away_from_the_platform_on_all_sides(name: str, sign: float) -> None:
    height = tile(name, difficulty=0.5, angle=(0.0, 2.0 * math.atan(0.2)))  # half of it: one in five
    assert height(0.4, -0.4) == 0.0
    for x, y in ((1.525, 0.0), (-1.525, 1.0), (0.3, 1.525), (1.525, -1.525)):
        assert height(x, y) == pytest.approx(sign * 0.2 * 1.025)


@pytest.mark.parametrize(("name", "sign"), [("stairs_up", 1.0), ("stairs_down", -1.0)])
def test_stairs_have_their_rise_and_tread(name: str, sign: float) -> None:
    height = tile(name, rise=(0.02, 0.12), tread=0.3)
    levels = [height(x, 0.0) for x in (0.475, 0.525, 0.775, 0.825, 1.075, 1.125)]
    assert levels == pytest.approx([sign * n * 0.12 for n in (0, 1, 1, 2, 2, 3)])
    assert height(-0.525, 0.2) == height(0.1, 0.525) == pytest.approx(sign * 0.12)


def test_boxes_are_flat_and_within_their_height() -> None:
    height = tile("boxes", height=(0.1, 0.3), width=0.4)
    tops = np.array([[height(-1.975 + 0.4 * i, -1.975 + 0.4 * k) for i in range(10)] for k in range(10)])
    ends = np.array([[height(-1.625 + 0.4 * i, -1.625 + 0.4 * k) for i in range(10)] for k in range(10)])
    np.testing.assert_array_equal(tops, ends)
    assert len(np.unique(tops)) == 100
    assert 0.0 <= tops.min() < 0.03 and 0.27 < tops.max() <= 0.3


def test_noise_is_linear_between_its_points() -> None:
    height = tile("noise", height=(0.1, 0.3), spacing=0.2)
    a, b, c, d, e = (height(-1.975 + 0.05 * i, -1.975) for i in range(5))
    assert a != e
    assert [b, c, d] == pytest.approx([a + f * (e - a) for f in (0.25, 0.5, 0.75)])
    assert 0.0 <= a <= 0.3


def test_waves_have_their_height_and_length() -> None:
    height = tile("waves", height=(0.1, 0.2), length=1.3)
    assert height(0.325, 0.325) == pytest.approx(0.1, rel=0.01)  # a quarter of the length: the top of a hill
    assert height(-0.325, 0.325) == pytest.approx(-0.1, rel=0.01)
    assert height(1.625, 0.325) == pytest.approx(0.1, rel=0.01)


def test_gaps_have_their_width_and_depth() -> None:
    height = tile("gaps", width=(0.1, 0.2), spacing=0.6, depth=0.5)
    ditch = [x for x in np.arange(0.025, 1.4, 0.05) if height(x, 0.1) == -0.5]
    assert ditch == pytest.approx([0.825, 0.875, 0.925, 0.975])  # 0.3 m and more from the platform, 0.2 m wide
    assert {height(x, 0.1) for x in np.arange(0.025, 1.4, 0.05)} == {0.0, -0.5}


def test_levels_are_linear_and_differ_in_their_random_numbers() -> None:
    terrain = Terrain(of(boxes=HEIGHT | {"width": 0.2}, waves=HEIGHT | {"length": 0.5}))
    n, margin = 40, 20
    assert terrain.heights.shape == (2 * n + 2 * margin, 3 * n + 2 * margin)
    inner = terrain.heights[margin:-margin, margin:-margin]
    boxes, waves = ([row[:, i * n : (i + 1) * n] for i in range(3)] for row in (inner[:n], inner[n:]))
    assert [np.ptp(wave) for wave in waves] == pytest.approx([0.1, 0.15, 0.2], rel=0.03)
    assert abs(np.corrcoef(boxes[0].ravel(), boxes[2].ravel())[0, 1]) < 0.3
    np.testing.assert_array_equal(
        terrain.heights, Terrain(of(boxes=HEIGHT | {"width": 0.2}, waves=HEIGHT | {"length": 0.5})).heights
    )
    assert not terrain.heights[:margin].any()


def test_robots_start_on_a_flat_platform() -> None:
    terrain = Terrain(of(boxes=HEIGHT | {"width": 0.2}, stairs_up={"rise": (0.05, 0.1), "tread": 0.2}))
    ground = Ground(terrain, torch.device("cpu"))
    for kind in range(2):
        for level in range(3):
            x, y, z = terrain.origins[kind, level]
            assert (x, y) == (2.0 * (level - 1), 2.0 * (kind - 0.5))
            around = torch.tensor([[-0.15, -0.15], [0.15, -0.1], [0.0, 0.15], [0.0, 0.0]])
            np.testing.assert_allclose(ground.height(around[:, 0] + x, around[:, 1] + y), z, atol=1e-6)
            assert ground.height(torch.tensor(x + 0.5), torch.tensor(y)).item() != pytest.approx(z, abs=1e-3)


def test_the_height_is_that_of_the_engine_s_surface(robot: Robot) -> None:
    terrain = Terrain(of(noise=HEIGHT | {"spacing": 0.1}, stairs_down={"rise": (0.05, 0.1), "tread": 0.2}))
    standing, ground = robot.on(terrain), Ground(terrain, torch.device("cpu"))
    model = standing.model
    data, geom = mujoco.MjData(model), np.zeros(1, np.int32)
    mujoco.mj_forward(model, data)
    half_x, half_y = terrain.half_extent
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (500, 2)) * [half_x, half_y]
    up = [
        5.0 - mujoco.mj_ray(model, data, np.array([x, y, 5.0]), np.array([0.0, 0.0, -1.0]), None, 1, robot.trunk_id, geom)
        for x, y in points[np.abs(points).max(1) > 0.3]  # beside the robot
    ]
    x, y = torch.tensor(points[np.abs(points).max(1) > 0.3]).float().T
    assert np.ptp(up) > 0.3
    np.testing.assert_allclose(ground.height(x, y), up, atol=1e-5)


def test_a_robot_on_other_ground_is_the_same_robot(robot: Robot) -> None:
    terrain = Terrain(of(boxes=HEIGHT | {"width": 0.2}))
    rough = robot.on(terrain)
    assert rough.terrain is terrain and robot.terrain is None
    floor, plane = rough.model.geom("floor"), robot.model.geom("floor")
    assert (floor.type[0], plane.type[0]) == (mujoco.mjtGeom.mjGEOM_HFIELD, mujoco.mjtGeom.mjGEOM_PLANE)
    for name in ("friction", "condim", "priority", "contype", "conaffinity", "solref", "solimp", "matid"):
        np.testing.assert_array_equal(getattr(floor, name), getattr(plane, name))
    np.testing.assert_array_equal(rough.model.body_mass, robot.model.body_mass)
    back = rough.on(None)
    assert back.terrain is None and back.model.geom("floor").type[0] == mujoco.mjtGeom.mjGEOM_PLANE
    assert robot.on(None) is robot


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"size": 2.03}, "a tile of 2.03 m must be a multiple of the resolution 0.05 m"),
        ({"platform": 2.0}, "larger than its platform of 2.0 m"),
        ({"start_level": (0, 3)}, r"terrain.start_level must be below terrain.levels, 3, got \[0, 3\]"),
    ],
)
def test_sizes_that_do_not_fit_are_told(change: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        Terrain(replace(of(boxes=HEIGHT | {"width": 0.2}), **change))


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("terrain.types={box: {}}", "terrain.types.box: unknown terrain 'box'; did you mean 'boxes'"),
        ("terrain.types={boxes: {height: [0, 0.1]}}", "field 'terrain.types.boxes.width' has no value"),
        ("terrain.types={boxes: {height: [0, 0.1], width: 0}}", "terrain.types.boxes.width must be > 0 m, got 0"),
    ],
)
def test_a_wrong_type_of_terrain_is_told(override: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        load_task("telebip_flat", [override])


def test_worlds_are_spread_over_types_and_levels(make_env: MakeEnv) -> None:
    env = make_env(*ROUGH, num_envs=12)
    tiles = env.state.tile.tolist()
    assert tiles == [[i % 3, i // 3 % 3] for i in range(12)]
    terrain = env.robot.terrain
    assert terrain is not None
    where = torch.as_tensor(terrain.origins)[env.state.tile[:, 0], env.state.tile[:, 1]].float()
    at_home = torch.tensor(env.robot.home_qpos[:3]).float()
    assert (env.sim.state.base_pos - where - at_home)[:, :2].abs().max() < 1e-5
    assert (env.view().base_height - at_home[2]).abs().max() < 0.02  # the joints' random offsets lift it


def test_an_episode_ends_with_a_time_out_where_the_robot_leaves_its_tile(make_env: MakeEnv) -> None:
    env = make_env(*ROUGH, NEVER_FALL, "episode.length=10", "events.push=null", num_envs=6)
    qpos = env.sim.state.qpos.clone()
    qpos[1, 0] += 0.51  # beyond half a tile
    qpos[2, 1] -= 0.51
    qpos[3, :2] += 0.4  # further away than half a tile, but on it
    env.sim.reset(torch.ones(6, dtype=torch.bool), qpos, torch.zeros(6, 12))
    _, _, dones, extras = env.step(torch.zeros(6, 6))
    assert dones.tolist() == extras["time_outs"].tolist() == [False, True, True, False, False, False]
    ground = env.world.ground
    assert ground is not None
    assert ground.distance(env.sim.state.base_pos, env.state.tile)[1:3].max() < 1e-5  # it starts in the middle again


def test_a_fall_is_a_fall_relative_to_the_ground(make_env: MakeEnv) -> None:
    env = make_env(
        "terrain.types={slope_down: {angle: [0.3, 0.3]}}", "terrain.start_level=[0,0]", "events.push=null", num_envs=4
    )
    qpos = env.sim.state.qpos.clone()
    ground = env.world.ground
    assert ground is not None
    qpos[:, 0] += 1.5  # 1 m down the slope: 0.31 m lower
    low = ground.height(qpos[:, 0], qpos[:, 1])
    assert (qpos[:, 2] - low).min() > 0.9
    qpos[:2, 2] = low[:2] + 0.45
    qpos[2:, 2] = low[2:] + 0.35
    env.sim.reset(torch.ones(4, dtype=torch.bool), qpos, torch.zeros(4, 12))
    _, _, dones, extras = env.step(torch.zeros(4, 6))
    assert dones.tolist() == [False, False, True, True]
    assert not extras["time_outs"].any()


def test_resuming_on_rough_ground_is_exact(make_env: MakeEnv) -> None:
    actions = random_actions(60, 6, scale=0.5)
    one, other = make_env(*ROUGH, num_envs=6), make_env(*ROUGH, "seed=7", num_envs=6)
    for action in actions[:30]:
        one.step(action)
    levels = one.state.tile.clone()
    assert not torch.equal(levels, other.state.tile)  # some have gone up or down
    other.load_state_dict(one.state_dict())
    for action in actions[30:]:
        same(one.step(action), other.step(action))
    same(one.state.tile, other.state.tile)


def test_levels_are_logged_by_type(make_env: MakeEnv) -> None:
    env = make_env(*ROUGH, num_envs=9)
    _, _, _, extras = env.step(torch.zeros(9, 6))
    tile = env.state.tile
    for kind, name in enumerate(("boxes", "stairs_up", "slope_down")):
        assert extras["log"][f"terrain/{name}_level"].item() == pytest.approx(tile[tile[:, 0] == kind, 1].float().mean().item())
    assert not any(name.startswith("terrain/") for name in make_env(num_envs=1).log_names)


def test_tracking_is_measured_on_flat_ground(robot: Robot) -> None:
    from telebip.eval.conditions import as_evaluated, on_flat_ground

    config = as_evaluated(on_flat_ground(load_task("telebip_rough")), 2, 1.0)
    env = TelebipEnv(config, robot.on(Terrain(of(boxes=HEIGHT | {"width": 0.2}))))
    assert env.world.ground is None
    assert env.robot.model.geom("floor").type[0] == mujoco.mjtGeom.mjGEOM_PLANE


def test_the_type_of_terrain_in_the_documentation_works() -> None:
    text = (ROOT / "docs" / "terrain.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    exec(code, {"__name__": "mine"})
    try:
        config = load_task(
            "telebip_flat", ["terrain.types.ridge={height: [0.1, 0.2]}", "terrain.levels=2", "terrain.start_level=[0,1]"]
        )
        heights = Terrain(config.terrain).heights
        margin, n = 20, 120
        easy, hard = heights[margin:-margin, margin : margin + n], heights[margin:-margin, margin + n : margin + 2 * n]
        assert (np.ptp(easy), np.ptp(hard)) == pytest.approx((0.1, 0.2))
    finally:
        del TERMS["terrain"]["ridge"]
