"""`train.py`: train a policy."""

import argparse
import math
import signal
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from telebip.cli.check import check
from telebip.cli.common import (
    Parser,
    check_connect,
    check_listen,
    checked_robot,
    compare_robot,
    hint,
    open_checkpoint,
    resolve_device,
)
from telebip.config import TaskConfig, load_task, task_names
from telebip.errors import UserError
from telebip.viz.opengl import choose_opengl

if TYPE_CHECKING:
    from telebip.cli.console import Console
    from telebip.rl.checkpoint import Checkpoint
    from telebip.rl.distributed import Ranks
    from telebip.rl.train import Trainer
    from telebip.sim import Backend
    from telebip.viz.browser.server import Address

EXAMPLES = """\
  train.py --task telebip_quick --record
  train.py --task telebip_quick --until-walking
  train.py --task telebip_flat
  train.py --task telebip_fast --num-envs 2048 --max-iterations 500 ppo.num_steps_per_env=24
  train.py --resume runs/telebip_flat/2026-01-31_12-00-00 --max-iterations 400
  train.py --task robots/mine.yaml --check --picture stand.png    (is the robot fit to be trained?)
  train.py --task telebip_flat --viewer rerun               (curves and robots, live)
  train.py --task telebip_flat --viewer browser             (the same, and the newest policy can be steered)
  tensorboard --logdir runs
"""

LENGTHS = 60
"""Iterations in the sparkline of the episodes' length, as a share of the longest."""
RECORDED = 10.0
"""How long the walk lasts that `--record` records [s]."""

Report = Callable[[dict[str, float]], None]
"""Takes what TensorBoard gets of an iteration."""


@dataclass(frozen=True)
class Start:
    """What to train, and where it goes."""

    task: str  # its name
    config: TaskConfig
    run_dir: Path | None = None  # the run's folder, which must exist; None makes a new one in `log_dir`
    log_dir: Path = Path("runs")
    checkpoint: "Checkpoint | None" = None  # where to go on from
    allow_robot_change: bool = False  # whether on another robot


@dataclass(frozen=True)
class View:
    """How a training is looked at."""

    is_watched: bool = False  # in the rerun viewer, while it goes on
    connect: str | None = None  # address of a running viewer
    served: "Address | None" = None  # where a browser may watch it and steer its newest policy
    record: bool = False  # whether the policy's walk is recorded at the end


def main(argv: Sequence[str] | None = None) -> None:
    """Parse arguments and train."""
    options = _parse(argv)
    if options.record or options.picture:
        choose_opengl()
    start = _resumed(options) if options.resume else _new(options)
    if options.check:
        return check(start.task, start.config, Path(options.picture) if options.picture else None)
    served = options.listen if options.viewer == "browser" else None
    view = View(options.viewer == "rerun", options.connect, served, options.record)
    train(start, options.device, options.backend, options.until_walking, view)


def _new(options: argparse.Namespace) -> Start:
    """Return the start of a new run."""
    if not options.task:
        raise UserError(f"which task? --task {{{','.join(task_names())}}}, or --resume a run")
    config = load_task(options.task, _overrides(options))
    return Start(Path(options.task).stem, config, log_dir=Path(options.log_dir or "runs"))


def _resumed(options: argparse.Namespace) -> Start:
    """Return where a run goes on, in its own folder.

    Raises:
        UserError: the checkpoint is no place to go on from, or something asked for is not its own.
    """
    checkpoint = open_checkpoint(options.resume)
    from telebip.rl.resume import require_complete

    if options.task and Path(options.task).stem != checkpoint.task:
        raise UserError(f"checkpoint '{checkpoint.path}' is of task '{checkpoint.task}', not of '{options.task}'")
    require_complete(checkpoint)
    config = load_task(checkpoint.config, _overrides(options))
    if config.seed != checkpoint.config.seed:
        raise UserError(
            f"--resume goes on with the checkpoint's generators, of seed {checkpoint.config.seed}; leave out the seed "
            f"{config.seed}, or start a new run with it"
        )
    run_dir = checkpoint.path.resolve().parent
    return Start(checkpoint.task, config, run_dir, checkpoint=checkpoint, allow_robot_change=options.allow_robot_change)


def _overrides(options: argparse.Namespace) -> list[str]:
    named = {"num_envs": options.num_envs, "ppo.max_iterations": options.max_iterations, "seed": options.seed}
    return [f"{key}={value}" for key, value in named.items() if value is not None] + options.overrides


