"""What a training does about faults: it dumps the first of each kind, and stops for too many of them or for ruined networks."""

import math
import shlex
from collections.abc import Callable
from pathlib import Path

import torch
from rsl_rl.algorithms import PPO

from telebip.env import TelebipEnv
from telebip.replay import describe, fault_file, save_fault

Note = Callable[[str], None]
"""Tells the user something in a line."""


def dump_new_faults(env: TelebipEnv, task: str, run_dir: Path, note: Note) -> None:
    """Write the first fault of each kind to the run's folder, unless an earlier one is there, and tell of it."""
    for kind, record in env.take_faults().items():
        said, file = env.sim.advice.get(kind, ""), fault_file(run_dir, kind)
        where = env.broken_reward() if kind == "non_finite_reward" else describe(record)
        try:
            if file.exists():
                dumped = f"not dumped, as {file} holds an earlier one"
            else:
                dumped = f"dumped, for play --replay {quoted(save_fault(run_dir, kind, record, task, env))}"
        except OSError as error:
            dumped = f"cannot be dumped: {error.strerror or error}"
        note(f"fault: {kind}, {where}{f' ({said})' if said else ''}; {dumped}")


def quoted(path: Path) -> str:
    """Return a path as it can be pasted into a shell, from any working directory."""
    return shlex.quote(str(path.absolute()))


def too_many_faults(env: TelebipEnv, counts: dict[str, float], run_dir: Path) -> str:
    """Return why a training must stop after a rollout with these numbers of faults, as the environment logs them, or ""."""
    cfg = env.cfg.ppo
    if counts["fault/capacity"] > 0.0:
        return (
            f"contacts or constraints did not fit, {int(counts['fault/capacity'])} times; {env.sim.advice['capacity']}, "
            f"then go on with --resume {quoted(run_dir)}"
        )
    rate = counts["fault/worlds"] / (env.num_envs * cfg.num_steps_per_env)
    if rate <= cfg.max_fault_rate:
        return ""
    if broken := env.broken_reward():
        return f"{broken}, and not finite {int(counts['fault/non_finite_reward'])} times in all: look at that term"
    kinds = {name.removeprefix("fault/"): int(count) for name, count in counts.items() if count}
    found = ", ".join(f"{count} {kind}" for kind, count in kinds.items() if kind != "worlds")
    return (
        f"{rate:.2g} faulty worlds per environment step ({found}), more than ppo.max_fault_rate={cfg.max_fault_rate:g}; saved "
        f"{run_dir}; repeat a step with play --replay {quoted(run_dir / 'faults')}/<kind>.pt"
    )


def ruined_networks(learner: PPO, losses: dict[str, float], run_dir: Path) -> str:
    """Return why a training must stop whose update has made the networks non-finite, or ""; their weights are not saved."""
    parameters = [p for network in (learner.actor, learner.critic) for p in network.parameters()]
    if torch.stack([p.isfinite().all() for p in parameters]).all() and all(map(math.isfinite, losses.values())):
        return ""
    advice = "start again with a lower ppo.learning_rate"
    if any(run_dir.glob("model_*.pt")):
        advice = f"go on from the last checkpoint with a lower ppo.learning_rate: --resume {quoted(run_dir)}"
    return f"made the networks non-finite (losses {losses}); {advice}"
