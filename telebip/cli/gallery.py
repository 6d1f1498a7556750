"""`gallery.py`: make the pictures of README and docs anew, from a policy."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from telebip import ROOT
from telebip.cli.common import Parser, open_checkpoint
from telebip.cli.evaluate import speed
from telebip.errors import UserError, nearest
from telebip.viz.opengl import choose_opengl

if TYPE_CHECKING:
    from telebip.control.policy import Policy
    from telebip.env import TelebipEnv
    from telebip.eval.rollout import Rollout
    from telebip.viz.scene import Actor

SECONDS = 10.0  # walked for the pictures
EXAMPLES = """\
  gallery.py
  gallery.py --checkpoint assets/policies/telebip_flat --only walking.gif stride.png
"""


def main(argv: Sequence[str] | None = None) -> None:
    """Parse arguments and draw."""
    parser = Parser("Make the pictures of walkers in README and docs anew, from the shipped policy.", EXAMPLES)
    parser.add_argument("--checkpoint", metavar="PATH_OR_RUN", default=str(ROOT / "assets" / "policies" / "telebip_efficient"))
    parser.add_argument("--command", nargs=3, type=speed, metavar=("VX", "VY", "WZ"), default=(0.7, 0.0, 0.0))
    parser.add_argument("--out", metavar="DIR", type=Path, default=ROOT / "docs" / "images", help="default: docs/images")
    parser.add_argument("--only", nargs="+", metavar="PICTURE", help=f"of {', '.join(PICTURES)} (default: all)")
    options = parser.parse(argv)
    for name in options.only or ():
        if name not in PICTURES:
            raise UserError(f"no picture '{name}'; {nearest(name, PICTURES)}")
    choose_opengl()
    from telebip.eval.report import make_folder

    make_folder(options.out)
    gallery = Gallery(options.checkpoint, tuple(options.command))
    for name in options.only or PICTURES:
        note = PICTURES[name](gallery, options.out / name)
        file = options.out / name
        print(f"{file}: {note}" if note else f"{file}: {file.stat().st_size / 1e3:.0f} kB", flush=True)


class Gallery:
    """The pictures of one policy at one command; each method writes one file, or returns why it did not."""

    def __init__(self, checkpoint: str, command: tuple[float, float, float]) -> None:
        """Walk the policy from rest."""
        from telebip.eval.conditions import as_evaluated
        from telebip.rl.policy import load_policy
        from telebip.robot import load_robot
        from telebip.viz.scene import line_up

        self.checkpoint, self.command = open_checkpoint(checkpoint), command
        self.config = as_evaluated(self.checkpoint.config, num_envs=1, duration=SECONDS)
        self.robot = load_robot(self.config.sim.robot)
        self.rollout = self._walk(lambda env: load_policy(self.checkpoint, "cpu"))
        self.actors = line_up([("RL", self.rollout)])

    def _walk(self, make_policy: "Callable[[TelebipEnv], Policy]") -> "Rollout":
        from telebip.env import TelebipEnv
        from telebip.eval.rollout import roll_out

        env = TelebipEnv(self.config, self.robot, "cpu", "native")
        env.set_command(*self.command)
        return roll_out(env, make_policy(env), round(SECONDS / env.step_dt))

    def walking(self, file: Path) -> None:
        """Eight strides as a GIF."""
        from telebip.viz.video import film

        seconds = 8 * self.checkpoint.config.gait.period
        film(self.actors, self.robot, file, size=(560, 315), start=self.rollout.time[-1] - seconds)

    def strides(self, file: Path) -> None:
        """The robot at equal intervals in one picture."""
        from telebip.viz.picture import strobe

        strobe(self.actors[0], self.robot, file)
        _shrink(file)

    def joints(self, file: Path) -> None:
        """The robot with its six joints named."""
        from telebip.viz.drawing import draw_robot

        draw_robot(self.robot).save(file)
        _shrink(file)

    def control_loop(self, file: Path) -> None:
        """The control loop as a diagram."""
        from telebip.viz.drawing import draw_control_loop

        _save(draw_control_loop(self.checkpoint.config, self.robot), file)

    def stride(self, file: Path) -> None:
        """Speed, feet, joints, power and rewards over one and a half seconds."""
        from telebip.viz.drawing import draw_stride

        _save(draw_stride(self.actors[0]), file)

    def learning(self, file: Path) -> str | None:
        """The learning curves, if they came with the policy."""
        from telebip.eval.learning import FILE, learning_curve
        from telebip.viz.drawing import draw_learning

        curves = learning_curve(self.checkpoint.path.parent)
        if curves is None:
            return f"left as it is: there is no {FILE} beside {self.checkpoint.path}"
        _save(draw_learning(curves, self.checkpoint.task), file)
        return None

    def recording(self, file: Path) -> str | None:
        """The recording in the rerun viewer."""
        walking = [replace(self.actors[0], rollout=self.rollout.after(2.16))]  # mid-stance when the shot is taken
        return self._screenshot(walking, file)

    def comparison(self, file: Path) -> str | None:
        """The policy beside the two model-based walkers, in the rerun viewer."""
        from telebip.control.factory import PLACEMENTS, make_controller
        from telebip.viz.scene import line_up

        walks = [("RL", self.rollout)]
        walks += [(name.upper(), self._walk(lambda env, name=name: make_controller(name, env))) for name in PLACEMENTS]
        return self._screenshot(line_up([(name, rollout.after(2.16)) for name, rollout in walks]), file)

    def _screenshot(self, actors: "Sequence[Actor]", file: Path) -> str | None:
        """Record, and let the viewer take a picture of itself: on a display, or through Xvfb and a software Vulkan."""
        from telebip.viz.opengl import has_display
        from telebip.viz.rerun import record

        viewer = Path(sys.executable).with_name("rerun")
        screen = [] if has_display() else ["xvfb-run", "-a", "-s", "-screen 0 1500x900x24"]
        if screen and not shutil.which(screen[0]):
            return "left as it is: no display; on Debian, apt-get install xvfb mesa-vulkan-drivers"
        with TemporaryDirectory() as folder:
            rrd, shot = Path(folder) / "walk.rrd", Path(folder) / "shot.png"
            record(actors, self.robot.path.with_suffix(".urdf"), rrd)
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


def _save(figure, file: Path) -> None:
    figure.savefig(file, dpi=150, bbox_inches="tight", facecolor="white")
    _shrink(file)


def _shrink(file: Path, width: int | None = None) -> None:
    """Keep a PNG small: at most `width` pixels wide, 256 colours."""
    from PIL import Image

    picture = Image.open(file).convert("RGB")
    if width and picture.width > width:
        picture = picture.resize((width, round(picture.height * width / picture.width)), Image.Resampling.LANCZOS)
    picture.quantize(256, method=Image.Quantize.MAXCOVERAGE, kmeans=2, dither=Image.Dither.NONE).save(file, optimize=True)
