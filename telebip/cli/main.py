"""The `telebip` command: `telebip train`, `telebip play` and so on, from any folder; the same functions as `scripts/`."""

import sys
from collections.abc import Sequence
from types import ModuleType

from telebip import __version__
from telebip.cli import benchmark, common, evaluate, export, play, race, reproduce, sweep, train
from telebip.errors import UserError, nearest

COMMANDS: dict[str, ModuleType] = {
    "train": train,
    "play": play,
    "evaluate": evaluate,
    "reproduce": reproduce,
    "export": export,
    "benchmark": benchmark,
    "race": race,
    "sweep": sweep,
}
"""Name -> module with `main(argv)`; the first line of its docstring is the command's description."""


def main() -> None:
    """Run the command that the arguments name; what it returns or raises becomes the exit status, see `common.run`."""
    common.run(lambda: dispatch(sys.argv[1:]))


def dispatch(argv: Sequence[str]) -> None:
    """Call the command `argv[0]` with the other arguments.

    Raises:
        UserError: there is no such command.
    """
    name, *arguments = argv or ["--help"]
    if name in COMMANDS:
        COMMANDS[name].main(arguments)
    elif name in ("-h", "--help"):
        print(_help())
    elif name == "--version":
        print(f"telebip {__version__}")
    else:
        raise UserError(f"unknown command '{name}'; {nearest(name, COMMANDS)} (see telebip --help)")


def _help() -> str:
    lines = [f"  {name:12}{(module.__doc__ or '').splitlines()[0].partition(': ')[2]}" for name, module in COMMANDS.items()]
    return "\n".join(
        ["usage: telebip COMMAND [OPTIONS]", "", *lines, "", "telebip COMMAND --help lists a command's options, with examples."]
    )


if __name__ == "__main__":
    main()
