"""The benchmark measures what it says: every stage goes over the same walk."""

from itertools import pairwise

import pytest
import torch
from torch import Tensor
from worlds import MakeEnv, put_low, random_actions

from telebip.config import load_task
from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.rl.checkpoint import load_checkpoint
from telebip.robot import Robot
from telebip.tools import benchmark
from telebip.tools.benchmark import Stages, summary
from telebip.tools.engines import BareEngine, recorded
from telebip.tools.measuring import allocated_bytes


@pytest.mark.parametrize("backend", ["native", "warp"])
def test_a_recorded_walk_can_be_gone_over_again(make_env: MakeEnv, backend: str) -> None:
    env = make_env("events.push.interval=[0.02,0.06]", num_envs=8, backend=backend)
    put_low(env, [2])  # it falls at the first step, and starts anew
    start = env.state_dict()
    with recorded(env) as (actions, calls):
        walked = [env.step(action)[0]["policy"] for action in random_actions(6, 8, 0.3)]
    assert (len(actions), len(calls)) == (6, 6)
    assert "step" not in vars(env) and "step" not in vars(env.sim)

    env.load_state_dict(start)
    again = [env.step(action)[0]["policy"] for action in actions]
    assert all(torch.equal(a, b) for a, b in zip(walked, again, strict=True))

    others = [0, 1, 3, 4, 5, 6, 7]  # worlds that are not reset go from each call of the engine to the next
    engine = BareEngine(env)
    for call, following in pairwise(calls):
        engine.prepare(call)
        engine.run()
        for name, value in env.sim.memory.items():
            assert torch.equal(value[others], following.memory[name][others]), name


@pytest.mark.usefixtures("torch_threads")
@pytest.mark.parametrize("precision", ["never", "always"])
def test_every_stage_takes_the_same_actions(robot: Robot, monkeypatch: pytest.MonkeyPatch, precision: str) -> None:
    walked: list[Tensor] = []
    step = TelebipEnv.step

    def noted(env: TelebipEnv, actions: Tensor):
        walked.append(actions.clone())
        return step(env, actions)

    monkeypatch.setattr(TelebipEnv, "step", noted)
    own = (f"ppo.mixed_precision={precision}", "ppo.num_steps_per_env=10", "ppo.learning_rate=0.01")
    config = load_task("telebip_flat", ["num_envs=8", *own])
    stages = Stages(config, robot, torch.device("cpu"), "native", load_checkpoint("telebip_flat"), with_stock=True)
    assert stages.arithmetic == ("float32" if precision == "never" else "bfloat16")
    for _ in range(2):
        walked.clear()
        stages.round()
        recording, *others = (torch.stack(walked[i : i + 10]) for i in range(0, 40, 10))
        assert len(others) == 3  # env, stock, collect
        for stage in others:
            assert torch.equal(stage, recording)


def test_the_summary_is_made_of_medians_over_the_rounds() -> None:
    rounds = [
        {"engine": 1.0, "env": 2.0, "collect": 3.0, "learn": 1.0, "stock_collect": 4.0, "stock_learn": 4.0},
        {"engine": 1.0, "env": 1.0, "collect": 2.0, "learn": 2.0, "stock_collect": 4.0, "stock_learn": 2.0},
        {"engine": 9.0, "env": 10.0, "collect": 10.0, "learn": 10.0, "stock_collect": 10.0, "stock_learn": 10.0},
    ]
    assert summary(rounds, 60) == {
        "engine_env_steps_per_s": 60.0,
        "env_env_steps_per_s": 30.0,
        "env_over_engine": 0.9,  # of 0.5, 1 and 0.9
        "collect_env_steps_per_s": 20.0,
        "learn_env_steps_per_s": 30.0,
        "train_env_steps_per_s": 15.0,
        "stock_train_env_steps_per_s": 7.5,
        "train_over_stock": 1.5,
    }
    assert "train_over_stock" not in summary([{"engine": 1.0, "env": 1.0, "collect": 1.0, "learn": 1.0}], 1)


def test_bytes_are_counted_once() -> None:
    cpu = torch.device("cpu")
    before = allocated_bytes(cpu)
    array = torch.zeros(1000, 30).numpy()  # 4 bytes each
    views = [torch.from_numpy(array[:, part]) for part in (slice(0, 20), slice(10, 30))]
    assert allocated_bytes(cpu) - before == 120_000
    del views, array
    assert allocated_bytes(cpu) == before


@pytest.mark.parametrize("backend", ["native", "warp"])
def test_a_step_leaves_no_memory_behind(make_env: MakeEnv, backend: str) -> None:
    env = make_env("episode.length=0.06", num_envs=16, backend=backend)
    held = []
    for _ in range(3):
        for action in random_actions(5, 16):
            env.step(action)
        del action
        held.append(allocated_bytes(torch.device("cpu")))
    assert held[0] == held[1] == held[2]


@pytest.mark.parametrize(
    ("raised", "seen"),
    [
        (torch.OutOfMemoryError("CUDA out of memory"), UserError),
        (RuntimeError("Failed to allocate 400 bytes on device 'cuda:0'"), UserError),  # as Warp says it
        (RuntimeError("something else"), RuntimeError),
    ],
    ids=["torch", "warp", "other"],
)
def test_worlds_that_do_not_fit_are_told_from_other_errors(
    robot: Robot, monkeypatch: pytest.MonkeyPatch, raised: RuntimeError, seen: type[Exception]
) -> None:
    def no_stages(*args: object) -> Stages:
        raise raised

    monkeypatch.setattr(benchmark, "Stages", no_stages)
    config, cpu = load_task("telebip_flat", ["num_envs=8"]), torch.device("cpu")
    with pytest.raises(seen, match="8 worlds do not fit" if seen is UserError else "something else"):
        benchmark.measure(config, robot, cpu, "native", load_checkpoint("telebip_flat"), 1)
