"""`reproduce.py`: the whole study with one command, which goes on where it was stopped."""

import argparse
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from telebip import ROOT
from telebip.cli.common import Parser, resolve_device, stop_on_signal
from telebip.cli.evaluate import checkpoint_candidate, controller_candidate, measure, references
from telebip.cli.trainings import Run, default_jobs, train_all
from telebip.config import load_task
from telebip.errors import UserError, nearest

if TYPE_CHECKING:
    from telebip.cli.console import Console
    from telebip.eval.study import Baseline, Training
    from telebip.eval.suites import Candidate, Protocol

EXAMPLES = """\
  reproduce.py                                  train and measure what is not yet, and write the report
  reproduce.py --only telebip_efficient dcm     these alone
  reproduce.py --seeds 10 --jobs 4              more seeds, four trainings side by side
  reproduce.py --ship                           the same, and copy each policy's median seed to assets/policies
  reproduce.py --shipped                        no training: measure the policies in assets/policies
  reproduce.py --quick                          the same at a toy size, in a minute, apart from the real one
"""

QUICK_TRAINING = ("num_envs=64", "ppo.max_iterations=2", "ppo.hidden_dims=[32,32]")
SHIPPED = Path("assets/policies")  # of telebip's own folder
WORLD_STEPS = {"tracking": 0.2e6, "push": 5.0e6, "terrain": 2.9e6, "omni": 3.5e6, "transfer": 11.0e6}
"""About how much each suite simulates; half as much work as in training, where the policy learns too."""
INTRODUCTION = (
    "Reinforcement learning and two model-based walkers on one robot, measured by one evaluator; in grey, and in the last "
    "rows, the article's own numbers, which belong to its own robot. Every number comes from `scripts/reproduce.py`.\n\n"
    "Numbers are interquartile means over the seeds of a policy, with their stratified bootstrap 95 % interval in brackets "
    "(Agarwal et al., 2021); with five seeds it covers in 90 % of all cases. Dots are single seeds. The shipped policy of "
    "several seeds is the median one, not the best: that of the median mean cost of transport, of the seeds without a fall."
)


def main(argv: Sequence[str] | None = None) -> None:
    """Parse arguments, train, measure, ship and report."""
    options = _parse(argv)
    from telebip.cli.console import Console

    console = Console()
    with console.status("loading torch and the physics engine"):
        from telebip.eval.report import make_folder
        from telebip.eval.study import BASELINES, TRAININGS
    names = [walker.name for walker in (*TRAININGS, *BASELINES)]
    for name in options.only:
        if name not in names:
            raise UserError(f"unknown walker '{name}'; {nearest(name, names)}")
    only = options.only or names
    trainings = [training for training in TRAININGS if training.name in only]
    if options.shipped and not options.only:
        trainings = [training for training in trainings if (SHIPPED / training.name).is_dir()]
    baselines = [baseline for baseline in BASELINES if baseline.name in only]
    make_folder(Path(options.out))
    device = resolve_device(options.device)
    seeds = () if options.shipped else range(1, options.seeds + 1)
    runs = {(training.name, seed): _run(training, seed, options) for training in trainings for seed in seeds}
    failed: list[Run] = []
    with study_progress(console, list(runs.values()), _measurements(trainings, baselines, options)) as progress:
        if runs:
            jobs = options.jobs or default_jobs(device.type)
            make_folder(Path(options.runs))
            with stop_on_signal(console) as asked:
                failed = train_all(list(runs.values()), jobs, str(device), asked, console.print, progress.trained)
                if asked():
                    console.print("stopped; the same command goes on")
                    return
        progress.stop()
        _measure_all(console, progress, trainings, baselines, runs, options)
    if options.ship:
        for training in trainings:
            _ship(console, training, runs, options)
    _report(console, options)
    if failed:
        raise UserError(
            f"{len(failed)} of {len(runs)} trainings failed: {'; '.join(run.name for run in failed)}; see their logs"
        )


def _run(training: "Training", seed: int, options: argparse.Namespace) -> Run:
    overrides = QUICK_TRAINING if options.quick else ()
    config = replace(load_task(training.name, overrides), seed=seed)
    return Run(training.name, seed, config, Path(options.runs), overrides, options.allow_robot_change)


