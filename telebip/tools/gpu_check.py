"""Checks a GPU in limited time: the most valuable steps first, each in a process of its own, each result on disk at once.

A step is a function here; the command `gpu_check.py` starts it in a process, gives it its share of the time that is left, and
ends it when that is over. What it has found by then stands in `results.jsonl`, a line each. On a CPU every step runs at a toy
size, to be tested: its figures say nothing.
"""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import torch

from telebip import ROOT
from telebip.config import TaskConfig, load_task, task_names
from telebip.env import TelebipEnv
from telebip.graph import CudaGraph
from telebip.rl.checkpoint import load_checkpoint
from telebip.rl.run import describe_code, machine_name
from telebip.rl.train import Trainer
from telebip.robot import Robot, load_robot
from telebip.sim import Backend
from telebip.tools.benchmark import COLUMNS, measure
from telebip.tools.engines import compiled_kernel_modules
from telebip.tools.measuring import Stopwatch
from telebip.tools.sweep import train_once

TERRAINS = ("telebip_rough", "telebip_omni")
"""Tasks that are trained for a moment, where there are such."""


@dataclass(frozen=True)
class Sizes:
    """How much a step does."""

    worlds: tuple[int, ...]  # of the benchmark
    rounds: int  # of each of them
    profiled: int  # worlds, whose launches are counted
    small: int  # worlds of a training that is repeated
    iterations: int | None  # of a training that is timed; None: the task's own
    overrides: tuple[str, ...] = ()  # of every task


FULL = Sizes(worlds=(4096, 16384, 65536), rounds=5, profiled=4096, small=512, iterations=None)
TOY = Sizes((4,), 1, 4, 4, 1, ("num_envs=4", "ppo.num_steps_per_env=5", "ppo.hidden_dims=[16,16]", "episode.length=1.0"))


class Check:
    """What the steps share: where they run, how large they are, and where results go."""

    def __init__(self, device: torch.device, folder: Path) -> None:
        """Write to `results.jsonl` in `folder`; on a CPU everything is of toy size."""
        self.device, self.folder = device, folder
        self.is_toy = device.type == "cpu"
        self.sizes = TOY if self.is_toy else FULL
        self.start = time.perf_counter()

    def task(self, name: str, *overrides: str) -> TaskConfig:
        """Return a task, at toy size on a CPU."""
        return load_task(name, [*self.sizes.overrides, *overrides])

    def robot(self, cfg: TaskConfig) -> Robot:
        """Return a task's robot."""
        return load_robot(cfg.sim.robot)

    def env(self, cfg: TaskConfig, backend: Backend = "auto") -> TelebipEnv:
        """Return the worlds of a task."""
        return TelebipEnv(cfg, self.robot(cfg), self.device, backend)

    def note(self, step: str, **values: Any) -> None:
        """Write one result to disk, and print it."""
        note(self.folder, {"step": step, "at_s": round(time.perf_counter() - self.start, 2), **values})

    def seconds(self, function: Callable[[], Any]) -> float:
        """Return how long a call takes the device [s]."""
        watch = Stopwatch(self.device)
        watch.time(function)
        return watch.seconds()


def note(folder: Path, row: dict[str, Any]) -> None:
    """Append a row to the results, and print it; what a machine loses afterwards, this outlives."""
    line = json.dumps(row)
    with (folder / "results.jsonl").open("a", encoding="utf-8") as file:
        file.write(line + "\n")
        file.flush()
        os.fsync(file.fileno())
    print(line, flush=True)


def versions(check: Check) -> None:
    """What runs here, how long kernels take to compile, and one step of the environment."""
    about: dict[str, Any] = {"machine": machine_name(check.device), "device": str(check.device), "processors": os.cpu_count()}
    if check.device.type == "cuda":
        about |= {"cuda": torch.version.cuda, "capability": torch.cuda.get_device_capability(check.device)}
        about["nvidia_smi"] = _output("nvidia-smi", "--query-gpu=name,driver_version,memory.total", "--format=csv,noheader")
    check.note("versions", **about, **describe_code())
    before = compiled_kernel_modules()
    for name in ("cold", "warm"):
        start = time.perf_counter()
        env = check.env(check.task("telebip_flat", f"num_envs={check.sizes.small}"), "warp")
        made = time.perf_counter()
        obs, rewards, _, _ = env.step(torch.zeros(env.num_envs, env.num_actions, device=check.device))
        finite = bool(obs["policy"].isfinite().all() & rewards.isfinite().all())
        done = time.perf_counter()
        check.note("versions", worlds=name, make_s=made - start, step_s=done - made, finite=finite)
    check.note("versions", kernel_modules={"there before": before, "compiled": compiled_kernel_modules() - before})


