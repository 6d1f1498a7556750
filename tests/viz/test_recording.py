# pyright: reportAttributeAccessIssue=false
"""A recording, read back with rerun's own reader, shows what happened."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import yourdfpy
from numpy.typing import NDArray

from telebip.control.policy import Stateless
from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.eval.rollout import Rollout, roll_out
from telebip.robot import FEET, JOINTS, Robot
from telebip.viz.rerun import foot_positions, record

chunk = pytest.importorskip("rerun.chunk")

STEPS = 50  # 1 s
TRUNK = "/world/robot/trunk"
KNEE = f"{TRUNK}/right_hip/right_thigh/right_shank"

Columns = dict[str, dict[str, list[Any]]]


@pytest.fixture(scope="module")
def rollout(make_env: Callable[..., TelebipEnv]) -> Rollout:
    return roll_out(make_env(num_envs=2), Stateless(lambda obs: torch.zeros(2, 6)), STEPS)


@pytest.fixture(scope="module")
def urdf(robot: Robot) -> Path:
    return robot.path.with_suffix(".urdf")


@pytest.fixture(scope="module")
def recorded(rollout: Rollout, urdf: Path, tmp_path_factory: pytest.TempPathFactory) -> Columns:
    """Columns of every entity that changes with time, as the reader gives them."""
    file = tmp_path_factory.mktemp("recording") / "new_folder" / "walk.rrd"
    record(rollout, urdf, file, world=1)
    chunks = list(chunk.RrdReader(file).stream())
    columns: Columns = {part.entity_path: {} for part in chunks}
    for part in chunks:
        if not part.is_static:
            for name, values in part.to_record_batch().to_pydict().items():
                columns[part.entity_path].setdefault(name, []).extend(values)
    return columns


def column(recorded: Columns, entity: str, component: str) -> NDArray[np.float64]:
    """One row per step; a batch of one instance is taken out of its list."""
    return np.array([values[0] for values in recorded[entity][component]], dtype=float)


def test_every_link_and_series_is_there(recorded: Columns) -> None:
    leg = ("hip", "hip/{}_thigh", "hip/{}_thigh/{}_shank", "hip/{}_thigh/{}_shank/{}_foot")
    links = {f"{TRUNK}/{side}_{part.format(*[side] * 3)}" for side in ("right", "left") for part in leg}
    forces = {f"/world/ground_force/{foot}" for foot in FEET} | {"/world/push"}
    joints = {f"/plot/joint_{what}/{joint}" for what in ("pos", "target", "force") for joint in JOINTS}
    series = {f"/plot/{name}" for name in ("speed/command", "speed/forward", "phase/p_r", "phase/p_l", "power/total")}
    series |= {f"/plot/foot_force/{foot}" for foot in FEET} | {"/plot/reward/total"}
    assert {TRUNK, *links, *forces, *joints, *series} <= set(recorded)
    assert all(len(recorded[entity]["time"]) == STEPS for entity in {TRUNK, *links, *forces, *joints, *series})


def test_the_time_runs_from_the_first_step_to_the_last(recorded: Columns) -> None:
    times = [time.total_seconds() for time in recorded[TRUNK]["time"]]
    np.testing.assert_allclose(times, 0.02 * np.arange(1, STEPS + 1), atol=1e-6)


def test_the_trunk_moves_as_it_did(recorded: Columns, rollout: Rollout) -> None:
    np.testing.assert_allclose(column(recorded, TRUNK, "Transform3D:translation"), rollout.qpos[:, 1, :3], atol=1e-6)
    quat_xyzw = column(recorded, TRUNK, "Transform3D:quaternion")
    np.testing.assert_allclose(quat_xyzw[:, [3, 0, 1, 2]], rollout.qpos[:, 1, 3:7], atol=1e-6)
    assert np.ptp(rollout.qpos[:, 1, 2]) > 0.001


def test_the_knee_slides_along_the_leg(recorded: Columns, rollout: Rollout) -> None:
    slide = column(recorded, KNEE, "Transform3D:translation")
    knee = rollout.qpos[:, 1, 7 + JOINTS.index("right_knee")]
    np.testing.assert_allclose(slide[[0, -1]], [[0.0, 0.0, -0.67 + knee[0]], [0.0, 0.0, -0.67 + knee[-1]]], atol=1e-6)
    np.testing.assert_allclose(column(recorded, "/plot/joint_pos/right_knee", "Scalars:scalars"), knee, atol=1e-6)


def test_a_hip_turns_about_its_axis(recorded: Columns, rollout: Rollout) -> None:
    pitch = rollout.qpos[:, 1, 7 + JOINTS.index("left_hip_pitch")].astype(float)
    quat_xyzw = column(recorded, f"{TRUNK}/left_hip/left_thigh", "Transform3D:quaternion")
    zero = np.zeros(STEPS)
    np.testing.assert_allclose(quat_xyzw, np.stack([zero, np.sin(pitch / 2), zero, np.cos(pitch / 2)], axis=1), atol=1e-6)
    assert np.abs(pitch).max() > 0.001


def test_feet_stand_where_mujoco_has_them(robot: Robot, urdf: Path) -> None:
    random = np.random.default_rng(0)
    qpos = np.concatenate([random.uniform(-2.0, 2.0, (20, 3)), random.normal(size=(20, 4)), np.zeros((20, 6))], axis=1)
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    qpos[:, 7:] = random.uniform(robot.joint_range[:, 0], robot.joint_range[:, 1], (20, 6))
    places = foot_positions(yourdfpy.URDF.load(str(urdf)), qpos)
    data = mujoco.MjData(robot.model)
    for step, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_kinematics(robot.model, data)
        for foot, place in zip(FEET, places, strict=True):
            np.testing.assert_allclose(place[step], data.site(foot).xpos, atol=1e-6)


def test_a_place_that_cannot_be_written_is_one_line(rollout: Rollout, urdf: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"^cannot write recording '.*walk.rrd': [^\n]+$"):
        record(rollout, urdf, tmp_path / "file" / "walk.rrd")
