"""What `env.step` records as CUDA graphs can be recorded: one step's operators, replayed without Python, make all others."""

import gc
import subprocess
import sys
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torch.utils import _pytree as pytree
from torch.utils._python_dispatch import TorchDispatchMode
from worlds import EVENTFUL, MORE_EVENTFUL, ROUGH, put_low, random_actions

from telebip import ROOT
from telebip.config import load_task
from telebip.env import TelebipEnv
from telebip.graph import CudaGraph, no_garbage_collection
from telebip.robot import Robot, load_robot
from telebip.sim import indexed

TASKS = pytest.mark.parametrize("task", [EVENTFUL, MORE_EVENTFUL, ROUGH], ids=["eventful", "more eventful", "rough"])


class Recording(TorchDispatchMode):
    """What a CUDA graph is, for tensors on a CPU: operators with the memory that they read and write, and nothing else."""

    def __init__(self) -> None:
        super().__init__()
        self.has_run = True  # on a CPU, recording runs what it records
        self.calls: list[tuple[Any, Any, Any, Any]] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        self.calls.append((func, args, kwargs or {}, result))
        return result

    def replay(self) -> None:
        """Run the operators again, each on the memory it had."""
        if self.has_run:
            self.has_run = False
            return
        for func, args, kwargs, result in self.calls:
            again = func(*args, **kwargs)
            for old, new in zip(_tensors(result), _tensors(again), strict=True):
                if old.data_ptr() != new.data_ptr():  # neither a view nor written in place
                    old.copy_(new)


def _tensors(value: Any) -> list[Tensor]:
    values = value if isinstance(value, (tuple, list)) else [value]
    return [x for x in values if isinstance(x, Tensor)]


class ReplayedOnCpu(CudaGraph):
    """A `CudaGraph` of operators instead of kernels."""

    def _record(self) -> Any:
        with Recording() as recording:
            result = self._function()
        return recording, result


def replayed(env: TelebipEnv) -> TelebipEnv:
    """Let `env` record and replay its steps, as on CUDA."""
    env._is_recorded = True
    env._fault_recorder._may_ask = False
    env._before_physics, env._after_physics = (
        ReplayedOnCpu(function, env.device, env.generator) for function in (env._prepare_step, env._finish_step)
    )
    return env


def same(obs: TensorDict, obs_2: TensorDict) -> None:
    assert set(obs.keys()) == set(obs_2.keys())
    for group in obs.keys():  # noqa: SIM118 (a TensorDict iterates over its rows)
        assert torch.equal(obs[group], obs_2[group])


@pytest.mark.parametrize(("task", "keep_final_obs"), [(EVENTFUL, False), (MORE_EVENTFUL, True)])
def test_a_recorded_step_makes_every_later_step(robot: Robot, task: tuple[str, ...], keep_final_obs: bool) -> None:
    config = load_task("telebip_flat", ["num_envs=6", *task])
    plain, env = (TelebipEnv(config, robot, "cpu", "warp", keep_final_obs) for _ in range(2))
    env = replayed(env)
    seen = {"fallen": 0, "timed out": 0, "faults": 0}
    for number, action in enumerate(random_actions(60, 6, 0.7)):
        if number == 20:
            action[2] = torch.nan
        if number == 30:
            for each in (plain, env):
                put_low(each, [1])
        if number == 40:
            for each in (plain, env):
                each.set_command(0.6, 0.0, 0.1)
                each.set_samples(3e6)
                each.push(torch.tensor([20.0, 0.0, -5.0]))
        (obs, rewards, dones, extras), (obs_2, rewards_2, dones_2, extras_2) = plain.step(action), env.step(action)
        same(obs, obs_2)
        assert torch.equal(rewards, rewards_2)
        assert torch.equal(dones, dones_2)
        assert torch.equal(extras["time_outs"], extras_2["time_outs"])
        assert extras["log"] == extras_2["log"]
        if keep_final_obs:
            same(extras["final_obs"], extras_2["final_obs"])
        seen["fallen"] += int((dones & ~extras["time_outs"]).sum())
        seen["timed out"] += int(extras["time_outs"].sum())
        seen["faults"] += int(extras["log"]["fault/worlds"])
    assert min(seen.values()) > 0
    for (name, value), (_, value_2) in zip(plain.state.items(), env.state.items(), strict=True):
        assert torch.equal(value, value_2), name
    for name, field in plain.sim.model_fields.items():
        assert torch.equal(field, env.sim.model_fields[name]), name
    fault, fault_2 = plain.take_faults()["non_finite_action"], env.take_faults()["non_finite_action"]
    assert int(fault["step"]) == int(fault_2["step"]) == 21
    assert int(fault["world"]) == int(fault_2["world"]) == 2


