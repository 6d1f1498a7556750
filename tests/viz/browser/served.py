"""A session that goes on while a test looks at it."""

import threading
import time
from collections.abc import Callable

from telebip.viz.browser.session import Session

PATIENCE = 120.0  # for what a browser does on a busy processor without a GPU [s]


class Served:
    """A session whose loop runs in a thread of its own."""

    def __init__(self, session: Session, url: str) -> None:
        self.session, self.url = session, url
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._error: BaseException | None = None
        self._thread.start()

    def _run(self) -> None:
        try:
            self.session.run(self._closing.is_set)
        except BaseException as error:
            self._error = error

    @property
    def steps(self) -> int:
        """Policy steps that the first walker has made."""
        return int(self.session.steered[0].env.state.num_steps)

    def close(self) -> None:
        self._closing.set()
        self._thread.join(PATIENCE)
        assert not self._thread.is_alive()
        if self._error:
            raise self._error


def wait_until(holds: Callable[[], object], what: str) -> None:
    """Wait until something holds, or fail."""
    end = time.monotonic() + PATIENCE
    while not holds():
        assert time.monotonic() < end, f"not within {PATIENCE:g} s: {what}"
        time.sleep(0.1)
