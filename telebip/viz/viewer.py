# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
"""MuJoCo's own window, in real time, with keys for the command."""

import os
import sys
import time
import warnings
from collections import deque

import mujoco
import numpy as np
import torch

from telebip.control.policy import Policy
from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.eval.walk import cost_of_transport, heading_velocity
from telebip.rollout import walk
from telebip.viz.opengl import has_display
from telebip.viz.render import add_arrow
from telebip.viz.scene import PUSH, PUSH_SCALE

ENTER, BACKSPACE, RIGHT, LEFT, DOWN, UP, SPACE = 257, 259, 262, 263, 264, 265, 32  # GLFW's key codes
STEP = 0.1  # per key press [m/s | rad/s]
PUSH_FORCE, PUSH_TIME = 60.0, 0.1  # to the right, and to the left the next time [N, s]
KEYS = ("up, down\nleft, right\nEnter\nspace\nBackspace", "faster, slower\nturn\npush\npause\nreset")


class Steering:
    """The first world of an environment, under a policy, at the command of whoever presses keys."""

    def __init__(self, env: TelebipEnv, policy: Policy) -> None:
        """Start at the environment's present command; random pushes, if there are any, leave no room for the user's."""
        self.env, self.policy = env, policy
        self.command = env.state.target_command[0].tolist()  # forward, left, yaw rate [m/s, m/s, rad/s]
        self.push = 0.0  # to the left [N]
        self._start, self._paused, self._restart = list(self.command), False, True
        self._push_left, self._next_push = 0, -PUSH_FORCE  # policy steps, N
        self._latest: deque[tuple[float, float, float]] = deque(maxlen=round(1.0 / env.step_dt))  # power and velocity

    def press(self, key: int) -> None:
        """Take note of a key that went down; any other is left to the window. Called from the window's thread."""
        if key in (UP, DOWN, LEFT, RIGHT):
            i = 0 if key in (UP, DOWN) else 2
            self.command[i] = round(self.command[i] + (STEP if key in (UP, LEFT) else -STEP), 3)
        elif key == SPACE:
            self._paused = not self._paused
        elif key == ENTER:
            self._push_left = max(1, round(PUSH_TIME / self.env.step_dt))
            self.push, self._next_push = self._next_push, -self._next_push
        elif key == BACKSPACE:
            self._restart = True

    def step(self) -> None:
        """Walk on for one policy step, unless paused; after a reset from the start, at the first command."""
        env = self.env
        if self._restart:
            self._restart, self.command, self.push, self._push_left = False, list(self._start), 0.0, 0
            env.set_command(*self.command)
            env.reset()
            self._walk = walk(env, self.policy)
            self._latest.clear()
        if self._paused:
            return
        env.set_command(*self.command)
        self.push = self.push if self._push_left else 0.0
        env.push(torch.tensor([0.0, self.push, 0.0]))
        self._push_left = max(0, self._push_left - 1)
        next(self._walk)
        state = env.sim.state
        vx, vy = heading_velocity(state.qpos[0].cpu().numpy(), state.qvel[0].cpu().numpy())
        self._latest.append((float(state.joint_power[0].sum()), vx, vy))

    def numbers(self) -> tuple[str, str]:
        """Return what is written beside the robot: names, and values over the last second."""
        names, (vx, vy, turn) = "command\nspeed\ncost of transport", self.command
        rows = np.array(self._latest) if self._latest else np.zeros((1, 3))
        cost = cost_of_transport(rows[:, :1], rows[:, None, 1:], self.env.robot.weight)
        speed = rows[:, 1].mean()
        moving = f"{cost:.2f}" if abs(speed) > 0.05 else "-"
        return names, f"{vx:.1f} m/s, {vy:.1f} m/s left, {turn:+.1f} rad/s\n{speed:.2f} m/s forward\n{moving}"


def steer(env: TelebipEnv, policy: Policy) -> None:
    """Open the window and walk in real time until it is closed.

    Raises:
        UserError: there is no display, or (on macOS) Python was not started as `mjpython`.
    """
    advice = "use --viewer rerun --connect HOST:PORT with a viewer elsewhere, or --record FILE.mp4"
    if not has_display():
        raise UserError(f"the MuJoCo viewer needs a display, and DISPLAY and WAYLAND_DISPLAY are empty; {advice}")
    import mujoco.viewer as window

    if sys.platform == "linux":  # else a display that does not answer would let `launch_passive` wait for ever
        with warnings.catch_warnings(action="ignore"):
            if not window.glfw.init():
                display = os.environ.get("WAYLAND_DISPLAY") or os.environ.get("DISPLAY")
                raise UserError(f"the MuJoCo viewer cannot open the display '{display}'; {advice}")
    model, data, steering = env.robot.model, mujoco.MjData(env.robot.model), Steering(env, policy)
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
            add_arrow(handle.user_scn, above, above + [0.0, PUSH_SCALE * steering.push, 0.0], PUSH, radius=0.02)
            font, corner = mujoco.mjtFontScale.mjFONTSCALE_150, mujoco.mjtGridPos
            handle.set_texts([(font, corner.mjGRID_TOPLEFT, *steering.numbers()), (font, corner.mjGRID_BOTTOMLEFT, *KEYS)])
            handle.sync()
            due = max(due + env.step_dt, time.perf_counter())
            time.sleep(max(0.0, due - time.perf_counter()))
