"""`evaluate.py`: measure what walks, and report it."""

import argparse
import math
import shlex
from collections.abc import Sequence
from contextlib import contextmanager
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

from telebip.cli.common import CONTROLLERS, Parser, checked_robot, match_robot, open_policy, policy_of, resolve_device
from telebip.config import load_task
from telebip.errors import UserError

EXAMPLES = """\
  evaluate.py --checkpoint assets/policies/telebip_efficient --out report
  evaluate.py --checkpoint runs/telebip_flat/2026-01-31_12-00-00 --suite tracking,gait
  evaluate.py --checkpoint assets/policies/telebip_flat --suite push --max-force 150
  evaluate.py --checkpoint assets/policies/telebip_efficient --suite omni
  evaluate.py --checkpoint assets/policies/telebip_stairs --suite tracking,terrain
  evaluate.py --checkpoint assets/policies/telebip_efficient --suite transfer --transfer-points 0
  evaluate.py --controller dcm control.step_time=0.2 sim.decimation=1
  evaluate.py --controller alip --suite tracking --commands=-0.3,0.5        (with = before a negative number)
"""

SET_HERE = {"num_envs": "--num-envs", "episode.length": "--duration"}
"""Fields of the task that the evaluator sets, and the options that say how."""


def main(argv: Sequence[str] | None = None) -> None:
    """Parse arguments, measure, print, and write the report."""
    options = _parse(argv)
    from telebip.cli.console import Console

    console = Console()
    with console.status("loading torch and the physics engine"):
        from telebip.eval.omni import OmniProtocol
        from telebip.eval.push import PushProtocol
        from telebip.eval.report import summary, write_report
        from telebip.eval.suites import Protocol, check_suites
        from telebip.eval.terrain import TerrainProtocol
        from telebip.eval.transfer import TransferProtocol
    suites = check_suites(options.suite.split(","))
    check_overrides(options.overrides, suites)
    load_task(options.transfer_task)  # refuses a name that is wrong before the long work
    protocol = Protocol(
        worlds=options.num_envs,
        duration=options.duration,
        skip=min(5.0, 0.25 * options.duration),
        commands=options.commands,
        push=PushProtocol(max_force=options.max_force, worlds=min(32, options.push_worlds), limit_worlds=options.push_worlds),
        omni=OmniProtocol(worlds=options.omni_worlds),
        terrain=TerrainProtocol(worlds=options.terrain_worlds),
        transfer=TransferProtocol(
            task=options.transfer_task,
            worlds=options.transfer_worlds,
            points=options.transfer_points,
            sweep_worlds=min(64, options.transfer_worlds),
        ),
        device=resolve_device(options.device),
        backend=options.backend,
    )
    if options.controller:
        candidate = controller_candidate(options.controller, options.label, options.overrides)
    else:
        candidate = checkpoint_candidate(options.checkpoint, options.label, options.overrides, options.allow_robot_change)
    candidate = replace(candidate, source=" ".join([candidate.source, *map(shlex.quote, options.given)]))
    out = Path(options.out) if options.out else default_folder(candidate.label)
    results = measure(console, candidate, suites, protocol, out)
    title, text = f"{candidate.label}: how it walks", f"Measured by: {candidate.source}"
    write_report([[results]], out, title, text, references=references())
    console.print(summary(results, console.width))
    console.print(f"wrote report.md, report.html and results.json to\n{out}")


def measure(console, candidate, suites: Sequence[str], protocol, out: Path) -> dict:
    """Measure a candidate with a progress bar, write `out`/results.json, and return what stands in it."""
    from telebip.eval.report import make_folder, write_results
    from telebip.eval.suites import evaluate

    robot = checked_robot(candidate.task)
    make_folder(out)
    with progress_bar(console, announce=True) as show:
        results = evaluate(candidate, robot, suites, protocol, show)
    write_results(results, out)
    return results


