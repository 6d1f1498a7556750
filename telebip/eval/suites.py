"""The evaluator: runs suites on anything that walks, and returns results ready for JSON (fields: `docs/evaluation.md`)."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from datetime import datetime
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch

from telebip import __version__
from telebip.config import TaskConfig, load_task, to_yaml
from telebip.control.factory import with_estimate
from telebip.control.policy import Policy
from telebip.env import TelebipEnv
from telebip.errors import UserError, nearest
from telebip.eval.conditions import SPEEDS, as_evaluated, forward_commands, on_flat_ground, trained_speeds
from telebip.eval.energy import energy
from telebip.eval.gait import summarise_gait
from telebip.eval.learning import learning_curve
from telebip.eval.omni import OmniProtocol, omni_results
from telebip.eval.push import PushProtocol, push_limits
from telebip.eval.terrain import TerrainProtocol, on_test_ground, terrain_results
from telebip.eval.transfer import TransferProtocol, transfer_results
from telebip.eval.walk import heading_velocity, summarise
from telebip.rl.run import machine_name, read_starts
from telebip.robot import Robot
from telebip.rollout import Rollout, roll_out
from telebip.sim import Backend, choose_backend

SCHEMA = "telebip-results-2"
SUITES = ("tracking", "push", "gait", "learning", "omni", "terrain", "transfer")
Progress = Callable[[str, int, int], None]  # called with what is running, the finished steps and their total


@dataclass(frozen=True)
class Candidate:
    """What is evaluated. `make_policy` makes it anew for each environment that it is to walk in."""

    label: str
    config: TaskConfig  # without the `overrides`
    make_policy: Callable[[TelebipEnv], Policy]
    is_model_based: bool = False  # then it takes any command, and reads the group of observations "estimate"
    run_dir: Path | None = None  # where its learning curve is kept
    source: str = ""  # how to measure it again: a command
    fingerprint: str = ""  # of what decides how it walks: weights, parameters
    overrides: tuple[str, ...] = ()  # of the task, which hold in the evaluator's worlds too

    @cached_property
    def task(self) -> TaskConfig:
        """The task with its overrides, as it is without the evaluator's conditions."""
        return load_task(self.config, self.overrides)


@dataclass(frozen=True)
class Protocol:
    """How the suites are run."""

    worlds: int = 64
    duration: float = 20.0  # s
    skip: float = 5.0  # s, left out of all means
    commands: tuple[float, ...] | None = None  # m/s; None: those of `SPEEDS` that the policy was trained on
    push: PushProtocol = field(default_factory=PushProtocol)
    omni: OmniProtocol = field(default_factory=OmniProtocol)
    terrain: TerrainProtocol = field(default_factory=TerrainProtocol)
    transfer: TransferProtocol = field(default_factory=TransferProtocol)
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    backend: Backend = "auto"


def check_suites(names: Sequence[str]) -> tuple[str, ...]:
    """Return the suites of these names in the order in which they run; a UserError tells of one that is unknown."""
    for name in names:
        if name not in SUITES:
            raise UserError(f"unknown suite '{name}'; {nearest(name, SUITES)}")
    return tuple(name for name in SUITES if name in names)


def evaluate(
    candidate: Candidate, robot: Robot, suites: Sequence[str], protocol: Protocol, progress: Progress = lambda *args: None
) -> dict[str, Any]:
    """Run suites and return the results: plain numbers, texts, lists and dictionaries. Deterministic for the task's seed."""
    run_dir = candidate.run_dir if "learning" in suites else None
    curve = learning_curve(run_dir) if run_dir else None  # first: it may be damaged
    results: dict[str, Any] = {
        "schema": SCHEMA,
        "label": candidate.label,
        "source": candidate.source,
        "fingerprint": candidate.fingerprint,
        "telebip": __version__,
        "date": datetime.now().astimezone().isoformat(timespec="seconds"),
        "machine": machine_name(protocol.device),
        "device": str(protocol.device),
        "engine": choose_backend(protocol.backend, protocol.device),
        "protocol": _walking_protocol(candidate, protocol),
        "training": _training(candidate),
    }
    if {"tracking", "gait"} & set(suites):
        walks = _walk(candidate, robot, protocol, progress)
        command = min(walks, key=lambda speed: abs(speed - protocol.push.command))
        results["series"] = {"speed": _speed_series(walks), "feet": _feet_series(walks[command], command)}
        if "tracking" in suites:
            results["tracking"] = [_tracking_row(command, walk, protocol.skip) for command, walk in walks.items()]
        if "gait" in suites:
            results["gait"] = _gait(walks[command], robot, command, protocol.skip, candidate.task.gait.period)
    if "push" in suites:
        results["push"] = _push(candidate, robot, protocol, progress)
    if "terrain" in suites:
        results["terrain"] = _terrain(candidate, robot, protocol, progress)
    if "transfer" in suites:
        results["transfer"] = _transfer(candidate, robot, protocol, progress)
    if "omni" in suites:
        results["omni"] = _omni(candidate, robot, protocol, progress)
    if "learning" in suites:
        results["learning"] = curve
    return results


