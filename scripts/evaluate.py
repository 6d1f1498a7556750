"""Measure a policy and write a report; see `python scripts/evaluate.py --help`."""

from telebip.cli.common import run
from telebip.cli.evaluate import main

if __name__ == "__main__":
    run(main)
