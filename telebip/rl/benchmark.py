"""Where the time of a training iteration goes, as a ladder: physics engine, environment, collection, training.

A round measures every rung on the same stretch of walking, one after the other in one process: a slow moment of the machine
hits them all, and their ratios hold where times do not. It first walks the stretch unmeasured and notes down the actions, and
the worlds and inputs from which every engine step starts. The rungs then go over it again, from the same worlds:

    engine      the engine alone takes the steps that were noted down: same states, contacts, targets, pushes and frictions
    env         `env.step` with the actions that were noted down
    collect     policy, `env.step` and storage, as in training
    learn       returns and update; the weights are put back afterwards, so that every round walks alike

On CUDA the device's own clock counts, and the device is waited for at the two ends of a rung alone, never in between.
"""

import contextlib
import copy
import gc
import platform
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from torch import Tensor, nn

from telebip.config import TaskConfig
from telebip.env import TelebipEnv
from telebip.errors import UserError, is_out_of_memory
from telebip.rl.checkpoint import Checkpoint
from telebip.rl.train import Trainer
from telebip.robot import Robot
from telebip.sim import Backend, Simulator

WARM_UP = 2.0
"""How long the robots walk before anything is measured [s]."""

Seconds = dict[str, float]


class StockTrainer(Trainer):
    """Trains with rsl-rl's PPO as it stands, in float32."""

    def _rsl_rl_cfg(self) -> dict:
        cfg = super()._rsl_rl_cfg()
        cfg["algorithm"] |= {"class_name": PPO, "use_mixed_precision": False}
        return cfg


class Ladder:
    """The rungs for one number of worlds, in which a trained policy walks."""

    def __init__(
        self,
        cfg: TaskConfig,
        robot: Robot,
        device: torch.device,
        backend: Backend,
        checkpoint: Checkpoint,
        stock_threads: int = 0,
    ) -> None:
        """Create the worlds and let them walk.

        Args:
            cfg: the task; `num_envs` is the number of worlds.
            robot: from `telebip.robot.load_robot(cfg.sim.robot)`.
            device: where to measure.
            backend: physics engine, see `telebip.sim.make_simulator`.
            checkpoint: of the policy that walks.
            stock_threads: threads of torch with which rsl-rl's own PPO is measured too; 0 leaves it out.

        Raises:
            UserError: the policy does not fit the task.
        """
        before = allocated_bytes(device)
        self.env = env = TelebipEnv(cfg, robot, device, backend)
        self._trainer = Trainer(env, "", Path())
        actor = self._trainer.learner.actor
        try:
            actor.load_state_dict(checkpoint.learner["actor_state_dict"])
        except (RuntimeError, KeyError) as error:
            raise UserError(f"checkpoint '{checkpoint.path}' holds no weights that fit the task's policy") from error
        self._weights = copy.deepcopy(self._trainer.learner.save())
        self._trainer.learner.train_mode()
        self._iteration(self._trainer)  # allocates what an iteration needs
        self.bytes_per_env = (allocated_bytes(device) - before) / cfg.num_envs
        self._stock_threads = stock_threads
        self._stock = StockTrainer(env, "", Path()) if stock_threads else None
        if self._stock:
            self._stock.learner.train_mode()
        self._restore(self._trainer)
        with torch.inference_mode():
            obs = self._trainer.view.get_observations()
            for _ in range(round(WARM_UP / env.step_dt)):
                obs = self._trainer.view.step(actor(obs))[0]

    @property
    def batch(self) -> int:
        """Environment steps in a round."""
        return self.env.num_envs * self.env.cfg.ppo.num_steps_per_env

    @property
    def update(self) -> str:
        """Arithmetic of the update in telebip's own training."""
        return self._trainer.arithmetic

    def round(self) -> Seconds:
        """Measure every rung once, and walk on."""
        env, learner = self.env, self._trainer.learner
        self._restore(self._trainer)
        start = env.state_dict()
        seed = torch.seed()
        with recorded(env) as (actions, calls), torch.inference_mode():
            self._trainer.collect(self._trainer.view.get_observations())
        learner.storage.clear()

        engine = Stopwatch(env.device)
        for call in calls:
            call.prepare(env.sim)
            engine.time(env.sim.advance)
        seconds = {"engine": engine.seconds()}
        calls.clear()
        env.load_state_dict(start)
        with torch.inference_mode():
            seconds["env"] = self._timed(lambda: [env.step(action)[2] for action in actions])
        if self._stock:
            env.load_state_dict(start)
            torch.manual_seed(seed)
            threads = torch.get_num_threads()
            torch.set_num_threads(self._stock_threads)
            seconds |= {f"stock_{rung}": value for rung, value in self._iteration(self._stock).items()}
            torch.set_num_threads(threads)
        env.load_state_dict(start)
        torch.manual_seed(seed)
        return seconds | self._iteration(self._trainer)

    def _iteration(self, trainer: Trainer) -> Seconds:
        """Run one training iteration from the policy's weights; return how long collecting and learning took."""
        learner = trainer.learner
        self._restore(trainer)
        with torch.inference_mode():
            obs = trainer.view.get_observations()

            def collect() -> None:
                nonlocal obs
                obs = trainer.collect(obs)[0]

            collect_seconds = self._timed(collect)

        def learn() -> None:
            with torch.inference_mode():
                learner.compute_returns(obs)
            learner.update()

        return {"collect": collect_seconds, "learn": self._timed(learn)}

    def _restore(self, trainer: Trainer) -> None:
        """Give a learner the weights of the policy that walks, as before any update."""
        trainer.learner.load(copy.deepcopy(self._weights), load_cfg=None, strict=True)

    def _timed(self, function: Callable[[], Any]) -> float:
        """Return how long a call took, from an idle device on [s]."""
        watch = Stopwatch(self.env.device)
        watch.time(function)
        return watch.seconds()