@TASKS
def test_a_recorded_step_goes_on_from_a_state(robot: Robot, task: tuple[str, ...]) -> None:
    config = load_task("telebip_flat", ["num_envs=3", *task])
    first, second = (replayed(TelebipEnv(config, robot, "cpu", "warp")) for _ in range(2))
    actions = random_actions(12, 3)
    for action in actions[:8]:
        first.step(action)
    second.step(actions[0])
    second.step(actions[0])
    second.load_state_dict(first.state_dict())
    for action in actions[8:]:
        same(first.step(action)[0], second.step(action)[0])


def test_what_a_recorded_step_returned_is_not_written_to_again(robot: Robot) -> None:
    env = replayed(TelebipEnv(load_task("telebip_flat", ["num_envs=3"]), robot, "cpu", "warp"))
    env.step(torch.zeros(3, 6))
    obs, rewards, _, extras = env.step(torch.zeros(3, 6))
    kept = obs["policy"].clone(), rewards.clone(), {name: value.clone() for name, value in extras["log"].items()}
    env.step(torch.ones(3, 6))
    assert torch.equal(obs["policy"], kept[0])
    assert torch.equal(rewards, kept[1])
    assert extras["log"] == kept[2]


def brought_in(recording: Recording) -> list[tuple[str, int]]:
    """Each operator's tensors that no operator before has made, by the operator's name and where they lie in memory."""
    made: set[int] = set()
    brought = []
    for func, args, kwargs, result in recording.calls:
        for tensor in _tensors(pytree.tree_leaves((args, kwargs))):
            place = tensor.untyped_storage().data_ptr()
            if place not in made:
                brought.append((str(func), place))
        made.update(tensor.untyped_storage().data_ptr() for tensor in _tensors(result))
    return brought


NAMED = (
    "events.load={term: mass, scale: [0.9, 1.1], bodies: [left_foot, trunk]}",
    "events.joints={term: model_field, field: dof_damping, range: [0.9, 1.1], names: [left_knee, right_knee]}",
    "events.shift={term: model_field, field: body_ipos, range: [-0.01, 0.01], operation: add, names: [trunk], column: 0}",
)