def _measurements(
    trainings: Sequence["Training"], baselines: Sequence["Baseline"], options: argparse.Namespace
) -> dict[str, float]:
    """Return what is to be measured, with its work in environment steps of training."""
    number = 1 if options.shipped else options.seeds
    walkers = [(f"{training.name}/{k}", training.suites) for training in trainings for k in range(number)]
    walkers += [(baseline.name, baseline.suites) for baseline in baselines]
    return {name: 0.5 * sum(WORLD_STEPS.get(suite, 0.0) for suite in suites) for name, suites in walkers}


def _measure_all(
    console: "Console",
    progress: "StudyProgress",
    trainings: Sequence["Training"],
    baselines: Sequence["Baseline"],
    runs: dict[tuple[str, int], Run],
    options: argparse.Namespace,
) -> None:
    """Measure every policy that is there and every model-based walker, unless their results are there already."""
    out = Path(options.out)
    for training in trainings:
        of_it = {f"seed{seed}": run for (name, seed), run in runs.items() if name == training.name}
        policies = {name: run.run_dir for name, run in of_it.items() if run.is_finished}
        if options.shipped:
            policies = {"": SHIPPED / training.name}
        for name, run_dir in policies.items():
            policy = str(run_dir / "policy.pt") if run_dir else ""
            candidate = checkpoint_candidate(policy, training.label, (), options.allow_robot_change)
            place = out / training.name / (name or f"seed{candidate.config.seed}")
            if not options.shipped:  # how to have it again; the run's folder is of this machine
                again = f"reproduce.py --only {training.name} --seeds {candidate.config.seed}"
                candidate = replace(candidate, source=again)
            _measure(console, place, training, options, candidate)
            progress.measured(training.name)
    for baseline in baselines:
        candidate = controller_candidate(baseline.controller, baseline.label, baseline.overrides)
        _measure(console, out / baseline.name, baseline, options, candidate)
        progress.measured(baseline.name)


def _measure(
    console: "Console", out: Path, walker: "Training | Baseline", options: argparse.Namespace, candidate: "Candidate"
) -> None:
    """Measure one walker, unless complete results of the same policy or parameters, measured in the same way, are there."""
    protocol, file = _protocol(options), out / "results.json"
    name = "/".join(file.relative_to(options.out).parts[:-1])
    if not options.again and _is_current(file, candidate, walker.suites, protocol):
        console.print(f"{name}: measured already")
        return
    measure(console, candidate, walker.suites, protocol, out)
    console.print(f"{name}: measured\n{file}")


def _protocol(options: argparse.Namespace) -> "Protocol":
    from telebip.eval.omni import OmniProtocol
    from telebip.eval.push import PushProtocol
    from telebip.eval.suites import Protocol
    from telebip.eval.terrain import TerrainProtocol
    from telebip.eval.transfer import TransferProtocol

    device = resolve_device(options.device)
    if not options.quick:
        return Protocol(device=device)
    push = PushProtocol(max_force=10.0, worlds=2, limit_worlds=2, warmup=0.5, horizons=(1.0, 2.0), num_envs=8)
    omni = OmniProtocol(
        (0.5,), (0.0,), (0.0,), (0.5,), directions=1, changes=1, worlds=1, duration=1.0, change_at=0.2, skip=0.2
    )
    terrain = TerrainProtocol(worlds=1, command=2.0)
    transfer = TransferProtocol(worlds=2, points=0, duration=1.0, skip=0.2)
    return Protocol(4, 3.0, 1.0, push=push, omni=omni, terrain=terrain, transfer=transfer, device=device)


def _is_current(file: Path, candidate: "Candidate", suites: Sequence[str], protocol: "Protocol") -> bool:
    """Whether a file holds what would be measured again; a missing, damaged or older one does not."""
    from telebip.eval.suites import is_current

    try:
        return file.is_file() and is_current(_read(file), candidate, suites, protocol)
    except UserError:
        return False


def _read(file: Path) -> dict[str, Any]:
    """Return results, or raise a `UserError` unless the report can show them."""
    from telebip.eval.report import can_be_shown, read_results

    results = read_results(file)
    if not can_be_shown(results):
        raise UserError(f"results '{file}' lack some of what the report shows; measure them again (--again), or delete them")
    return results


