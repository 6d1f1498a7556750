"""Pushes: limits by hand, and real pushes on real worlds."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from worlds import NEVER_FALL, MakeEnv

from telebip.control.policy import Stateless
from telebip.eval.push import DIRECTIONS, Field, PushProtocol, Search, Trial, limit_table, push_limits
from telebip.rollout import walk

STAND = Stateless(lambda obs: torch.zeros(len(obs["policy"]), 6))
PROTOCOL = PushProtocol(max_force=100.0, worlds=4, limit_worlds=20)


def searched(falls_after: Callable[[int, float], float], protocol: PushProtocol = PROTOCOL) -> Search:
    """Search where world `i` pushed with `force` N falls after `falls_after(i, force)` s; worlds walk as long as they may."""
    search = Search(protocol, 0)
    for trials in search.steps():
        for trial in trials:
            for i in range(trial.ended, len(trial.walked)):
                time = falls_after(i, trial.level * protocol.force_step)
                trial.walked[i], trial.fell[i] = min(time, max(protocol.horizons)), time < max(protocol.horizons)
            trial.started = trial.ended = len(trial.walked)
            trial.stop_if_decided(protocol.horizons, protocol.allowed(len(trial.walked)))
    return search


def limits(search: Search, horizon: float) -> tuple[float, float]:
    step = search.protocol.force_step
    return step * search.all_survive(horizon), step * search.limits[horizon]


def test_all_fall_above_a_force_and_none_below_it() -> None:
    search = searched(lambda i, force: 3.0 if force > 55.0 else np.inf)
    assert limits(search, 10.0) == limits(search, 20.0) == (55.0, 55.0)
    walked = {5.0 * level: len(trial.walked) for level, trial in sorted(search.trials.items())}
    assert walked == {20.0: 4, 40.0: 4, 45.0: 4, 50.0: 4, 55.0: 20, 60.0: 4, 80.0: 4}


def test_limits_differ_by_the_horizon_and_by_the_share() -> None:
    """At 30 N and more one of twenty worlds falls after 15 s, at 50 N and more one more after 5 s, at 70 N all."""

    def falls_after(i: int, force: float) -> float:
        if force >= 70.0:
            return 1.0
        return 5.0 if force >= 50.0 and i == 1 else 15.0 if force >= 30.0 and i == 0 else np.inf

    search = searched(falls_after)
    assert limits(search, 10.0) == (45.0, 65.0)
    assert limits(search, 20.0) == (25.0, 45.0)


def test_nothing_and_everything_survived() -> None:
    assert limits(searched(lambda i, force: 0.0), 10.0) == (0.0, 0.0)
    assert limits(searched(lambda i, force: np.inf), 20.0) == (100.0, 100.0)


def test_a_scanned_force_that_fells_below_others_is_the_limit() -> None:
    """Survival is not monotone: 20 N fell, 25 to 80 N do not."""
    search = searched(lambda i, force: 2.0 if force in (20.0, 85.0) or force > 85.0 else np.inf)
    assert limits(search, 10.0) == (15.0, 15.0)


def test_how_many_may_fall() -> None:
    protocol = PushProtocol()
    assert [protocol.allowed(worlds) for worlds in (300, 400)] == [15, 20]
    assert protocol.allowed(32) == 4  # of 28 survivors the interval's upper end is 0.9503, of 27 it is 0.931
    assert protocol.allowed(1) == 0  # of 0 survivors it is 0.79


def test_a_level_is_stopped_once_nothing_can_change() -> None:
    trial = Trial(0, 1)
    trial.extend(4)
    trial.walked[:], trial.fell[:] = [12.0, 13.0, 11.0, 9.0], [True, True, False, False]
    trial.stop_if_decided((10.0, 20.0), allowed=1)
    assert not trial.is_done  # the last one may still fall within 10 s
    trial.walked[3] = 10.0
    trial.stop_if_decided((10.0, 20.0), allowed=1)
    assert trial.is_done
    assert trial.failed == {20.0}
    assert (trial.fallen(10.0), trial.fallen(20.0), trial.fallen(20.0, 1)) == (0, 2, 1)


def test_the_table_has_the_worse_side_and_the_interval_of_the_share() -> None:
    bounds = (80.0, 60.0, 40.0, 55.0)
    searches = [searched(lambda i, force, bound=bound: 3.0 if force > bound else np.inf) for bound in bounds]
    table = limit_table(searches, PROTOCOL, weight=100.0)
    assert list(table) == ["10s", "20s"]
    row = table["10s"]
    assert [row[f"{name}_n"] for name in ("forward", "backward", "lateral")] == [80.0, 60.0, 40.0]
    assert [row[f"{name}_95_n"] for name in ("forward", "backward", "lateral")] == [80.0, 60.0, 40.0]
    assert (row["forward_ns"], row["forward_bw"]) == pytest.approx((8.0, 0.8))  # 80 N for 0.1 s, of 100 N
    assert row["shares"]["left"] == {"share": 1.0, "share_low": 0.8389, "share_high": 1.0, "worlds": 20}
    assert row["tried"]["left"] == [[20.0, 4, 0], [40.0, 20, 0], *([force, 4, 4] for force in (45.0, 50.0, 55.0, 60.0, 80.0))]


def test_every_force_is_applied_in_its_direction_for_its_time(make_env: MakeEnv) -> None:
    protocol = PushProtocol(interval=0.4, warmup=0.2, horizons=(1.0,), num_envs=24)
    env = make_env(NEVER_FALL, "events.start_pose.heading=0", calm=True, num_envs=protocol.num_envs)
    field = Field(env, protocol)
    trials = [Trial(direction, level) for level in (2, 4) for direction in range(4)]
    for trial in trials:
        trial.extend(3)
    field.queue += trials
    field.fill()
    wrenches, walking = [], walk(env, STAND)
    for _ in range(60):
        env.push(field.forces())
        field.note(next(walking).dones.numpy())
        wrenches.append(env.state.wrench_w.clone())
    assert all(trial.is_done and not trial.fell.any() and (trial.walked == 1.0).all() for trial in trials)
    wrench = torch.stack(wrenches).reshape(60, 2, 4, 3, 6)  # steps, forces, directions, worlds
    assert not wrench[:10].any()  # 0.2 s of warm-up
    for i, force in enumerate((10.0, 20.0)):
        for j, (x, y) in enumerate(DIRECTIONS.values()):
            for world in range(3):
                pushed = wrench[:, i, j, world]
                active = pushed.any(dim=1)
                assert torch.equal(pushed[active].unique(dim=0), torch.tensor([[force * x, force * y, 0, 0, 0, 0]]))
                starts = torch.nonzero(torch.diff(active.int(), prepend=torch.zeros(1).int()) == 1)[:, 0]
                assert 10 <= starts[0] <= 30
                assert set(torch.diff(starts).tolist()) <= {19, 20, 21}  # 0.4 s
                assert active.sum() in range(5 * (len(starts) - 1), 5 * len(starts) + 1)  # 0.1 s each, the last may be cut


def test_a_world_begins_each_of_its_walks_at_rest(make_env: MakeEnv) -> None:
    protocol = PushProtocol(interval=0.3, warmup=0.1, horizons=(0.5,), num_envs=2)
    env = make_env(
        NEVER_FALL, "events.start_pose={joint_pos: 0, heading: 0}", "events.start_velocity=null", calm=True, num_envs=2
    )
    field, first, second, walking = Field(env, protocol), Trial(0, 20), Trial(1, 20), walk(env, STAND)
    first.extend(2)
    second.extend(2)
    field.queue += [first, second]
    home = env.sim.state.qpos[:, :3].clone()
    far = False
    while not second.is_done:
        field.fill()
        env.push(field.forces())
        field.note(next(walking).dones.numpy())
        far |= bool((env.sim.state.qpos[:, :3] - home).norm(dim=1).gt(0.01).any())
        if first.is_done and not second.ended and not env.state.episode_length.any():
            torch.testing.assert_close(env.sim.state.qpos[:, :3], home)
            far = False
    assert far  # the second walk, too, has gone somewhere
    assert (first.walked == 0.5).all() and (second.walked == 0.5).all()


def test_who_only_stands_is_knocked_over_by_large_pushes_and_the_same_again(make_env: MakeEnv) -> None:
    protocol = PushProtocol(
        *(0.0, 0.1, 0.3), warmup=0.1, horizons=(0.5, 1.0), force_step=250.0, scan_step=250.0, max_force=1000.0
    )
    protocol = replace(protocol, worlds=2, limit_worlds=4, num_envs=16)
    found = []
    for _ in range(2):
        env = make_env("events.start_pose.heading=0", calm=True, num_envs=16)
        found.append(push_limits(env, STAND, protocol))
    assert found[0] == found[1]
    row = found[0]["1s"]
    assert row["forward_95_n"] < 1000.0
    assert row["tried"]["forward"][-1][2] >= 1
    assert 0 < found[0]["world_steps"] < 8 * 4 * 2 * 55 * 2
