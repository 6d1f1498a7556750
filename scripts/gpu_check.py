"""Check telebip on a GPU in limited time; see `python scripts/gpu_check.py --help`."""

from telebip.cli.common import run
from telebip.cli.gpu_check import main

if __name__ == "__main__":
    run(main)
