"""Train and measure everything in the study; see `python scripts/reproduce.py --help`."""

from telebip.cli.common import run
from telebip.cli.reproduce import main

if __name__ == "__main__":
    run(main)