def _training(candidate: Candidate) -> dict[str, Any] | None:
    """Return how a policy was trained, as its run's folder tells it; None for what was not."""
    if candidate.is_model_based or not candidate.run_dir:
        return None
    starts = read_starts(candidate.run_dir)
    last = starts[-1] if starts else {}
    task = sha256(to_yaml(dataclasses.replace(candidate.config, seed=0)).encode()).hexdigest()[:16]
    return {
        "seed": candidate.config.seed,
        "task": task,
        **{key: last.get(key) for key in ("processor", "arithmetic", "backend")},
    }


def _walking_protocol(candidate: Candidate, protocol: Protocol) -> dict[str, Any]:
    """Return how the walking suites are run, as results say it."""
    return {
        "worlds": protocol.worlds,
        "duration_s": protocol.duration,
        "skip_s": protocol.skip,
        "seed": candidate.task.seed,
        "gait_period_s": candidate.task.gait.period,
    }


def _push_protocol(candidate: Candidate, protocol: Protocol) -> PushProtocol:
    """Return how the push suite is run: at a speed that the policy was trained on."""
    low, high = candidate.task.commands.lin_vel_x
    command = protocol.push.command if candidate.is_model_based else float(np.clip(protocol.push.command, low, high))
    return dataclasses.replace(protocol.push, command=command)


def _terrain_protocol(candidate: Candidate, protocol: Protocol) -> TerrainProtocol:
    """Return how the terrain suite is run: at a speed that the policy was trained on."""
    low, high = candidate.task.commands.lin_vel_x
    command = protocol.terrain.command if candidate.is_model_based else float(np.clip(protocol.terrain.command, low, high))
    return dataclasses.replace(protocol.terrain, command=command)


def _transfer_protocol(candidate: Candidate, protocol: Protocol) -> TransferProtocol:
    """Return how the transfer suite is run: at a speed that the policy was trained on."""
    low, high = candidate.task.commands.lin_vel_x
    command = protocol.transfer.command if candidate.is_model_based else float(np.clip(protocol.transfer.command, low, high))
    return dataclasses.replace(protocol.transfer, command=command)


def is_current(results: dict[str, Any], candidate: Candidate, suites: Sequence[str], protocol: Protocol) -> bool:
    """Whether results from a file are what `evaluate` would measure again: all of the suites, of the same, in the same way."""
    push = _push_protocol(candidate, protocol)
    pushed, omni, terrain = _as_json(push), _as_json(protocol.omni), _as_json(_terrain_protocol(candidate, protocol))
    transfer = _as_json(_transfer_protocol(candidate, protocol))
    return (
        set(suites) <= results.keys()
        and all(results[suite] for suite in suites if suite != "learning")  # which may be null
        and results.get("fingerprint") == candidate.fingerprint
        and results.get("protocol") == _walking_protocol(candidate, protocol)
        and ("push" not in suites or results["push"].get("protocol") == pushed)
        and ("omni" not in suites or results["omni"].get("protocol") == omni)
        and ("terrain" not in suites or results["terrain"].get("protocol") == terrain)
        and ("transfer" not in suites or results["transfer"].get("protocol") == transfer)
    )


def _as_json(protocol: PushProtocol | OmniProtocol | TerrainProtocol | TransferProtocol) -> dict[str, Any]:
    """Return a protocol as it comes back from a file of results: tuples are lists there."""
    return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(protocol).items()}


def commands_of(candidate: Candidate, protocol: Protocol) -> tuple[float, ...]:
    """Return the forward speeds to ask for [m/s]."""
    if protocol.commands is not None:
        return protocol.commands
    return SPEEDS if candidate.is_model_based else trained_speeds(candidate.task)


def make_env(candidate: Candidate, robot: Robot, protocol: Protocol, num_envs: int, duration: float) -> TelebipEnv:
    """Create worlds of the candidate's task on flat ground, undisturbed but for its overrides; see `as_evaluated`."""
    config = as_evaluated(on_flat_ground(candidate.config), num_envs, duration, candidate.overrides)
    config = with_estimate(config) if candidate.is_model_based else config
    return TelebipEnv(config, robot, protocol.device, protocol.backend)