def train(
    start: Start,
    device_name: str = "auto",
    backend: "Backend" = "auto",
    until_walking: bool = False,
    view: View = View(),
) -> bool:
    """Train with progress and logs until the end, until the policy walks, or until Ctrl-C.

    Args:
        start: what to train, and where.
        device_name: as `resolve_device` takes it.
        backend: physics engine.
        until_walking: whether to end as soon as the policy walks, see `telebip.eval.walking`.
        view: how to look at it.

    Returns:
        Whether all iterations are done, or the policy walks and that was enough.
    """
    from telebip.cli.console import Console
    from telebip.rl.distributed import Ranks, joined

    ranks = Ranks.from_environment()
    console, is_watched = Console(quiet=not ranks.is_main), view.is_watched and ranks.is_main
    with console.status("loading torch and the physics engine"):
        from telebip.rl.process import keep_freed_memory
    if is_watched:
        from telebip.viz.rerun import require_viewer

        require_viewer(view.connect)
    device = resolve_device(ranks.device_name(device_name))
    if device.type == "cpu":
        keep_freed_memory()
    with joined(ranks, device), ExitStack() as stack:
        with console.status("creating the worlds (the warp backend compiles for a minute or two the first time)"):
            trainer = _make_trainer(start, ranks, str(device), backend, console)
        if is_watched or view.record:
            from telebip.viz.rerun import drawable

            drawable(trainer.env.robot)
        if ranks.is_main:  # after all that may be refused, so that this leaves no empty folder
            trainer.run_dir = stack.enter_context(_own_folder(start))
        if start.checkpoint and ranks.is_main:
            compare_robot(start.checkpoint, trainer.env.cfg.sim, trainer.env.robot)
        restart = trainer.resume(start.checkpoint, start.allow_robot_change) if start.checkpoint else ""
        total = start.config.ppo.max_iterations
        if trainer.iteration >= total:
            console.print(f"{trainer.run_dir} has finished its {total} iterations; raise --max-iterations to train on")
            return True
        if ranks.is_main:
            _prepare_folder(trainer, console)
        _announce(trainer, console, restart)
        asked = stack.enter_context(stop_on_signal(console))
        walking = None
        if until_walking and ranks.is_main:
            from telebip.eval.walking import UntilWalking

            walking = UntilWalking(trainer)
        report = stack.enter_context(progress_bar(console, trainer, walking))
        if is_watched:
            from telebip.viz.live import live_view

            report = _both(report, stack.enter_context(live_view(trainer, view.connect)))
        if view.served and ranks.is_main:
            report = _both(report, stack.enter_context(_in_browser(trainer, view.served, console)))
        trainer.learn(lambda: asked() or bool(walking and walking.walks()), report)
        walks = bool(walking and walking.walks())
        if walks:
            console.print(f"it walks after {trainer.samples / 1e6:.2f} M samples: {walking and walking.last}")
        if trainer.iteration < total:
            again = hint("train", "--resume", trainer.run_dir)
            console.print(f"stopped after iteration {trainer.iteration} of {total}; go on with: {again}")
        if ranks.is_main and view.record:
            _record(trainer, console)
    console.print(f"see it walk: {hint('play', '--checkpoint', trainer.run_dir, '--viewer', 'rerun')}")
    return walks or trainer.iteration >= total


def _record(trainer: "Trainer", console: "Console") -> None:
    """Let one robot walk for 10 s, record it in the run's folder, and draw it where there is OpenGL."""
    from telebip.env import TelebipEnv
    from telebip.eval.conditions import as_evaluated
    from telebip.eval.learning import learning_curve
    from telebip.rl.policy import load_network
    from telebip.rollout import roll_out
    from telebip.viz.drawing import draw_learning
    from telebip.viz.picture import strobe
    from telebip.viz.rerun import record
    from telebip.viz.scene import line_up

    cfg, run_dir = trainer.env.cfg, trainer.run_dir
    env = TelebipEnv(as_evaluated(cfg, 1, RECORDED), trainer.env.robot, trainer.env.device, trainer.env.sim.backend)
    env.set_command(*(0.5 * (low + high) for low, high in cfg.commands.ranges))
    rollout = roll_out(env, load_network(trainer.policy(), env.device), round(RECORDED / env.step_dt))
    actors = line_up([(trainer.task, rollout)])
    record(actors, env.robot, run_dir / "walk.rrd")
    console.print(f"recorded its walk; look at it with: rerun {run_dir / 'walk.rrd'}")
    curves = learning_curve(run_dir)
    if curves:
        draw_learning(curves, trainer.task).savefig(run_dir / "learning.png", dpi=150)
        console.print(f"drew {run_dir / 'learning.png'}")
    try:
        strobe(actors[0], env.robot, run_dir / "walk.png")
        console.print(f"drew {run_dir / 'walk.png'}")
    except UserError as error:
        console.print(f"note: no picture of it: {error}")


