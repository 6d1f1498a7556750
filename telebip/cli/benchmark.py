"""`benchmark.py`: measure the speed of engine, environment and training."""

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from telebip.cli.common import Parser, check_outputs, open_checkpoint, resolve_device
from telebip.config import load_task, task_names
from telebip.errors import UserError

if TYPE_CHECKING:
    from telebip.rl.checkpoint import Checkpoint

EXAMPLES = """\
  benchmark.py
  benchmark.py --num-envs 4096 --rounds 20 --json speed.json --plot speed.png
  benchmark.py --task telebip_efficient --stock                           (beside rsl-rl's own PPO in float32)
  benchmark.py --device cuda --num-envs 4096 16384
"""

COLUMNS: dict[str, tuple[str, Callable[[float], str]]] = {
    "worlds": ("num_envs", "{:d}".format),
    "engine": ("engine_env_steps_per_s", "{:.0f}".format),
    "env": ("env_env_steps_per_s", "{:.0f}".format),
    "env/engine": ("env_over_engine", "{:.3f}".format),
    "collect": ("collect_env_steps_per_s", "{:.0f}".format),
    "learn": ("learn_env_steps_per_s", "{:.0f}".format),
    "train": ("train_env_steps_per_s", "{:.0f}".format),
    "train/stock": ("train_over_stock", "{:.2f}".format),
    "bytes/world": ("bytes_per_env", "{:d}".format),
}
"""Heading of the printed table -> field of a row, and how it is written."""


def main(argv: Sequence[str] | None = None) -> None:
    """Parse arguments, measure, print the table and write the files asked for."""
    options = _parse(argv)
    from telebip.cli.console import Console

    console = Console()
    with console.status("loading torch and the physics engine"):
        import torch

        from telebip.cli.evaluate import progress_bar
        from telebip.rl.benchmark import machine_name, measure
        from telebip.rl.process import prepare_cpu
        from telebip.rl.run import describe_code
        from telebip.robot import load_robot

    given = options.checkpoint
    checkpoint = open_checkpoint(given) if given else _shipped_for(options.task, options.overrides)
    policy = given or checkpoint.path.parent.name
    task = options.task or checkpoint.task
    configs = [load_task(options.task or checkpoint.config, [*options.overrides, f"num_envs={n}"]) for n in options.num_envs]
    if configs[0].ppo.symmetry != checkpoint.config.ppo.symmetry:
        raise UserError(
            f"checkpoint '{checkpoint.path}' has ppo.symmetry={checkpoint.config.ppo.symmetry}, and task '{task}' has "
            f"{configs[0].ppo.symmetry}; choose a --checkpoint that was trained like the task"
        )
    device = resolve_device(options.device)
    threads = torch.get_num_threads()
    if device.type == "cpu":
        prepare_cpu()
    robot = load_robot(configs[0].sim.robot)

    rows, done, total = [], 0, (options.rounds + 1) * sum(options.num_envs)
    with progress_bar(console) as show:
        for config in configs:

            def progress(worlds: int = config.num_envs) -> None:
                nonlocal done
                done += worlds
                show("measuring", done, total)

            show("measuring", done, total)
            stock_threads = threads if options.stock else 0
            rows.append(measure(config, robot, device, options.backend, checkpoint, options.rounds, stock_threads, progress))
            if not console.is_terminal:
                console.print(f"measured {config.num_envs} worlds")

    machine = machine_name(device)
    console.print(
        f"{task} on {machine} ({rows[0]['backend']}), torch threads: {threads}, update in {rows[0]['update']}; "
        f"environment steps per second, medians of {options.rounds} rounds"
    )
    console.print(table(rows))
    if options.json:
        content = {"machine": machine, "threads": threads, "task": task, "policy": policy, **describe_code(), "rows": rows}
        Path(options.json).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
        console.print(f"wrote {options.json}")
    if options.plot:
        from telebip.eval.plots import throughput

        throughput(rows, f"{task} on {machine}").savefig(options.plot, dpi=150, bbox_inches="tight")
        console.print(f"wrote {options.plot}")


def _shipped_for(task: str | None, overrides: Sequence[str]) -> "Checkpoint":
    """Return the policy of `assets/policies` that walks in a task: its own, or one that learned as much of the gait."""
    from telebip.rl.checkpoint import POLICIES

    symmetry = load_task(task or "telebip_flat", overrides).ppo.symmetry
    for name in (Path(task or "").stem, "telebip_flat"):
        if (POLICIES / name / "policy.pt").is_file():
            checkpoint = open_checkpoint(POLICIES / name)
            if checkpoint.config.ppo.symmetry == symmetry:
                return checkpoint
    return open_checkpoint(POLICIES / "telebip_efficient")


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the rows as text, a column for each of `COLUMNS` that they have."""
    columns = {heading: (field, form) for heading, (field, form) in COLUMNS.items() if field in rows[0]}
    lines = [list(columns), *([form(row[field]) for field, form in columns.values()] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in lines)


def _parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        "Measure, for several numbers of worlds, how many environment steps per second the physics engine alone does, the "
        "environment, collecting with a policy, and training.",
        EXAMPLES,
    )
    parser.add_argument(
        "--num-envs",
        type=int,
        nargs="+",
        default=[256, 1024, 4096, 16384],
        metavar="N",
        help="numbers of worlds (default: 256 1024 4096 16384)",
    )
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda or cuda:N (default: auto, which prefers CUDA)")
    parser.add_argument("--backend", default="auto", choices=("auto", "native", "warp"), help="physics engine (default: auto)")
    parser.add_argument("--task", metavar="NAME", help=f"{', '.join(task_names())}, or a YAML file (default: the policy's)")
    parser.add_argument(
        "--checkpoint",
        metavar="PATH_OR_RUN",
        help="the policy that walks (default: what comes with telebip for the task, or telebip_flat)",
    )
    parser.add_argument("--rounds", type=int, default=8, metavar="N", help="measurements of each number (default: 8)")
    parser.add_argument("--stock", action="store_true", help="measure training with rsl-rl's own PPO in float32 too")
    parser.add_argument("--json", metavar="FILE", help="write everything that was measured")
    parser.add_argument("--plot", metavar="FILE", help="draw the rates over the number of worlds (.png, .svg or .pdf)")
    parser.add_argument("overrides", nargs="*", metavar="key.path=value", help="override any field of the task")
    options = parser.parse(argv)
    for name, values in (("--num-envs", options.num_envs), ("--rounds", [options.rounds])):
        if min(values) < 1:
            raise UserError(f"{name} must be at least 1, got {min(values)}")
    check_outputs(options.json, options.plot)
    return options
