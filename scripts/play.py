"""Walk a policy and record it: `python scripts/play.py --checkpoint assets/policies/telebip_flat`."""

from telebip.cli.common import run
from telebip.cli.play import main

if __name__ == "__main__":
    run(main)