def default_folder(label: str) -> Path:
    """Return where the report of this label goes: a folder in `reports`, whatever path a checkpoint's task or a user gives."""
    name = Path(label).name
    return Path("reports") / (name if name not in ("", "..") else "unnamed")


def check_overrides(overrides: Sequence[str], suites: Sequence[str]) -> None:
    """Refuse overrides of what the evaluator itself sets."""
    for override in overrides:
        key = override.partition("=")[0]
        if key in SET_HERE:
            raise UserError(f"'{override}' cannot be overridden here; use {SET_HERE[key]}")
        is_own = key.split(".")[:2] == ["events", "push"] or key in ("events.start_pose", "events.start_pose.heading")
        if "push" in suites and is_own:
            raise UserError(f"the push suite has its own pushes, of robots that face x; '{override}' goes with other suites")


def controller_candidate(name: str, label: str | None, overrides: Sequence[str] = ()):
    """Return a model-based walker for the evaluator, with `overrides` of its parameters and of the task."""
    from telebip.control.config import load_controller, split_overrides
    from telebip.control.factory import make_controller
    from telebip.eval.suites import Candidate
    from telebip.robot import load_robot
    from telebip.robot_record import describe_robot

    task, own = split_overrides(overrides)
    base = load_task("telebip_flat")
    config = load_task(base, task)
    robot = describe_robot(load_robot(config.sim.robot), config.sim.decimation)
    digest = (robot["digest"], robot["decimation"])
    return Candidate(
        label=label or name,
        config=base,
        make_policy=lambda env: make_controller(name, env, own),
        is_model_based=True,
        source=shlex.join(["evaluate.py", "--controller", name, *overrides]),
        fingerprint=sha256(repr((name, load_controller(name, own), digest, config.actions)).encode()).hexdigest()[:16],
        overrides=tuple(task),
    )


def checkpoint_candidate(
    checkpoint_path: str, label: str | None, overrides: Sequence[str] = (), allow_robot_change: bool = False
):
    """Return what a checkpoint holds for the evaluator; the label is the name of its task unless one is given."""
    from telebip.eval.suites import Candidate
    from telebip.robot import load_robot
    from telebip.robot_record import describe_robot

    checkpoint = open_policy(checkpoint_path)
    sim = load_task(checkpoint.config, overrides).sim
    robot = load_robot(sim.robot)
    match_robot(checkpoint, sim, robot, allow_robot_change)
    record = describe_robot(robot, sim.decimation)
    what = checkpoint.path.read_bytes() + repr((record["digest"], record["decimation"])).encode()
    return Candidate(
        label=label or checkpoint.task,
        config=checkpoint.config,
        make_policy=lambda env: policy_of(checkpoint, env, allow_robot_change),
        run_dir=checkpoint.path.parent,
        source=shlex.join(["evaluate.py", "--checkpoint", checkpoint_path, *overrides]),
        fingerprint=sha256(what).hexdigest()[:16],
        overrides=tuple(overrides),
    )


def references() -> list[dict]:
    """Return the article's numbers as results."""
    from telebip.eval.article import TRACKING, as_results

    return [as_results(label) for label in TRACKING]


@contextmanager
def progress_bar(console, announce: bool = False):
    """Yield a function that shows what is running, how long it will take and how far it is, whole on 60 columns.

    Where there is no terminal it shows nothing, or, with `announce`, a line as something begins.
    """
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), TextColumn("eta"), TimeRemainingColumn(), BarColumn(20), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        tasks = {}

        def show(name: str, step: int, total: int) -> None:
            if name not in tasks:
                tasks[name] = progress.add_task(name, total=total)
                if announce and not console.is_terminal:
                    console.print(f"{name} ...")
            progress.update(tasks[name], completed=step, total=total)

        yield show


def speed(text: str) -> float:
    """Read a finite number; argparse turns a ValueError into a refusal that quotes the text."""
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value


