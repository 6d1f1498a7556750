"""Pushes: limits by hand, and real pushes on real worlds."""

import dataclasses

import numpy as np
import pytest
import torch
from worlds import NEVER_FALL, MakeEnv

from telebip.control.policy import Stateless
from telebip.eval.push import DIRECTIONS, PushProtocol, largest_survived, push_limits, push_trial

FORCES = np.array([5.0, 10.0, 15.0, 20.0])
STAND = Stateless(lambda obs: torch.zeros(len(obs["policy"]), 6))


@pytest.mark.parametrize(
    ("survivors", "limit"),
    [([2, 2, 2, 2], 20.0), ([2, 2, 1, 2], 10.0), ([1, 2, 2, 2], 0.0), ([2, 0, 0, 0], 5.0)],
)
def test_the_limit_is_the_largest_force_below_which_nobody_falls(survivors: list[int], limit: float) -> None:
    survived = np.array([[world < count for world in range(2)] for count in survivors])
    assert largest_survived(survived, FORCES) == limit


def test_limits_of_each_horizon_and_the_worse_side() -> None:
    protocol = PushProtocol(max_force=20.0, worlds=1)
    walked = np.full((4, 4, 1), np.inf)
    walked[3, 0] = 15.0  # 20 N forward: a fall after 15 s
    walked[2:, 1] = 3.0  # 15 N backward: after 3 s
    walked[3, 2], walked[1:, 3] = 4.0, 4.0  # left stands 15 N, right 5 N
    limits = push_limits(walked, protocol, weight=100.0)
    assert list(limits) == ["10s", "20s"]
    assert {name: limits["10s"][f"{name}_n"] for name in ("forward", "backward", "lateral")} == {
        "forward": 20.0,
        "backward": 10.0,
        "lateral": 5.0,
    }
    assert limits["20s"]["forward_n"] == 15.0
    assert limits["10s"]["survivors"] == {
        "forward": [1, 1, 1, 1],
        "backward": [1, 1, 0, 0],
        "left": [1, 1, 1, 0],
        "right": [1, 0, 0, 0],
    }
    assert limits["20s"]["survivors"]["forward"] == [1, 1, 1, 0]
    assert limits["10s"]["forward_ns"] == pytest.approx(2.0)  # 20 N for 0.1 s
    assert limits["10s"]["forward_bw"] == pytest.approx(0.2)


def test_every_force_is_applied_in_its_direction_for_its_time(make_env: MakeEnv) -> None:
    protocol = PushProtocol(max_force=20.0, force_step=10.0, worlds=3, interval=0.4, warmup=0.2, horizons=(1.0,))
    env = make_env(NEVER_FALL, "events.start_pose.heading=0", calm=True, num_envs=protocol.num_envs)
    wrenches: list[torch.Tensor] = []
    survival = push_trial(env, STAND, protocol, progress=lambda step: wrenches.append(env.state.wrench_w.clone()))
    assert survival.shape == (2, 4, 3)
    assert np.isinf(survival).all()
    wrench = torch.stack(wrenches).reshape(-1, 2, 4, 3, 6)  # steps, forces, directions, worlds
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


def test_a_fall_is_dated_from_the_end_of_the_warm_up(make_env: MakeEnv) -> None:
    protocol = PushProtocol(max_force=1000.0, force_step=1000.0, worlds=2, interval=0.3, warmup=0.1, horizons=(1.0, 2.0))
    env = make_env("events.start_pose.heading=0", calm=True, num_envs=protocol.num_envs)
    survival = push_trial(env, STAND, protocol)
    assert (survival < 2.0).all()  # 1000 N knock anyone over
    assert (survival > 0.0).all()
    limits = push_limits(survival, protocol, env.robot.weight)
    assert all(row[f"{name}_n"] == 0.0 for row in limits.values() for name in ("forward", "backward", "lateral"))


def test_the_whole_trial_is_one_batch() -> None:
    protocol = dataclasses.replace(PushProtocol(), max_force=100.0, worlds=8)
    assert protocol.num_envs == 20 * 4 * 8
    assert protocol.seconds == 22.0
    np.testing.assert_allclose(protocol.forces[[0, -1]], [5.0, 100.0])
