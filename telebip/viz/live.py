"""A training, watched while it runs: its learning curves, and a few robots under the policy of the moment."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import rerun as rr
import torch

from telebip.env import TelebipEnv
from telebip.eval.conditions import as_evaluated, on_levels
from telebip.rl.policy import load_policy
from telebip.rl.train import Trainer
from telebip.rollout import roll_out
from telebip.viz.blueprint import training_layout
from telebip.viz.rerun import ground_mesh, log_mesh, viewer
from telebip.viz.scene import LANE
from telebip.viz.urdf import Array, link_poses, load_urdf

WORLDS, SECONDS = 4, 4.0
FRAME_STEPS = 4  # policy steps from one frame to the next
BUDGET = 0.03  # share of the training's time that all this may take

CHARTS = {
    "episode length [policy steps]": ["/training/train/episode_length"],
    "return": ["/training/train/episode_return"],
    "velocity and yaw-rate error [m/s, rad/s]": ["/training/error/lin_vel_mps", "/training/error/yaw_rate_radps"],
    "cost of transport": ["/training/walk/cost_of_transport"],
    "rewards per step": ["/training/reward/**"],
    "samples per second": ["/training/speed/samples_per_s"],
}


@contextmanager
def live_view(trainer: Trainer, address: str | None) -> Iterator[Callable[[dict[str, float]], None]]:
    """Open a rerun viewer (see `telebip.viz.rerun.viewer`) and yield the function that an iteration's scalars go to."""
    with viewer(training_layout(CHARTS), address) as stream:
        view = LiveView(trainer, stream)
        try:
            yield view.update
        finally:
            view.close()


class LiveView:
    """Streams curves after every iteration, and now and then a new walk, which a thread of its own plays over and over.

    The robots live in worlds of their own on the CPU, with the task's commands and disturbances, and walk anew whenever curves,
    walks and frames so far have taken less than their share of the time. On a terrain they have tiles of its middle level, and
    each lane shows a strip of one.
    """

    def __init__(self, trainer: Trainer, stream: rr.RecordingStream, budget: float = BUDGET) -> None:
        """Log robots' shapes and ground, and start the thread; `budget` is the share of the time that may be taken."""
        self._trainer, self._stream, self._budget = trainer, stream, budget
        self._start, self._spent, self._played = time.perf_counter(), 0.0, 0.0  # [s], the last two by either thread
        cfg, robot = as_evaluated(trainer.env.cfg, WORLDS, SECONDS, disturbed=True), trainer.env.robot
        cfg = on_levels(cfg, cfg.terrain.levels // 2, cfg.terrain.levels // 2)
        self._env = TelebipEnv(replace(cfg, observations={"policy": cfg.observations["policy"]}), robot, "cpu", "native")
        self._shift = _lanes(self._env)
        self._urdf = load_urdf(robot)
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for link in self._urdf.link_map:
            log_mesh(stream, f"world/{link}", self._urdf, link, robot)
        _log_ground(stream, self._env, self._shift)
        self._frames: list[dict[str, list[rr.DescribedComponentBatch]]] = []  # for each frame, poses of each link
        self._closing = threading.Event()
        self._player = threading.Thread(target=self._play, daemon=True)
        self._player.start()

    def update(self, scalars: dict[str, float]) -> None:
        """Take an iteration's scalars, as `Trainer.learn` reports them."""
        began = time.perf_counter()
        self._set_time()
        for name, value in scalars.items():
            self._stream.log(f"training/{name}", rr.Scalars(value))
        if self._spent + self._played <= self._budget * (began - self._start):
            self._walk()
        self._spent += time.perf_counter() - began

    def close(self) -> None:
        """Stop the thread."""
        self._closing.set()
        self._player.join()

    def _walk(self) -> None:
        trainer, env = self._trainer, self._env
        env.set_samples(trainer.samples)
        env.reset()
        with torch.random.fork_rng(devices=[]):  # new networks draw weights before they are given the learner's
            policy = load_policy(trainer.policy(), "cpu")
        rollout = roll_out(env, policy, round(SECONDS / env.step_dt))
        qpos = rollout.qpos[::FRAME_STEPS].astype(float)
        qpos[..., :3] += self._shift
        poses = link_poses(self._urdf, env.robot, qpos.reshape(-1, qpos.shape[-1]))
        frames = {link: pose.reshape(len(qpos), WORLDS, 4, 4) for link, pose in poses.items()}
        self._frames = [{link: _poses(pose[i]) for link, pose in frames.items()} for i in range(len(qpos))]

    def _play(self) -> None:
        """Log the latest walk in real time, over and over, until `close`."""
        shown, frame = self._frames, 0
        while not self._closing.wait(FRAME_STEPS * self._env.step_dt):
            if frame >= len(shown):
                shown, frame = self._frames, 0
            if shown:
                began = time.thread_time()
                self._set_time()
                for link, poses in shown[frame].items():
                    self._stream.log(f"world/{link}", poses)
                frame += 1
                self._played += time.thread_time() - began

    def _set_time(self) -> None:
        """Set the calling thread's time: samples, which the viewer follows, and seconds, which can be played again."""
        self._stream.set_time("samples", sequence=self._trainer.samples)
        self._stream.set_time("time", duration=time.perf_counter() - self._start)


def _lanes(env: TelebipEnv) -> Array:
    """Return by how much each world is moved [m], (WORLDS, 3), so that all start side by side."""
    shift = np.zeros((WORLDS, 3))
    shift[:, 1] = LANE * (0.5 * (WORLDS - 1) - np.arange(WORLDS))
    ground = env.world.ground
    return shift - ground.origin(env.state.tile).numpy() if ground else shift


def _log_ground(stream: rr.RecordingStream, env: TelebipEnv, shift: Array) -> None:
    """Log the strip of each world's tile that its lane has room for, if there is a terrain."""
    terrain, ground = env.robot.terrain, env.world.ground
    if terrain and ground:
        for world, origin in enumerate(ground.origin(env.state.tile).numpy()):
            reach = 0.5 * np.array([terrain.size, LANE])
            strip = ground_mesh(terrain, origin[:2] - reach, origin[:2] + reach)
            stream.log(f"world/ground/{world}", strip, rr.Transform3D(translation=shift[world]), static=True)


def _poses(pose: Array) -> list[rr.DescribedComponentBatch]:
    """Return what is logged of a link's poses (WORLDS, 4, 4), made ready once, as each walk is played many times."""
    return list(rr.InstancePoses3D(translations=pose[:, :3, 3], mat3x3=pose[:, :3, :3]).as_component_batches())
