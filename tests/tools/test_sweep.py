"""A sweep trains as `train.py` would, and its verdict can be made by hand."""

from pathlib import Path

import torch

from telebip.config import load_task
from telebip.env import TelebipEnv
from telebip.rl.train import Trainer
from telebip.robot import Robot
from telebip.tools.sweep import CURVES, train_once, verdict

SMALL = (
    *("num_envs=8", "ppo.num_steps_per_env=10", "ppo.hidden_dims=[16,16]", "episode.length=0.2", "seed=4"),
    "ppo.max_iterations=11",
)


def test_a_training_is_that_of_the_trainer_alone(robot: Robot) -> None:
    config, seen = load_task("telebip_flat", SMALL), []
    result = train_once("telebip_flat", config, robot, torch.device("cpu"), "native", True, lambda *args: seen.append(args))
    alone = Trainer(TelebipEnv(config, robot, "cpu", "native"), "", Path())
    rows = [alone.iterate() for _ in range(11)]
    for name, key in CURVES.items():
        assert [value for value in result[name] if value is not None] == [row[key] for row in rows if row[key] == row[key]]
    assert result["samples"] == [80 * i for i in range(1, 12)]
    assert result["seconds"] == sorted(result["seconds"])
    assert (result["seed"], result["walks"], len(result["looks"])) == (4, None, 1)
    assert result["looks"][0][0] == 800 and result["looks"][0][1].startswith("falls after 0.")
    assert seen[-1] == ("training", 11, 11)
    assert "tracking" not in result


def whole(seconds: float | None, speeds: tuple[float, float], costs: tuple[float, float], falls: int) -> dict:
    rows = [
        {"command_mps": command, "mean_speed_mps": speed, "cot_mechanical": cost, "falls": falls}
        for command, speed, cost in zip((0.5, 1.0), speeds, costs, strict=True)
    ]
    walks = seconds and {"seconds": seconds, "samples": 1000.0 * seconds}
    return {"walks": walks, "seconds": [1.0, 90.0], "tracking": rows}


def test_the_verdict_is_median_and_worst() -> None:
    first = whole(20.0, (0.5, 0.98), (0.2, 0.1), 0)
    second = whole(30.0, (0.45, 1.0), (0.3, 0.1), 1)
    third = whole(None, (0.5, 1.0), (0.1, 0.1), 0)
    found = verdict([first, second, third])
    assert (found["seeds"], found["walked"], found["falls"]) == (3, 2, 2)
    assert found["seconds"] == (30.0, None) and found["samples"] == (30_000.0, None)
    assert [round(x, 9) for x in found["speed_error"]] == [0.02, 0.1]
    assert [round(x, 9) for x in found["cost_of_transport"]] == [0.15, 0.2]
    assert found["end_seconds"] == (90.0, 90.0)
    assert verdict([third, third])["seconds"] == (None, None)
