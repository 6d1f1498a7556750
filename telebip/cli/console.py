"""The console that commands print to; imported late, as rich takes its time."""

import contextlib
import io
import sys

import rich.console

from telebip.cli.common import silence_stdout


class Console(rich.console.Console):
    """Prints texts as they are, brackets in paths too, and signs that the encoding lacks as question marks.

    Falls silent when its output cannot be written any more, so that the work goes on: `... | head`, a closed terminal.
    """

    def __init__(self, quiet: bool = False) -> None:
        """Print to standard output, or nothing at all if `quiet`."""
        with contextlib.suppress(OSError):  # of a stream that cannot be changed any more
            if isinstance(sys.stdout, io.TextIOWrapper):
                sys.stdout.reconfigure(errors="replace")
        super().__init__(highlight=False, soft_wrap=True, markup=False, emoji=False, quiet=quiet)

    def on_broken_pipe(self) -> None:
        """Print nothing from here on."""
        self.quiet = True
        silence_stdout()

    def _check_buffer(self) -> None:
        try:
            super()._check_buffer()
        except OSError:  # of a terminal that has been closed, say
            self.on_broken_pipe()
