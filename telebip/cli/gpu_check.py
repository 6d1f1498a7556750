"""`gpu_check.py`: check telebip on a GPU in limited time."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from telebip import ROOT
from telebip.cli.common import Parser, resolve_device
from telebip.errors import UserError, nearest

EXAMPLES = """\
  gpu_check.py --minutes 6 --out check
  gpu_check.py --minutes 4 --out check --steps versions tests quick
  gpu_check.py --device cpu --out check                     (at toy size)
"""


def main(argv: Sequence[str] | None = None) -> None:
    """Parse arguments, run the steps, and print what they found."""
    options = _parse(argv)
    from telebip.tools.gpu_check import STEPS, Check, run_steps, summary

    for name in (*options.steps, options.run):
        if name and name not in STEPS:
            raise UserError(f"no step '{name}'; {nearest(name, STEPS)}")
    device = resolve_device(options.device)
    folder = options.out.resolve()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot write to '{options.out}': {error.strerror}") from error
    if options.run:
        STEPS[options.run][0](Check(device, folder))
        return
    command = [sys.executable, str(ROOT / "scripts/gpu_check.py"), "--device", str(device), "--out", str(folder), "--run"]
    is_whole = run_steps(options.steps or [*STEPS], 60.0 * options.minutes, folder, command)
    print("\n".join(["", *summary(folder), f"{folder} has results.jsonl and log.txt"]))
    if not is_whole:
        sys.exit(1)


def _parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        "Check telebip on a GPU within a time, the most valuable steps first: versions and one step, tests, training until it "
        "walks, speed, launches and waits, the article's training, determinism, other tasks, precision. What is found stands "
        "in a file at once. On a CPU everything is of toy size. From a checkout alone, as it runs tests.",
        EXAMPLES,
    )
    parser.add_argument("--minutes", type=float, default=6.0, metavar="M", help="time for all steps (default: 6)")
    parser.add_argument("--out", type=Path, default=Path("gpu_check"), metavar="DIR", help="default: gpu_check")
    parser.add_argument("--steps", nargs="+", default=[], metavar="STEP", help="some of them (default: all, in their order)")
    parser.add_argument("--run", metavar="STEP", help=argparse.SUPPRESS)  # one step, in this process
    parser.add_device()
    options = parser.parse(argv)
    if not options.minutes > 0.0:
        raise UserError(f"--minutes must be > 0, got {options.minutes:g}")
    return options
