"""How hard a walking robot can be pushed: the largest force in each direction that all, or 95 %, of the worlds survive."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from telebip.control.policy import Policy
from telebip.env import TelebipEnv
from telebip.eval.statistics import share_interval
from telebip.rollout import judge_faults, walk

DIRECTIONS = {"forward": (1.0, 0.0), "backward": (-1.0, 0.0), "left": (0.0, 1.0), "right": (0.0, -1.0)}
"""Unit vectors in the plane, x forward and y left of a robot that faces x."""
ABREAST = 4  # levels of the scan that a direction walks at the same time
CHECK_EVERY = 10  # policy steps between two looks at which levels may be stopped


@dataclass(frozen=True)
class PushProtocol:
    """A force on the trunk's centre of mass, again and again while the robot walks.

    The first push comes a random part of the interval after the warm-up: with an interval that is no multiple of the gait
    period, pushes meet all phases of the gait.
    """

    command: float = 0.7  # m/s, forward
    duration: float = 0.1  # s, of one push
    interval: float = 1.1  # s, from the start of one push to the next
    warmup: float = 2.0  # s
    horizons: tuple[float, ...] = (10.0, 20.0)  # s of walking under pushes
    force_step: float = 5.0  # N, between two levels of force
    scan_step: float = 20.0  # N, between the levels that are tried from the smallest up
    max_force: float = 300.0  # N
    worlds: int = 32  # that walk at each level of the scan
    limit_worlds: int = 300  # that walk at the levels of the bisection
    share: float = 0.95  # of them that must survive
    num_envs: int = 640  # worlds that walk at the same time

    @property
    def levels(self) -> int:
        """Number of forces, the largest of which is `max_force`; level 0 is no push at all."""
        return round(self.max_force / self.force_step)

    @property
    def scan(self) -> list[int]:
        """Levels that are tried first."""
        stride = max(1, round(self.scan_step / self.force_step))
        return [*range(stride, self.levels, stride), self.levels]

    @property
    def seconds(self) -> float:
        """Length of one world's walk [s]."""
        return self.warmup + max(self.horizons)

    def allowed(self, worlds: int) -> int:
        """Return how many of a level's worlds may fall before it is stopped.

        Of `limit_worlds` and more as many as leave `share` of them standing; of fewer as many as leave it possible that the
        share is that large: the upper end of its 95 % interval is.
        """
        if worlds >= self.limit_worlds:
            return math.floor((1.0 - self.share) * worlds + 1e-9)
        return next(k for k in range(worlds, -1, -1) if not k or share_interval(worlds - k, worlds)[1] >= self.share)


class Trial:
    """Worlds that are pushed with one force in one direction."""

    def __init__(self, direction: int, level: int) -> None:
        """Begin without a world; `direction` is an index of `DIRECTIONS`."""
        self.direction, self.level = direction, level
        self.walked = np.zeros(0)  # of each world: how long it has walked under pushes [s], at most to its fall
        self.fell = np.zeros(0, dtype=bool)
        self.started = self.ended = 0  # worlds
        self.failed: set[float] = set()  # horizons at which it had failed when it was stopped

    def extend(self, worlds: int) -> None:
        """Ask for more worlds, `worlds` in all."""
        more = max(0, worlds - len(self.walked))
        self.walked, self.fell = np.pad(self.walked, (0, more)), np.pad(self.fell, (0, more))

    @property
    def is_done(self) -> bool:
        """Whether there is nothing more to walk."""
        return self.ended == len(self.walked)

    def fallen(self, horizon: float, first: int | None = None) -> int:
        """Return how many of the `first` worlds, or all, have fallen within `horizon` s."""
        return int((self.fell & (self.walked < horizon))[:first].sum())

    def stop_if_decided(self, horizons: Sequence[float], allowed: int) -> None:
        """Stop if it has failed at some horizons, with more than `allowed` falls, and no world can fall within the others."""
        failed = {horizon for horizon in horizons if self.fallen(horizon) > allowed}
        passed = {horizon for horizon in horizons if (self.fell | (self.walked >= horizon)).all()}
        if failed and failed | passed == set(horizons):
            self.failed |= failed
            self.started = self.ended = len(self.walked)


