"""The web server: where it listens, what is said of that, and that nothing is sent anywhere else."""

import contextlib
import errno
import io
import ipaddress
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from urllib.parse import urlsplit

import viser

from telebip.errors import UserError

LOOPBACK, PORT = "127.0.0.1", 8080
TRIED = 100  # ports from the default one on


@dataclass(frozen=True)
class Address:
    """Where the server listens."""

    host: str = LOOPBACK
    port: int = PORT
    is_given: bool = False  # the port, by the user: no other one will do

    @property
    def is_local(self) -> bool:
        """Whether this machine alone reaches it."""
        return self.host == "localhost" or ipaddress.ip_address(self.host).is_loopback

    @property
    def url(self) -> str:
        """What to open in a browser, on this machine."""
        host = {"0.0.0.0": LOOPBACK, "::": "::1"}.get(self.host, self.host)
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}"

    def advice(self) -> list[str]:
        """Return what a user should know: the address, and how to reach it from elsewhere; or who else does."""
        lines = [f"open {self.url} in a browser"]
        if self.is_local:
            tunnel = f"ssh -N -L {self.port}:{LOOPBACK}:{self.port} {socket.gethostname()}"
            return [*lines, f"from another machine: {tunnel}", f"and open http://{LOOPBACK}:{self.port} there"]
        return [*lines, f"warning: whoever reaches port {self.port} of this machine can look and steer; there is no password"]


def read_address(text: str | None) -> Address:
    """Read `PORT`, `HOST` or `HOST:PORT`; without one, it is the loopback address.

    Raises:
        UserError: it is none of these.
    """
    if not text:
        return Address()
    try:
        place = urlsplit(f"//{LOOPBACK}:{text}" if text.isdigit() else f"//{text}")
        host, port = place.hostname or LOOPBACK, place.port
        if place.path or place.query or place.username or port == 0:
            raise ValueError("HOST:PORT is expected")
        if host != "localhost":
            ipaddress.ip_address(host)
    except ValueError as error:
        raise UserError(f"--listen takes PORT or HOST:PORT, as 8080 or 0.0.0.0:8080, not '{text}': {error}") from error
    return Address(host, port or PORT, is_given=port is not None)


def free(address: Address) -> Address:
    """Return an address with a free port: this one or, where the user gave none, one of the next.

    Raises:
        UserError: its port is in use, or this machine has no such address.
    """
    ports = range(address.port, min(address.port + TRIED, 65536))
    found = next((port for port in ports if _is_free(address.host, port)), None)
    if address.is_given and found != address.port:
        hint = f"; {found} is free" if found else ""
        raise UserError(f"port {address.port} of {address.host} is in use{hint}: --listen {address.host}:{found or 'PORT'}")
    if found is None:
        raise UserError(f"ports {ports[0]} to {ports[-1]} of {address.host} are in use; choose one with --listen HOST:PORT")
    return Address(address.host, found, address.is_given)


def _is_free(host: str, port: int) -> bool:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(
            socket.SOL_SOCKET, socket.SO_REUSEADDR, 1
        )  # as the server does: a port that has just been left is free
        try:
            probe.bind((host, port))
            probe.listen()
        except PermissionError as error:
            raise UserError(f"port {port} is for the system's own services; choose one from 1024 on") from error
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise UserError(f"this machine cannot listen at '{host}': {error.strerror or error}") from error
            return False
    return True


class Server(viser.ViserServer):
    """viser's server, quiet, and without its tunnel through a server elsewhere."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Share nothing: the page has no button for it, but others could ask."""
        return None


@contextlib.contextmanager
def serving(address: Address, label: str) -> Iterator[tuple[Server, Address]]:
    """Serve at an address (see `free`), and yield the server and the address with the port that it has.

    Raises:
        UserError: see `free`.
    """
    address = free(address)
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints a table of addresses
        server = Server(host=address.host, port=address.port, label=label, verbose=False)
    try:
        server.gui.configure_theme(show_share_button=False, show_logo=False, control_width="large")
        server.gui.main_panel.dock_right()
        yield server, Address(address.host, server.get_port(), address.is_given)
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()