def tests(check: Check) -> None:
    """The tests marked `gpu`, four at a time: of the files that have some, as others need more packages."""
    files = sorted(str(path) for path in (ROOT / "tests").rglob("test_*.py") if "mark.gpu" in path.read_text(encoding="utf-8"))
    own = ("-m", "gpu", "-n", "4" if not check.is_toy else "0", "-ra", "--durations=10", "-p", "no:cacheprovider")
    status, counts = None, {}
    with subprocess.Popen([sys.executable, "-m", "pytest", *own, *files], cwd=ROOT, stdout=subprocess.PIPE, text=True) as run:
        assert run.stdout is not None
        for line in run.stdout:
            print(line, end="", flush=True)
            if line.startswith(("FAILED", "ERROR")):
                check.note("tests", line=line.strip())
            if re.search(r"\d+ (passed|failed|skipped|error)", line):
                counts = {kind: int(number) for number, kind in re.findall(r"(\d+) (\w+)", line.partition(" in ")[0])}
        status = run.wait()
    check.note("tests", exit_status=status, **counts)


def quick(check: Check) -> None:
    """How long `telebip_quick` takes from its first iteration until it walks."""
    _train(check, "quick", "telebip_quick", True)


def flat(check: Check) -> None:
    """The article's training, to its end: seconds and samples until it walks, and what the policy is like."""
    _train(check, "flat", "telebip_flat", False)


def _train(check: Check, step: str, task: str, stop_when_walking: bool) -> None:
    cfg = check.task(task)
    if check.sizes.iterations:
        cfg = replace(cfg, ppo=replace(cfg.ppo, max_iterations=check.sizes.iterations))
    start = last = time.perf_counter()

    def progress(what: str, done: int, total: int) -> None:
        nonlocal last
        if done == total or time.perf_counter() - last > 10.0:
            last = time.perf_counter()
            check.note(step, doing=what, done=done, total=total, wall_s=round(last - start, 1))

    result = train_once(task, cfg, check.robot(cfg), check.device, "auto", stop_when_walking, progress)
    kept = {name: result[name] for name in ("arithmetic", "walks", "looks")}
    ended = {
        "samples": result["samples"][-1],
        "seconds": result["seconds"][-1],
        "velocity_error_mps": result["velocity_error_mps"][-1],
    }
    check.note(step, task=task, num_envs=cfg.num_envs, **kept, end=ended, tracking=result.get("tracking"))


def speed(check: Check) -> None:
    """Engine, environment, collecting and learning at several numbers of worlds, with the step's graphs and without."""
    checkpoint = load_checkpoint("telebip_flat")
    for worlds in check.sizes.worlds:
        for graph in ("true", "false"):
            cfg = load_task(checkpoint.config, [f"num_envs={worlds}", f"sim.cuda_graph={graph}", *_few_steps(check)])
            row = measure(cfg, check.robot(cfg), check.device, "auto", checkpoint, check.sizes.rounds)
            figures = {field: row[field] for field, _ in COLUMNS.values() if field in row}
            check.note("speed", machine=machine_name(check.device), cuda_graph=graph, **figures, rounds_s=row["rounds_s"])


def _few_steps(check: Check) -> list[str]:
    return ["ppo.num_steps_per_env=3"] if check.is_toy else []


def profile(check: Check) -> None:
    """How often a step and an update launch something and wait for the device, and which kernels take how long."""
    trainer = Trainer(check.env(check.task("telebip_flat", f"num_envs={check.sizes.profiled}")), "", Path())
    for _ in range(2):  # records the graphs
        trainer.iterate()
    env = trainer.env
    actions = torch.zeros(env.num_envs, env.num_actions, device=check.device)
    with torch.inference_mode():
        obs = trainer.view.get_observations()

        def collect() -> None:
            nonlocal obs
            obs = trainer.collect(obs)[0]

        _profile(check, "env.step", lambda: env.step(actions))
        _profile(check, "collect", collect)
        trainer.learner.compute_returns(obs)
    _profile(check, "update", trainer.learner.update)


def _profile(check: Check, name: str, function: Callable[[], Any]) -> None:
    """Note how many calls of CUDA and waits a function makes, and its ten longest kernels (operators, on a CPU)."""
    seconds = check.seconds(function) if name == "env.step" else None
    kinds = [torch.profiler.ProfilerActivity.CPU]
    if check.device.type == "cuda":
        kinds.append(torch.profiler.ProfilerActivity.CUDA)
    with torch.profiler.profile(activities=kinds) as found:
        function()
        if check.device.type == "cuda":
            torch.cuda.synchronize(check.device)  # one of the waits below
    calls: Counter[str] = Counter()
    kernels: Counter[str] = Counter()
    for event in found.key_averages():
        is_host = event.device_type.name == "CPU"
        if is_host and (re.match(r"cu(da)?[A-Z]", event.key) or event.key == "aten::_local_scalar_dense"):
            calls[event.key] += event.count
        if is_host == (check.device.type == "cpu"):
            kernels[event.key] += round(event.self_cpu_time_total if is_host else event.self_device_time_total)
    longest = {kernel[:90]: microseconds for kernel, microseconds in kernels.most_common(10)}
    total = sum(kernels.values())
    check.note("profile", of=name, seconds=seconds, calls=dict(calls.most_common()), total_us=total, longest_us=longest)