class Stopwatch:
    """Adds up how long calls take: on CUDA how long the device does, between events that it passes on its way."""

    def __init__(self, device: torch.device) -> None:
        """Wait until `device` is idle."""
        self._device, self._seconds = device, 0.0
        self._events: list[tuple[torch.cuda.Event, torch.cuda.Event]] = []
        self._synchronize()

    def time(self, function: Callable[[], Any]) -> None:
        """Call `function`, and count it."""
        if self._device.type != "cuda":
            start = time.perf_counter()
            function()
            self._seconds += time.perf_counter() - start
            return
        before, after = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        stream = torch.cuda.current_stream(self._device)
        before.record(stream)
        function()
        after.record(stream)
        self._events.append((before, after))

    def seconds(self) -> float:
        """Return the sum [s]."""
        self._synchronize()
        return self._seconds + sum(before.elapsed_time(after) for before, after in self._events) / 1000.0

    def _synchronize(self) -> None:
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)


def measure(
    cfg: TaskConfig,
    robot: Robot,
    device: torch.device,
    backend: Backend,
    checkpoint: Checkpoint,
    rounds: int,
    stock_threads: int = 0,
    progress: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Return a row of the benchmark's table, ready for JSON: `summary`, bytes, and every round's seconds.

    Measured are `rounds` rounds of a `Ladder`, after a slower one that is not; `progress` is called after each of them.

    Raises:
        UserError: the policy does not fit the task, or the worlds do not fit the memory.
    """
    try:
        ladder = Ladder(cfg, robot, device, backend, checkpoint, stock_threads)
        seconds = []
        for _ in range(rounds + 1):
            seconds.append(ladder.round())
            progress()
    except Exception as error:
        if not is_out_of_memory(error):
            raise
        raise UserError(f"{cfg.num_envs} worlds do not fit into the memory of {device}") from error
    return {
        "backend": ladder.env.sim.backend,
        "device": str(device),
        "num_envs": cfg.num_envs,
        "update": ladder.update,
        **summary(seconds[1:], ladder.batch),
        "bytes_per_env": round(ladder.bytes_per_env),
        "env_steps_per_round": ladder.batch,
        "rounds_s": seconds[1:],
    }


def summary(rounds: list[Seconds], batch: int) -> dict[str, float]:
    """Return a table row of rounds of `batch` environment steps each: medians over the rounds of rates and of ratios."""

    def rate(*rungs: str) -> float:
        return batch / median(sum(seconds[rung] for rung in rungs) for seconds in rounds)

    row = {
        "engine_env_steps_per_s": rate("engine"),
        "env_env_steps_per_s": rate("env"),
        "env_over_engine": median(seconds["engine"] / seconds["env"] for seconds in rounds),
        "collect_env_steps_per_s": rate("collect"),
        "learn_env_steps_per_s": rate("learn"),
        "train_env_steps_per_s": rate("collect", "learn"),
    }
    if "stock_learn" in rounds[0]:
        row["stock_train_env_steps_per_s"] = rate("stock_collect", "stock_learn")
        row["train_over_stock"] = median(
            (seconds["stock_collect"] + seconds["stock_learn"]) / (seconds["collect"] + seconds["learn"]) for seconds in rounds
        )
    return row


@dataclass(frozen=True)
class EngineCall:
    """Where the worlds were when the engine was called, and with what; copies."""

    memory: dict[str, Tensor]
    model_fields: dict[str, Tensor]
    targets: Tensor
    wrench_w: Tensor

    def prepare(self, sim: Simulator) -> None:
        """Put `sim` into the same state, so that `sim.advance` does the same again."""
        sim.load(self.memory)
        for name, value in self.model_fields.items():
            sim.model_fields[name].copy_(value)
        sim.write(self.targets, self.wrench_w)


@contextmanager
def recorded(env: TelebipEnv) -> Iterator[tuple[list[Tensor], list[EngineCall]]]:
    """Note down the actions of each `env.step`, and its call of the engine."""
    walked: list[Tensor] = []
    calls: list[EngineCall] = []
    step, advance = env.step, env.sim.step

    def env_step(actions: Tensor):
        walked.append(actions.clone())
        return step(actions)

    def sim_step(targets: Tensor, wrench_w: Tensor):
        memory, fields = ({name: x.clone() for name, x in part.items()} for part in (env.sim.memory, env.sim.model_fields))
        calls.append(EngineCall(memory, fields, targets.clone(), wrench_w.clone()))
        return advance(targets, wrench_w)

    env.step, env.sim.step = env_step, sim_step
    try:
        yield walked, calls
    finally:
        del env.step, env.sim.step


def allocated_bytes(device: torch.device) -> int:
    """Return the bytes that stay allocated on `device`: what its tensors cover, on CUDA all that is not free."""
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()
        free, total = torch.cuda.mem_get_info(device)
        return total - free
    kinds = (Tensor, nn.Parameter)  # torch's stand-ins for tensors, as exports leave them, have no memory
    storages = [x.untyped_storage() for x in gc.get_objects() if type(x) in kinds and x.device == device]
    covered = end = 0
    for low, high in sorted((s.data_ptr(), s.data_ptr() + s.nbytes()) for s in storages):  # views of one array overlap
        covered += max(0, high - max(low, end))
        end = max(end, high)
    return covered


def machine_name(device: torch.device) -> str:
    """Return what the device calls itself."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    with contextlib.suppress(OSError):  # Linux; elsewhere platform knows
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
        if names:
            return names[0]
    return platform.processor() or platform.machine()
