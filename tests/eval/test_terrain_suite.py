"""The terrain suite: who arrives, in what time, and with which interval."""

import math
from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from telebip.config import load_task
from telebip.control.policy import Stateless
from telebip.env import TelebipEnv
from telebip.eval.conditions import as_evaluated
from telebip.eval.statistics import share_interval
from telebip.eval.terrain import LEVELS, SIZE, TYPES, TerrainProtocol, limit, on_test_ground, terrain_results
from telebip.robot import Robot


def test_the_limit_is_the_last_level_before_the_first_that_is_not_passed() -> None:
    rows = [{"size": 0.02 * (i + 1), "success": share} for i, share in enumerate((1.0, 0.96, 0.9, 1.0))]
    assert limit(rows, 0.95) == pytest.approx(0.04)
    assert limit(rows[2:], 0.95) == 0.0
    assert limit(rows, 0.5) == pytest.approx(0.08)


def test_every_type_and_level_has_its_worlds_and_nothing_disturbs_them() -> None:
    protocol = TerrainProtocol(worlds=3)
    config = on_test_ground(as_evaluated(load_task("telebip_rough"), protocol.num_envs, protocol.seconds))
    assert set(config.events) == {"start_pose", "start_velocity"}
    assert config.terrain.start_level == (0, LEVELS - 1)
    assert config.num_envs == 3 * LEVELS * len(TYPES)
    # To a corner at 0.5 m/s: 4.24 m in 8.5 s, and a quarter more.
    assert protocol.seconds == pytest.approx(10.6, abs=0.01)


def test_who_glides_over_the_ground_arrives_and_who_is_slow_or_falls_does_not(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Robots are moved along their heading: those of even worlds as commanded, every fourth too slowly, one is dropped."""
    monkeypatch.setattr("telebip.eval.terrain.TYPES", {"waves": {"height": (0.0, 0.0), "length": 1.0}})
    monkeypatch.setattr("telebip.eval.terrain.LEVELS", 1)
    protocol = TerrainProtocol(worlds=4, command=2.0)
    config = on_test_ground(as_evaluated(load_task("telebip_flat"), 4, protocol.seconds))
    env = TelebipEnv(config, robot)
    speeds = torch.tensor([2.0, 1.7, 1.5, 2.0])

    def glide(env: TelebipEnv) -> Callable[[TensorDict], Tensor]:
        def act(obs: TensorDict) -> Tensor:
            state, psi = env.sim.state, env.view().heading
            qpos, qvel = state.qpos.clone(), torch.zeros_like(state.qvel)
            qpos[:, 0] += 0.02 * speeds * torch.cos(psi)
            qpos[:, 1] += 0.02 * speeds * torch.sin(psi)
            qpos[:, 2] = 0.8
            qpos[3, 2] = 0.3 if env.state.num_steps > 20 else 0.8
            env.sim.reset(torch.ones(4, dtype=torch.bool), qpos, qvel)
            return torch.zeros(4, 6)

        return act

    results = terrain_results(env, Stateless(glide(env)), protocol)
    (row,) = results["levels"]
    assert row["success"] == 0.5  # 1.7 is more than 2.0 / 1.25, and 1.5 is less
    assert (row["success_low"], row["success_high"]) == pytest.approx(share_interval(2, 4), abs=1e-4)
    assert results["limits"] == {"waves": 0.0}
    assert math.isfinite(row["cot"])
    assert SIZE == 6.0
