"""A training, watched and steered in a browser while it goes on.

Worlds, policy and server live in a process of their own, of low priority: the training hands over its scalars and, when
a tab is open and asks for it, a copy of the policy's weights. It waits for nothing, and its random numbers are its own.
"""

import multiprocessing
import os
import queue
import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from multiprocessing.queues import Queue
from multiprocessing.synchronize import Event

import numpy as np
import torch
import viser

from telebip.control.policy import Policy
from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.eval.conditions import as_evaluated
from telebip.rl.checkpoint import Checkpoint
from telebip.rl.policy import load_policy
from telebip.rl.train import Trainer
from telebip.robot import load_robot
from telebip.viz.browser.charts import chart, line
from telebip.viz.browser.server import Address, serving
from telebip.viz.browser.session import Session
from telebip.viz.series import PALETTE

WORLDS = 4
FOREVER = 1e5  # time after which a walk ends [s]
NAME = "the training"
NICENESS = 10
"""Beside a training that keeps two cores busy, the scheduler of Linux leaves a process of this niceness a tenth of one core."""
POINTS = 500  # of a curve, at most

CHARTS: dict[str, list[str]] = {
    "episode length [policy steps]": ["train/episode_length"],
    "return": ["train/episode_return"],
    "velocity and yaw-rate error [m/s, rad/s]": ["error/lin_vel_mps", "error/yaw_rate_radps"],
    "falls per robot-minute": ["walk/falls_per_minute"],
    "cost of transport": ["walk/cost_of_transport"],
    "samples per second": ["speed/samples_per_s"],
}


@dataclass(frozen=True)
class News:
    """What an iteration sends to the viewer's process."""

    iteration: int
    samples: int
    scalars: Mapping[str, float]
    weights: Mapping[str, np.ndarray] | None  # of the policy, if they were asked for


class Sender:
    """The training's end: never waits for the other one."""

    def __init__(self, trainer: Trainer, news: "Queue[News | Address | str | None]", wanted: Event) -> None:
        """Send news of `trainer`; weights where they are `wanted`."""
        self._trainer, self._news, self._wanted = trainer, news, wanted

    def update(self, scalars: dict[str, float]) -> None:
        """Take an iteration's scalars, as `Trainer.learn` reports them."""
        trainer, weights = self._trainer, None
        if self._wanted.is_set():
            self._wanted.clear()
            weights = {name: value.numpy() for name, value in trainer.policy().policy_weights.items()}
        self._news.put(News(trainer.iteration, trainer.samples, scalars, weights))


@contextmanager
def live_session(trainer: Trainer, address: Address) -> Iterator[tuple[Address, Callable[[dict[str, float]], None]]]:
    """Serve a training until the end of the context; yield where, and the function that an iteration's scalars go to.

    Raises:
        UserError: it cannot be served at `address`.
    """
    context = multiprocessing.get_context("spawn")  # a fork would share the engine's and torch's threads and locks
    news, answers, wanted = context.Queue(), context.Queue(), context.Event()
    process = context.Process(target=_serve, args=(trainer.policy(), address, news, answers, wanted), daemon=True)
    process.start()
    news.cancel_join_thread()  # what the viewer has not read is of no use when the training has ended
    try:
        answer = _answer(process, answers)
        if not isinstance(answer, Address):
            raise UserError(answer)
        yield answer, Sender(trainer, news, wanted).update
    finally:
        news.put(None)
        process.join(timeout=5.0)
        if process.is_alive():
            process.terminate()
            process.join()


def _answer(process, answers: "Queue[Address | str]") -> Address | str:
    """Return where the process serves, or why it does not."""
    while True:
        with suppress(queue.Empty):
            return answers.get(timeout=0.5)
        if not process.is_alive():
            return f"the viewer's process has ended with status {process.exitcode}"