def _walk(candidate: Candidate, robot: Robot, protocol: Protocol, progress: Progress) -> dict[float, Rollout]:
    """Walk all commands as one batch, and return each command's worlds."""
    commands = commands_of(candidate, protocol)
    env = make_env(candidate, robot, protocol, len(commands) * protocol.worlds, protocol.duration)
    env.set_commands(forward_commands(commands, protocol.worlds, env.device))
    steps = max(1, round(protocol.duration / env.step_dt))
    rollout = roll_out(env, candidate.make_policy(env), steps, lambda step: progress("walking", step, steps))
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
        "cot_joints": {name: round(cost, 5) for name, cost in zip(rollout.joint_names, s.joint_cost_of_transport, strict=True)},
        "energy": energy(rollout.after(skip)),
    }


def _gait(rollout: Rollout, robot: Robot, command: float, skip: float, clock: float) -> dict[str, float]:
    kept = rollout.after(skip)
    speed = float(heading_velocity(kept.qpos, kept.qvel)[..., 0].mean(dtype=float))
    knees = [i for i, name in enumerate(robot.joint_names) if name.endswith("knee") and robot.is_slide[i]]
    summary = summarise_gait(kept.foot_force, kept.joint_pos[..., knees], speed, rollout.weight, rollout.step_dt, clock)
    return {"command_mps": command, **{name: round(value, 5) for name, value in summary.items()}}


def _push(candidate: Candidate, robot: Robot, protocol: Protocol, progress: Progress) -> dict[str, Any]:
    push = _push_protocol(candidate, protocol)
    env = make_env(candidate, robot, protocol, push.num_envs, push.seconds)
    limits = push_limits(env, candidate.make_policy(env), push, lambda ended, asked: progress("pushing", ended, asked))
    return {"protocol": _as_json(push), **limits}


def _terrain(candidate: Candidate, robot: Robot, protocol: Protocol, progress: Progress) -> dict[str, Any]:
    terrain = _terrain_protocol(candidate, protocol)
    config = as_evaluated(candidate.config, terrain.num_envs, terrain.seconds, candidate.overrides)
    config = with_estimate(config) if candidate.is_model_based else config
    env = TelebipEnv(on_test_ground(config), robot, protocol.device, protocol.backend)
    name, total = f"crossing terrain in {env.num_envs} worlds", math.ceil(terrain.seconds / env.step_dt)
    results = terrain_results(env, candidate.make_policy(env), terrain, lambda step: progress(name, step, total))
    return {"protocol": _as_json(terrain), **results}


def _transfer(candidate: Candidate, robot: Robot, protocol: Protocol, progress: Progress) -> dict[str, Any]:
    transfer = _transfer_protocol(candidate, protocol)
    config = as_evaluated(on_flat_ground(candidate.config), transfer.worlds, transfer.duration, candidate.overrides)

    def make(task: TaskConfig) -> tuple[TelebipEnv, Policy]:
        task = with_estimate(task) if candidate.is_model_based else task
        env = TelebipEnv(task, robot, protocol.device, protocol.backend)
        return env, candidate.make_policy(env)

    results = transfer_results(make, config, load_task(transfer.task), robot, transfer, progress)
    return {"protocol": _as_json(transfer), **results}


def _omni(candidate: Candidate, robot: Robot, protocol: Protocol, progress: Progress) -> dict[str, Any]:
    omni = protocol.omni
    env = make_env(candidate, robot, protocol, omni.num_envs, omni.duration)
    name, total = f"walking {env.num_envs} worlds in all directions", round(omni.duration / env.step_dt)
    results = omni_results(env, candidate.make_policy(env), omni, lambda step: progress(name, step, total))
    return {"protocol": _as_json(omni), **results}


def _speed_series(walks: dict[float, Rollout]) -> dict[str, Any]:
    """Mean forward speed over the worlds against time, ten times a second, for each command."""
    first = next(iter(walks.values()))
    rows = max(1, round(0.1 / first.step_dt))
    series = {"time_s": _rounded(first.time[rows - 1 :: rows], 3)}
    for command, walk in walks.items():
        speed = heading_velocity(walk.qpos, walk.qvel)[..., 0].mean(1)
        series[f"{command:g}"] = _rounded(speed[: len(speed) // rows * rows].reshape(-1, rows).mean(1), 4)
    return series


def _feet_series(walk: Rollout, command: float) -> dict[str, Any]:
    """Foot forces of the first world in the last two seconds [body weights], with the phase signals."""
    rows = slice(-round(2.0 / walk.step_dt), None)
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