def determinism(check: Check) -> None:
    """Whether two trainings, and a resumed one, are the same bit for bit with `sim.deterministic`, and what that costs."""
    cfg = check.task("telebip_quick", f"num_envs={check.sizes.small}", "sim.deterministic=true")
    backend: Backend = "warp"
    with tempfile.TemporaryDirectory() as folder:
        runs = [_trained(check, cfg, 4, Path(folder, name), backend) for name in ("first", "second")]
        check.note("determinism", same_seed_same_bits=_differing(*runs) == [], differing=_differing(*runs))
        halved = Path(folder, "halved")
        _trained(check, cfg, 2, halved, backend)
        resumed = _trained(check, cfg, 4, halved, backend, resume=True)
        check.note("determinism", resumed_same_bits=_differing(runs[0], resumed) == [], differing=_differing(runs[0], resumed))
    worlds = check.sizes.worlds[0]
    envs = [
        check.env(check.task("telebip_flat", f"num_envs={worlds}", f"sim.deterministic={on}"), backend)
        for on in ("false", "true")
    ]
    times = [[_steps_seconds(check, env) for env in envs] for _ in range(check.sizes.rounds + 1)][1:]
    check.note("determinism", num_envs=worlds, cost=median(ordered / plain for plain, ordered in times), rounds_s=times)


def _trained(check: Check, cfg: TaskConfig, iterations: int, folder: Path, backend: Backend, resume: bool = False) -> Any:
    """Train to so many iterations, and return all that the checkpoint at the end has of networks and worlds."""
    cfg = replace(cfg, ppo=replace(cfg.ppo, max_iterations=iterations))
    trainer = Trainer(check.env(cfg, backend), "telebip_quick", folder)
    if resume and (reason := trainer.resume(load_checkpoint(folder))):
        raise RuntimeError(f"resuming starts new episodes: {reason}")
    folder.mkdir(exist_ok=True)
    trainer.learn(stop=lambda: False, report=lambda scalars: None)
    checkpoint = load_checkpoint(folder)
    return {"learner": checkpoint.learner, "training": checkpoint.training}


def _differing(first: Any, second: Any, name: str = "") -> list[str]:
    """Return the names of what is not the same, bit for bit, in two trees of tensors."""
    if isinstance(first, torch.Tensor):
        return [] if torch.equal(first.cpu(), second.cpu()) else [name]
    if isinstance(first, dict | list | tuple):
        keys = first.keys() if isinstance(first, dict) else range(len(first))
        return [found for key in keys for found in _differing(first[key], second[key], f"{name}.{key}")]
    return [] if first == second or first != first else [name]  # a NaN is itself


def _steps_seconds(check: Check, env: TelebipEnv) -> float:
    """Return how long a stretch of zero actions takes, from the start pose on [s]."""
    actions = torch.zeros(env.num_envs, env.num_actions, device=check.device)
    env.reset()
    steps = 3 if check.is_toy else 50

    def walk() -> None:
        for _ in range(steps):
            env.step(actions)

    return check.seconds(walk)


def tasks(check: Check) -> None:
    """A few iterations of other tasks, where there are such."""
    for task in TERRAINS:
        if task not in task_names():
            check.note("tasks", task=task, skipped="no such task")
            continue
        trainer = Trainer(check.env(check.task(task)), task, Path(tempfile.gettempdir()))
        rows = [trainer.iterate() for _ in range(2 if check.is_toy else 10)]
        speeds = [row["speed/samples_per_s"] for row in rows]
        check.note("tasks", task=task, samples_per_s=median(speeds), faults=sum(row["fault/worlds"] for row in rows))


def compiled(check: Check) -> None:
    """What it is worth to fuse the tensor work of a step with torch.compile, before it is recorded."""
    cfg = check.task("telebip_flat", f"num_envs={check.sizes.worlds[0]}")
    plain, fused = (check.env(cfg) for _ in range(2))
    start = time.perf_counter()
    _fuse(fused)
    check.note("compiled", compile_s=time.perf_counter() - start)
    times = [[_steps_seconds(check, env) for env in (plain, fused)] for _ in range(check.sizes.rounds + 1)][1:]
    check.note("compiled", num_envs=cfg.num_envs, ratio=median(after / before for before, after in times), rounds_s=times)


