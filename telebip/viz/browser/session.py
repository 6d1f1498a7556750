"""Walkers in real time, drawn in every open tab and steered from any of them."""

import queue
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Literal

import numpy as np
import torch
import viser

from telebip.control.policy import Policy
from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.eval.walk import cost_of_transport, heading_velocity
from telebip.math import yaw
from telebip.robot import Robot
from telebip.rollout import Rollout, judge_faults
from telebip.viz.browser.charts import Charts
from telebip.viz.browser.scene import Pose, Scene
from telebip.viz.series import plots
from telebip.viz.steering import Steering

Walker = Callable[[], tuple[TelebipEnv, Policy]]
"""Makes worlds and what walks in them; raises a `UserError` if that cannot be."""

MEMORY = 5.0  # of the time series [s]
FRAME, CHARTS, IDLE, LOOK = 1 / 30, 0.25, 0.1, 2.0  # time between frames, charts, looks for tabs, looks for new policies [s]
STEP = 0.1  # of a key [m/s | rad/s]
PUSH, MAX_PUSH = 60.0, 300.0  # of a button at first, and at most [N]
PUSHES = {"forward": (1.0, 0.0), "back": (-1.0, 0.0), "left": (0.0, 1.0), "right": (0.0, -1.0)}
KEYS = """\
Keys: **I** **K** faster, slower · **J** **L** turn · **U** **O** left, right ·
**P** push · **space** pause · **N** one step · **R** reset
"""
NOBODY = "nobody"
Key = Literal["I", "J", "K", "L", "N", "O", "P", "R", "U", "space"]


