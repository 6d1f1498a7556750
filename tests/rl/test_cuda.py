"""Training on a GPU, end to end: `pytest -m gpu` on a machine that has one."""

import math
import warnings
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from telebip.config import load_task
from telebip.env import TelebipEnv
from telebip.rl.checkpoint import load_checkpoint
from telebip.rl.train import Trainer
from telebip.robot import Robot
from telebip.tools.benchmark import measure
from telebip.tools.race import RACERS, race

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")]

SMALL = ("num_envs=64", "ppo.num_steps_per_env=10", "ppo.hidden_dims=[64,64]", "episode.length=0.4")


def trainer(robot: Robot, run_dir: Path, iterations: int) -> Trainer:
    config = load_task("telebip_flat", [*SMALL, f"ppo.max_iterations={iterations}"])
    return Trainer(TelebipEnv(config, robot, "cuda", "auto"), "telebip_flat", run_dir)


def test_a_run_goes_on_from_its_checkpoint(robot: Robot, tmp_path: Path) -> None:
    first = trainer(robot, tmp_path, 2)
    first.learn(stop=lambda: False, report=lambda scalars: None)
    second = trainer(robot, tmp_path, 4)
    assert second.resume(load_checkpoint(tmp_path)) == ""
    scalars = []
    second.learn(stop=lambda: False, report=scalars.append)
    assert (second.iteration, second.samples) == (4, 4 * 64 * 10)
    assert all(math.isfinite(value) for row in scalars for value in row.values())
    assert all(row["fault/worlds"] == 0.0 for row in scalars)


def test_a_rollout_never_waits_for_the_device(robot: Robot, tmp_path: Path) -> None:
    running = trainer(robot, tmp_path, 1)
    running.iterate()  # records the graphs
    running.iterate()
    with torch.inference_mode():
        obs = running.view.get_observations()
        torch.cuda.set_sync_debug_mode("error")
        try:
            running.collect(obs)
        finally:
            torch.cuda.set_sync_debug_mode("default")


def test_an_update_waits_for_the_device_once_at_its_end(robot: Robot, tmp_path: Path) -> None:
    """For its losses; the learning rate adapts on the device, and Adam is the fused one."""
    running = trainer(robot, tmp_path, 1)
    running.iterate()
    with torch.inference_mode():
        obs, _ = running.collect(running.view.get_observations())
        running.learner.compute_returns(obs)
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            running.learner.update()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    waits = [str(warning.message) for warning in caught if "synchronizing CUDA operation" in str(warning.message)]
    assert len(waits) == 1
    assert all(group["fused"] and group["lr"].is_cuda for group in running.learner.optimizer.param_groups)


def test_the_same_seed_trains_the_same_policy_bit_for_bit(robot: Robot, tmp_path: Path) -> None:
    config = load_task("telebip_flat", [*SMALL, "sim.deterministic=true", "ppo.max_iterations=3"])
    weights = []
    for _ in range(2):
        running = Trainer(TelebipEnv(config, robot, "cuda", "auto"), "telebip_flat", tmp_path)
        for _ in range(3):
            running.iterate()
        weights.append({name: value.clone() for name, value in running.learner.get_policy().state_dict().items()})
    for name, value in weights[0].items():
        assert torch.equal(value, weights[1][name]), name


def test_a_policy_acts_alike_on_both_devices(robot: Robot) -> None:
    checkpoint = load_checkpoint("telebip_flat")
    actions = []
    for device in ("cuda", "cpu"):
        env = TelebipEnv(load_task(checkpoint.config, ["num_envs=16"]), robot, device, "auto")
        actor = Trainer(env, "", Path()).learner.actor
        actor.load_state_dict(checkpoint.learner["actor_state_dict"])
        obs = torch.linspace(-1.0, 1.0, 16 * 33, device=device).view(16, 33)
        with torch.inference_mode():
            actions.append(actor(TensorDict({"policy": obs}, batch_size=[16])).cpu())
    torch.testing.assert_close(actions[0], actions[1], atol=1e-4, rtol=0.0)


def test_the_benchmark_measures(robot: Robot) -> None:
    config, checkpoint = load_task("telebip_flat", ["num_envs=64", "ppo.num_steps_per_env=5"]), load_checkpoint("telebip_flat")
    row = measure(config, robot, torch.device("cuda:0"), "auto", checkpoint, rounds=2, with_stock=True)
    assert (row["backend"], row["device"]) == ("warp", "cuda:0")
    assert all(value > 0.0 for seconds in row["rounds_s"] for value in seconds.values())


def test_a_race_goes_to_its_end(robot: Robot) -> None:
    result = race(load_task("telebip_flat", SMALL), robot, torch.device("cuda:0"), "auto", 1280)
    assert result["samples"] == [640, 1280]
    assert all(math.isfinite(value) for name in RACERS for value in result[name]["episode_return"])
