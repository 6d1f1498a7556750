"""The evaluator: runs suites on anything that walks, and returns one table of results, ready for JSON.

`docs/evaluation.md` describes every field of the results.
"""

import dataclasses
import platform
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch

from telebip import __version__
from telebip.config import TaskConfig
from telebip.control.policy import Policy
from telebip.env import TelebipEnv
from telebip.errors import UserError, nearest
from telebip.eval.conditions import as_evaluated
from telebip.eval.gait import summarise_gait
from telebip.eval.learning import learning_curve
from telebip.eval.push import PushProtocol, push_limits, push_trial
from telebip.eval.rollout import Rollout, roll_out
from telebip.eval.walk import heading_velocity, summarise
from telebip.robot import JOINTS, Robot
from telebip.sim import Backend, choose_backend

SUITES = ("tracking", "push", "gait", "learning")
COMMANDS = (0.5, 0.7, 1.0, -0.3)
"""Forward speeds that the tracking suite asks for, where the policy was trained on them [m/s]."""

Progress = Callable[[str, int, int], None]
"""Called with what is running, the finished steps and their total."""


@dataclass(frozen=True)
class Subject:
    """What is evaluated. `make_policy` makes it anew for each environment that it is to walk in."""

    label: str
    config: TaskConfig
    make_policy: Callable[[TelebipEnv], Policy]
    limited: bool = True  # to the commands it was trained on; a model-based controller takes any
    run_dir: Path | None = None  # where its learning curve is kept
    source: str = ""  # how to measure it again: a command
    fingerprint: str = ""  # of what decides how it walks: weights, parameters
    overrides: tuple[str, ...] = ()  # of the task, which hold in the evaluator's worlds too


@dataclass(frozen=True)
class Protocol:
    """How the suites are run."""

    worlds: int = 64
    duration: float = 20.0  # s
    skip: float = 5.0  # s, left out of all means
    commands: tuple[float, ...] | None = None  # m/s; None: those of `COMMANDS` that the policy was trained on
    push: PushProtocol = field(default_factory=PushProtocol)
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    backend: Backend = "auto"


def check_suites(names: Sequence[str]) -> tuple[str, ...]:
    """Return the suites of these names in the order in which they run.

    Raises:
        UserError: there is no suite of a name.
    """
    for name in names:
        if name not in SUITES:
            raise UserError(f"unknown suite '{name}'; {nearest(name, SUITES)}")
    return tuple(name for name in SUITES if name in names)


def evaluate(
    subject: Subject,
    robot: Robot,
    suites: Sequence[str],
    protocol: Protocol,
    progress: Progress = lambda name, step, total: None,
) -> dict[str, Any]:
    """Run suites and return the results: plain numbers, texts, lists and dictionaries. Deterministic for the task's seed."""
    curve = learning_curve(subject.run_dir) if "learning" in suites and subject.run_dir else None  # first: it may be damaged
    results: dict[str, Any] = {
        "schema": "telebip-results-1",
        "label": subject.label,
        "source": subject.source,
        "fingerprint": subject.fingerprint,
        "telebip": __version__,
        "date": datetime.now().astimezone().isoformat(timespec="seconds"),
        "machine": f"{platform.machine()}, {protocol.device}",
        "engine": choose_backend(protocol.backend, protocol.device),
        "protocol": describe_protocol(subject, protocol),
    }
    if "tracking" in suites or "gait" in suites:
        walks = _walk(subject, robot, protocol, progress)
        if "tracking" in suites:
            results["tracking"] = [_tracking_row(command, walk, protocol.skip) for command, walk in walks.items()]
        command = min(walks, key=lambda speed: abs(speed - protocol.push.command))
        results["series"] = {"speed": _speed_series(walks), "feet": _feet_series(walks[command], command)}
        if "gait" in suites:
            results["gait"] = _gait(walks[command], command, protocol.skip, subject.config.gait.period)
    if "push" in suites:
        results["push"] = _push(subject, robot, protocol, progress)
    if "learning" in suites:
        results["learning"] = curve
    return results


def describe_protocol(subject: Subject, protocol: Protocol) -> dict[str, Any]:
    """Return how the walking suites are run, as results say it."""
    return {
        "worlds": protocol.worlds,
        "duration_s": protocol.duration,
        "skip_s": protocol.skip,
        "seed": subject.config.seed,
        "gait_period_s": subject.config.gait.period,
    }


def push_protocol_of(subject: Subject, protocol: Protocol) -> PushProtocol:
    """Return how the push suite is run: at a speed that the policy was trained on."""
    low, high = subject.config.command.lin_vel_x
    command = float(np.clip(protocol.push.command, low, high)) if subject.limited else protocol.push.command
    return dataclasses.replace(protocol.push, command=command)


def is_current(results: dict[str, Any], subject: Subject, suites: Sequence[str], protocol: Protocol) -> bool:
    """Whether results from a file are what `evaluate` would measure again: all of the suites, of the same, in the same way."""
    push = push_protocol_of(subject, protocol)
    pushed = {**asdict(push), "horizons": list(push.horizons)}
    return (
        set(suites) <= results.keys()
        and all(results[suite] for suite in suites if suite != "learning")  # which may be null
        and results.get("fingerprint") == subject.fingerprint
        and results.get("protocol") == describe_protocol(subject, protocol)
        and ("push" not in suites or results["push"].get("protocol") == pushed)
    )


