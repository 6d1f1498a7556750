"""Where the time of a training iteration goes, in stages: physics engine, environment, collection, learning.

A round measures every stage on the same stretch of walking, one after the other in one process: a slow moment of the machine
hits them all, and their ratios hold where times do not. It first walks the stretch unmeasured and notes down the actions, and
the worlds and inputs from which every engine step starts. The stages then go over it again, from the same worlds:

    engine      the engine alone takes the steps that were noted down: same states, contacts, targets, pushes and frictions
    env         `env.step` with the actions that were noted down
    collect     policy, `env.step` and storage, as in training
    learn       returns and update; the weights are put back afterwards, so that every round walks alike

and, where rsl-rl's own PPO is measured too, `stock_collect` and `stock_learn`, from the same weights and random numbers. On
CUDA the device's own clock counts, and the device is waited for at the two ends of a stage alone, never in between.
"""

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import torch

from telebip.config import TaskConfig, load_task
from telebip.env import TelebipEnv
from telebip.errors import UserError, is_out_of_memory
from telebip.rl.checkpoint import POLICIES, Checkpoint, load_checkpoint
from telebip.rl.policy import require_fit
from telebip.rl.train import Trainer
from telebip.robot import Robot
from telebip.sim import Backend
from telebip.tools.engines import BareEngine, recorded
from telebip.tools.measuring import Stopwatch, allocated_bytes

WARM_UP = 2.0
"""How long the robots walk before anything is measured [s]."""

Seconds = dict[str, float]

COLUMNS: dict[str, tuple[str, Callable[[float], str]]] = {
    "worlds": ("num_envs", "{:d}".format),
    "engine": ("engine_env_steps_per_s", "{:.0f}".format),
    "env": ("env_env_steps_per_s", "{:.0f}".format),
    "env/engine": ("env_over_engine", "{:.3f}".format),
    "collect": ("collect_env_steps_per_s", "{:.0f}".format),
    "learn": ("learn_env_steps_per_s", "{:.0f}".format),
    "train": ("train_env_steps_per_s", "{:.0f}".format),
    "train/stock": ("train_over_stock", "{:.2f}".format),
    "bytes/world": ("bytes_per_env", "{:d}".format),
}
"""Heading of the printed table -> field of a row, and how it is written."""


class Stages:
    """The stages for one number of worlds, in which a trained policy walks."""

    def __init__(
        self,
        cfg: TaskConfig,
        robot: Robot,
        device: torch.device,
        backend: Backend,
        checkpoint: Checkpoint,
        with_stock: bool = False,
    ) -> None:
        """Create the worlds and let them walk.

        Args:
            cfg: the task; `num_envs` is the number of worlds.
            robot: from `telebip.robot.load_robot(cfg.sim.robot)`.
            device: where to measure.
            backend: physics engine, see `telebip.sim.make_simulator`.
            checkpoint: of the policy that walks.
            with_stock: whether rsl-rl's own PPO is measured too.

        Raises:
            UserError: the policy does not fit the task.
        """
        before = allocated_bytes(device)
        self.env = env = TelebipEnv(cfg, robot, device, backend)
        require_fit(checkpoint, env)
        self._trainer = Trainer(env, "", Path())
        actor = self._trainer.learner.actor
        try:
            actor.load_state_dict(checkpoint.policy_weights)
        except (RuntimeError, KeyError) as error:
            raise UserError(f"checkpoint '{checkpoint.path}' holds no weights that fit the task's policy") from error
        self._weights = copy.deepcopy(self._trainer.learner.save())
        self._trainer.learner.train_mode()
        self._iteration(self._trainer)  # allocates what an iteration needs
        self.bytes_per_env = (allocated_bytes(device) - before) / cfg.num_envs
        self._stock = Trainer(env, "", Path(), algorithm="ppo") if with_stock else None
        if self._stock:
            self._stock.learner.train_mode()
        self._engine = BareEngine(env)
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
    def arithmetic(self) -> str:
        """What the networks compute in, with rsl-rl's PPO too."""
        return self._trainer.arithmetic

    def round(self) -> Seconds:
        """Measure every stage once, and walk on."""
        env, learner = self.env, self._trainer.learner
        self._restore(self._trainer)
        start, seed = env.state_dict(), torch.seed()
        with recorded(env) as (actions, calls), torch.inference_mode():
            self._trainer.collect(self._trainer.view.get_observations())
        learner.storage.clear()
        seconds = {"engine": self._engine.seconds(calls)}
        calls.clear()
        env.load_state_dict(start)
        with torch.inference_mode():
            seconds["env"] = self._timed(lambda: [env.step(action)[2] for action in actions])
        trainers = {"stock_": self._stock, "": self._trainer} if self._stock else {"": self._trainer}
        for prefix, trainer in trainers.items():
            env.load_state_dict(start)
            torch.manual_seed(seed)
            seconds |= {f"{prefix}{stage}": value for stage, value in self._iteration(trainer).items()}
        return seconds

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


