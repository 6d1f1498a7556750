"""`race.py`: train beside rsl-rl's own PPO, from the same samples, and compare returns and time."""

import argparse
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from telebip.cli.common import Parser, check_outputs, checked_robot, resolve_device
from telebip.config import check, load_task, task_names
from telebip.errors import UserError

EXAMPLES = """\
  race.py
  race.py --task telebip_efficient --samples 8e6 --seeds 5 --json race.json --plot race.png
  race.py ppo.mixed_precision=never num_envs=2048
"""


def main(argv: Sequence[str] | None = None) -> None:
    """Parse arguments, train, print how it went and write the files asked for."""
    options = _parse(argv)
    from telebip.cli.console import Console

    console = Console()
    with console.status("loading torch and the physics engine"):
        import torch

        from telebip.cli.evaluate import progress_bar
        from telebip.rl.process import keep_freed_memory
        from telebip.rl.run import describe_code, machine_name
        from telebip.tools import plots
        from telebip.tools.race import RACERS, race, sentence, verdict

    first = load_task(options.task, options.overrides)
    configs = [check(replace(first, seed=first.seed + k)) for k in range(options.seeds)]
    device, threads = resolve_device(options.device), torch.get_num_threads()
    if device.type == "cpu":
        keep_freed_memory()
    robot, machine = checked_robot(first), machine_name(device)
    iterations = -(-options.samples // (first.num_envs * first.ppo.num_steps_per_env))

    races, done = [], 0
    with progress_bar(console) as show:

        def progress() -> None:
            nonlocal done
            done += 1
            show("training", done, iterations * len(configs))

        show("training", 0, iterations * len(configs))
        for config in configs:
            races.append(race(config, robot, device, options.backend, options.samples, progress))
            if None in (races[-1][name]["episode_return"][-1] for name in RACERS):
                raise UserError(f"no episode has ended after {races[-1]['samples'][-1]} samples; give more --samples")
            console.print(f"seed {config.seed}: {sentence(verdict(races[-1:]))}")
            if options.json:  # after every seed: nothing is lost
                about = {"machine": machine, "threads": threads, "task": options.task, "num_envs": first.num_envs}
                content = {**about, "device": str(device), **describe_code(), "verdict": verdict(races), "races": races}
                Path(options.json).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")

    found, title = verdict(races), f"{options.task}, {first.num_envs} worlds, networks in {races[0]['arithmetic']}"
    console.print(f"{title}, {found['samples']:,} samples on {machine} ({races[0]['backend']}), torch threads: {threads}")
    console.print(f"{len(races)} seed{'s' * (len(races) > 1)}: {sentence(found)}")
    if options.json:
        console.print(f"wrote {options.json}")
    if options.plot:
        plots.race(races, title).savefig(options.plot, dpi=150, bbox_inches="tight")
        console.print(f"wrote {options.plot}")


def _parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        "Train from scratch with telebip's learner and with rsl-rl's PPO as it stands, on the same networks. Both have worlds "
        "of their own, the same seeds and as many samples, and their iterations alternate: ratios hold on a busy machine.",
        EXAMPLES,
    )
    parser.add_argument("--task", default="telebip_flat", metavar="NAME", help=f"{', '.join(task_names())}, or a YAML file")
    parser.add_argument("--samples", type=whole_number, default=4_500_000, metavar="N", help="samples of each (default: 4.5e6)")
    parser.add_argument("--seeds", type=int, default=3, metavar="N", help="races, from the task's seed on (default: 3)")
    parser.add_engine()
    parser.add_argument("--json", metavar="FILE", help="write every iteration's return and time, after each seed")
    parser.add_argument("--plot", metavar="FILE", help="draw the returns over samples and over time (.png, .svg or .pdf)")
    parser.add_overrides()
    options = parser.parse(argv)
    for name, value in (("--samples", options.samples), ("--seeds", options.seeds)):
        if value < 1:
            raise UserError(f"{name} must be at least 1, got {value}")
    check_outputs(options.json, options.plot)
    return options


def whole_number(text: str) -> int:
    """Read `4500000` or `4.5e6`; argparse turns a ValueError into a refusal that quotes the text."""
    if not math.isfinite(number := float(text)):
        raise ValueError
    return int(number)