class Session:
    """Steers one walker, and any others beside it, for all open tabs alike; while none is open, nothing moves."""

    def __init__(
        self,
        server: viser.ViserServer,
        robot: Robot,
        walkers: Callable[[], Mapping[str, Walker]],
        chosen: str,
        beside: Sequence[str] = (),
    ) -> None:
        """Begin with the walker `chosen` and those `beside` it.

        Args:
            server: where tabs connect to.
            robot: what is drawn.
            walkers: returns who can be chosen, by their names; asked again and again, as checkpoints come and go.
            chosen: one of them.
            beside: more of them.

        Raises:
            UserError: one of them cannot walk.
        """
        self.server, self._robot, self._find = server, robot, walkers
        self._walkers, self._chosen, self._beside = dict(walkers()), chosen, list(beside)
        self._requests: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._drawn = self._charted = self._looked = 0.0  # when [s]
        self._rate = 1.0  # of the worlds' time to the clock's
        self.steered = [self._make(name) for name in [chosen, *beside]]
        self._next_push = "right"
        self._scene = Scene(server, robot)
        self.tabs = server.gui.add_tab_group()
        with self.tabs.add_tab("Steer", viser.Icon.STEERING_WHEEL):
            self._add_steering()
        with self.tabs.add_tab("Plots", viser.Icon.CHART_LINE):
            self._charts = Charts(server.gui)
        with self.tabs.add_tab("View", viser.Icon.EYE):
            arrows = server.gui.add_checkbox("Arrows", True, hint="pushes, ground forces, commanded and actual speed")
            arrows.on_update(lambda _: setattr(self._scene, "shows_arrows", arrows.value))
            self._scene.add_gui()
        self._add_keys()
        self._fit_sliders()

    def run(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Walk in real time until `stop()` holds; or until Ctrl-C.

        Raises:
            UserError: the engine had no room for a world's contacts or constraints.
        """
        due = time.perf_counter()
        while not stop():
            self._answer()
            if not self.server.get_clients():
                time.sleep(IDLE)
                due = time.perf_counter()
                continue
            began = time.perf_counter()
            self.advance()
            now, step_dt = time.perf_counter(), self.steered[0].env.step_dt
            due = max(due + step_dt, now - step_dt)  # it may catch up with one step, not with seconds
            time.sleep(max(0.0, due - now))
            self._rate += 0.02 * (step_dt / (time.perf_counter() - began) - self._rate)

    def advance(self) -> None:
        """Walk on for one policy step, and show what is due."""
        walked = [steering.step() for steering in self.steered]
        now = time.perf_counter()
        if now - self._drawn >= FRAME:
            self._drawn = now
            self._scene.draw(self._poses())
        if now - self._charted >= CHARTS and any(walked):
            self._charted = now
            self._show_numbers()
        if now - self._looked >= LOOK:
            self._looked = now
            self._look_for_walkers()
            for steering in self.steered:
                judge_faults(steering.env)

    def later(self, request: Callable[..., None], *values: object) -> None:
        """Let the loop call `request(*values)` between two steps; from any thread."""
        self._requests.put(partial(request, *values))

    def choose(self, name: str, beside: Sequence[str]) -> None:
        """Let others walk; if one of them cannot, say so in the tabs and let those go on that walk."""
        try:
            steered = [self._make(one) for one in [name, *beside]]
        except UserError as error:
            self._say(str(error))
            self._policy.value, self._companion.value = self._chosen, (self._beside or [NOBODY])[0]
            return
        for steering in steered:
            steering.paused = self.steered[0].paused
        self.steered, self._chosen, self._beside = steered, name, list(beside)
        self._fit_sliders()

    def _make(self, name: str) -> Steering:
        env, policy = self._walkers[name]()
        if env.robot.path.resolve() != self._robot.path.resolve():
            raise UserError(f"'{name}' walks another robot, {env.robot.path.name}")
        return Steering(env, policy, MEMORY)

    def _answer(self) -> None:
        while True:
            try:
                request = self._requests.get_nowait()
            except queue.Empty:
                return
            request()

    def _say(self, text: str) -> None:
        for client in self.server.get_clients().values():
            client.add_notification("That does not work", text, auto_close_seconds=15.0)

    # What is on the page, and what it asks for.

    def _add_steering(self) -> None:
        gui = self.server.gui
        self._numbers = gui.add_markdown("")
        names = list(self._walkers)
        self._policy = gui.add_dropdown("Policy", names, initial_value=self._chosen)
        self._companion = gui.add_dropdown("Beside it", [NOBODY, *names], initial_value=(self._beside or [NOBODY])[0])
        self._policy.on_update(lambda _: self.later(self._choose_as_asked))
        self._companion.on_update(lambda _: self.later(self._choose_as_asked))
        self._world = gui.add_dropdown("Follow", ["1"], hint="whom the camera follows, and whose numbers are shown")
        self._world.on_update(lambda _: setattr(self._scene, "followed", self._world.options.index(self._world.value)))
        units = ("Forward [m/s]", "Left [m/s]", "Turn [rad/s]")
        self._sliders = [gui.add_slider(name, min=-1.0, max=1.0, step=0.01, initial_value=0.0) for name in units]
        for i, slider in enumerate(self._sliders):
            slider.on_update(lambda event, i=i: self.later(self._command, i, event.target.value))
        actions = {"Pause": self._pause, "Step": self._single_step, "Reset": self._restart}
        buttons = gui.add_button_group("Time", tuple(actions))
        buttons.on_click(lambda event: self.later(actions[event.target.value]))
        with gui.add_folder("Push"):
            self._force = gui.add_slider("Force [N]", min=0.0, max=MAX_PUSH, step=5.0, initial_value=PUSH)
            pushes = gui.add_button_group("Towards", tuple(PUSHES))
            pushes.on_click(lambda event: self.later(self._push, event.target.value))
        gui.add_markdown(KEYS)

    def _add_keys(self) -> None:
        def add(key: Key, name: str, action: Callable[..., None], *values: object) -> None:
            self.server.gui.add_command(name, hotkey=key).on_trigger(lambda _: self.later(action, *values))

        add("I", "faster", self._nudge, 0, STEP)
        add("K", "slower", self._nudge, 0, -STEP)
        add("U", "to the left", self._nudge, 1, STEP)
        add("O", "to the right", self._nudge, 1, -STEP)
        add("J", "turn left", self._nudge, 2, STEP)
        add("L", "turn right", self._nudge, 2, -STEP)
        add("P", "push", self._push_from_either_side)
        add("space", "pause", self._pause)
        add("N", "one step", self._single_step)
        add("R", "reset", self._restart)

    def _choose_as_asked(self) -> None:
        beside = [] if self._companion.value == NOBODY else [self._companion.value, *self._beside[1:]]
        if (self._policy.value, beside) != (self._chosen, self._beside):
            self.choose(self._policy.value, beside)

    def _command(self, i: int, value: float) -> None:
        for steering in self.steered:
            steering.command[i] = value

    def _nudge(self, i: int, change: float) -> None:
        slider = self._sliders[i]
        if not slider.disabled:
            slider.value = round(min(max(slider.value + change, slider.min), slider.max), 3)
            self._command(i, slider.value)

    def _pause(self) -> None:
        for steering in self.steered:
            steering.paused = not steering.paused

    def _single_step(self) -> None:
        for steering in self.steered:
            steering.paused = True
            steering.single_step()

    def _restart(self) -> None:
        for steering in self.steered:
            steering.restart()
        self._fit_sliders()

    def _push(self, towards: str) -> None:
        """Push every robot, as seen from its own trunk."""
        ahead, left = PUSHES[towards]
        for steering in self.steered:
            psi = yaw(steering.env.sim.state.base_quat)
            x, y = ahead * psi.cos() - left * psi.sin(), ahead * psi.sin() + left * psi.cos()
            steering.push(float(self._force.value) * torch.stack([x, y, torch.zeros_like(x)], dim=1))

    def _push_from_either_side(self) -> None:
        self._push(self._next_push)
        self._next_push = "left" if self._next_push == "right" else "right"

    # What is shown.

    def _fit_sliders(self) -> None:
        """Give the sliders the ranges that the steered policy's task commands, and its command; and the robots' names."""
        steering = self.steered[0]
        for slider, value, (low, high) in zip(self._sliders, steering.command, steering.env.cfg.commands.ranges, strict=True):
            slider.disabled = low == high
            slider.min, slider.max = (low - STEP, high + STEP) if low == high else (min(low, value), max(high, value))
            slider.value = value
        names = [self._chosen, *self._beside]
        worlds = [(name, i) for name, one in zip(names, self.steered, strict=True) for i in range(one.env.num_envs)]
        labels = [f"{name}, world {i + 1}" if self.steered[0].env.num_envs > 1 else name for name, i in worlds]
        labels = [f"{label} ({k})" if label in labels[:k] else label for k, label in enumerate(labels)]
        self._world.options = tuple(labels)
        self._world.value = labels[min(self._scene.followed, len(labels) - 1)]
        self._world.visible = len(labels) > 1

    def _poses(self) -> list[Pose]:
        poses = []
        for name, steering in zip([self._chosen, *self._beside], self.steered, strict=True):
            sim, env = steering.env.sim.state, steering.env
            arrays = (sim.qpos, sim.qvel, env.state.target_command, sim.foot_force, steering.force_w)
            for rows in zip(*(array.cpu().numpy() for array in arrays), strict=True):
                poses.append(Pose(name if self._beside else "", *rows))
        return poses

    def _show_numbers(self) -> None:
        """Show the followed robot's last second in numbers, and its last seconds as curves."""
        world = self._scene.followed
        for steering in self.steered:
            if world < steering.env.num_envs:
                break
            world -= steering.env.num_envs
        recent = steering.recent()
        if recent is None:
            return
        self._numbers.content = _numbers(recent.select(slice(world, world + 1)), steering, self._rate)
        steps = int(steering.env.state.num_steps)
        self._charts.show(
            plots(recent, world, self._robot.is_slide), recent.step_dt * (steps - np.arange(len(recent.time))[::-1])
        )

    def _look_for_walkers(self) -> None:
        """Offer checkpoints that have come, and no more those that have gone."""
        found = dict(self._find())
        found |= {name: self._walkers[name] for name in [self._chosen, *self._beside] if name not in found}
        if found.keys() != self._walkers.keys():
            self._policy.options, self._companion.options = tuple(found), (NOBODY, *found)
        self._walkers = found


def _numbers(recent: Rollout, steering: Steering, rate: float) -> str:
    """Return a table of the last second of one world."""
    last = recent.after(max(0.0, recent.time[-1] - 1.0))
    velocity = heading_velocity(last.qpos, last.qvel)
    (vx, vy), turn = velocity.mean((0, 1)), float(last.qvel[..., 5].mean())
    cost = cost_of_transport(last.joint_power.sum(-1), velocity, last.weight) if np.hypot(vx, vy) > 0.05 else float("nan")
    push = float(steering.force_w[0].norm())
    state = "paused" if steering.paused else f"pushed with {push:.0f} N" if push else f"{rate:.1f} x real time"
    wanted = steering.command
    return (
        "| | forward | left | turn |\n|---|---|---|---|\n"
        f"| wanted | {wanted[0]:.2f} m/s | {wanted[1]:.2f} m/s | {wanted[2]:+.2f} rad/s |\n"
        f"| last second | {vx:.2f} m/s | {vy:.2f} m/s | {turn:+.2f} rad/s |\n\n"
        f"cost of transport **{cost:.2f}** · gait period {steering.env.cfg.gait.period:g} s · "
        f"falls {steering.falls} · {state}"
    )
