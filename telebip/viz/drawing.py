"""Pictures of the documentation: the robot with its joints named, the control loop, a second of walking, learning curves."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from PIL import Image, ImageDraw, ImageFont

from telebip.config import TaskConfig
from telebip.eval.plots import COLORS, STYLE
from telebip.robot import Robot
from telebip.viz.render import Array, Renderer
from telebip.viz.scene import Actor
from telebip.viz.series import plots, split_side

INK = (35, 40, 50)
AXIS_COLORS = {"hip_roll": (200, 50, 60), "hip_pitch": (30, 140, 80), "knee": (40, 90, 210)}
LEARNING = {
    "episode_length": "episode length [policy steps]",
    "velocity_error_mps": "velocity error [m/s]",
    "falls_per_minute": "falls per robot-minute",
    "cost_of_transport": "cost of transport",
}


def draw_robot(robot: Robot, size: tuple[int, int] = (1000, 720)) -> Image.Image:
    """Draw telebip's robot in its home pose, with the axis, name, range and force limit of each joint.

    Raises:
        UserError: there is no OpenGL to render with.
    """
    scale = 2  # drawn larger, for smooth edges
    with Renderer(robot, (scale * size[0], scale * size[1]), extent=1.5) as renderer:
        renderer.look_at([0.0, 0.0, 0.42], distance=1.4, azimuth=161.0, elevation=-20.0)
        renderer.place([robot.home_qpos])
        tips = np.array([_draw_axis(renderer, joint) for joint in robot.joint_names])
        corner = np.array([-0.02, -0.36, 0.004])
        for direction in np.eye(3):
            renderer.arrow(corner, corner + 0.14 * direction, INK, radius=0.004)
        picture = Image.fromarray(renderer.render())
        joint_places, frame_places = renderer.project(tips), renderer.project(corner + 0.18 * np.eye(3))
    draw = ImageDraw.Draw(picture)
    name_font, font = ImageFont.load_default(17.0 * scale), ImageFont.load_default(14.0 * scale)
    for text, (x, y) in zip(("x forward", "y left", "z up"), frame_places, strict=True):
        draw.text((x, y), text, fill=INK, font=font, anchor="mm")
    rows = {"hip_pitch": 0.26, "hip_roll": 0.42, "knee": 0.66}
    for i, joint in enumerate(robot.joint_names):
        side, kind = split_side(joint)
        (low, high), limit = robot.joint_range[i], robot.force_limit[i]
        units = ("m", "N") if robot.is_slide[i] else ("rad", "N m")
        x, y = picture.width * (0.03 if side == "right" else 0.97), picture.height * rows[kind]
        anchor, inner = ("l", x + 190 * scale) if side == "right" else ("r", x - 190 * scale)
        draw.line([(inner, y), tuple(joint_places[i])], fill=AXIS_COLORS[kind], width=scale)
        draw.text((x, y), joint, fill=AXIS_COLORS[kind], font=name_font, anchor=f"{anchor}b")
        what = f"{low:+.2f} to {high:+.2f} {units[0]}, {limit:.0f} {units[1]}"
        draw.text((x, y + 4 * scale), what, fill=INK, font=font, anchor=f"{anchor}t")
    return picture.resize(size, Image.Resampling.LANCZOS)


def _draw_axis(renderer: Renderer, joint: str) -> Array:
    """Add an arrow along a joint's axis, outwards from the robot, beside the leg for a knee; return its tip [m]."""
    side, kind = split_side(joint)
    outwards = 1.0 if side == "left" else -1.0
    axis = renderer.data.joint(joint).xaxis * (outwards if kind == "hip_pitch" else 1.0)
    start = renderer.data.joint(joint).xanchor + 0.05 * axis
    if kind == "knee":
        start += [0.0, 0.06 * outwards, 0.18]
    tip = start + (0.13 if kind == "hip_pitch" else 0.16) * axis
    renderer.arrow(start, tip, AXIS_COLORS[kind], radius=0.007)
    return tip


