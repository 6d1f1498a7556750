# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
"""MuJoCo's own window, in real time, with keys for the command."""

import math
import os
import sys
import time
import warnings

import mujoco
import torch

from telebip.control.policy import Policy
from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.eval.walk import cost_of_transport, heading_velocity
from telebip.viz.opengl import has_display
from telebip.viz.render import add_arrow
from telebip.viz.scene import PUSH, PUSH_SCALE
from telebip.viz.steering import Steering

ENTER, BACKSPACE, RIGHT, LEFT, DOWN, UP, SPACE = 257, 259, 262, 263, 264, 265, 32  # GLFW's key codes
HOME, END = 268, 269
STEERING = {UP: (0, 1), DOWN: (0, -1), HOME: (1, 1), END: (1, -1), LEFT: (2, 1), RIGHT: (2, -1)}  # number and sign of a step
STEP = 0.1  # per key press [m/s | rad/s]
PUSH_FORCE = 60.0  # to the right, and to the left the next time [N]
KEYS = (
    "up, down\nleft, right\nHome, End\nEnter\nspace\nBackspace",
    "faster, slower\nturn\nstep left, right\npush\npause\nreset",
)


class KeyboardSteering(Steering):
    """Steering with the keys of MuJoCo's window; the first world is the one that is seen."""

    _next_push = -PUSH_FORCE  # to the left [N]

    def press(self, key: int) -> None:
        """Take note of a key that went down; any other is left to the window. Called from the window's thread."""
        if key in STEERING:
            i, sign = STEERING[key]
            self.command[i] = round(self.command[i] + sign * STEP, 3)
        elif key == SPACE:
            self.paused = not self.paused
        elif key == ENTER:
            self.push(torch.tensor([0.0, self._next_push, 0.0], device=self.env.device))
            self._next_push = -self._next_push
        elif key == BACKSPACE:
            self.restart()

    def numbers(self) -> tuple[str, str]:
        """Return what is written beside the robot: names, and values over the last second."""
        names, (vx, vy, turn) = "command\nspeed\ncost of transport", self.command
        (ahead, left), moving = (0.0, 0.0), "-"
        if recent := self.recent():
            velocity = heading_velocity(recent.qpos[:, :1], recent.qvel[:, :1])
            cost = cost_of_transport(recent.joint_power[:, :1].sum(-1), velocity, recent.weight)
            ahead, left = velocity.mean((0, 1)).tolist()
            moving = f"{cost:.2f}" if math.hypot(ahead, left) > 0.05 else "-"
        return names, f"{vx:.1f} m/s, {vy:.1f} m/s left, {turn:+.1f} rad/s\n{ahead:.2f} m/s, {left:.2f} m/s left\n{moving}"


def steer(env: TelebipEnv, policy: Policy) -> None:
    """Open the window and walk in real time until it is closed.

    Raises:
        UserError: there is no display, or (on macOS) Python was not started as `mjpython`.
    """
    advice = "use --viewer browser, --viewer rerun --connect HOST:PORT with a viewer elsewhere, or --record FILE.mp4"
    if not has_display():
        raise UserError(f"the MuJoCo viewer needs a display, and DISPLAY and WAYLAND_DISPLAY are empty; {advice}")
    import mujoco.viewer as window

    if sys.platform == "linux":  # else a display that does not answer would let `launch_passive` wait for ever
        with warnings.catch_warnings(action="ignore"):
            if not window.glfw.init():
                display = os.environ.get("WAYLAND_DISPLAY") or os.environ.get("DISPLAY")
                raise UserError(f"the MuJoCo viewer cannot open the display '{display}'; {advice}")
    model, data, steering = env.robot.model, mujoco.MjData(env.robot.model), KeyboardSteering(env, policy)
    steering.step()
    try:
        handle = window.launch_passive(model, data, key_callback=steering.press, show_left_ui=False, show_right_ui=False)
    except RuntimeError as error:
        raise UserError(f"the MuJoCo viewer does not start: {error}") from error
    with handle:
        handle.cam.type, handle.cam.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, env.robot.trunk_id
        handle.cam.distance, handle.cam.azimuth, handle.cam.elevation = 2.5, 125.0, -12.0
        due = time.perf_counter()
        while handle.is_running():
            steering.step()
            data.qpos[:], data.qvel[:] = env.sim.state.qpos[0].cpu().numpy(), env.sim.state.qvel[0].cpu().numpy()
            mujoco.mj_forward(model, data)
            handle.user_scn.ngeom, above = 0, data.qpos[:3] + [0.0, 0.0, 0.1]
            add_arrow(handle.user_scn, above, above + PUSH_SCALE * steering.force_w[0].cpu().numpy(), PUSH, radius=0.02)
            font, corner = mujoco.mjtFontScale.mjFONTSCALE_150, mujoco.mjtGridPos
            handle.set_texts([(font, corner.mjGRID_TOPLEFT, *steering.numbers()), (font, corner.mjGRID_BOTTOMLEFT, *KEYS)])
            handle.sync()
            due = max(due + env.step_dt, time.perf_counter())
            time.sleep(max(0.0, due - time.perf_counter()))