def commands_of(subject: Subject, protocol: Protocol) -> tuple[float, ...]:
    """Return the forward speeds to ask for [m/s]."""
    if protocol.commands is not None:
        return protocol.commands
    low, high = subject.config.command.lin_vel_x
    known = tuple(c for c in COMMANDS if not subject.limited or low <= c <= high)
    return known or (round(0.5 * (low + high), 3),)


def make_env(subject: Subject, robot: Robot, protocol: Protocol, num_envs: int, duration: float) -> TelebipEnv:
    """Create worlds of the subject's task, undisturbed unless its overrides say otherwise."""
    config = as_evaluated(subject.config, num_envs, duration, subject.overrides)
    return TelebipEnv(config, robot, protocol.device, protocol.backend)


def _walk(subject: Subject, robot: Robot, protocol: Protocol, progress: Progress) -> dict[float, Rollout]:
    """Walk all commands as one batch, and return each command's worlds."""
    commands = commands_of(subject, protocol)
    env = make_env(subject, robot, protocol, len(commands) * protocol.worlds, protocol.duration)
    forward = torch.tensor(commands, device=env.device).repeat_interleave(protocol.worlds)
    env.set_commands(torch.nn.functional.pad(forward[:, None], (0, 2)))
    steps = max(1, round(protocol.duration / env.step_dt))
    rollout = roll_out(env, subject.make_policy(env), steps, lambda step: progress("walking", step, steps))
    n = protocol.worlds
    return {command: rollout.select(slice(i * n, (i + 1) * n)) for i, command in enumerate(commands)}


def _tracking_row(command: float, rollout: Rollout, skip: float) -> dict[str, Any]:
    s = summarise(rollout, skip)
    return {
        "command_mps": command,
        "mean_speed_mps": round(s.speed[0], 5),
        "ci95_mps": round(s.speed_ci95, 5),
        "rms_error_mps": round(s.lin_vel_rms_error, 5),
        "falls": s.worlds_fallen,
        "worlds": s.worlds,
        "yaw_drift_deg": round(s.yaw_drift_deg, 3),
        "cot_mechanical": round(s.cost_of_transport, 5),
        "cot_article": round(s.cost_of_transport_article, 5),
        "cot_positive": round(s.cost_of_transport_positive, 5),
        "cot_joints": {name: round(cost, 5) for name, cost in zip(JOINTS, s.joint_cost_of_transport, strict=True)},
    }


def _gait(rollout: Rollout, command: float, skip: float, clock: float) -> dict[str, float]:
    kept = rollout.after(skip)
    speed = float(heading_velocity(kept.qpos, kept.qvel)[..., 0].mean(dtype=float))
    knees = kept.qpos[..., 7:][..., [2, 5]]
    summary = summarise_gait(kept.foot_force, knees, speed, rollout.weight, rollout.step_dt, clock)
    return {"command_mps": command, **{name: round(value, 5) for name, value in asdict(summary).items()}}


def _push(subject: Subject, robot: Robot, protocol: Protocol, progress: Progress) -> dict[str, Any]:
    push = push_protocol_of(subject, protocol)
    env = make_env(subject, robot, protocol, push.num_envs, push.seconds)
    total = round(push.seconds / env.step_dt)
    name = f"pushing {push.num_envs} worlds"
    survival = push_trial(env, subject.make_policy(env), push, lambda step: progress(name, step, total))
    return {"protocol": asdict(push), **push_limits(survival, push, robot.weight)}


def _speed_series(walks: dict[float, Rollout], every: float = 0.1) -> dict[str, Any]:
    """Mean forward speed over the worlds against time, ten times a second, for each command."""
    first = next(iter(walks.values()))
    rows = max(1, round(every / first.step_dt))
    series: dict[str, Any] = {"time_s": _rounded(first.time[rows - 1 :: rows], 3)}
    for command, walk in walks.items():
        speed = heading_velocity(walk.qpos, walk.qvel)[..., 0].mean(1)
        series[f"{command:g}"] = _rounded([speed[i - rows + 1 : i + 1].mean() for i in range(rows - 1, len(speed), rows)], 4)
    return series


def _feet_series(walk: Rollout, command: float, seconds: float = 2.0) -> dict[str, Any]:
    """Foot forces of the first world in the last two seconds [body weights], with the phase signals."""
    rows = slice(-round(seconds / walk.step_dt), None)
    force = walk.foot_force[rows, 0] / walk.weight
    return {
        "command_mps": command,
        "time_s": _rounded(walk.time[rows], 3),
        "right_bw": _rounded(force[:, 0], 4),
        "left_bw": _rounded(force[:, 1], 4),
        "phase_right": _rounded(walk.phase[rows, 0, 0], 4),
    }


def _rounded(values: Any, digits: int) -> list[float]:
    return [round(float(value), digits) for value in values]