@pytest.mark.parametrize(
    ("task", "overrides"),
    [
        ("telebip_flat", EVENTFUL),
        ("telebip_flat", (*MORE_EVENTFUL, *NAMED)),
        ("telebip_real", ("episode.length=0.1",)),
        ("tests/robots/four_joints.yaml", ()),
    ],
    ids=["eventful", "more eventful", "all that is randomised", "joints that do not lie side by side"],
)
def test_a_step_brings_nothing_new_from_the_host(task: str, overrides: tuple[str, ...]) -> None:
    """As a list as an index or torch.tensor would, which no recording on CUDA can: all that is there was there before."""
    config = load_task(task, ["num_envs=2", *overrides])
    env = TelebipEnv(config, load_robot(config.sim.robot), "cpu", "warp")
    env.step(torch.zeros(2, env.num_actions))
    for function in (env._prepare_step, env._finish_step):
        with Recording() as first:
            function()
        with Recording() as second:
            function()
        assert brought_in(first) == brought_in(second)

    with Recording() as first:
        torch.zeros(3)[[0, 2]]
    with Recording() as second:
        torch.zeros(3)[[0, 2]]
    assert brought_in(first) != brought_in(second)  # this is how it would be seen


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@TASKS
def test_on_cuda_the_graphs_do_what_the_functions_do(robot: Robot, task: tuple[str, ...]) -> None:
    """Sums in another order round differently, and contacts let that grow; within 15 steps it stays below 1e-3."""
    plain, env = (
        TelebipEnv(load_task("telebip_flat", ["num_envs=64", *task, f"sim.cuda_graph={graph}"]), robot, "cuda", "warp")
        for graph in ("false", "true")
    )
    for action in random_actions(15, 64, 0.3).cuda():
        (obs, rewards, dones, extras), (obs_2, rewards_2, dones_2, extras_2) = plain.step(action), env.step(action)
        for group in plain.groups:
            torch.testing.assert_close(obs[group], obs_2[group], atol=1e-3, rtol=0.0)
        torch.testing.assert_close(rewards, rewards_2, atol=1e-3, rtol=0.0)
        assert torch.equal(dones, dones_2)
        assert extras["log"].keys() == extras_2["log"].keys()
    assert int(env.state.num_steps) == 15
    assert torch.equal(plain.generator.get_state(), env.generator.get_state())


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@TASKS
def test_on_cuda_the_graphs_give_the_functions_bits(robot: Robot, task: tuple[str, ...]) -> None:
    """Replayed kernels are the same kernels: with sums in a fixed order nothing differs, on another stream neither."""
    plain, env = (
        TelebipEnv(
            load_task("telebip_flat", ["num_envs=64", *task, "sim.deterministic=true", f"sim.cuda_graph={graph}"]),
            robot,
            "cuda",
            "warp",
        )
        for graph in ("false", "true")
    )
    stream = torch.cuda.Stream()
    for number, action in enumerate(random_actions(40, 64, 0.7).cuda()):
        obs, rewards, dones, _ = plain.step(action)
        torch.cuda.synchronize()
        with torch.cuda.stream(stream if number >= 20 else torch.cuda.default_stream()):
            obs_2, rewards_2, dones_2, _ = env.step(action)
        torch.cuda.synchronize()
        same(obs, obs_2)
        assert torch.equal(rewards, rewards_2)
        assert torch.equal(dones, dones_2)
    for (name, value), (_, value_2) in zip(plain.state.items(), env.state.items(), strict=True):
        assert torch.equal(value, value_2), name


def test_no_garbage_is_collected_while_a_recording_lasts() -> None:
    for before in (False, True):
        gc.enable() if before else gc.disable()
        with pytest.raises(KeyError), no_garbage_collection():
            assert not gc.isenabled()
            raise KeyError
        assert gc.isenabled() == before


READS_BACK = """
import torch
from telebip.config import load_task
from telebip.env import TelebipEnv
from telebip.robot import load_robot

env = TelebipEnv(load_task("telebip_flat", ["num_envs=4"]), load_robot("assets/telebip.xml"), "cuda", "warp")
env._rewards["cmd"] = lambda step: step.action.sum(1) * step.action.sum().item()
for _ in range(2):
    env.step(torch.zeros(4, 6, device="cuda"))
"""


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_reward_that_reads_back_is_refused_with_what_to_do() -> None:
    """In a process of its own, which a recording that broke off leaves unfit for others."""
    done = subprocess.run([sys.executable, "-c", READS_BACK], cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert "RuntimeError: the step cannot be recorded as a CUDA graph." in done.stderr
    assert "sim.cuda_graph=false" in done.stderr


def test_cuda_without_a_number_is_the_current_device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 2)
    assert indexed(torch.device("cuda")) == torch.device("cuda:2")
    assert indexed(torch.device("cuda:1")) == torch.device("cuda:1")
    assert indexed(torch.device("cpu")) == torch.device("cpu")
