"""`train.py`: train a policy."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from telebip.cli.check import check
from telebip.cli.common import Parser, check_connect, check_listen, open_checkpoint
from telebip.cli.run_training import Start, View, train
from telebip.config import load_task, task_names
from telebip.errors import UserError
from telebip.viz.opengl import choose_opengl

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