def _ship(console: "Console", training: "Training", runs: dict[tuple[str, int], Run], options: argparse.Namespace) -> None:
    """Copy the median seed of a policy to where the shipped ones are."""
    from telebip.eval.study import median_seed
    from telebip.rl.shipping import ship

    results = {}
    for (name, seed), run in runs.items():
        file = Path(options.out, name, f"seed{seed}", "results.json")
        if name == training.name and run.is_finished and file.is_file():
            results[seed] = _read(file)
    if not results:
        console.print(f"{training.name}: nothing to ship")
        return
    seed = median_seed(results)
    run_dir = runs[training.name, seed].run_dir
    assert run_dir
    folder = Path(options.ship_to) / training.name
    ship(run_dir, folder, ["scripts/train.py", "--task", training.name, "--seed", str(seed)])
    console.print(f"{training.name}: seed {seed} is the median of {len(results)}, copied to {folder}")


def _report(console: "Console", options: argparse.Namespace) -> None:
    """Write the report about all results that are there, and the tables of the pages that show them."""
    from telebip.eval.report import write_report

    out = Path(options.out)
    walkers = _walkers(out, options.shipped)
    write_report(list(walkers.values()), out, "The study", INTRODUCTION, references())
    console.print(f"wrote {out}/report.md and report.html, about {len(walkers)} walkers")
    for page in _write_pages(walkers, options):
        console.print(f"wrote the tables of {page}")


def _write_pages(walkers: dict[str, list[dict[str, Any]]], options: argparse.Namespace) -> list[Path]:
    """Write the tables of the page beside the results, and of README for the study's own; return the pages there are."""
    from telebip.eval.report import write_tables
    from telebip.eval.study import IN_README
    from telebip.eval.tables import overview, short_overview

    out = Path(options.out)
    every = [*walkers.values(), *([results] for results in references())]
    pages = {out.with_suffix(".md"): overview(every)}
    if not options.quick and out.resolve() == ROOT / "docs" / "results":
        pages[ROOT / "README.md"] = [short_overview({name: walkers[name] for name in IN_README if name in walkers})]
    there = [page for page in pages if page.is_file()]  # an installed package has none
    for page in there:
        write_tables(page, pages[page])
    return there


def _walkers(out: Path, is_shipped: bool) -> dict[str, list[dict[str, Any]]]:
    """Return the results of every walker that has some, by its name."""
    from telebip.eval.study import BASELINES, TRAININGS

    walkers = {training.name: _seeds(out / training.name, is_shipped) for training in TRAININGS}
    files = {baseline.name: out / baseline.name / "results.json" for baseline in BASELINES}
    walkers |= {name: [_read(file)] for name, file in files.items() if file.is_file()}
    return {name: group for name, group in walkers.items() if group}


def _seeds(folder: Path, is_shipped: bool) -> list[dict[str, Any]]:
    """Return the results of a policy's seeds that were trained with the same task as the latest one, or the shipped one's."""
    files = {int(file.parent.name.removeprefix("seed")): file for file in folder.glob("seed*/results.json")}
    found = [_read(file) for _, file in sorted(files.items())]
    latest = max(found, key=lambda results: results["date"], default=None)
    if latest is None or is_shipped:
        return [latest] if latest else []
    return [results for results in found if (results["training"] or {}).get("task") == (latest["training"] or {}).get("task")]


