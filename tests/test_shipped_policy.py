"""The policies that come with the repository walk as docs/results.md says."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from telebip import ROOT
from telebip.config import load_task, parse_config
from telebip.env import TelebipEnv
from telebip.eval.conditions import as_evaluated, on_flat_ground
from telebip.eval.walk import summarise
from telebip.rl.checkpoint import load_checkpoint
from telebip.rl.curve import read_curve
from telebip.rl.policy import load_policy
from telebip.robot import Robot
from telebip.rollout import Rollout, roll_out
from telebip.rollout import walk as walking
from telebip.sim import Backend

SPEEDS = (0.5, 0.7, 1.0)  # m/s
SHIPPED = sorted(folder.name for folder in (ROOT / "assets" / "policies").iterdir())
OTHERWISE = {
    "telebip_robust": "the last of three trainings with pushes of other sizes",
    "telebip_slow": "of the time when it learned as telebip_flat does",
    "telebip_fast": "of the time when it learned as telebip_flat does",
    "telebip_backward": "of the time when it learned as telebip_flat does",
    "no_foot_reward": "of the time when it learned as telebip_flat does",
    "period_06": "of the time when it learned as telebip_flat does",
}
"""Policies that are yet to be trained anew, and why they are not of the task of their name."""

OTHERS = {
    "telebip_efficient": (0.7, 0.702),
    "telebip_robust": (0.7, 0.676),
    "period_06": (0.7, 0.677),
    "telebip_slow": (0.7, 0.662),
    "telebip_fast": (1.0, 0.998),
    "telebip_backward": (-0.3, -0.334),
    "telebip_rough": (0.7, 0.672),
    "telebip_stairs": (0.7, 0.718),
    "telebip_real": (0.7, 0.712),
    "telebip_omni": (0.7, 0.703),
}
"""Commanded and published mean speed [m/s]."""
SLOW = ("telebip_efficient", "period_06", "telebip_rough", "telebip_stairs", "telebip_real")
PERIODS = {**dict.fromkeys(SLOW, 0.6), "telebip_omni": 0.24}
"""Periods of the gaits where they are not 0.5 s [s]; `telebip_omni` steps faster than its clock (docs/omnidirectional.md)."""


def walk(
    robot: Robot, *speeds: float, worlds: int, seconds: float, backend: Backend = "native", policy: str = "telebip_flat"
) -> Rollout:
    """Walk `worlds` of a shipped policy at each speed, without disturbances and from random initial velocities."""
    checkpoint = load_checkpoint(ROOT / "assets" / "policies" / policy)
    config = as_evaluated(on_flat_ground(checkpoint.config), len(speeds) * worlds, seconds)
    env = TelebipEnv(config, robot, "cpu", backend)
    env.set_commands(torch.tensor([[speed, 0.0, 0.0] for speed in speeds]).repeat_interleave(worlds, dim=0))
    return roll_out(env, load_policy(checkpoint, "cpu"), round(seconds / env.step_dt))


@pytest.fixture(scope="module")
def at_all_speeds(robot: Robot) -> Rollout:
    return walk(robot, *SPEEDS, worlds=4, seconds=10.0)


@pytest.mark.parametrize("speed", SPEEDS)
def test_it_walks_at_the_commanded_speed(at_all_speeds: Rollout, speed: float) -> None:
    first = 4 * SPEEDS.index(speed)
    summary = summarise(at_all_speeds.select(slice(first, first + 4)), skip=5.0)
    assert summary.falls == 0
    assert summary.speed[0] == pytest.approx(speed, rel=0.05)
    assert summary.gait_period == pytest.approx(0.5, rel=0.02)


@pytest.mark.parametrize("policy", OTHERS)
def test_the_others_walk_as_fast_as_published(robot: Robot, policy: str) -> None:
    command, published = OTHERS[policy]
    summary = summarise(walk(robot, command, worlds=4, seconds=8.0, policy=policy), skip=4.0)
    assert summary.falls == 0
    assert summary.speed[0] == pytest.approx(published, rel=0.03)
    assert summary.gait_period == pytest.approx(PERIODS.get(policy, 0.5), rel=0.02)


@pytest.mark.parametrize("policy", [name for name in OTHERS if name.startswith("telebip_")])
def test_they_call_themselves_by_their_names(policy: str) -> None:
    assert load_checkpoint(policy).task == policy


@pytest.mark.parametrize("policy", OTHERS)
def test_their_learning_curves_are_whole(policy: str) -> None:
    curve = read_curve(ROOT / "assets" / "policies" / policy)
    assert [row["iteration"] for row in curve] == list(range(1, len(curve) + 1))
    assert curve[-1]["samples"] == pytest.approx(load_checkpoint(policy).samples, rel=1e-4)


@pytest.mark.parametrize(
    ("policy", "name", "params"),
    [
        ("telebip_rough", "boxes", {"height": (0.1, 0.1), "width": 0.4}),
        ("telebip_rough", "slope_up", {"angle": (0.35, 0.35)}),
        ("telebip_rough", "waves", {"height": (0.1, 0.1), "length": 1.0}),
        ("telebip_stairs", "stairs_up", {"rise": (0.08, 0.08), "tread": 0.3}),
        ("telebip_stairs", "boxes", {"height": (0.16, 0.16), "width": 0.4}),
    ],
)
def test_policies_for_rough_ground_leave_their_tile_on_foot(
    robot: Robot, policy: str, name: str, params: dict[str, Any]
) -> None:
    """At 0.5 m/s, 3 m to the edge take 6 s."""
    checkpoint = load_checkpoint(policy)
    terrain = replace(checkpoint.config.terrain, types={name: params}, levels=1, start_level=(0, 0))
    env = TelebipEnv(as_evaluated(replace(checkpoint.config, terrain=terrain), 16, 10.0), robot)
    env.set_command(0.5, 0.0, 0.0)
    left, fell = np.zeros(16, bool), np.zeros(16, bool)
    for _, stride in zip(range(375), walking(env, load_policy(checkpoint, "cpu")), strict=False):
        time_outs = stride.extras["time_outs"].numpy()
        fell |= stride.dones.numpy() & ~time_outs & ~left
        left |= time_outs & ~fell
    assert left.sum() >= 15


def test_its_feet_take_turns(robot: Robot) -> None:
    feet = walk(robot, 0.7, worlds=2, seconds=6.0).foot_force[150:]
    right, left = (feet[..., foot] > 20.0 for foot in range(2))  # N: the foot carries weight
    assert np.mean(right & left) < 0.25
    assert 0.8 < right.sum() / left.sum() < 1.25
    shifted = np.roll(feet[..., 1], 12, axis=0)  # half a period is 12.5 steps
    assert np.corrcoef(feet[12:, :, 0].ravel(), shifted[12:].ravel())[0, 1] > 0.5


@pytest.mark.slow
def test_it_walks_on_the_other_engine_too(robot: Robot) -> None:
    summary = summarise(walk(robot, 0.7, worlds=4, seconds=6.0, backend="warp"), skip=3.0)
    assert summary.falls == 0
    assert summary.speed[0] == pytest.approx(0.7, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("speed", SPEEDS)
def test_sixty_four_worlds_walk_twenty_seconds(robot: Robot, speed: float) -> None:
    summary = summarise(walk(robot, speed, worlds=64, seconds=20.0), skip=5.0)
    assert summary.falls == 0
    assert summary.speed[0] == pytest.approx(speed, rel=0.05)
    assert summary.yaw_drift_deg < 10.0
    assert summary.gait_period == pytest.approx(0.5, rel=0.02)


@pytest.mark.parametrize("policy", SHIPPED)
def test_each_comes_from_the_task_of_its_name(policy: str) -> None:
    """`train.py --task NAME --seed S` makes it, but for those of `OTHERWISE`, which must really differ."""
    folder = ROOT / "assets" / "policies" / policy
    trained = parse_config((folder / "config.yaml").read_text(encoding="utf-8"), policy)
    assert load_checkpoint(policy).config == trained
    task = replace(load_task(policy), seed=trained.seed)
    assert (trained != task) == (policy in OTHERWISE)
