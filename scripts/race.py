"""Race telebip's training against rsl-rl's own PPO; see `python scripts/race.py --help`."""

from telebip.cli.common import run
from telebip.cli.race import main

if __name__ == "__main__":
    run(main)
