"""Who can be chosen to walk in `play.py --viewer browser`."""

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from telebip.cli.common import CONTROLLERS, policy_of, resolve_device
from telebip.config import load_task
from telebip.control.factory import with_estimate
from telebip.control.policy import Policy
from telebip.env import TelebipEnv
from telebip.eval.conditions import as_evaluated
from telebip.rl.checkpoint import POLICIES, Checkpoint, checkpoints_in, load_checkpoint
from telebip.robot import load_robot
from telebip.viz.browser.session import Walker

FOREVER = 1e5
"""Time after which a walk ends, longer than anyone looks [s]."""


class Walkers:
    """The checkpoints of a run, the policies that come with telebip, the controllers and what else was asked for."""

    def __init__(
        self,
        options: argparse.Namespace,
        checkpoint: Checkpoint | None,
        overrides: Sequence[str],
        command: Sequence[float],
        make_policy: Callable[[str, TelebipEnv, Sequence[str]], Policy],
    ) -> None:
        """Read the options of `play.py`; `make_policy` is its maker of controllers and agents."""
        self._options, self._overrides, self._command, self._make_policy = options, overrides, command, make_policy
        self._run_dir = checkpoint.path.resolve().parent if checkpoint else None
        self._task = checkpoint.config if checkpoint else load_task(options.task)
        self.chosen = _name(checkpoint.path) if checkpoint else options.controller or options.agent

    def find(self) -> dict[str, Walker]:
        """Return all of them by their names, a run's newest checkpoint first."""
        files = checkpoints_in(self._run_dir) if self._run_dir else []
        files += [policy for policy in sorted(POLICIES.glob("*/policy.pt")) if policy.parent != self._run_dir]
        others = dict.fromkeys([*CONTROLLERS, *filter(None, [self._options.agent, *self._options.beside])])
        return {_name(file): partial(self._trained, file) for file in files} | {
            name: partial(self._other, name) for name in others
        }

    def _trained(self, file: Path) -> tuple[TelebipEnv, Policy]:
        checkpoint = load_checkpoint(file)
        env = self._worlds(checkpoint.config)
        return env, policy_of(checkpoint, env)

    def _other(self, name: str) -> tuple[TelebipEnv, Policy]:
        env = self._worlds(with_estimate(self._task) if name in CONTROLLERS else self._task)
        own = self._options.control_overrides if name == self._options.controller else []
        return env, self._make_policy(name, env, own)

    def _worlds(self, config) -> TelebipEnv:
        options = self._options
        config = as_evaluated(config, options.num_envs, FOREVER, self._overrides, disturbed=options.disturb)
        env = TelebipEnv(config, load_robot(config.sim.robot), resolve_device(options.device), options.backend)
        ranges = config.commands.ranges
        command = [min(max(value, low), high) for value, (low, high) in zip(self._command, ranges, strict=True)]
        env.set_command(*(self._options.command or command))
        return env


def _name(file: Path) -> str:
    """Return how a checkpoint is listed: `telebip_efficient`, or `model_200` of a run."""
    return file.parent.name if file.resolve().parent.parent == POLICIES.resolve() else file.stem
