"""Compare settings of a task by how soon they walk; see `python scripts/sweep.py --help`."""

from telebip.cli.common import run
from telebip.cli.sweep import main

if __name__ == "__main__":
    run(main)