def _make_trainer(start: Start, ranks: "Ranks", device: str, backend: "Backend", console: "Console") -> "Trainer":
    """Create this process's worlds, of a seed of their own, and its learner."""
    from telebip.env import TelebipEnv
    from telebip.rl.train import Trainer

    config = replace(start.config, seed=start.config.seed + ranks.rank)
    env = TelebipEnv(config, checked_robot(config, is_quiet=not ranks.is_main), device, backend)
    return Trainer(env, start.task, Path(), ranks, note=lambda line: console.print(f"note: {line}"))


@contextmanager
def _own_folder(start: Start) -> Iterator[Path]:
    """Yield the run's folder, which no other process trains in meanwhile.

    Raises:
        UserError: another one does or did so since the checkpoint was loaded, or a file that the run goes on with is damaged.
    """
    from telebip.rl.checkpoint import require_unchanged
    from telebip.rl.curve import rows_so_far
    from telebip.rl.run import create_run_dir, exclusive, read_starts

    run_dir = start.run_dir or create_run_dir(start.log_dir, start.task)
    with exclusive(run_dir):
        require_unchanged(run_dir, start.checkpoint)
        rows_so_far(run_dir)  # whole, or refused before anything is changed; so is the next
        read_starts(run_dir)
        yield run_dir


def _prepare_folder(trainer: "Trainer", console: "Console") -> None:
    """Make the run's folder ready to be written to from the trainer's iteration on."""
    from telebip.rl.checkpoint import set_aside_newer
    from telebip.rl.run import describe_run, require_space

    run_dir, env = trainer.run_dir, trainer.env
    require_space(run_dir, trainer.checkpoint_bytes(), env.cfg.ppo.keep_checkpoints)
    for file in set_aside_newer(run_dir, trainer.iteration):
        console.print(f"note: {file.name} is from after the checkpoint to go on from, and is in {file.parent} now")
    describe_run(run_dir, env.cfg, str(env.device), env.sim.backend, trainer.ranks.size)


def _announce(trainer: "Trainer", console: "Console", restart: str) -> None:
    """Print what is trained, how and where."""
    env, size = trainer.env, trainer.ranks.size
    worlds = f"{env.num_envs} worlds" if size == 1 else f"{size} processes x {env.num_envs} worlds"
    console.print(f"{trainer.task}: {worlds} on {env.device} ({env.sim.backend}), networks in {trainer.arithmetic}")
    console.print(f"writing to {trainer.run_dir}")
    if trainer.iteration:
        console.print(f"resuming after iteration {trainer.iteration} of {env.cfg.ppo.max_iterations}")
    if restart:
        console.print(f"note: the worlds start new episodes, as {restart}")


@contextmanager
def _in_browser(trainer: "Trainer", address: "Address", console: "Console") -> Iterator[Report]:
    """Serve the training to browsers, and say where."""
    from telebip.viz.browser.training import live_session

    with live_session(trainer, address) as (served, report):
        for line in served.advice():
            console.print(line)
        yield report


def _both(first: Report, second: Report) -> Report:
    def report(scalars: dict[str, float]) -> None:
        first(scalars)
        second(scalars)

    return report


