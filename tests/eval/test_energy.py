"""The cost of transport, split by joint, phase and sign."""

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
    nothing = np.zeros((steps, 1, joints), np.float32)
    return Rollout(
        0.02, WEIGHT, names, (), qpos.astype(np.float32), qvel.astype(np.float32),
        *(nothing,) * 3, power[:, None].astype(np.float32), net[:, None].astype(np.float32), feet[:, None].astype(np.float32),
        *(np.zeros((steps, 1, n), np.float32) for n in (3, 2, 3)), *(np.zeros((steps, 1), np.float32),) * 2,
        np.zeros((steps, 1, 0), np.float32), np.zeros((steps, 1), bool),
    )  # fmt: skip


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
