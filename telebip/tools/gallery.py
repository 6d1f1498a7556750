"""The pictures of README and docs, made anew from a policy."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from matplotlib.figure import Figure
from PIL import Image

from telebip.control.factory import PLACEMENTS, make_controller, with_estimate
from telebip.control.policy import Policy
from telebip.env import TelebipEnv
from telebip.eval.conditions import as_evaluated
from telebip.eval.learning import FILE, learning_curve
from telebip.rl.checkpoint import Checkpoint
from telebip.rl.policy import load_policy
from telebip.robot import load_robot
from telebip.rollout import Rollout, roll_out
from telebip.viz.drawing import draw_control_loop, draw_learning, draw_robot, draw_stride
from telebip.viz.opengl import has_display
from telebip.viz.picture import strobe
from telebip.viz.rerun import record
from telebip.viz.scene import Actor, line_up
from telebip.viz.video import film

SECONDS = 10.0  # walked for the pictures
MID_STANCE = 2.16  # left out of recordings, so that a screenshot finds the robot on one leg [s]


class Gallery:
    """The pictures of one policy at one command; each method writes one file, or returns why it did not."""

    def __init__(self, checkpoint: Checkpoint, command: tuple[float, float, float]) -> None:
        """Walk the policy from rest."""
        self.checkpoint, self.command = checkpoint, command
        self.config = with_estimate(as_evaluated(checkpoint.config, num_envs=1, duration=SECONDS))
        self.robot = load_robot(self.config.sim.robot)
        self.rollout = self._walk(lambda env: load_policy(checkpoint, "cpu"))
        self.actors = line_up([("RL", self.rollout)])

    def _walk(self, make_policy: Callable[[TelebipEnv], Policy]) -> Rollout:
        env = TelebipEnv(self.config, self.robot, "cpu", "native")
        env.set_command(*self.command)
        return roll_out(env, make_policy(env), round(SECONDS / env.step_dt))

    def walking(self, file: Path) -> None:
        """Eight strides as a GIF."""
        seconds = 8 * self.checkpoint.config.gait.period
        film(self.actors, self.robot, file, size=(560, 315), start=self.rollout.time[-1] - seconds)

    def strides(self, file: Path) -> None:
        """The robot at equal intervals in one picture."""
        strobe(self.actors[0], self.robot, file)
        _shrink(file)

    def joints(self, file: Path) -> None:
        """The robot with its six joints named."""
        draw_robot(self.robot).save(file)
        _shrink(file)

    def control_loop(self, file: Path) -> None:
        """The control loop as a diagram."""
        observation = {part["name"]: part["size"] for part in self.checkpoint.observations["policy"]}
        _save(draw_control_loop(self.checkpoint.config, self.robot, observation), file)

    def stride(self, file: Path) -> None:
        """Speed, feet, joints, power and rewards over one and a half seconds."""
        _save(draw_stride(self.actors[0], self.robot), file)

    def learning(self, file: Path) -> str | None:
        """The learning curves, if they came with the policy."""
        curves = learning_curve(self.checkpoint.path.parent)
        if curves is None:
            return f"left as it is: there is no {FILE} beside {self.checkpoint.path}"
        _save(draw_learning(curves, self.checkpoint.task), file)
        return None

    def recording(self, file: Path) -> str | None:
        """The recording in the rerun viewer."""
        return self._screenshot([replace(self.actors[0], rollout=self.rollout.after(MID_STANCE))], file)

    def comparison(self, file: Path) -> str | None:
        """The policy beside the two model-based walkers, in the rerun viewer."""
        walks = [("RL", self.rollout)]
        walks += [(name.upper(), self._walk(lambda env, name=name: make_controller(name, env))) for name in PLACEMENTS]
        return self._screenshot(line_up([(name, rollout.after(MID_STANCE)) for name, rollout in walks]), file)

    def _screenshot(self, actors: Sequence[Actor], file: Path) -> str | None:
        """Record, and let the viewer take a picture of itself: on a display, or through Xvfb and a software Vulkan."""
        viewer = Path(sys.executable).with_name("rerun")
        screen = [] if has_display() else ["xvfb-run", "-a", "-s", "-screen 0 1500x900x24"]
        if screen and not shutil.which(screen[0]):
            return "left as it is: no display; on Debian, apt-get install xvfb mesa-vulkan-drivers"
        with TemporaryDirectory() as folder:
            rrd, shot = Path(folder) / "walk.rrd", Path(folder) / "shot.png"
            record(actors, self.robot, rrd)
            viewed = [str(viewer), str(rrd), "--port", "auto", "--window-size", "1500x900", "--screenshot-to", str(shot)]
            subprocess.run([*screen, *viewed], capture_output=True, timeout=180, env={"XDG_RUNTIME_DIR": folder, **os.environ})
            if not shot.is_file():
                return "left as it is: the rerun viewer gave no screenshot; on Debian, apt-get install mesa-vulkan-drivers"
            shutil.copy(shot, file)
        _shrink(file, width=1500)
        return None


PICTURES: dict[str, Callable[[Gallery, Path], str | None]] = {
    "walking.gif": Gallery.walking,
    "walking.png": Gallery.strides,
    "robot.png": Gallery.joints,
    "control_loop.png": Gallery.control_loop,
    "stride.png": Gallery.stride,
    "learning.png": Gallery.learning,
    "recording.png": Gallery.recording,
    "comparison.png": Gallery.comparison,
}


def _save(figure: Figure, file: Path) -> None:
    figure.savefig(file, dpi=150, bbox_inches="tight", facecolor="white")
    _shrink(file)


def _shrink(file: Path, width: int | None = None) -> None:
    """Keep a PNG small: at most `width` pixels wide, 256 colours."""
    picture = Image.open(file).convert("RGB")
    picture.thumbnail((width or picture.width, picture.height), Image.Resampling.LANCZOS)
    picture.quantize(256, method=Image.Quantize.MAXCOVERAGE, kmeans=2, dither=Image.Dither.NONE).save(file, optimize=True)
