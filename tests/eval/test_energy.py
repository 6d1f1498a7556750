"""The cost of transport, split by joint, phase and sign."""

from typing import Any

import numpy as np
import pytest

from telebip.eval.energy import energy
from telebip.eval.walk import summarise
from telebip.rollout import Rollout

WEIGHT = 100.0  # N


def rollout(power: np.ndarray, net: np.ndarray, feet: np.ndarray, names: tuple[str, ...]) -> Rollout:
    """One world that walks at 0.5 m/s; arrays are (steps, joints) and (steps, feet)."""
    steps, joints = power.shape
    qpos, qvel = np.zeros((steps, 1, 7)), np.zeros((steps, 1, 6))
    qpos[..., 3], qvel[..., 0] = 1.0, 0.5
    arrays = {"joint_power": power, "joint_net_power": net, "foot_force": feet, "fallen": np.zeros(steps, bool)}
    arrays |= {name: np.zeros((steps, joints)) for name in ("joint_pos", "joint_target", "joint_force")}
    arrays |= {
        name: np.zeros((steps, size)) for name, size in (("push_w", 3), ("phase", 2), ("command", 3), ("reward_terms", 0))
    }
    arrays |= {name: np.zeros(steps) for name in ("reference_heading", "reward")}
    one_world: dict[str, Any] = {name: array[:, None] for name, array in arrays.items()}
    one_world |= {"qpos": qpos, "qvel": qvel}
    return Rollout(step_dt=0.02, weight=WEIGHT, joint_names=names, reward_names=(), **one_world)


def test_every_joule_has_one_place() -> None:
    """Four steps: both feet on the ground, the right one, the left one, none. 1 W over 100 N x 0.5 m/s is 0.02."""
    feet = np.array([[50.0, 50.0], [100.0, 0.0], [4.0, 96.0], [0.0, 0.0]])  # 4 N are less than 5 % of the weight
    power = np.array([[4.0, 0.0, 0.0], [8.0, 12.0, 0.0], [20.0, 0.0, 0.0], [0.0, 0.0, 40.0]])  # W
    net = np.array([[4.0, 0.0, 0.0], [-8.0, 12.0, 0.0], [10.0, 0.0, 0.0], [0.0, 0.0, -40.0]])
    walk = rollout(power, net, feet, ("right_knee", "left_knee", "waist"))
    rows = {(row["joint"], row["phase"]): row for row in energy(walk)}
    got = {key: (row["positive"], row["negative"]) for key, row in rows.items() if row["positive"] or row["negative"]}
    assert got == {
        ("knee", "double_support"): pytest.approx((0.02, 0.0)),  # 4 W a quarter of the time
        ("knee", "stance"): pytest.approx((0.0, 0.04)),  # 8 W of braking, right
        ("knee", "swing"): pytest.approx((0.135, 0.025)),  # right: 15 W and 5 W; left: 12 W while the right foot stands
        ("waist", "swing"): pytest.approx((0.0, 0.2)),
    }
    assert sum(map(sum, got.values())) == pytest.approx(summarise(walk, 0.0).cost_of_transport, abs=1e-4)
