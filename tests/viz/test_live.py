"""A training that is watched: what the viewer gets, and that the training does not notice."""

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

chunk = pytest.importorskip("rerun.chunk")

SMALL = ("num_envs=8", "ppo.num_steps_per_env=10", "ppo.hidden_dims=[16,16]", "ppo.max_iterations=3")


def make_trainer(robot: Robot, run_dir: Path) -> Trainer:
    run_dir.mkdir()
    return Trainer(TelebipEnv(load_task("telebip_flat", SMALL), robot, "cpu", "native"), "telebip_flat", run_dir)


def watch(robot: Robot, run_dir: Path, budget: float) -> tuple[Trainer, list[dict[str, float]], dict[str, list[Any]]]:
    """Train, watched through a file; return the trainer, what was reported, and rows of (entity, columns) by entity."""
    trainer, reports, file = make_trainer(robot, run_dir), [], run_dir / "live.rrd"
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
