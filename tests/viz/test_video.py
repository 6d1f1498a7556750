"""Films and pictures, decoded again: frames, size, time, and the robot in view. Skipped where there is no OpenGL."""

from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import av
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from telebip import ROOT
from telebip.errors import UserError
from telebip.robot import Robot, load_robot
from telebip.rollout import Rollout
from telebip.viz import opengl
from telebip.viz.picture import strobe
from telebip.viz.render import Renderer
from telebip.viz.scene import line_up
from telebip.viz.video import camera_path, film, frame_rows

SIZE = (320, 180)
Frames = list[NDArray[np.uint8]]


@pytest.fixture(scope="module")
def opengl_works(robot: Robot) -> None:
    try:
        with Renderer(robot, SIZE):
            pass
    except UserError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def mp4(opengl_works: None, walking: Rollout, robot: Robot, tmp_path_factory: pytest.TempPathFactory) -> Frames:
    """Frames of two seconds of two robots, as the decoder gives them."""
    file = tmp_path_factory.mktemp("film") / "new_folder" / "walk.mp4"
    film(line_up([("RL", walking)], worlds=2), robot, file, SIZE)
    with av.open(str(file)) as container:
        stream = container.streams.video[0]
        assert stream.average_rate == 25
        assert container.duration is not None and container.duration / 1e6 == pytest.approx(2.0, abs=0.05)
        return [np.asarray(frame.to_image()) for frame in container.decode(stream)]


