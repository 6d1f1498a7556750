"""A training that is watched: what the viewer gets, and that the training does not notice."""

import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr
import torch

from telebip.config import load_task
from telebip.env import TelebipEnv
from telebip.rl.train import Trainer
from telebip.robot import Robot
from telebip.viz.live import LiveView
from telebip.viz.scene import LANE

chunk = pytest.importorskip("rerun.chunk")

SMALL = ("num_envs=8", "ppo.num_steps_per_env=10", "ppo.hidden_dims=[16,16]", "ppo.max_iterations=3")


def make_trainer(robot: Robot, run_dir: Path, task: str = "telebip_flat") -> Trainer:
    run_dir.mkdir()
    return Trainer(TelebipEnv(load_task(task, SMALL), robot, "cpu", "native"), task, run_dir)


def watch(
    robot: Robot, run_dir: Path, budget: float, task: str = "telebip_flat"
) -> tuple[Trainer, list[dict[str, float]], dict[str, list[Any]]]:
    """Train, watched through a file; return the trainer, what was reported, and rows of (entity, columns) by entity."""
    trainer, reports, file = make_trainer(robot, run_dir, task), [], run_dir / "live.rrd"
    stream = rr.RecordingStream("test")
    stream.save(file)
    view = LiveView(trainer, stream, budget)

    def report(scalars: dict[str, float]) -> None:
        view.update(scalars)
        reports.append(scalars)
        time.sleep(0.3)  # for a few frames of the walk

    trainer.learn(stop=lambda: False, report=report)
    view.close()
    stream.disconnect()
    entities: dict[str, list[Any]] = {}
    for part in chunk.RrdReader(file).stream():
        batch = part.to_record_batch()
        shown = [name for name in batch.schema.names if name not in ("log_time", "time")]  # in ns, which datetime lacks
        entities.setdefault(part.entity_path, []).extend(batch.select(shown).to_pylist())
    return trainer, reports, entities


def test_the_viewer_gets_curves_and_robots_that_move(robot: Robot, tmp_path: Path) -> None:
    _, reports, entities = watch(robot, tmp_path / "run", budget=1.0)
    for name in ("train/action_std", "reward/cmd", "loss/value"):
        rows = entities[f"/training/{name}"]
        assert [row["samples"] for row in rows] == [80, 160, 240]
        np.testing.assert_allclose([row["Scalars:scalars"][0] for row in rows], [report[name] for report in reports])
    frames = [row for row in entities["/world/right_foot"] if row.get("InstancePoses3D:translations")]
    places = np.array([row["InstancePoses3D:translations"] for row in frames])
    assert len(frames) >= 5
    assert places.shape[1:] == (4, 3)
    np.testing.assert_allclose(np.diff(places[0, :, 1]), -0.9, atol=0.2)  # side by side
    assert np.ptp(places[:, :, 2], axis=0).max() > 0.001
    assert {row["samples"] for row in frames} <= {0, 80, 160, 240}
    assert any("Mesh3D:vertex_positions" in row for row in entities["/world/trunk"])


def test_robots_on_a_terrain_stand_on_strips_of_their_tiles(robot: Robot, tmp_path: Path) -> None:
    _, _, entities = watch(robot, tmp_path / "run", budget=1.0, task="telebip_rough")
    frames = [row for row in entities["/world/right_foot"] if row.get("InstancePoses3D:translations")]
    feet = np.array([row["InstancePoses3D:translations"] for row in frames])
    slope_up, *_, stairs_down = strips = [strip(entities[f"/world/ground/{world}"]) for world in range(4)]
    for world, points in enumerate(strips):
        lane = LANE * (1.5 - world)
        assert abs(points[:, :2] - [0.0, lane]).max(0) == pytest.approx([3.0, 0.5 * LANE], abs=0.06)  # the nodes are 5 cm apart
        nearest = abs(feet[:, world, None, :2] - points[:, :2]).sum(2).argmin(1)
        height = feet[:, world, 2] - points[nearest, 2]  # of the middle of the foot
        assert height.min() == pytest.approx(0.026, abs=0.01) and height.max() < 0.2
    assert slope_up[:, 2].max() == pytest.approx(2.5 * math.tan(0.24), abs=0.03)  # the sixth of ten levels from 0.04 to 0.4
    assert stairs_down[:, 2].min() == pytest.approx(-9 * 0.12, abs=0.01)


def strip(rows: list[Any]) -> np.ndarray:
    """Return the nodes of a ground that was logged once [m], (nodes, 3)."""
    (points,) = (row["Mesh3D:vertex_positions"] for row in rows if row.get("Mesh3D:vertex_positions"))
    (moved,) = (row["Transform3D:translation"] for row in rows if row.get("Transform3D:translation"))
    return np.array(points) + np.array(moved[0])


def test_without_a_budget_there_is_no_walk(robot: Robot, tmp_path: Path) -> None:
    _, reports, entities = watch(robot, tmp_path / "run", budget=-1.0)
    assert len(entities["/training/reward/cmd"]) == len(reports) == 3
    assert not any(row.get("InstancePoses3D:translations") for row in entities["/world/right_foot"])


def test_a_watched_training_is_the_same_bit_for_bit(robot: Robot, tmp_path: Path) -> None:
    watched, _, _ = watch(robot, tmp_path / "watched", budget=1.0)
    alone = make_trainer(robot, tmp_path / "alone")
    alone.learn(stop=lambda: False, report=lambda scalars: None)
    for name, weight in alone.learner.get_policy().state_dict().items():
        assert torch.equal(watched.learner.get_policy().state_dict()[name], weight), name
