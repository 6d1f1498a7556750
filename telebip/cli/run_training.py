"""One training from its start to its end: the worlds, the run's folder, who watches it, and what is recorded of it."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from telebip.cli.common import checked_robot, compare_robot, hint, resolve_device, stop_on_signal
from telebip.cli.progress import training_progress
from telebip.config import TaskConfig
from telebip.errors import UserError

if TYPE_CHECKING:
    from telebip.cli.console import Console
    from telebip.rl.checkpoint import Checkpoint
    from telebip.rl.distributed import Ranks
    from telebip.rl.train import Trainer
    from telebip.sim import Backend
    from telebip.viz.browser.server import Address

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
        report = stack.enter_context(training_progress(console, trainer, walking))
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
