"""A user's browser: the page loads and shows the robot, and what is moved and pressed there reaches it."""

import io
import json

import numpy as np
import pytest
from PIL import Image
from selenium.webdriver.chrome.webdriver import WebDriver
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from served import Served, wait_until

from telebip.eval.walk import heading_velocity


@pytest.fixture
def page(chromium: WebDriver, served: Served) -> WebDriver:
    """The page, once the robot is drawn."""
    if not chromium.current_url.startswith(served.url):
        chromium.get(served.url)
    wait_until(lambda: served.session.server.get_clients(), "a tab is there")
    wait_until(lambda: chromium.find_elements(By.XPATH, "//*[@role='slider']"), "the sliders are there")
    return chromium


def picture(page: WebDriver) -> np.ndarray:
    """Return what the canvas left of the controls shows, (height, width, 3)."""
    shown = Image.open(io.BytesIO(page.get_screenshot_as_png())).convert("RGB")
    return np.asarray(shown)[:, : shown.width // 2].astype(float)


def is_orange(pixels: np.ndarray) -> np.ndarray:
    """Return where the robot's trunk is."""
    red, green, blue = np.moveaxis(pixels, -1, 0)
    return (red > 180) & (green > 90) & (green < 190) & (blue < 110)


def speeds(served: Served) -> np.ndarray:
    """Return the forward speeds of the last second, world by world [m/s]."""
    recent = served.session.steered[0].recent()
    assert recent
    return heading_velocity(recent.qpos, recent.qvel)[-50:, :, 0].mean(0)


def press(page: WebDriver, key: str) -> None:
    page.find_element(By.TAG_NAME, "body").send_keys(key)


def test_the_page_shows_robots_that_move(page: WebDriver, served: Served) -> None:
    wait_until(lambda: is_orange(picture(page)).sum() > 500, "the trunk is drawn in its colour")
    first, steps = picture(page), served.steps
    assert first.mean() > 40.0 and first.std() > 5.0  # not black, and not empty
    wait_until(lambda: served.steps > steps + 20, "the robot walks")
    assert (np.abs(picture(page) - first).max(-1) > 30).sum() > 200


def test_nothing_is_loaded_from_elsewhere(page: WebDriver, served: Served) -> None:
    entries = [json.loads(entry["message"])["message"] for entry in page.get_log("performance")]
    urls = [entry["params"]["request"]["url"] for entry in entries if entry["method"] == "Network.requestWillBeSent"]
    own = (served.url, "data:", f"blob:{served.url}")
    assert any(url.startswith(served.url) for url in urls)
    assert [url for url in urls if not url.startswith(own)] == []


def test_a_slider_changes_the_robots_speed(page: WebDriver, served: Served) -> None:
    wait_until(lambda: abs(speeds(served) - 0.6).max() < 0.1, "it walks at 0.6 m/s")
    slider = page.find_elements(By.XPATH, "//*[@role='slider']")[0]
    slider.send_keys(Keys.ARROW_RIGHT * 35)
    wait_until(lambda: served.session.steered[0].command[0] == pytest.approx(0.95), "the command is 0.95 m/s")
    wait_until(lambda: abs(speeds(served) - 0.95).max() < 0.1, "it walks at 0.95 m/s")


def test_keys_steer_as_well(page: WebDriver, served: Served) -> None:
    steering = served.session.steered[0]
    before = steering.command[0]
    press(page, "k")
    wait_until(lambda: steering.command[0] == pytest.approx(before - 0.1), "the command falls by 0.1 m/s")
    press(page, "j")
    wait_until(lambda: steering.command[2] == pytest.approx(0.1), "the robot is to turn left")
    press(page, "l")
    wait_until(lambda: steering.command[2] == pytest.approx(0.0), "and straight on")


def test_a_push_moves_the_robot(page: WebDriver, served: Served) -> None:
    before = served.steps
    page.find_element(By.XPATH, "//button[.//text()='left']").click()
    wait_until(lambda: served.steps > before + 30, "steps pass")
    recent = served.session.steered[0].recent()
    assert recent
    pushed = np.flatnonzero(recent.push_w[:, 0].any(-1))
    assert len(pushed) == 5  # 0.1 s
    np.testing.assert_allclose(np.linalg.norm(recent.push_w[pushed[0], 0]), 60.0, rtol=1e-4)
    leftward = heading_velocity(recent.qpos, recent.qvel)[:, 0, 1]
    assert leftward[pushed[-1]] - leftward[pushed[0] - 1] > 0.2  # 6 N s on 13.6 kg; the foot holds some back


def test_space_pauses_and_n_steps_once(page: WebDriver, served: Served) -> None:
    steering = served.session.steered[0]
    press(page, " ")
    wait_until(lambda: steering.paused, "it pauses")
    paused = served.steps
    press(page, "n")
    wait_until(lambda: served.steps == paused + 1, "one step")
    press(page, " ")
    wait_until(lambda: served.steps > paused + 5, "it goes on")


def test_another_policy_can_be_chosen(page: WebDriver, served: Served) -> None:
    page.find_elements(By.XPATH, "//input[@value='telebip_efficient']")[0].click()
    wait_until(lambda: page.find_elements(By.XPATH, "//*[@role='option'][.='dcm']"), "the policies are listed")
    page.find_elements(By.XPATH, "//*[@role='option'][.='dcm']")[0].click()
    wait_until(lambda: type(served.session.steered[0].policy).__name__ == "Walker", "the DCM walker walks")
    wait_until(lambda: served.steps > 30, "on and on")
