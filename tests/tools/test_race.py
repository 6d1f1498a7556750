"""A race trains twice as `train.py` would, and its verdict can be made by hand."""

from pathlib import Path

import pytest
import torch
from rsl_rl.algorithms import PPO

from telebip.config import load_task
from telebip.env import TelebipEnv
from telebip.rl.train import Trainer
from telebip.robot import Robot
from telebip.tools.race import RACERS, race, verdict

SMALL = ("num_envs=8", "ppo.num_steps_per_env=10", "ppo.hidden_dims=[16,16]", "episode.length=0.2", "seed=4")


def test_both_train_for_as_many_samples_as_asked_for(robot: Robot) -> None:
    rounds = []
    config = load_task("telebip_flat", SMALL)
    result = race(config, robot, torch.device("cpu"), "native", 161, lambda: rounds.append(1))
    assert result["samples"] == [80, 160, 240]
    assert len(rounds) == 3
    assert (result["seed"], result["backend"]) == (4, "native")
    for name in RACERS:
        assert set(result[name]) == {"episode_return", "episode_length", "seconds"}
        assert all(len(curve) == 3 for curve in result[name].values())
        assert all(0.0 < length <= 10.0 for length in result[name]["episode_length"])
    assert result["telebip"] != result["stock"]


@pytest.mark.usefixtures("torch_threads")
@pytest.mark.parametrize("precision", ["never", "always"])
def test_a_racer_learns_what_it_learns_alone(robot: Robot, precision: str) -> None:
    config = load_task("telebip_flat", [*SMALL, f"ppo.mixed_precision={precision}"])
    raced = race(config, robot, torch.device("cpu"), "native", 240)
    for name, algorithm in RACERS.items():
        alone = Trainer(TelebipEnv(config, robot, "cpu", "native"), "", Path(), algorithm=algorithm)
        returns = [alone.iterate()["train/episode_return"] for _ in range(3)]
        assert raced[name]["episode_return"] == returns


@pytest.mark.parametrize("precision", ["never", "always"])
def test_the_stock_racer_is_rsl_rls_own_on_the_same_networks(robot: Robot, precision: str) -> None:
    config = load_task("telebip_flat", [*SMALL, f"ppo.mixed_precision={precision}"])
    own, stock = (
        Trainer(TelebipEnv(config, robot, "cpu", "native"), "", Path(), algorithm=name).learner for name in RACERS.values()
    )
    assert type(stock) is PPO
    assert type(stock.optimizer) is torch.optim.Adam and not stock.optimizer.defaults["fused"]
    assert type(own.actor) is type(stock.actor)


def racer(last_return: float, *seconds: float) -> dict[str, list[float]]:
    return {"episode_return": [0.0, last_return], "episode_length": [1.0, 1.0], "seconds": list(seconds)}


@pytest.mark.parametrize(("stock_return", "overlap"), [(2.5, True), (4.0, True), (4.1, False), (0.9, False)])
def test_the_verdict(stock_return: float, overlap: bool) -> None:
    first = {"samples": [5, 10], "telebip": racer(1.0, 1.0, 2.0), "stock": racer(stock_return, 9.0, 6.0)}
    second = {"samples": [5, 10], "telebip": racer(4.0, 1.0, 2.0), "stock": racer(stock_return, 9.0, 4.0)}
    assert verdict([first, second]) == {
        "samples": 10,
        "episode_return": {"telebip": (1.0, 4.0), "stock": (stock_return, stock_return)},
        "overlap": overlap,
        "train_over_stock": 2.5,  # of 3 and 2: the first pairs do not count
    }