class StudyProgress:
    """How far the whole study is: samples trained and policies measured, as environment steps."""

    def __init__(self, console: "Console", bar, runs: Sequence[Run], measurements: dict[str, float]) -> None:
        """Begin with what is done already."""
        self._console, self._bar, self._runs = console, bar, runs
        self._left = dict(measurements)
        self._trained = {run.name: run.total if run.is_finished else run.samples() for run in runs}
        self._goal = sum(run.total for run in runs) + sum(measurements.values())
        self._total = bar.add_task("the study", total=self._goal, eta="")
        self._lines: dict[str, Any] = {}
        self._began, self._before, self._said = time.monotonic(), self._done(), 0.0

    def trained(self, at_work: Sequence[Run]) -> None:
        """Show the runs that are being trained."""
        names = {run.name for run in at_work}
        for run in self._runs:
            if run.name in names or self._lines.get(run.name) is not None:
                self._trained[run.name] = run.total if run.is_finished else run.samples()
        for name in [name for name in self._lines if name not in names]:
            self._bar.remove_task(self._lines.pop(name))
        for run in at_work:
            if run.name not in self._lines:
                self._lines[run.name] = self._bar.add_task(run.name, total=run.total, eta="")
            self._bar.update(self._lines[run.name], completed=self._trained[run.name])
        self._update()

    def stop(self) -> None:
        """Take the bars away: the trainings are over, and measuring has a bar of its own."""
        self._bar.stop()

    def measured(self, walker: str) -> None:
        """Say how far the study is, now that one more policy of a walker is measured."""
        del self._left[next(key for key in self._left if key.split("/")[0] == walker)]
        done = self._done()
        self._console.print(f"{100.0 * done / self._goal:.0f} % of the study, eta {self._eta(done)}")

    def _done(self) -> float:
        return sum(self._trained.values()) + self._goal - sum(run.total for run in self._runs) - sum(self._left.values())

    def _update(self) -> None:
        done, now = self._done(), time.monotonic()
        self._bar.update(self._total, completed=done, eta=f"eta {self._eta(done)}")
        if not self._console.is_terminal and now - self._said > 60.0:
            self._said = now
            self._console.print(f"{100.0 * done / self._goal:.0f} % of the study, eta {self._eta(done)}")

    def _eta(self, done: float) -> str:
        gained = done - self._before
        if gained <= 0:
            return "-:--"
        seconds = (time.monotonic() - self._began) * (self._goal - done) / gained
        return f"{int(seconds // 3600)}:{int(seconds % 3600 // 60):02d}"


@contextmanager
def study_progress(console: "Console", runs: Sequence[Run], measurements: dict[str, float]) -> Iterator[StudyProgress]:
    """Yield the progress of the study; on a terminal a line for all and one for each training, of 80 columns at most."""
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

    columns = (TextColumn("{task.description:32.32}"), BarColumn(24), TaskProgressColumn(), TextColumn("{task.fields[eta]}"))
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        yield StudyProgress(console, bar, runs, measurements)


def _parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser("Train and measure every policy of the study and both model-based walkers, and report.", EXAMPLES)
    folders = "(default: docs/results; quick: runs/study_quick/results)"
    parser.add_argument("--out", metavar="DIR", help=f"where results and report go {folders}")
    parser.add_argument("--runs", metavar="DIR", help="where trainings go (default: runs/study; quick: runs/study_quick)")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="these walkers alone")
    parser.add_argument("--seeds", type=int, metavar="N", help="trainings of each policy: seeds 1 to N (default: 5; quick: 1)")
    parser.add_argument(
        "--jobs", type=int, metavar="N", help="trainings side by side (default: 2 on a CPU of two processors or more, else 1)"
    )
    parser.add_argument("--ship", action="store_true", help="copy the median seed of each policy to assets/policies")
    parser.add_argument("--shipped", action="store_true", help="measure the policies in assets/policies instead of training")
    parser.add_argument("--again", action="store_true", help="measure again what has been measured")
    parser.add_argument("--quick", action="store_true", help="toy size: two iterations, four worlds")
    parser.add_device()
    parser.add_allow_robot_change()
    options = parser.parse(argv)
    for name in ("seeds", "jobs"):
        if (value := getattr(options, name)) is not None and value < 1:
            raise UserError(f"--{name} must be 1 or more, got {value}")
    if options.shipped:
        for name in ("seeds", "jobs", "ship"):
            if getattr(options, name):
                raise UserError(f"--shipped measures the one policy that there is of each; leave out --{name}")
    options.out = options.out or ("runs/study_quick/results" if options.quick else "docs/results")
    options.runs = options.runs or ("runs/study_quick" if options.quick else "runs/study")
    options.ship_to = Path(options.runs, "shipped") if options.quick else SHIPPED
    options.seeds = options.seeds or (1 if options.quick else 5)
    return options
