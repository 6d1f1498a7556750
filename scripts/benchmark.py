"""Measure the speed of engine, environment and training; see `python scripts/benchmark.py --help`."""

from telebip.cli.benchmark import main
from telebip.cli.common import run

if __name__ == "__main__":
    run(main)
