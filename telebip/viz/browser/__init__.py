"""Seeing and steering robots in a web browser, through viser."""

from importlib.util import find_spec

from telebip.errors import UserError

if not (find_spec("viser") and find_spec("mjviser")):
    raise UserError("--viewer browser takes viser and mjviser: pip install 'telebip[browser]'")
