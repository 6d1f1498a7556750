"""Train a policy: `python scripts/train.py --task telebip_flat`."""

from telebip.cli.common import run
from telebip.cli.train import main

if __name__ == "__main__":
    run(main)