def _parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser("Train a walking policy with PPO in thousands of parallel worlds.", EXAMPLES)
    parser.add_argument("--task", metavar="NAME", help=f"{', '.join(task_names())}, or a path to a YAML file")
    parser.add_argument("--num-envs", metavar="N", help="worlds in parallel (default: the task's num_envs)")
    parser.add_argument("--max-iterations", metavar="N", help="total of the run (default: the task's ppo.max_iterations)")
    parser.add_argument("--seed", metavar="S", help="of worlds and networks (default: the task's seed)")
    parser.add_device()
    parser.add_argument(
        "--backend",
        default="auto",
        choices=("auto", "native", "warp"),
        help="physics engine: native is C MuJoCo on the CPU, warp is MuJoCo Warp (default: auto, warp on CUDA, else native)",
    )
    parser.add_argument("--log-dir", metavar="DIR", help="the run writes to DIR/<task>/<time> (default: runs)")
    parser.add_argument(
        "--resume",
        metavar="RUN_OR_CHECKPOINT",
        help="go on with a run, in its folder and with its configuration, up to --max-iterations in all",
    )
    parser.add_argument(
        "--until-walking",
        action="store_true",
        help="end as soon as the policy walks: no falls and mean speeds within 10 %%, twice in a row, ten iterations apart",
    )
    parser.add_argument(
        "--record", action="store_true", help="at the end, leave walk.rrd, walk.png and learning.png in the run's folder"
    )
    parser.add_argument(
        "--check", action="store_true", help="train nothing: let the robot stand, and say what is wrong with it"
    )
    parser.add_argument("--picture", metavar="FILE.png", help="with --check, draw it in its home pose and a second later")
    parser.add_argument(
        "--viewer", choices=("none", "rerun", "browser"), default="none", help="watch the training (default: none)"
    )
    parser.add_argument("--listen", metavar="HOST:PORT", help="of --viewer browser (default: 127.0.0.1:8080)")
    parser.add_argument("--connect", metavar="HOST:PORT", help="a running rerun viewer (default: start one here)")
    parser.add_allow_robot_change()
    parser.add_overrides()
    options = parser.parse(argv)
    check_connect(options)
    check_listen(options)
    if options.allow_robot_change and not options.resume:
        raise UserError("--allow-robot-change goes with --resume: a new run has no other robot")
    if options.picture and not options.check:
        raise UserError("--picture shows what --check has found; it goes with --check")
    if options.resume and options.log_dir:
        raise UserError("--resume goes on in the run's own folder; leave out --log-dir")
    return options


@contextmanager
def stop_on_signal(console):
    """Yield a function that tells whether to stop: one Ctrl-C ends the run after its iteration, a second one at once.

    So do SIGTERM and, as a terminal that is closed sends it, SIGHUP; not where `nohup` has said to ignore that.
    """
    asked = False

    def handle(signum: int, frame: object) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True
        console.print("stopping after this iteration with a checkpoint (press Ctrl-C again to leave at once)")

    numbers = [signal.SIGINT, signal.SIGTERM]
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    previous = {number: signal.signal(number, handle) for number in numbers}
    try:
        yield lambda: asked
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextmanager
def progress_bar(console, trainer, walking=None):
    """Yield a function that shows an iteration's scalars: three live lines on a terminal, else a line per fiftieth of the run.

    Iteration, time left, whether it walks and the speed error come first, and are whole on 60 columns.
    """
    from rich.console import Group
    from rich.live import Live
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.text import Text

    total = trainer.env.cfg.ppo.max_iterations
    every, lengths, below = max(1, total // 50), deque(maxlen=LENGTHS), Text("starting", overflow="ellipsis", no_wrap=True)
    columns = (MofNCompleteColumn(), TextColumn("eta"), TimeRemainingColumn(), BarColumn(20), TimeElapsedColumn())
    progress = Progress(*columns, console=console, speed_estimate_period=600)
    task = progress.add_task("", total=total, completed=trainer.iteration)

    def show(scalars: dict[str, float]) -> None:
        if math.isfinite(scalars["train/episode_length"]):  # until an episode has ended there is none
            lengths.append(scalars["train/episode_length"] / trainer.env.max_episode_length)
        lines = _progress_lines(scalars, trainer, walking)
        below.plain = "\n".join([*lines, f"length {sparkline(lengths)}"])
        progress.update(task, completed=trainer.iteration)
        if not console.is_terminal and (trainer.iteration % every == 0 or trainer.iteration == total):
            console.print(f"{trainer.iteration:5d}/{total}  {' | '.join(lines)}", soft_wrap=True)

    with Live(Group(progress, below), console=console, refresh_per_second=4) if console.is_terminal else nullcontext():
        yield show


def _progress_lines(scalars: dict[str, float], trainer: "Trainer", walking) -> list[str]:
    """Return what an iteration has brought, in lines of less than 60 characters, as a rule."""
    lines = [
        f"error {scalars['error/lin_vel_mps']:.2f} m/s | {scalars['walk/falls_per_minute']:.1f} falls/min | "
        f"length {scalars['train/episode_length']:.0f}/{trainer.env.max_episode_length}",
        f"{trainer.samples / 1e6:.2f} M samples at {scalars['speed/samples_per_s'] / 1e3:.1f} k/s | "
        f"return {scalars['train/episode_return']:.1f}",
    ]
    if walking and walking.last:
        lines.insert(0, f"{'walks' if walking.last.passed else 'not yet'}: {walking.last}")
    return lines


def sparkline(shares: Iterable[float]) -> str:
    """Return a bar of an eighth to eight eighths for each share from 0 to 1."""
    return "".join("▁▂▃▄▅▆▇█"[min(7, max(0, int(8.0 * share)))] for share in shares)
