"""`benchmark.py`: measure the speed of engine, environment and training."""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

from telebip.cli.common import Parser, check_outputs, checked_robot, open_checkpoint, resolve_device
from telebip.config import task_names
from telebip.errors import UserError

EXAMPLES = """\
  benchmark.py
  benchmark.py --num-envs 4096 --rounds 20 --json speed.json --plot speed.png
  benchmark.py --task telebip_efficient --stock                           (beside rsl-rl's own PPO)
  benchmark.py --device cuda --num-envs 4096 16384
"""


def main(argv: Sequence[str] | None = None) -> None:
    """Parse arguments, measure, print the table and write the files asked for."""
    options = _parse(argv)
    from telebip.cli.console import Console

    console = Console()
    with console.status("loading torch and the physics engine"):
        import torch

        from telebip.cli.evaluate import progress_bar
        from telebip.rl.process import keep_freed_memory
        from telebip.rl.run import describe_code, machine_name
        from telebip.tools.benchmark import configurations, measure, shipped_for, table

    given = options.checkpoint
    checkpoint = open_checkpoint(given) if given else shipped_for(options.task, options.overrides)
    task, policy = options.task or checkpoint.task, given or checkpoint.path.parent.name
    configs = configurations(options.task, checkpoint, options.overrides, options.num_envs)
    device = resolve_device(options.device)
    if device.type == "cpu":
        keep_freed_memory()
    robot, machine, threads = checked_robot(configs[0]), machine_name(device), torch.get_num_threads()

    rows, done, total = [], 0, (options.rounds + 1) * sum(options.num_envs)
    with progress_bar(console) as show:
        for config in configs:

            def progress(worlds: int = config.num_envs) -> None:
                nonlocal done
                done += worlds
                show("measuring", done, total)

            show("measuring", done, total)
            rows.append(measure(config, robot, device, options.backend, checkpoint, options.rounds, options.stock, progress))
            if not console.is_terminal:
                console.print(f"measured {config.num_envs} worlds")

    console.print(
        f"{task} on {machine} ({rows[0]['backend']}), torch threads: {threads}, networks in {rows[0]['arithmetic']}; "
        f"environment steps per second, medians of {options.rounds} rounds"
    )
    console.print(table(rows))
    if options.json:
        content = {"machine": machine, "threads": threads, "task": task, "policy": policy, **describe_code(), "rows": rows}
        Path(options.json).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
        console.print(f"wrote {options.json}")
    if options.plot:
        from telebip.tools.plots import throughput

        throughput(rows, f"{task} on {machine}").savefig(options.plot, dpi=150, bbox_inches="tight")
        console.print(f"wrote {options.plot}")


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
    parser.add_engine()
    parser.add_argument("--task", metavar="NAME", help=f"{', '.join(task_names())}, or a YAML file (default: the policy's)")
    parser.add_argument(
        "--checkpoint",
        metavar="PATH_OR_RUN",
        help="the policy that walks (default: what comes with telebip for the task, or telebip_flat)",
    )
    parser.add_argument("--rounds", type=int, default=8, metavar="N", help="measurements of each number (default: 8)")
    parser.add_argument("--stock", action="store_true", help="measure training with rsl-rl's own PPO too")
    parser.add_argument("--json", metavar="FILE", help="write everything that was measured")
    parser.add_argument("--plot", metavar="FILE", help="draw the rates over the number of worlds (.png, .svg or .pdf)")
    parser.add_overrides()
    options = parser.parse(argv)
    for name, values in (("--num-envs", options.num_envs), ("--rounds", [options.rounds])):
        if min(values) < 1:
            raise UserError(f"{name} must be at least 1, got {min(values)}")
    check_outputs(options.json, options.plot)
    return options