class Search:
    """Finds one direction's limits; what it needs to know is asked for level by level."""

    def __init__(self, protocol: PushProtocol, direction: int) -> None:
        """Begin without any trial."""
        self.protocol, self.direction = protocol, direction
        self.trials: dict[int, Trial] = {}  # by their level
        self.limits: dict[float, int] = {}  # by the horizon: the largest level that `share` of the worlds survive

    def steps(self) -> Iterator[list[Trial]]:
        """Yield the trials that are to be walked next, and go on when they are done.

        1. Scan: levels `scan_step` apart with `worlds` each, from the smallest up, until one fails at all horizons.
        2. The levels between the last of them without a fall and the first with one.
        3. Bisection with `limit_worlds`, at each horizon.
        """
        protocol = self.protocol
        for i in range(0, len(protocol.scan), ABREAST):
            levels = protocol.scan[i : i + ABREAST]
            yield [self._trial(level, protocol.worlds) for level in levels]
            if any(self._fails(level, min(protocol.horizons)) for level in levels):
                break
        fine: set[int] = set()
        for horizon in protocol.horizons:
            low = self.all_survive(horizon)
            fine |= set(range(low + 1, min((level for level in self.trials if level > low), default=low)))
        yield [self._trial(level, protocol.worlds) for level in sorted(fine)]
        for horizon in sorted(protocol.horizons, reverse=True):
            yield from self._bisect(horizon)

    def all_survive(self, horizon: float) -> int:
        """Return the largest level at which the first `worlds` all survive, as they do at all smaller ones that were tried."""
        passed = 0
        for level in sorted(self.trials):
            if self.trials[level].fallen(horizon, self.protocol.worlds):
                break
            passed = level
        return passed

    def _bisect(self, horizon: float) -> Iterator[list[Trial]]:
        """Find the limit at `horizon`: `share` of `limit_worlds` survive it, and not the next level."""
        low = self.all_survive(horizon)
        failing = [level for level in self.trials if level > low and self._fails(level, horizon)]
        high = min(failing, default=self.protocol.levels + 1)
        while high - low > 1:
            middle = (low + high) // 2
            yield [self._trial(middle, self.protocol.limit_worlds)]
            low, high = (low, middle) if self._fails(middle, horizon) else (middle, high)
        while low:
            yield [self._trial(low, self.protocol.limit_worlds)]
            if not self._fails(low, horizon):
                break
            low -= 1
        self.limits[horizon] = low

    def _trial(self, level: int, worlds: int) -> Trial:
        trial = self.trials.setdefault(level, Trial(self.direction, level))
        if trial.failed != set(self.protocol.horizons):
            trial.extend(worlds)
        return trial

    def _fails(self, level: int, horizon: float) -> bool:
        trial = self.trials[level]
        return horizon in trial.failed or trial.fallen(horizon) > self.protocol.allowed(len(trial.walked))


class Field:
    """The worlds of an environment, each at some trial or idle. One that ends its trial starts anew with the next."""

    def __init__(self, env: TelebipEnv, protocol: PushProtocol) -> None:
        """Let all worlds be idle."""
        self._env, self._protocol, n = env, protocol, env.num_envs
        self._trials: list[Trial | None] = [None] * n
        self._index = np.zeros(n, dtype=int)  # of the world in its trial
        self._clock = np.zeros(n, dtype=int)  # policy steps of its walk
        self._restarts = np.zeros(n, dtype=bool)  # worlds whose next step ends what they were doing
        self._push = torch.zeros(n, 3, device=env.device)  # [N]
        self._first = torch.zeros(n, device=env.device)  # time of the first push [s]
        self._steps = round(protocol.seconds / env.step_dt)
        self.queue: list[Trial] = []  # whose worlds are not all walking yet

    def fill(self) -> None:
        """Give idle worlds to the trials that wait for them."""
        idle = [world for world, trial in enumerate(self._trials) if trial is None]
        given = []
        while idle and self.queue:
            trial = self.queue[0]
            if trial.started == len(trial.walked):
                self.queue.pop(0)
                continue
            world = idle.pop(0)
            self._trials[world], self._index[world] = trial, trial.started
            trial.started += 1
            given.append(world)
        if not given:
            return
        env, protocol, worlds = self._env, self._protocol, torch.tensor(given, device=self._env.device)
        trials = [trial for world in given if (trial := self._trials[world])]
        force = protocol.force_step * torch.tensor([float(trial.level) for trial in trials], device=env.device)
        directions = torch.tensor([(*DIRECTIONS[name], 0.0) for name in DIRECTIONS], device=env.device)
        self._push[worlds] = force[:, None] * directions[[trial.direction for trial in trials]]
        when = torch.rand(env.num_envs, generator=env.generator, device=env.device)
        self._first[worlds] = protocol.warmup + protocol.interval * when[worlds]
        self._restart([world for world in given if self._clock[world]])

    def forces(self) -> torch.Tensor:
        """Return the force on each trunk during the next step [N], (num_envs, 3)."""
        since = self._env.state.episode_length * self._env.step_dt - self._first
        is_pushed = (since > -1e-6) & (torch.remainder(since + 1e-6, self._protocol.interval) < self._protocol.duration)
        return self._push * is_pushed[:, None]

    def note(self, dones: NDArray[np.bool_]) -> None:
        """Take in a step: its worlds that have fallen, or walked to the end, are idle again."""
        self._clock += 1
        walked, ended = self._walked(), []
        for world in np.flatnonzero(dones | (self._clock == self._steps)).tolist():
            trial = self._trials[world]
            if trial and not self._restarts[world]:
                trial.walked[self._index[world]], trial.fell[self._index[world]] = walked[world], dones[world]
                trial.ended += 1
                ended.append(world)
        self._release(ended)
        self._clock[dones], self._restarts[dones] = 0, False

    def stop_what_is_decided(self) -> None:
        """Stop the trials in which no world that still walks can change anything."""
        walked = self._walked()
        at_work = [(world, trial) for world, trial in enumerate(self._trials) if trial]
        for world, trial in at_work:
            if not self._restarts[world]:
                trial.walked[self._index[world]] = walked[world]
        for trial in dict.fromkeys(trial for _, trial in at_work):
            trial.stop_if_decided(self._protocol.horizons, self._protocol.allowed(len(trial.walked)))
        self._release([world for world, trial in at_work if trial.is_done])

    def _walked(self) -> NDArray[np.floating]:
        """Return how long each world has walked under pushes [s], (num_envs,)."""
        return np.maximum(0.0, self._clock * self._env.step_dt - self._protocol.warmup).round(6)

    def _release(self, worlds: list[int]) -> None:
        for world in worlds:
            self._trials[world] = None
        if worlds:
            self._push[worlds] = 0.0

    def _restart(self, worlds: list[int]) -> None:
        """Let worlds time out in their next step, which starts them anew."""
        self._restarts[worlds] = True
        if worlds:
            self._env.episode_length_buf[worlds] = self._env.max_episode_length


