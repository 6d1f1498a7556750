"""`sweep.py`: train settings x seeds until they walk, and compare the time and the samples it took."""

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from telebip.cli.common import Parser, check_outputs, checked_robot, resolve_device
from telebip.config import check, load_task, task_names
from telebip.errors import UserError

EXAMPLES = """\
  sweep.py --task telebip_quick
  sweep.py --task telebip_quick --setting "kl 0.03: ppo.desired_kl=0.03" --setting "no push: events.push=null" --json sweep.json
  sweep.py --task telebip_efficient --whole --seeds 5 --json efficient.json --plot efficient.png
"""


def main(argv: Sequence[str] | None = None) -> None:
    """Parse arguments, train, print a table and write the files asked for."""
    options = _parse(argv)
    from telebip.cli.console import Console

    console = Console()
    with console.status("loading torch and the physics engine"):
        import torch

        from telebip.cli.evaluate import progress_bar
        from telebip.rl.process import keep_freed_memory
        from telebip.rl.run import describe_code, machine_name
        from telebip.tools import plots
        from telebip.tools.sweep import train_once, verdict

    configs = _configs(options)
    device = resolve_device(options.device)
    if device.type == "cpu":
        keep_freed_memory()
    about = {"machine": machine_name(device), "threads": torch.get_num_threads(), "device": str(device), "task": options.task}
    results: dict[str, list[dict[str, Any]]] = {label: [] for label in configs}
    with progress_bar(console) as show:
        for label, seeds in configs.items():
            for config in seeds:
                robot = checked_robot(config)
                result = train_once(options.task, config, robot, device, options.backend, not options.whole, show)
                results[label].append(result)
                console.print(f"{label}, seed {config.seed}: {_walked(verdict([result]))}")
                if options.json:  # after every training: nothing is lost
                    found = {name: verdict(done) for name, done in results.items() if done}
                    content = {**about, **describe_code(), "settings": options.setting, "verdict": found, "results": results}
                    Path(options.json).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    console.print(
        f"\n{options.task} on {about['machine']}, torch threads: {about['threads']}; {options.seeds} seeds: median (worst)"
    )
    for label, done in results.items():
        console.print(f"  {label}: {_walked(verdict(done))}")
    if options.plot:
        plots.sweep(results, options.task).savefig(options.plot, dpi=150, bbox_inches="tight")
        console.print(f"wrote {options.plot}")


def _configs(options: argparse.Namespace) -> dict[str, list[Any]]:
    """Return each setting's tasks, one a seed; all of them are checked before anything is trained."""
    settings = dict(_setting(text) for text in options.setting) or {"as it is": []}
    if len(settings) < len(options.setting):
        raise UserError("--setting: two settings have the same label")
    loaded = {label: load_task(options.task, [*options.overrides, *own]) for label, own in settings.items()}
    return {
        label: [check(replace(config, seed=config.seed + k)) for k in range(options.seeds)] for label, config in loaded.items()
    }


def _setting(text: str) -> tuple[str, list[str]]:
    label, colon, overrides = text.partition(":")
    if not colon or not label.strip():
        raise UserError(f"--setting is 'LABEL: key.path=value ...', got '{text}'")
    return label.strip(), overrides.split()


def _walked(found: dict[str, Any]) -> str:
    """Return a verdict in words."""
    text = "does not walk"
    if found["walked"]:
        text = f"walks after {_pair(found['seconds'], '.1f')} s and {_pair(found['samples'], '.2f', 1e-6)} M samples"
        if found["seeds"] > found["walked"]:
            text += f", {found['walked']} of {found['seeds']} seeds"
    if "falls" in found:
        text += f"; after {_pair(found['end_seconds'], '.0f')} s speeds within {_pair(found['speed_error'], '.1f', 100.0)} %, "
        text += f"cost of transport {_pair(found['cost_of_transport'], '.3f')}, {found['falls']} falls"
    return text


def _pair(values: tuple[float | None, float | None], form: str, unit: float = 1.0) -> str:
    """Return a median, and the worst value in brackets where it differs."""
    middle, worst = ("never" if value is None else format(unit * value, form) for value in values)
    return middle if middle == worst else f"{middle} ({worst})"


def _parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        "Train a task under several settings, several seeds each, and compare how soon they walk: no falls, and mean speeds "
        "within 10 % of the commands, in two looks in a row. Seconds are of collecting and learning alone.",
        EXAMPLES,
    )
    parser.add_argument(
        "--task",
        default="telebip_quick",
        metavar="NAME",
        help=f"{', '.join(task_names())}, or a YAML file (default: telebip_quick)",
    )
    parser.add_argument(
        "--setting", action="append", default=[], metavar="'LABEL: KEY=VALUE ...'", help="overrides to compare; may be repeated"
    )
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help="seeds, from the task's on (default: 5)")
    parser.add_argument("--whole", action="store_true", help="train all ppo.max_iterations, and measure the policy then")
    parser.add_engine()
    parser.add_argument("--json", metavar="FILE", help="write every iteration's numbers, after each training")
    parser.add_argument("--plot", metavar="FILE", help="draw the curves over samples and over seconds (.png, .svg or .pdf)")
    parser.add_overrides("override any field of the task, in all settings")
    options = parser.parse(argv)
    if options.seeds < 1:
        raise UserError(f"--seeds must be at least 1, got {options.seeds}")
    check_outputs(options.json, options.plot)
    return options