def draw_control_loop(config: TaskConfig, robot: Robot, observation: Mapping[str, int]) -> Figure:
    """Draw what happens in one policy step, with the rates of the task and the size of each term of its `observation`."""
    physics_hz, decimation = 1.0 / robot.physics_dt, config.sim.decimation
    figure = Figure((9.6, 3.7))
    axes = figure.subplots()
    axes.set(xlim=(0, 96), ylim=(0, 37))
    axes.axis("off")

    def box(x: float, y: float, width: float, height: float, text: str, color: str) -> None:
        patch = FancyBboxPatch((x, y), width, height, boxstyle="round,pad=0,rounding_size=1", fc=color, ec="none")
        axes.add_patch(patch)
        axes.text(x + width / 2, y + height / 2, text, ha="center", va="center", fontsize=9, linespacing=1.4)

    def arrow(points: list[tuple[float, float]], text: str = "", at: tuple[float, float] = (0, 0)) -> None:
        xs, ys = zip(*points, strict=True)
        axes.plot(xs[:-1], ys[:-1], color="#555b66", lw=1.4, solid_capstyle="round")
        axes.annotate("", points[-1], points[-2], arrowprops={"arrowstyle": "-|>", "color": "#555b66", "lw": 1.4, "shrinkA": 0})
        axes.text(*at, text, ha="center", va="center", fontsize=8.5, color="#3b414c", linespacing=1.3)

    box(0, 2, 96, 34, "", "#f3f4f6")
    box(56, 10, 38.5, 21, "", "#dfe6ee")
    axes.text(2, 33.5, f"policy step: {physics_hz / decimation:.0f} Hz", fontsize=10, fontweight="bold", va="center")
    title = f"physics: {physics_hz:.0f} Hz, {decimation} steps of {1e3 * robot.physics_dt:g} ms"
    axes.text(57.5, 28.5, title, fontsize=10, fontweight="bold", va="center")
    sizes = [f"{name.replace('_', ' ')} {size}" for name, size in observation.items()]
    lines = [", ".join(sizes[i : i + 2]) for i in range(0, len(sizes), 2)]
    box(2, 12.5, 28, 13.5, "\n".join([f"observation ({sum(observation.values())})", *lines]), "#fbe3cf")
    layers = "-".join(str(size) for size in config.ppo.hidden_dims)
    box(34.5, 12.5, 13, 13.5, f"policy\n{layers}\n{config.ppo.activation.upper()}", "#cfe0f2")
    box(58, 12.5, 17, 13.5, "PD actuators\nkp (q* - q) - kv $\\dot{q}$\nforce limits", "#ffffff")
    box(81.5, 12.5, 11.5, 13.5, "robot\nand\nground", "#ffffff")
    arrow([(30, 19.2), (34.5, 19.2)])
    arrow([(47.5, 19.2), (58, 19.2)], f"{len(robot.joint_names)} joint\ntargets q*", (51.7, 22.6))
    arrow([(75, 21), (81.5, 21)], "forces", (78.2, 22.7))
    arrow([(81.5, 17), (75, 17)], "q, $\\dot{q}$", (78.2, 15.3))
    arrow([(87, 12.5), (87, 6), (16, 6), (16, 12.5)], "state; means of forces and power over the step", (51, 7.7))
    arrow([(16, 31), (16, 26)], "command vx, vy, yaw rate; phase p_r, p_l", (33, 29.3))
    rewards = f"rewards in training: {', '.join(config.rewards)}"
    axes.text(51, 4.1, rewards, ha="center", va="center", fontsize=8.5, color="#3b414c")
    return figure


@rc_context(STYLE)
def draw_stride(actor: Actor, robot: Robot, seconds: float = 1.5) -> Figure:
    """Plot the last `seconds` of a walk of telebip's robot: speed, feet, knees, hips, power."""
    rollout = actor.rollout
    rows = slice(-round(seconds / rollout.step_dt), None)
    time = rollout.time[rows] - rollout.time[rows][0]
    shown = plots(rollout, actor.world, robot.is_slide)
    figure = Figure((9.6, 6.0), layout="constrained")
    grid = figure.subplots(3, 2, sharex=True)
    for axes, name in zip(grid.flat, ("speed", "gait", "hip_pitch", "knee", "power", "reward"), strict=True):
        _plot_curves(axes, time, {key: curve.values[rows] for key, curve in shown[name].curves.items()})
        axes.set_title(shown[name].title)
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")
    return figure


def _plot_curves(axes: Axes, time: Array, curves: dict[str, Array]) -> None:
    """Draw right in orange, left in blue, targets and signals thin, everything else in turn."""
    sides = {"right": COLORS[0], "p_r": COLORS[0], "left": COLORS[1], "p_l": COLORS[1], "command": "#9aa0a8"}
    others = iter((COLORS[0], *COLORS[2:], COLORS[1]))
    for name, values in curves.items():
        color = next((sides[side] for side in sides if name.startswith(side)), None) or next(others)
        thin = name.endswith("_target") or name.startswith("p_")
        axes.plot(time, values, color=color, lw=0.8 if thin else 1.6, ls="--" if thin else "-", label=name.replace("_", " "))
    beside_the_title = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.2}
    axes.legend(fontsize=7, ncols=4, handlelength=1.0, columnspacing=0.8, handletextpad=0.4, **beside_the_title)
    axes.set_xlim(time[0], time[-1])


@rc_context(STYLE)
def draw_learning(curves: dict[str, Any], label: str) -> Figure:
    """Plot learning curves as `telebip.eval.learning.learning_curve` returns them."""
    samples = np.array(curves["samples"]) / 1e6
    figure = Figure((9.6, 4.6), layout="constrained")
    grid = figure.subplots(2, 2, sharex=True)
    for axes, tone, (name, title) in zip(grid.flat, COLORS[:4], LEARNING.items(), strict=True):
        values = np.array(curves[name], dtype=float)
        axes.plot(samples, values, color=tone, lw=1.6)
        late = values[len(values) // 20 :]  # the first stumbles would set the scale
        axes.set(title=title, ylim=(0, 1.15 * np.nanmax(late)), xlim=(0, samples[-1]))
    for axes in grid[-1]:
        axes.set_xlabel("million samples")
    figure.suptitle(f"training of {label}", fontsize=10, color="#555b66")
    return figure
