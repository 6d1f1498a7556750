"""Make the pictures of README and docs anew: `python scripts/gallery.py`."""

from telebip.cli.common import run
from telebip.cli.gallery import main

if __name__ == "__main__":
    run(main)
