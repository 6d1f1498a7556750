# pyright: reportAttributeAccessIssue=false
"""The physics engines alone: the steps that an environment asked of them, without what goes in and comes out."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from telebip.env import TelebipEnv
from telebip.tools.measuring import Stopwatch


@dataclass(frozen=True)
class EngineCall:
    """Where the worlds were when the engine was called, and with what; copies."""

    memory: dict[str, Tensor]
    model_fields: dict[str, Tensor]
    targets: Tensor
    wrench_w: Tensor


@contextmanager
def recorded(env: TelebipEnv) -> Iterator[tuple[list[Tensor], list[EngineCall]]]:
    """Note down the actions of each `env.step`, and its call of the engine."""
    actions: list[Tensor] = []
    calls: list[EngineCall] = []
    step, sim_step = env.step, env.sim.step

    def noted_step(given: Tensor):
        actions.append(given.clone())
        return step(given)

    def noted_sim_step(targets: Tensor, wrench_w: Tensor):
        memory, fields = ({name: x.clone() for name, x in part.items()} for part in (env.sim.memory, env.sim.model_fields))
        calls.append(EngineCall(memory, fields, targets.clone(), wrench_w.clone()))
        return sim_step(targets, wrench_w)

    env.step, env.sim.step = noted_step, noted_sim_step
    try:
        yield actions, calls
    finally:
        del env.step, env.sim.step


class BareEngine:
    """The engine of an environment, called directly: `Batch.step` or, on `warp`, `mujoco_warp.step`, on CUDA as a graph."""

    def __init__(self, env: TelebipEnv) -> None:
        """Take the engine out of `env`."""
        self._sim, self._steps, self._device = env.sim, env.cfg.sim.decimation, env.device
        self._trunk = int(env.sim.model.jnt_bodyid[0])
        make = _native if env.sim.backend == "native" else _warp
        self._ctrl, self._xfrc, self._warnings, self._run = make(env.sim, self._steps)

    def seconds(self, calls: Sequence[EngineCall]) -> float:
        """Take the steps of `calls` again, each from its own beginning; return how long the engine took [s]."""
        watch = Stopwatch(self._device)
        for call in calls:
            self.prepare(call)
            watch.time(self.run)
        self._warnings.zero_()  # the environment has seen them
        return watch.seconds()

    def prepare(self, call: EngineCall) -> None:
        """Put the worlds where `call` began."""
        sim = self._sim
        for name, value in call.model_fields.items():
            sim.model_fields[name].copy_(value)
        if call.model_fields:
            sim.refresh_constants(torch.ones(sim.num_envs, dtype=torch.bool, device=sim.device))
        sim.load(call.memory)
        self._ctrl.copy_(call.targets if call.targets.dim() == 2 else call.targets[:, 0])  # physics_delay: the first for all
        self._xfrc[:, self._trunk].copy_(call.wrench_w)

    def run(self) -> None:
        """Take the physics steps of one policy step."""
        self._run()


def _native(sim: Any, steps: int) -> tuple:
    ctrl, xfrc = (torch.from_numpy(sim.batch.bind(name)) for name in ("ctrl", "xfrc_applied"))
    return ctrl, xfrc, torch.from_numpy(sim.batch.warning), lambda: sim.batch.step(nstep=steps)


def _warp(sim: Any, steps: int) -> tuple:
    import mujoco_warp as mjw
    import warp as wp

    from telebip.sim.warp import EngineGraph

    model, data = sim.mjw_model, sim.mjw_data
    device = wp.device_from_torch(sim.device)

    def launch() -> None:
        with wp.ScopedDevice(device):
            for _ in range(steps):
                mjw.step(model, data)

    run = EngineGraph(launch, sim.device) if device.is_cuda else launch
    ctrl, xfrc, overflow = (wp.to_torch(array) for array in (data.ctrl, data.xfrc_applied, data.overflow))
    return ctrl, xfrc, overflow, run


def compiled_kernel_modules() -> int:
    """Return how many modules of kernels Warp has compiled on this machine and keeps for later processes."""
    import warp as wp

    wp.init()
    return sum(path.is_dir() for path in Path(wp.config.kernel_cache_dir or "").glob("*"))