def orange(frame: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Pixels in the colour of the trunk, which nothing else has."""
    red, green, blue = np.moveaxis(frame.astype(int), -1, 0)
    return (red > 120) & (red - blue > 80) & (red > green + 40)


def test_a_film_has_all_frames_in_their_size(mp4: Frames) -> None:
    assert len(mp4) == 50  # 2 s x 25
    assert {frame.shape for frame in mp4} == {(180, 320, 3)}


def test_both_robots_are_in_view_all_the_time(mp4: Frames) -> None:
    for frame in mp4:
        assert frame.mean() > 100  # daylight
        shell = orange(frame)
        rows, columns = np.nonzero(shell)
        assert shell.mean() > 0.005
        assert columns.min() > 5 and columns.max() < 315  # pixels from the edges
        assert rows.min() > 5 and rows.max() < 120
        filled = np.flatnonzero(shell.any(0))
        assert np.diff(filled).max() > 10  # a gap: two trunks, not one


def test_the_film_moves(mp4: Frames) -> None:
    changes = [np.abs(a.astype(int) - b.astype(int)).mean() for a, b in pairwise(mp4)]
    assert min(changes[5:]) > 0.3


def test_numbers_are_written_above(mp4: Frames) -> None:
    corner = mp4[-1][5:40, 5:120].astype(int).sum(-1)
    assert corner.min() < 200 < 400 < np.median(corner)  # dark letters on the sky


def test_a_gif_keeps_real_time(opengl_works: None, standing: Rollout, robot: Robot, tmp_path: Path) -> None:
    film(line_up([("none", standing)]), robot, tmp_path / "stand.gif", (160, 90))
    with Image.open(tmp_path / "stand.gif") as gif:
        assert (gif.format, gif.size, getattr(gif, "n_frames", 0)) == ("GIF", (160, 90), 10)
        durations = []
        for i in range(10):
            gif.seek(i)
            durations.append(gif.info["duration"])
            assert orange(np.asarray(gif.convert("RGB"))).mean() > 0.005
    assert sum(durations) == 400  # ms


def test_a_strobe_shows_every_pose(opengl_works: None, walking: Rollout, robot: Robot, tmp_path: Path) -> None:
    strobe(line_up([("RL", walking)])[0], robot, tmp_path / "walk.png", interval=0.8, poses=2, size=(400, 140))
    shell = orange(np.asarray(Image.open(tmp_path / "walk.png")))
    assert shell.shape == (140, 400)
    assert np.diff(np.flatnonzero(shell.any(0))).max() > 20


def test_a_robot_of_ones_own_needs_touch_sensors_and_no_bodies_named_after_feet(opengl_works: None) -> None:
    own = load_robot(ROOT / "tests" / "robots" / "rotary_knee.xml")
    with Renderer(own, SIZE) as renderer:
        feet = renderer.place([own.home_qpos])
    np.testing.assert_allclose(feet, [[[0.0, -0.1, 0.03], [0.0, 0.1, 0.03]]], atol=2e-3)


def test_an_arrow_ends_where_the_camera_sees_its_ends(opengl_works: None, robot: Robot) -> None:
    ends = np.array([[0.3, -0.2, 0.8], [0.3, -0.2, 1.0]])
    with Renderer(robot, (400, 300)) as renderer:
        renderer.look_at([0.0, 0.0, 0.5], distance=2.0, azimuth=70.0, elevation=-20.0)
        renderer.place([robot.home_qpos])
        renderer.arrow(ends[0], ends[1], (255, 0, 255))
        red, green, blue = np.moveaxis(renderer.render().astype(int), -1, 0)
        rows, columns = np.nonzero((red > 150) & (blue > 150) & (green < 80))
        (_, low), (_, high) = renderer.project(ends)
        middle, _ = renderer.project(ends.mean(0, keepdims=True))[0]
    assert (rows.max(), rows.min()) == (pytest.approx(low, abs=2.0), pytest.approx(high, abs=3.0))
    assert columns.mean() == pytest.approx(middle, abs=1.5)
    assert low - high > 30


def test_frames_are_taken_in_real_time() -> None:
    time = 0.02 * np.arange(1, 51)
    np.testing.assert_array_equal(frame_rows(time), np.arange(1, 50, 2))  # 0.04 s, 0.08 s, ...
    np.testing.assert_array_equal(frame_rows(time, start=0.8), np.arange(41, 50, 2))  # 0.84 s, ...
    np.testing.assert_array_equal(frame_rows(time[:1]), [0])


def test_the_camera_goes_with_the_robots(walking: Rollout) -> None:
    path = camera_path(line_up([("RL", walking)], worlds=3))
    mean = walking.qpos[..., :3].mean(1)
    np.testing.assert_allclose(path[[0, -1]], mean[[0, -1]], atol=1e-6)
    np.testing.assert_allclose(path, mean, atol=0.1)
    assert np.abs(np.diff(path[:, 1], n=2)).max() < np.abs(np.diff(mean[:, 1], n=2)).max()


def test_a_place_that_cannot_be_written_is_one_line(walking: Rollout, robot: Robot, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"^cannot write film '.*walk.gif': [^\n]+$"):
        film(line_up([("RL", walking)]), robot, tmp_path / "file" / "walk.gif")


@pytest.fixture
def libraries(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
    """Return a function that pretends that of all OpenGL libraries only these load, on Linux without a display."""
    for variable in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    yield lambda *there: monkeypatch.setattr(opengl, "_loads", lambda library: library in there)


@pytest.mark.parametrize(
    ("there", "chosen", "advice"),
    [
        (["libEGL.so.1", "libOSMesa.so.8"], "egl", "try MUJOCO_GL=egl or MUJOCO_GL=osmesa"),
        (["libOSMesa.so.8"], "osmesa", "try MUJOCO_GL=osmesa; on Debian, apt-get install libegl1"),
        ([], "disable", "on Debian, apt-get install libegl1 or libosmesa6"),
    ],
    ids=["both", "osmesa", "none"],
)
def test_what_is_there_is_chosen(libraries: Callable[..., None], there: list[str], chosen: str, advice: str) -> None:
    libraries(*there)
    opengl.choose_opengl()
    assert opengl.os.environ["MUJOCO_GL"] == chosen
    assert opengl.how_to_get_opengl() == advice


def test_the_users_choice_is_kept_or_refused(libraries: Callable[..., None], monkeypatch: pytest.MonkeyPatch) -> None:
    libraries("libEGL.so.1", "libOSMesa.so.8")
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    opengl.choose_opengl()
    assert opengl.os.environ["MUJOCO_GL"] == "osmesa"
    monkeypatch.setenv("MUJOCO_GL", "elg")
    with pytest.raises(UserError, match=r"MUJOCO_GL=elg names no way to render; did you mean 'egl'\?"):
        opengl.check_opengl()
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    libraries("libEGL.so.1")
    with pytest.raises(UserError, match=r"MUJOCO_GL=osmesa, but libOSMesa.so.8 is not there; .* install libosmesa6"):
        opengl.choose_opengl()
