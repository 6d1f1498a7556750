"""Worlds that a user steers: commands, pushes, pauses and restarts between the steps of the one loop that walks a policy."""

from collections import deque

import torch
from torch import Tensor

from telebip.control.policy import Policy
from telebip.env import TelebipEnv
from telebip.rollout import Rollout, Row, as_rollout, next_row, walk

PUSH_TIME = 0.1  # how long a push lasts [s]


class Steering:
    """All worlds of an environment, under a policy, at the command of whoever steers them."""

    def __init__(self, env: TelebipEnv, policy: Policy, memory: float = 1.0) -> None:
        """Start at the environment's present command, with the first step; `recent` tells of the last `memory` seconds.

        Random pushes, if the task has any, leave no room for the user's.
        """
        self.env, self.policy = env, policy
        self.command: list[float] = env.state.target_command[0].tolist()  # forward, left, yaw rate [m/s, m/s, rad/s]
        self.force_w = torch.zeros(env.num_envs, 3, device=env.device)  # of the push that lasts, world frame [N]
        self.paused = False
        self.falls = 0  # of all worlds since the start
        self._start, self._restarts, self._single_steps = list(self.command), True, 0
        self._push_left = 0  # policy steps
        self._rows: deque[Row] = deque(maxlen=max(1, round(memory / env.step_dt)))

    def push(self, force_w: Tensor) -> None:
        """Push the trunks with `force_w` (num_envs, 3) or (3,) [N], world frame, for `PUSH_TIME`."""
        self.force_w, self._push_left = force_w.expand(self.env.num_envs, 3), max(1, round(PUSH_TIME / self.env.step_dt))

    def restart(self) -> None:
        """Begin anew with the next step, at the first command."""
        self._restarts, self.command = True, list(self._start)

    def single_step(self) -> None:
        """Walk on for one policy step in spite of a pause."""
        self._single_steps += 1

    def take_over(self, policy: Policy) -> None:
        """Let another policy walk on from here, in the same worlds."""
        self.policy, self._walk = policy, walk(self.env, policy)

    def step(self) -> bool:
        """Walk on for one policy step, unless paused; return whether it has."""
        env = self.env
        if self._restarts:
            self._begin()
        if self.paused and not self._single_steps:
            return False
        self._single_steps = max(0, self._single_steps - 1)
        env.set_command(*self.command)
        self.force_w = self.force_w if self._push_left else torch.zeros_like(self.force_w)
        env.push(self.force_w)
        self._push_left = max(0, self._push_left - 1)
        row = next_row(env, self._walk)
        self.falls += int(row["fallen"].sum())
        self._rows.append(row)
        return True

    def recent(self) -> Rollout | None:
        """Return the last seconds, if there has been a step."""
        return as_rollout(self.env, self._rows) if self._rows else None

    def _begin(self) -> None:
        self._restarts, self._push_left, self.falls = False, 0, 0
        self.force_w = torch.zeros_like(self.force_w)
        self.env.set_command(*self.command)
        self.env.reset()
        self._walk = walk(self.env, self.policy)
        self._rows.clear()
