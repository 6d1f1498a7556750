"""Where the viewer is served, and tabs that come, go, or do not keep up; over real sockets."""

import socket
import time
from contextlib import ExitStack

import pytest
from served import PATIENCE, Served, open_tab, wait_until

from telebip.cli.play import main as play
from telebip.errors import UserError
from telebip.viz.browser.server import Address, free, read_address


@pytest.mark.parametrize(
    ("text", "address"),
    [
        (None, Address("127.0.0.1", 8080)),
        ("9000", Address("127.0.0.1", 9000, is_given=True)),
        ("0.0.0.0", Address("0.0.0.0", 8080)),
        ("0.0.0.0:9000", Address("0.0.0.0", 9000, is_given=True)),
        ("[::1]:9000", Address("::1", 9000, is_given=True)),
        ("localhost:9000", Address("localhost", 9000, is_given=True)),
    ],
)
def test_an_address_is_read(text: str | None, address: Address) -> None:
    assert read_address(text) == address


@pytest.mark.parametrize("text", ["nowhere.example:80", "127.0.0.1:0", "127.0.0.1:99999", "1.2.3", "http://127.0.0.1:80"])
def test_a_wrong_address_is_one_line(text: str) -> None:
    with pytest.raises(UserError, match=r"^--listen takes PORT or HOST:PORT, as 8080 or 0\.0\.0\.0:8080, not '"):
        read_address(text)


def test_a_port_in_use_is_left_to_whoever_has_it() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert free(Address("127.0.0.1", port)).port > port
        with pytest.raises(UserError, match=rf"^port {port} of 127\.0\.0\.1 is in use; \d+ is free: --listen "):
            free(Address("127.0.0.1", port, is_given=True))


def test_an_address_of_another_machine_is_one_line() -> None:
    with pytest.raises(UserError, match=r"^this machine cannot listen at '192\.0\.2\.1': "):
        free(Address("192.0.2.1", 8080))


def test_loopback_tells_how_to_get_there_and_other_addresses_warn() -> None:
    assert any("ssh -N -L 8080:127.0.0.1:8080" in line for line in Address().advice())
    assert not any("warning" in line for line in Address().advice())
    (opened, warning) = Address("0.0.0.0").advice()
    assert opened == "open http://127.0.0.1:8080 in a browser"
    assert warning.startswith("warning: whoever reaches port 8080")


def test_listen_goes_with_the_browser_alone() -> None:
    with pytest.raises(UserError, match=r"^--listen says where --viewer browser is served"):
        play(["--agent", "zero", "--listen", "8080"])
    with pytest.raises(UserError, match=r"^--viewer browser leaves no room for --record"):
        play(["--agent", "zero", "--viewer", "browser", "--record", "walk.rrd"])


def tabs(served: Served) -> int:
    return len(served.session.server.get_clients())


def test_ten_tabs_see_the_same_walk(served: Served) -> None:
    with ExitStack() as stack:
        opened = [stack.enter_context(open_tab(served.url)) for _ in range(10)]
        wait_until(lambda: tabs(served) == 10, "ten tabs are there")
        before = served.steps
        received = [sum(len(tab.recv(timeout=PATIENCE)) for _ in range(10)) for tab in opened]
        assert min(received) > 10_000
        wait_until(lambda: served.steps > before + 25, "the robot walks")


def test_a_tab_that_does_not_read_holds_up_nobody(served: Served) -> None:
    buffer = served.session.server._websock_server.get_message_buffer()
    with open_tab(served.url) as slow, open_tab(served.url) as other:
        wait_until(lambda: tabs(served) == 2, "both tabs are there")
        before = served.steps
        wait_until(lambda: served.steps > before + 50, "the robot walks")
        waiting = len(buffer.message_from_id)
        wait_until(lambda: served.steps > before + 200, "the robot walks on")
        assert len(buffer.message_from_id) < waiting + 200  # of each thing on the page, the latest is kept
        assert other.recv(timeout=PATIENCE)
        assert slow.recv(timeout=PATIENCE)


def test_nothing_moves_while_no_tab_is_open(served: Served) -> None:
    wait_until(lambda: tabs(served) == 0, "no tab is there")
    time.sleep(0.3)  # for the step that it is at
    before = served.steps
    time.sleep(1.0)
    assert served.steps == before
    tab = open_tab(served.url)
    wait_until(lambda: served.steps > before + 10, "the robot walks")
    tab.socket.shutdown(socket.SHUT_RDWR)  # as where a laptop is shut, without a farewell
    wait_until(lambda: tabs(served) == 0, "it is noticed that the tab has gone")
