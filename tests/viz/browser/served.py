"""A session that goes on while a test looks at it."""

import threading
import time
from collections.abc import Callable

import msgspec
import viser
import zstandard
from websockets import Subprotocol
from websockets.sync.client import ClientConnection, connect
from websockets.sync.connection import Connection

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


CAMERA = {
    "type": "ViewerCameraMessage",
    **{"wxyz": (1.0, 0.0, 0.0, 0.0), "position": (2.0, 0.0, 1.0), "look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, 0.0, 1.0)},
    **{"fov": 1.0, "near": 0.01, "far": 100.0, "image_height": 480, "image_width": 640},
}


def open_tab(url: str) -> ClientConnection:
    """Connect as a page does, and say where its camera is: from then on it counts as a tab."""
    protocol = Subprotocol(f"viser-v{viser.__version__}")
    tab = connect(url.replace("http", "ws"), subprotocols=[protocol], max_size=None, max_queue=1)
    tab.send(msgspec.msgpack.encode(CAMERA))
    return tab


def read(tab: Connection, timeout: float) -> bytes:
    """Return the texts of the next message to a page: viser compresses them, after two lengths of eight bytes."""
    message = bytes(tab.recv(timeout=timeout, decode=False))
    return zstandard.ZstdDecompressor().decompress(message[16 : 16 + int.from_bytes(message[8:16], "little")])
