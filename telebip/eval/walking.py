"""Whether a policy walks, while it is still being trained: a short walk at a few speeds, repeated every few iterations."""

import math
from dataclasses import dataclass

import numpy as np
import torch

from telebip.config import TaskConfig
from telebip.control.policy import Policy
from telebip.env import TelebipEnv
from telebip.eval.conditions import as_evaluated, forward_commands, on_flat_ground, trained_speeds
from telebip.eval.walk import heading_velocity
from telebip.rl.policy import load_network
from telebip.rl.process import random_state, set_random_state
from telebip.rl.train import Trainer
from telebip.robot import Robot
from telebip.rollout import walk
from telebip.sim import Backend

TOLERANCE = 0.1  # of the command, by which a mean speed may differ
WORLDS = 16  # for each speed
SECONDS = 10.0  # walked by each
SKIP = 3.0  # left out of the mean speeds [s]
EVERY = 10  # iterations between two looks
PASSES = 2  # looks in a row that have to be passed


@dataclass(frozen=True)
class Look:
    """What a short walk has shown."""

    commands: tuple[float, ...]  # forward speeds that were asked for [m/s]
    speeds: tuple[float, ...]  # means over worlds and time [m/s]; NaN if any world fell
    upright: float  # how long all worlds stood [s]

    @property
    def passed(self) -> bool:
        """Whether no world fell and every mean speed is within a tenth of its command."""
        return all(abs(v - c) <= TOLERANCE * abs(c) for c, v in zip(self.commands, self.speeds, strict=True))

    def __str__(self) -> str:
        """Return it in a few words."""
        if math.isnan(self.speeds[0]):
            return f"falls after {self.upright:.1f} s"
        asked, speeds = (" / ".join(f"{v:.2f}" for v in values) for values in (self.commands, self.speeds))
        return f"{speeds} of {asked} m/s"


class WalkingTest:
    """The worlds of the short walk: flat, undisturbed, without noise, at the speeds of the tracking suite that are trained."""

    def __init__(self, config: TaskConfig, robot: Robot, device: torch.device, backend: Backend = "auto") -> None:
        """Create `WORLDS` worlds for each speed."""
        self.commands = trained_speeds(config)
        config = as_evaluated(on_flat_ground(config), WORLDS * len(self.commands), SECONDS)
        self._env = TelebipEnv(config, robot, device, backend)

    def look(self, policy: Policy) -> Look:
        """Walk `policy` from rest, until a world falls or `SECONDS` are over."""
        env = self._env
        env.reset()
        env.set_commands(forward_commands(self.commands, WORLDS, env.device))
        distance = np.zeros(env.num_envs)
        steps, skipped = round(SECONDS / env.step_dt), round(SKIP / env.step_dt)
        for step, stride in zip(range(steps), walk(env, policy), strict=False):
            if (stride.dones & ~stride.extras["time_outs"]).any():
                return Look(self.commands, (math.nan,) * len(self.commands), step * env.step_dt)
            if step >= skipped:
                sim = env.sim.state
                distance += env.step_dt * heading_velocity(sim.qpos.cpu().numpy(), sim.qvel.cpu().numpy())[:, 0]
        means = distance.reshape(len(self.commands), WORLDS).mean(1) / (SECONDS - SKIP)
        return Look(self.commands, tuple(means.tolist()), SECONDS)


class UntilWalking:
    """Looks at a training every `EVERY` iterations; it walks when it has passed `PASSES` looks in a row."""

    def __init__(self, trainer: Trainer) -> None:
        """Create the worlds of the looks; the training's own worlds and random numbers are left alone."""
        env = trainer.env
        self._trainer, self._passes = trainer, 0
        self._test = WalkingTest(env.cfg, env.robot, env.device, env.sim.backend)
        self.last: Look | None = None

    def walks(self) -> bool:
        """Return whether the policy walks; to be asked after every iteration."""
        iteration = self._trainer.iteration
        if self._passes < PASSES and iteration and iteration % EVERY == 0:
            device = self._trainer.env.device
            random = random_state(device)
            self.last = self._test.look(load_network(self._trainer.policy(), device))
            set_random_state(random, device)  # a new network draws weights, before it is given others
            self._passes = self._passes + 1 if self.last.passed else 0
        return self._passes >= PASSES