def push_limits(
    env: TelebipEnv, policy: Policy, protocol: PushProtocol, progress: Callable[[int, int], None] = lambda done, total: None
) -> dict[str, Any]:
    """Push the worlds of `env` until the limits in all directions are known; see `Search.steps` for the order.

    Args:
        env: `protocol.num_envs` worlds of a task whose own pushes are off, whose robots start facing x, and whose episodes are
            longer than `protocol.seconds`.
        policy: what walks.
        protocol: when and how hard.
        progress: called with the number of walks that have ended, and of those asked for so far.

    Returns:
        `limit_table` of all directions, and `world_steps`, how many policy steps of a world it took.

    Raises:
        UserError: the engine had no room for a world's contacts or constraints.
    """
    searches = [Search(protocol, i) for i in range(len(DIRECTIONS))]
    field, steps = Field(env, protocol), 0
    env.set_command(protocol.command, 0.0, 0.0)
    walking = walk(env, policy)
    asked = {i: (search.steps(), list[Trial]()) for i, search in enumerate(searches)}
    while True:
        for i, (requests, trials) in list(asked.items()):
            while all(trial.is_done for trial in trials):
                if (wanted := next(requests, None)) is None:
                    del asked[i]
                    break
                trials[:] = wanted
                field.queue += wanted
        if not asked:
            break
        field.fill()
        env.push(field.forces())
        field.note(next(walking).dones.cpu().numpy())
        steps += 1
        if steps % CHECK_EVERY == 0:
            field.stop_what_is_decided()
            every = [trial for search in searches for trial in search.trials.values()]
            progress(sum(trial.ended for trial in every), sum(len(trial.walked) for trial in every))
    judge_faults(env)
    return {"world_steps": steps * env.num_envs, **limit_table(searches, protocol, env.robot.weight)}


def limit_table(searches: Sequence[Search], protocol: PushProtocol, weight: float) -> dict[str, dict[str, Any]]:
    """Return the limits that the searches in `DIRECTIONS` have found; `weight` is m g [N].

    Returns:
        For each horizon ("10s"): `forward_n`, `backward_n` and `lateral_n` (of left and right the worse), which all of
        `worlds` survive [N], the same as impulses (`forward_ns` [N s]) and as fractions of the weight (`forward_bw` [-]);
        `forward_95_n` and so on, which `share` of `limit_worlds` survive [N]; `shares`, for each direction how many survive
        the latter, with the interval of that share; and `tried`, for each direction [force, worlds, how many fell].
    """
    table, step = {}, protocol.force_step
    for horizon in protocol.horizons:
        all_of_them, most, shares, tried = {}, {}, {}, {}
        for name, search in zip(DIRECTIONS, searches, strict=True):
            all_of_them[name], most[name] = step * search.all_survive(horizon), step * search.limits[horizon]
            trials = [search.trials[level] for level in sorted(search.trials)]
            tried[name] = [[step * trial.level, len(trial.walked), trial.fallen(horizon)] for trial in trials]
            shares[name] = _share(search.trials.get(search.limits[horizon]), horizon)
        force, force_95 = _worst_lateral(all_of_them), _worst_lateral(most)
        table[f"{horizon:g}s"] = {
            **{f"{name}_n": value for name, value in force.items()},
            **{f"{name}_ns": round(value * protocol.duration, 6) for name, value in force.items()},
            **{f"{name}_bw": round(value / weight, 4) for name, value in force.items()},
            **{f"{name}_95_n": value for name, value in force_95.items()},
            "shares": shares,
            "tried": tried,
        }
    return table


def _worst_lateral(limit: dict[str, float]) -> dict[str, float]:
    return {"forward": limit["forward"], "backward": limit["backward"], "lateral": min(limit["left"], limit["right"])}


def _share(trial: Trial | None, horizon: float) -> dict[str, float] | None:
    """Return the share of a trial's worlds that survive, with its 95 % interval; None where there is none."""
    if trial is None:
        return None
    worlds, survivors = len(trial.walked), len(trial.walked) - trial.fallen(horizon)
    low, high = (round(end, 4) for end in share_interval(survivors, worlds))
    return {"share": round(survivors / worlds, 4), "share_low": low, "share_high": high, "worlds": worlds}
