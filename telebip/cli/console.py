"""A console whose reader may leave."""

import os
import sys

import rich.console


class Console(rich.console.Console):
    """Falls silent when its output cannot be written any more, so that the work goes on: `... | head`, a closed terminal."""

    def on_broken_pipe(self) -> None:
        """Print nothing from here on; what Python writes itself when it ends goes nowhere too."""
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())

    def _check_buffer(self) -> None:
        try:
            super()._check_buffer()
        except OSError:  # of a terminal that has been closed, say
            self.on_broken_pipe()