def _fuse(env: TelebipEnv) -> None:
    """Let torch.compile fuse what a step does around the physics; on CUDA a graph then replays that."""
    backend = "inductor" if env.device.type == "cuda" else "aot_eager"  # which compiles nothing, in a few seconds
    before = torch.compile(env._prepare_step, dynamic=False, backend=backend)
    after = torch.compile(env._finish_step, dynamic=False, backend=backend)
    env._before_physics, env._after_physics = before, after
    for _ in range(3):  # compiles, and compiles again where it has learned more, which a recording cannot
        env.step(torch.zeros(env.num_envs, env.num_actions, device=env.device))
    if env._is_recorded:
        env._before_physics = CudaGraph(before, env.device, env.generator)
        env._after_physics = CudaGraph(after, env.device, env.generator)


def precision(check: Check) -> None:
    """How long an iteration takes with networks in float32, with TF32 products, and in bfloat16."""
    worlds = check.sizes.worlds[0]
    before = torch.get_float32_matmul_precision()
    for name, matmul, mixed in (("float32", "highest", "never"), ("tf32", "high", "never"), ("bfloat16", "highest", "always")):
        torch.set_float32_matmul_precision(matmul)
        trainer = Trainer(
            check.env(check.task("telebip_flat", f"num_envs={worlds}", f"ppo.mixed_precision={mixed}")), "", Path()
        )
        rows = [trainer.iterate() for _ in range(check.sizes.rounds + 2)][2:]
        times = {key: median(row[f"speed/{key}"] for row in rows) for key in ("collect_s", "learn_s")}
        check.note("precision", arithmetic=name, num_envs=worlds, **times)
    torch.set_float32_matmul_precision(before)


STEPS: dict[str, tuple[Callable[[Check], None], float]] = {
    "versions": (versions, 1.5),
    "tests": (tests, 2.5),
    "quick": (quick, 1.0),
    "speed": (speed, 2.0),
    "profile": (profile, 1.0),
    "flat": (flat, 2.0),
    "determinism": (determinism, 1.5),
    "tasks": (tasks, 0.5),
    "precision": (precision, 1.0),
    "compiled": (compiled, 1.0),
}
"""Name -> the step, and its share of the time; in order of worth."""


def run_steps(names: Sequence[str], seconds: float, folder: Path, command: Sequence[str]) -> bool:
    """Run steps one after the other, each in a process of its own within its share of what is left of `seconds`.

    Args:
        names: of `STEPS`.
        seconds: for all of them [s].
        folder: takes `results.jsonl`, a line for each result and for each step's end, and `log.txt`, all that they print.
        command: starts one step, whose name is appended.

    Returns:
        Whether all steps came to their end.
    """
    end, outcomes = time.monotonic() + seconds, []
    for i, name in enumerate(names):
        left = end - time.monotonic()
        limit = left * STEPS[name][1] / sum(STEPS[later][1] for later in names[i:])
        if limit < 1.0:
            outcomes.append("no time left")
        else:
            start = time.monotonic()
            outcomes.append(_run_limited([*command, name], limit, folder / "log.txt"))
            note(
                folder,
                {
                    "step": name,
                    "ended": outcomes[-1],
                    "seconds": round(time.monotonic() - start, 1),
                    "limit_s": round(limit, 1),
                },
            )
            continue
        note(folder, {"step": name, "ended": outcomes[-1]})
    return all(outcome == "done" for outcome in outcomes)


def _run_limited(command: Sequence[str], limit: float, log: Path) -> str:
    """Run a command whose output goes to the end of `log`; return how it ended."""
    with log.open("a", encoding="utf-8") as file:
        file.write(f"\n== {' '.join(command)}\n")
        file.flush()
        process = subprocess.Popen(command, cwd=ROOT, stdout=file, stderr=subprocess.STDOUT, start_new_session=True)
        try:
            status = process.wait(timeout=limit)
            return "done" if status == 0 else f"failed with status {status}, see {log.name}"
        except subprocess.TimeoutExpired:
            return f"cut off after {limit:.0f} s"
        finally:
            _end(process)


def _end(process: "subprocess.Popen[bytes]") -> None:
    """End a process with all that it started."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=3.0)


def summary(folder: Path) -> Iterator[str]:
    """Yield the results as lines to read: each step's end, and before it what it found."""
    rows = [json.loads(line) for line in (folder / "results.jsonl").read_text(encoding="utf-8").splitlines()]
    for row in rows:
        step = row.pop("step")
        if "ended" in row:
            yield f"{step:12} {row['ended']}" + (f" ({row['seconds']} s of {row['limit_s']} s)" if "seconds" in row else "")
        else:
            shown = {key: _short(value) for key, value in row.items() if key not in ("at_s", "rounds_s", "doing", "versions")}
            yield f"{step:12}   {', '.join(f'{key} {value}' for key, value in shown.items())}"


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _output(*command: str) -> str:
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=20).stdout.strip()
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)
