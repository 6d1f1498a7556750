"""`reproduce.py`: the whole study with one command, which goes on where it was stopped."""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from telebip.cli.common import Parser, open_checkpoint, resolve_device
from telebip.cli.evaluate import checkpoint_candidate, controller_candidate, measure, references
from telebip.config import load_task
from telebip.errors import UserError, nearest

EXAMPLES = """\
  reproduce.py                                  train and measure what is not yet, and write the report
  reproduce.py --only telebip_efficient dcm     these alone
  reproduce.py --only telebip_flat --seeds 3    the same policy from three seeds, each with its rows in the report
  reproduce.py --shipped                        no training: measure the policies in assets/policies
  reproduce.py --quick                          the same at a toy size, in a minute, apart from the real one
"""

QUICK_TRAINING = ("num_envs=64", "ppo.max_iterations=2", "ppo.hidden_dims=[32,32]")
SHIPPED = Path("assets/policies")  # of telebip's own folder
INTRODUCTION = (
    "Reinforcement learning and two model-based walkers on one robot, measured by one evaluator; in grey, and in the last "
    "rows, the article's own numbers, which belong to its own robot. Trainings: {trainings}. Every number comes from "
    "`scripts/reproduce.py`."
)


def main(argv: Sequence[str] | None = None) -> None:
    """Parse arguments, train, measure and report."""
    options = _parse(argv)
    from telebip.cli.console import Console

    console = Console()
    with console.status("loading torch and the physics engine"):
        from telebip.eval.report import make_folder, write_report
        from telebip.eval.study import BASELINES, TRAININGS
    names = [walker.name for walker in (*TRAININGS, *BASELINES)]
    for name in options.only:
        if name not in names:
            raise UserError(f"unknown walker '{name}'; {nearest(name, names)}")
    out = Path(options.out)
    make_folder(out)
    only = options.only or names
    for training in (training for training in TRAININGS if training.name in only):
        for seed in range(1, options.seeds + 1):
            run_dir = SHIPPED / training.name if options.shipped else _train(console, training, seed, options)
            if run_dir is None:
                return
            name, label = training.name, training.label
            if seed > 1:
                name, label = f"{name}-seed{seed}", f"{label}, seed {seed}"
            _measure(
                console,
                out / name,
                training,
                options,
                checkpoint_candidate(str(run_dir), label, (), options.allow_robot_change),
            )
    for baseline in (baseline for baseline in BASELINES if baseline.name in only):
        candidate = controller_candidate(baseline.controller, baseline.label, baseline.overrides)
        _measure(console, out / baseline.name, baseline, options, candidate)
    results = {name: [_read(file) for file in _measured(out, name, seeds=not options.shipped)] for name in names}
    seeds = [f"{t.label} ({n} seed{'s' if n > 1 else ''})" for t in TRAININGS if (n := len(results[t.name]))]
    text = INTRODUCTION.format(trainings=", ".join(seeds) or "none")
    write_report([one for each in results.values() for one in each], out, "The study", text, references())
    console.print(f"wrote report.md and report.html, about {sum(map(bool, results.values()))} of {len(names)} walkers, to")
    console.print(f"{out}")


def _measured(out: Path, name: str, seeds: bool) -> list[Path]:
    """Return the results of one walker that are there, of its first seed first, and of the other `seeds` if asked for."""
    files = [out / name / "results.json", *(sorted(out.glob(f"{name}-seed*/results.json")) if seeds else ())]
    return [file for file in files if file.is_file()]


def _read(file: Path):
    """Return results, or raise a `UserError` unless the report can show them."""
    from telebip.eval.report import can_be_shown, read_results

    results = read_results(file)
    if not can_be_shown(results):
        raise UserError(f"results '{file}' lack some of what the report shows; measure them again (--again), or delete them")
    return results


def _train(console, training, seed: int, options: argparse.Namespace) -> Path | None:
    """Train, or go on training, one policy; return its run folder, or None if the user stopped it."""
    from telebip.cli.train import Start, train
    from telebip.eval.report import make_folder

    run_dir = Path(options.runs) / f"{training.name}-seed{seed}"
    config = load_task(training.task, [*training.overrides, *(QUICK_TRAINING if options.quick else ())])
    config = replace(config, seed=seed)
    checkpoint = open_checkpoint(run_dir) if any(run_dir.glob("model_*.pt")) else None
    if checkpoint and checkpoint.iteration >= config.ppo.max_iterations:
        console.print(f"{training.name}, seed {seed}: trained already, {checkpoint.samples / 1e6:.1f} M samples\n{run_dir}")
        return run_dir
    make_folder(run_dir)
    console.print(f"{training.name}, seed {seed}: training")
    start = Start(training.task, config, run_dir, checkpoint=checkpoint, allow_robot_change=options.allow_robot_change)
    return run_dir if train(start, options.device) else None


def _measure(console, out: Path, walker, options: argparse.Namespace, candidate) -> None:
    """Measure one walker, unless complete results of the same policy or parameters, measured in the same way, are there."""
    from telebip.eval.push import PushProtocol
    from telebip.eval.suites import Protocol

    if options.quick:
        push = PushProtocol(max_force=10.0, worlds=2, warmup=0.5, horizons=(1.0, 2.0))
        protocol = Protocol(worlds=4, duration=3.0, skip=1.0, push=push)
    else:
        protocol = Protocol(device=resolve_device(options.device))
    file = out / "results.json"
    if not options.again and _is_current(file, candidate, walker.suites, protocol):
        console.print(f"{walker.name}: measured already")
        return
    measure(console, candidate, walker.suites, protocol, out)
    console.print(f"{walker.name}: measured\n{file}")


def _is_current(file: Path, candidate, suites: Sequence[str], protocol) -> bool:
    """Whether a file holds what would be measured again; a missing, damaged or older one does not."""
    from telebip.eval.suites import is_current

    try:
        return file.is_file() and is_current(_read(file), candidate, suites, protocol)
    except UserError:
        return False


def _parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser("Train and measure every policy of the study and both model-based walkers, and report.", EXAMPLES)
    folders = "(default: docs/results; quick: runs/study_quick/results)"
    parser.add_argument("--out", metavar="DIR", help=f"where results and report go {folders}")
    parser.add_argument("--runs", metavar="DIR", help="where trainings go (default: runs/study; quick: runs/study_quick)")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="these walkers alone")
    parser.add_argument("--shipped", action="store_true", help="measure the policies in assets/policies instead of training")
    parser.add_argument("--seeds", type=int, default=1, metavar="N", help="trainings of each policy: seeds 1 to N (default: 1)")
    parser.add_argument("--again", action="store_true", help="measure again what has been measured")
    parser.add_argument("--quick", action="store_true", help="toy size: two iterations, four worlds")
    parser.add_device()
    parser.add_allow_robot_change()
    options = parser.parse(argv)
    options.out = options.out or ("runs/study_quick/results" if options.quick else "docs/results")
    options.runs = options.runs or ("runs/study_quick" if options.quick else "runs/study")
    if options.shipped and options.seeds != 1:
        raise UserError("--shipped measures the one policy that there is of each; leave out --seeds")
    if options.seeds < 1:
        raise UserError(f"--seeds must be 1 or more, got {options.seeds}")
    return options
