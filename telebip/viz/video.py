"""A walk as a film, MP4 or GIF: rendered without a window, the camera beside the robot, with what it does written above."""

from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from pathlib import Path

import av
import numpy as np
from av.error import FFmpegError
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from telebip.errors import UserError
from telebip.robot import Robot
from telebip.viz.render import Renderer
from telebip.viz.scene import FORCE_SCALE, GROUND_FORCE, LANE, PUSH, PUSH_SCALE, Actor
from telebip.viz.series import plots, running_mean

FPS = 25  # frames per second; a GIF counts in hundredths of a second, of which four are one frame
Array = NDArray[np.floating]


def film(
    actors: Sequence[Actor],
    robot: Robot,
    file: Path,
    size: tuple[int, int] | None = None,
    start: float = 0.0,
    progress: Callable[[int, int], None] = lambda frame, total: None,
) -> None:
    """Film walks in real time.

    Args:
        actors: who walked, from `telebip.viz.scene.line_up`; all for the same time.
        robot: their model.
        file: `.mp4` (H.264) or `.gif`; its folder is made.
        size: width and height [pixels], even numbers; 960 x 540, and half of it for a GIF, if not given.
        start: what was before is not filmed, but counts in the means over the last second [s].
        progress: called with the number of finished frames and of all.

    Raises:
        UserError: there is no OpenGL to render with, or the file cannot be written.
    """
    size = size or ((480, 270) if file.suffix == ".gif" else (960, 540))
    rows = frame_rows(actors[0].rollout.time, start)

    def pictures() -> Iterator[Image.Image]:
        for i, picture in enumerate(_pictures(actors, robot, rows, size)):
            yield picture
            progress(i + 1, len(rows))

    write = _write_gif if file.suffix == ".gif" else _write_mp4
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        write(pictures(), file)
    except (OSError, FFmpegError) as error:
        raise UserError(f"cannot write film '{file}': {error}") from error


def frame_rows(time: Array, start: float = 0.0) -> NDArray[np.integer]:
    """Return the rows of a rollout that are filmed, so that it runs in real time: those nearest to the times of the frames."""
    frames = np.arange(int(start * FPS + 1e-6) + 1, int(time[-1] * FPS + 1e-6) + 1)
    return np.abs(time[None] - frames[:, None] / FPS).argmin(1) if len(frames) else np.array([len(time) - 1])


def _pictures(actors: Sequence[Actor], robot: Robot, rows: NDArray[np.integer], size: tuple[int, int]) -> Iterator[Image.Image]:
    path, numbers = camera_path(actors), [_numbers(actor, robot) for actor in actors]
    font, margin = ImageFont.load_default(size[1] / 22), size[1] // 36
    several, width = len(actors) > 1, LANE * (len(actors) - 1)
    with Renderer(robot, size, extent=1.7 + width) as renderer:
        for row in rows:
            ground = path[row][2] - robot.home_qpos[2] if robot.terrain else 0.0
            renderer.look_at([*path[row][:2], ground + 0.42], 1.7 + 0.6 * width, azimuth=125.0, elevation=-12.0)
            poses = [_in_lane(actor, row) for actor in actors]
            feet = renderer.place(poses)
            for actor, qpos, soles in zip(actors, poses, feet, strict=True):
                _annotate(renderer, actor, row, qpos, soles, labelled=several)
            picture = Image.fromarray(renderer.render())
            lines = [f"{actor.label}: {of[row]}" if several else of[row] for actor, of in zip(actors, numbers, strict=True)]
            text = "\n".join([_headline(actors[0], row), *lines])
            ImageDraw.Draw(picture).multiline_text((margin, margin), text, fill=(25, 30, 40), font=font, spacing=margin / 2)
            yield picture


def camera_path(actors: Sequence[Actor], seconds: float = 0.5) -> Array:
    """Return where the camera follows: the middle of the robots' trunks [m], (steps, 3), means over `seconds`."""
    places = np.mean([actor.rollout.qpos[:, actor.world, :3] + [0.0, actor.lane, 0.0] for actor in actors], axis=0)
    half = max(1, round(0.5 * seconds / actors[0].rollout.step_dt))
    sums, row = np.pad(np.cumsum(places, axis=0, dtype=float), ((1, 0), (0, 0))), np.arange(len(places))
    reach = np.minimum(half, np.minimum(row, len(places) - 1 - row))  # a window that stays centred up to the ends
    return (sums[row + reach + 1] - sums[row - reach]) / (2 * reach + 1)[:, None]


def _in_lane(actor: Actor, row: int) -> Array:
    qpos = actor.rollout.qpos[row, actor.world].astype(float)
    qpos[1] += actor.lane
    return qpos


def _annotate(renderer: Renderer, actor: Actor, row: int, qpos: Array, feet: Array, labelled: bool) -> None:
    """Add ground forces at the feet (2, 3) [m], the push on the trunk, and the label."""
    for foot, force in zip(feet, actor.rollout.foot_force[row, actor.world], strict=True):
        renderer.arrow(foot, foot + [0.0, 0.0, FORCE_SCALE * force], GROUND_FORCE, radius=0.022)
    trunk = qpos[:3] + [0.0, 0.0, 0.1]
    renderer.arrow(trunk, trunk + PUSH_SCALE * actor.rollout.push_w[row, actor.world], PUSH, radius=0.02)
    if labelled:
        renderer.label(qpos[:3] + [0.0, 0.0, 0.32], actor.label)


def _numbers(actor: Actor, robot: Robot) -> list[str]:
    """Return what is written of each row: forward speed and cost of transport, both over the last second."""
    curves = plots(actor.rollout, actor.world, robot.is_slide)
    speeds = running_mean(curves["speed"].curves["forward"].values, round(1.0 / actor.rollout.step_dt))
    costs = curves["cost_of_transport"].curves["mechanical"].values
    texts = [f"{cost:.2f}" if np.isfinite(cost) else "-" for cost in costs]
    return [f"{speed:.2f} m/s, cost of transport {text}" for speed, text in zip(speeds, texts, strict=True)]


def _headline(actor: Actor, row: int) -> str:
    vx, vy, turn = actor.rollout.command[row, actor.world]
    sideways = f", {vy:+.2f} m/s left" if abs(vy) > 0.005 else ""
    turning = f", {turn:+.2f} rad/s" if abs(turn) > 0.005 else ""
    return f"command {vx:.2f} m/s{sideways}{turning}   {actor.rollout.time[row]:4.1f} s"


def _write_mp4(pictures: Iterator[Image.Image], file: Path) -> None:
    with av.open(str(file), "w", options={"movflags": "faststart"}) as container:
        first = next(pictures)
        stream = container.add_stream("libx264", rate=FPS, options={"crf": "20", "preset": "medium"})
        stream.width, stream.height, stream.pix_fmt = first.width, first.height, "yuv420p"
        for picture in chain([first], pictures):
            container.mux(stream.encode(av.VideoFrame.from_image(picture)))
        container.mux(stream.encode(None))


def _write_gif(pictures: Iterator[Image.Image], file: Path) -> None:
    """All frames share their colours, so that what stands still compresses away and nothing flickers."""
    first = next(pictures)
    sample = first.copy()  # the first frame, and arrows that it may not show
    for i, color in enumerate((GROUND_FORCE, PUSH)):
        sample.paste(color, (0, 8 * i, first.width // 4, 8 * i + 8))
    palette = sample.quantize(160, dither=Image.Dither.NONE)
    frames = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in chain([first], pictures)]
    frames[0].save(file, save_all=True, append_images=frames[1:], duration=1000 // FPS, loop=0, optimize=False)
