"""`gallery.py`: make the pictures of README and docs anew, from a policy."""

from collections.abc import Sequence
from pathlib import Path

from telebip import ROOT
from telebip.cli.common import Parser, open_checkpoint
from telebip.cli.evaluate import speed
from telebip.errors import UserError, nearest
from telebip.viz.opengl import choose_opengl

EXAMPLES = """\
  gallery.py
  gallery.py --checkpoint assets/policies/telebip_flat --only walking.gif stride.png
"""


def main(argv: Sequence[str] | None = None) -> None:
    """Parse arguments and draw."""
    parser = Parser("Make the pictures of walkers in README and docs anew, from the shipped policy.", EXAMPLES)
    parser.add_argument("--checkpoint", metavar="PATH_OR_RUN", default=str(ROOT / "assets" / "policies" / "telebip_efficient"))
    parser.add_argument("--command", nargs=3, type=speed, metavar=("VX", "VY", "WZ"), default=(0.7, 0.0, 0.0))
    parser.add_argument("--out", metavar="DIR", type=Path, default=ROOT / "docs" / "images", help="default: docs/images")
    parser.add_argument("--only", nargs="+", metavar="PICTURE", help="files of docs/images (default: all)")
    options = parser.parse(argv)
    choose_opengl()
    from telebip.eval.report import make_folder
    from telebip.tools.gallery import PICTURES, Gallery

    for name in options.only or ():
        if name not in PICTURES:
            raise UserError(f"no picture '{name}'; {nearest(name, PICTURES)}")
    make_folder(options.out)
    gallery = Gallery(open_checkpoint(options.checkpoint), tuple(options.command))
    for name in options.only or PICTURES:
        file = options.out / name
        note = PICTURES[name](gallery, file)
        print(f"{file}: {note}" if note else f"{file}: {file.stat().st_size / 1e3:.0f} kB", flush=True)
