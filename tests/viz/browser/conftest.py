"""A walking robot that is served, and a real Chromium to look at it with."""

import shutil
from collections.abc import Iterator

import pytest
from selenium import webdriver
from selenium.webdriver.chrome.options import Options
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.chrome.webdriver import WebDriver
from served import Served

from telebip import ROOT
from telebip.control.factory import make_controller, with_estimate
from telebip.control.policy import Policy
from telebip.env import TelebipEnv
from telebip.eval.conditions import as_evaluated
from telebip.rl.checkpoint import load_checkpoint
from telebip.rl.policy import load_policy
from telebip.robot import Robot
from telebip.viz.browser.server import Address, serving
from telebip.viz.browser.session import Session


@pytest.fixture(scope="module")
def served(robot: Robot) -> Iterator[Served]:
    """Two worlds of `telebip_efficient`, which facing x walk at 0.6 m/s, with `dcm` to choose from."""
    checkpoint = load_checkpoint(ROOT / "assets" / "policies" / "telebip_efficient")

    def worlds(estimate: bool) -> TelebipEnv:
        config = as_evaluated(checkpoint.config, 2, 1e5, ["seed=1"])
        env = TelebipEnv(with_estimate(config) if estimate else config, robot, "cpu", "native")
        env.set_command(0.6, 0.0, 0.0)
        return env

    def trained() -> tuple[TelebipEnv, Policy]:
        return worlds(False), load_policy(checkpoint, "cpu")

    def controlled() -> tuple[TelebipEnv, Policy]:
        return (env := worlds(True)), make_controller("dcm", env)

    with serving(Address(), "test") as (server, address):
        session = Session(server, robot, lambda: {"telebip_efficient": trained, "dcm": controlled}, "telebip_efficient")
        served = Served(session, address.url)
        yield served
        served.close()


@pytest.fixture(scope="module")
def chromium() -> Iterator[WebDriver]:
    """Debian's Chromium without a window and, where there is no GPU, with its own renderer."""
    binary = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    driver = shutil.which("chromedriver")
    if not binary or not driver:
        pytest.skip("no Chromium to test the browser viewer in; on Debian, apt-get install chromium chromium-driver")
    options = Options()
    options.binary_location = binary
    for flag in ("headless=new", "no-sandbox", "disable-dev-shm-usage", "use-angle=swiftshader", "enable-unsafe-swiftshader"):
        options.add_argument(f"--{flag}")
    options.add_argument("--window-size=800,500")
    options.set_capability("goog:loggingPrefs", {"performance": "ALL"})
    browser = webdriver.Chrome(options=options, service=Service(driver))
    yield browser
    browser.quit()