def measure(
    cfg: TaskConfig,
    robot: Robot,
    device: torch.device,
    backend: Backend,
    checkpoint: Checkpoint,
    rounds: int,
    with_stock: bool = False,
    progress: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Return a row of the benchmark's table, ready for JSON: `summary`, bytes, and every round's seconds.

    Measured are `rounds` rounds of `Stages`, after a slower one that is not; `progress` is called after each of them.

    Raises:
        UserError: the policy does not fit the task, or the worlds do not fit the memory.
    """
    try:
        stages = Stages(cfg, robot, device, backend, checkpoint, with_stock)
        seconds = []
        for _ in range(rounds + 1):
            seconds.append(stages.round())
            progress()
    except Exception as error:
        if not is_out_of_memory(error):
            raise
        raise UserError(f"{cfg.num_envs} worlds do not fit into the memory of {device}") from error
    return {
        "backend": stages.env.sim.backend,
        "device": str(device),
        "num_envs": cfg.num_envs,
        "arithmetic": stages.arithmetic,
        **summary(seconds[1:], stages.batch),
        "bytes_per_env": round(stages.bytes_per_env),
        "env_steps_per_round": stages.batch,
        "rounds_s": seconds[1:],
    }


def summary(rounds: list[Seconds], batch: int) -> dict[str, float]:
    """Return a table row of rounds of `batch` environment steps each: medians over the rounds of rates and of ratios."""

    def rate(*stages: str) -> float:
        return batch / median(sum(seconds[stage] for stage in stages) for seconds in rounds)

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


def configurations(
    task: str | None, checkpoint: Checkpoint, overrides: Sequence[str], num_envs: Sequence[int]
) -> list[TaskConfig]:
    """Return the task, or the checkpoint's where none is named, for several numbers of worlds.

    Raises:
        UserError: it wants half of the gait to be learned, and the checkpoint knows all of it, or the other way round.
    """
    config = load_task(task or checkpoint.config, overrides)
    if config.ppo.symmetry != checkpoint.config.ppo.symmetry:
        raise UserError(
            f"checkpoint '{checkpoint.path}' has ppo.symmetry={checkpoint.config.ppo.symmetry}, and task "
            f"'{task or checkpoint.task}' has {config.ppo.symmetry}; choose a --checkpoint that was trained like the task"
        )
    return [replace(config, num_envs=number) for number in num_envs]


def shipped_for(task: str | None, overrides: Sequence[str]) -> Checkpoint:
    """Return the policy of `assets/policies` that walks in a task: its own, or one that learned as much of the gait."""
    symmetry = load_task(task or "telebip_flat", overrides).ppo.symmetry
    for name in (Path(task or "").stem, "telebip_flat"):
        if (POLICIES / name / "policy.pt").is_file():
            checkpoint = load_checkpoint(POLICIES / name)
            if checkpoint.config.ppo.symmetry == symmetry:
                return checkpoint
    return load_checkpoint(POLICIES / "telebip_efficient")


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the rows as text, a column for each of `COLUMNS` that they have."""
    columns = {heading: (field, form) for heading, (field, form) in COLUMNS.items() if field in rows[0]}
    lines = [list(columns), *([form(row[field]) for field, form in columns.values()] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in lines)