def _serve(
    checkpoint: Checkpoint, address: Address, news: "Queue[News | None]", answers: "Queue[Address | str]", wanted: Event
) -> None:
    """Be the viewer's process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a Ctrl-C is for the training, which ends this one
    if hasattr(os, "nice"):
        os.nice(NICENESS)
    torch.set_num_threads(1)
    answer: Address | str = "the viewer has ended"
    try:
        with serving(address, f"telebip: training {checkpoint.task}") as (server, answer):
            training = LiveTraining(server, checkpoint, news, wanted)
            answers.put(answer)
            training.run()
    except UserError as error:
        answers.put(str(error))


class LiveTraining:
    """The session of a training: its newest policy walks on and on, as the curves grow."""

    def __init__(self, server: viser.ViserServer, checkpoint: Checkpoint, news: "Queue[News | None]", wanted: Event) -> None:
        """Begin with the policy of `checkpoint`."""
        self._checkpoint, self._news, self._wanted = checkpoint, news, wanted
        self._rows: list[tuple[int, dict[str, float]]] = []
        robot = load_robot(checkpoint.config.sim.robot)
        self._session = Session(server, robot, lambda: {NAME: self._walker}, NAME)
        with self._session.tabs.add_tab("Training", viser.Icon.SCHOOL):
            self._told = server.gui.add_markdown("no iteration yet")
            self._follows = server.gui.add_checkbox("Follow", True, hint="let the newest policy take over as it comes")
            nothing = np.zeros(1, np.float32)
            self._charts = {
                title: chart(server.gui, title, (nothing,) * (1 + len(names)), "samples [M]", _lines(names))
                for title, names in CHARTS.items()
            }

    def run(self) -> None:
        """Walk until the training has ended."""
        self._session.run(self._listen)

    def _walker(self) -> tuple[TelebipEnv, Policy]:
        config = as_evaluated(self._checkpoint.config, WORLDS, FOREVER)
        env = TelebipEnv(config, load_robot(config.sim.robot), "cpu", "native")
        env.set_command(*(0.5 * (low + high) for low, high in config.commands.ranges))
        return env, load_policy(self._checkpoint, "cpu")

    def _listen(self) -> bool:
        """Take in what has come, and return whether the training has ended, or its process has been killed."""
        latest, parent = None, multiprocessing.parent_process()
        if parent and not parent.is_alive():
            return True
        while True:
            try:
                message = self._news.get_nowait()
            except queue.Empty:
                break
            if message is None:
                return True
            latest = message
            self._rows.append((message.samples, dict(message.scalars)))
            if message.weights is not None:
                self._take_over(message)
        is_looked_at = bool(self._session.server.get_clients())
        if latest and is_looked_at:
            self._draw(latest)
        if is_looked_at and self._follows.value:
            self._wanted.set()
        return False

    def _take_over(self, message: News) -> None:
        weights = {name: torch.from_numpy(value) for name, value in (message.weights or {}).items()}
        self._checkpoint = replace(
            self._checkpoint, iteration=message.iteration, samples=message.samples, learner={"actor_state_dict": weights}
        )
        self._session.steered[0].take_over(load_policy(self._checkpoint, "cpu"))

    def _draw(self, latest: News) -> None:
        total = self._checkpoint.config.ppo.max_iterations
        walks = f"the policy of iteration {self._checkpoint.iteration}" if self._checkpoint.iteration else "a new policy"
        self._told.content = (
            f"Iteration **{latest.iteration}** of {total}, {latest.samples / 1e6:.2f} M samples at "
            f"{latest.scalars['speed/samples_per_s'] / 1e3:.1f} k/s. Here walks {walks}."
        )
        shown = self._rows[:: max(1, len(self._rows) // POINTS)]
        samples = np.array([samples / 1e6 for samples, _ in shown], np.float32)
        for title, names in CHARTS.items():
            curves = (np.array([scalars.get(name, np.nan) for _, scalars in shown], np.float32) for name in names)
            self._charts[title].data = (samples, *curves)  # pyright: ignore[reportAttributeAccessIssue]


def _lines(names: list[str]) -> list:
    return [line(name.partition("/")[2], color) for name, color in zip(names, PALETTE[1:], strict=False)]