def speeds(text: str) -> tuple[float, ...]:
    """Read `0.5,0.7`, as `speed` reads one."""
    return tuple(speed(part) for part in text.split(","))


def _parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        "Measure how something walks: tracking, energy, pushes, gait, learning, all directions, rough terrain, other robots.",
        EXAMPLES,
    )
    who = parser.add_mutually_exclusive_group()
    who.add_argument("--checkpoint", metavar="PATH_OR_RUN", help="a checkpoint file, or a run folder for its newest")
    who.add_argument("--controller", choices=CONTROLLERS, help="a model-based walker: angular momentum, or DCM")
    suites = "tracking,push,gait,learning"
    parser.add_argument(
        "--suite", default=suites, metavar="A,B", help=f"which suites; also omni, terrain, transfer (default: {suites})"
    )
    parser.add_argument("--out", metavar="DIR", help="folder of results.json and the report (default: reports/<label>)")
    parser.add_argument("--label", metavar="NAME", help="name in tables and plots (default: the task's)")
    parser.add_argument("--num-envs", type=int, default=64, metavar="N", help="worlds for each commanded speed (default: 64)")
    parser.add_argument("--duration", type=float, default=20.0, metavar="S", help="seconds of walking (default: 20)")
    parser.add_argument(
        "--commands",
        type=speeds,
        metavar="VX,VX",
        help="forward speeds in m/s (default: 0.5,0.7,1.0,-0.3 as far as the policy was trained on them); "
        "--commands=-0.3,0.5 where the first is negative",
    )
    parser.add_argument("--max-force", type=float, default=300.0, metavar="N", help="largest push tried in N (default: 300)")
    parser.add_argument("--push-worlds", type=int, default=300, metavar="N", help="worlds at the largest pushes (default: 300)")
    parser.add_argument("--omni-worlds", type=int, default=16, metavar="N", help="worlds for each omni command (default: 16)")
    parser.add_argument("--terrain-worlds", type=int, default=64, metavar="N", help="worlds for each level (default: 64)")
    parser.add_argument(
        "--transfer-task",
        default="telebip_real",
        metavar="NAME",
        help="task whose ranges are drawn from (default: telebip_real)",
    )
    parser.add_argument("--transfer-worlds", type=int, default=512, metavar="N", help="worlds drawn from ranges (default: 512)")
    parser.add_argument(
        "--transfer-points", type=int, default=7, metavar="N", help="values of each factor in sweeps, 0 for none (default: 7)"
    )
    parser.add_engine()
    parser.add_allow_robot_change()
    parser.add_overrides()
    options = parser.parse(argv)
    if not (options.checkpoint or options.controller):
        raise UserError(
            "what is to be measured? --checkpoint PATH_OR_RUN (try assets/policies/telebip_efficient), or --controller"
        )
    bounds = {"num_envs": (1, 2**20), "duration": (1, 3600), "max_force": (5, 5000), "push_worlds": (1, 2**16)}
    bounds |= {"omni_worlds": (1, 2**12), "terrain_worlds": (1, 2**12)}
    bounds |= {"transfer_worlds": (1, 2**16), "transfer_points": (0, 100)}
    for name, (low, high) in bounds.items():
        value = getattr(options, name)
        if not low <= value <= high:
            raise UserError(f"--{name.replace('_', '-')} must be between {low:g} and {high:g}, got {value:g}")
    options.given = [
        f"--{name.replace('_', '-')}={','.join(map(str, value)) if isinstance(value, tuple) else value}"
        for name in (
            *("suite", "num_envs", "duration", "commands", "max_force"),
            *("push_worlds", "omni_worlds", "terrain_worlds"),
            *("transfer_task", "transfer_worlds", "transfer_points", "backend"),
        )
        if (value := getattr(options, name)) != parser.get_default(name)
    ] + ["--allow-robot-change"] * options.allow_robot_change
    return options
