"""Trainings side by side, as processes: they are stopped with checkpoints, gone on with, and say what went wrong."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from telebip.cli.trainings import Run, default_jobs, train_all
from telebip.config import load_task
from telebip.rl.checkpoint import load_checkpoint

TINY = ("num_envs=8", "ppo.num_steps_per_env=5", "ppo.hidden_dims=[16,16]", "ppo.num_mini_batches=1")


def make_run(folder: Path, seed: int, *overrides: str) -> Run:
    own = (*TINY, *overrides)
    return Run("telebip_quick", seed, replace(load_task("telebip_quick", own), seed=seed), folder, own)


def test_a_stop_leaves_checkpoints_and_the_same_call_goes_on_to_the_same_policy(tmp_path: Path) -> None:
    whole = make_run(tmp_path / "whole", 1, "ppo.max_iterations=60")
    said: list[str] = []
    assert train_all([whole], 1, "cpu", lambda: False, said.append, lambda at_work: None) == []
    assert whole.is_finished
    assert whole.samples() == whole.total == 60 * 40
    run = make_run(tmp_path / "stopped", 1, "ppo.max_iterations=60")
    is_asked = False

    def show(at_work: Sequence[Run]) -> None:
        nonlocal is_asked
        is_asked |= any(run.samples() >= 80 for run in at_work)

    stopped = make_run(tmp_path / "stopped", 1, "ppo.max_iterations=60")
    assert train_all([stopped], 1, "cpu", lambda: is_asked, said.append, show) == []
    assert stopped.run_dir and list(stopped.run_dir.glob("model_*.pt"))
    assert train_all([run], 1, "cpu", lambda: False, said.append, lambda at_work: None) == []
    assert run.is_finished
    assert run.run_dir == stopped.run_dir
    for name, value in load_checkpoint(str(run.run_dir)).policy_weights.items():
        torch.testing.assert_close(value, load_checkpoint(str(whole.run_dir)).policy_weights[name], rtol=0.0, atol=0.0)


def test_one_that_fails_is_named_with_its_log_and_the_others_go_on(tmp_path: Path) -> None:
    good, bad = make_run(tmp_path, 1, "ppo.max_iterations=2"), make_run(tmp_path, 2, "ppo.max_iterations=2")
    bad.overrides = ("ppo.max_iterations=many",)
    said: list[str] = []
    seen: set[str] = set()
    failed = train_all(
        [bad, good], 2, "cpu", lambda: False, said.append, lambda at_work: seen.update(run.name for run in at_work)
    )
    assert failed == [bad]
    assert good.is_finished
    (line,) = [line for line in said if "failed" in line]
    assert line.startswith(f"telebip_quick, seed 2: training failed (exit status 2), see {bad.log}: error: ")
    assert "'many'" in line
    assert seen == {"telebip_quick, seed 1", "telebip_quick, seed 2"}


def test_a_run_of_another_configuration_is_not_gone_on_with(tmp_path: Path) -> None:
    run = make_run(tmp_path, 1, "ppo.max_iterations=1")
    train_all([run], 1, "cpu", lambda: False, lambda line: None, lambda at_work: None)
    assert make_run(tmp_path, 1, "ppo.max_iterations=1").run_dir == run.run_dir
    assert make_run(tmp_path, 1, "ppo.max_iterations=1", "gait.period=0.7").run_dir is None


def test_how_many_side_by_side() -> None:
    assert default_jobs("cpu") in (1, 2)
    assert default_jobs("cuda") == 1
