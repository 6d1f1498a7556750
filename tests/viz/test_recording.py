"""A recording, read back with rerun's own reader, shows what happened."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from telebip import ROOT
from telebip.config import load_task
from telebip.control.policy import Stateless
from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.robot import FEET, Robot
from telebip.rollout import Rollout, roll_out
from telebip.viz.rerun import PUSH_SCALE, SPEED_SCALE, record, show
from telebip.viz.scene import LANE, line_up

chunk = pytest.importorskip("rerun.chunk")

STEPS = 100
TRUNK = "/world/RL_2/trunk"
KNEE = f"{TRUNK}/right_hip/right_thigh/right_shank"
FORCE = "/world/RL_2/ground_force/left_foot"
ARROW, SCALAR, MOVED, TURNED = "Arrows3D:vectors", "Scalars:scalars", "Transform3D:translation", "Transform3D:mat3x3"

Columns = dict[str, dict[str, list[Any]]]


@pytest.fixture(scope="module")
def file(walking: Rollout, standing: Rollout, robot: Robot, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two of the walking worlds and the standing one in one recording."""
    file = tmp_path_factory.mktemp("recording") / "new_folder" / "walk.rrd"
    record(line_up([("RL", walking), ("no policy", standing)], worlds=2), robot, file)
    return file


@pytest.fixture(scope="module")
def recorded(file: Path) -> Columns:
    return columns(file)


def columns(file: Path) -> Columns:
    """Columns of every entity, as the reader gives them."""
    found: Columns = {}
    for part in chunk.RrdReader(file).stream():
        entity = found.setdefault(part.entity_path, {})
        for name, values in part.to_record_batch().to_pydict().items():
            entity.setdefault(name, []).extend(values)
    return found


def column(recorded: Columns, entity: str, component: str) -> NDArray[np.float64]:
    """One row per step; a batch of one instance is taken out of its list."""
    rows = [values[0] for values in recorded[entity][component] if values is not None]
    return np.array(rows, dtype=float)


@pytest.mark.parametrize(("name", "steps"), [("RL_1", 100), ("RL_2", 100), ("no_policy", 20)])
def test_every_robot_has_its_links_forces_and_series(recorded: Columns, walking: Rollout, name: str, steps: int) -> None:
    leg = ("hip", "hip/{0}_thigh", "hip/{0}_thigh/{0}_shank", "hip/{0}_thigh/{0}_shank/{0}_foot")
    links = {f"trunk/{side}_{part.format(side)}" for side in ("right", "left") for part in leg}
    arrows = {*(f"ground_force/{foot}" for foot in FEET), "push", "velocity/command", "velocity/actual"}
    sides = ("right", "left", "right_target", "left_target")
    series = {f"{joint}/{side}" for joint in ("hip_roll", "hip_pitch", "knee") for side in sides}
    series |= {"speed/command", "speed/forward", "yaw_rate/command", "yaw_rate/trunk", "gait/p_r", "gait/p_l"}
    series |= {"power/total", "cost_of_transport/mechanical", "reward/total", "force/right_knee", "force/left_knee"}
    series |= {f"reward/{term}" for term in walking.reward_names} | {f"gait/{foot}" for foot in FEET}
    series |= {f"torque/{joint}" for joint in walking.joint_names if not joint.endswith("knee")}
    for entity in [f"/world/{name}/{path}" for path in links | arrows] + [f"/plot/{name}/{path}" for path in series]:
        times = [time for time in recorded[entity]["time"] if time is not None]
        assert len(times) == steps, entity


def test_the_time_runs_from_the_first_step_to_the_last(recorded: Columns) -> None:
    times = [time.total_seconds() for time in recorded[TRUNK]["time"] if time is not None]
    np.testing.assert_allclose(times, 0.02 * np.arange(1, STEPS + 1), atol=1e-6)


def test_the_trunk_moves_as_it_did(recorded: Columns, walking: Rollout) -> None:
    np.testing.assert_allclose(column(recorded, TRUNK, MOVED), walking.qpos[:, 1, :3], atol=1e-6)
    quat_xyzw = column(recorded, TRUNK, "Transform3D:quaternion")
    np.testing.assert_allclose(quat_xyzw[:, [3, 0, 1, 2]], walking.qpos[:, 1, 3:7], atol=1e-6)
    assert walking.qpos[-1, 1, 0] > 0.8  # m walked


def test_the_knee_slides_along_the_leg(recorded: Columns, walking: Rollout) -> None:
    slide = column(recorded, KNEE, MOVED)
    knee = walking.joint_pos[:, 1, walking.joint_names.index("right_knee")]
    np.testing.assert_allclose(slide, np.outer(knee - 0.67, [0, 0, 1]), atol=1e-6)
    np.testing.assert_allclose(column(recorded, "/plot/RL_2/knee/right", SCALAR), knee, atol=1e-6)
    assert np.ptp(knee) > 0.02


def test_a_hip_turns_about_its_axis(recorded: Columns, walking: Rollout) -> None:
    pitch = walking.joint_pos[:, 1, walking.joint_names.index("left_hip_pitch")].astype(float)
    turned = column(recorded, f"{TRUNK}/left_hip/left_thigh", TURNED).reshape(STEPS, 3, 3).swapaxes(1, 2)  # by columns
    zero, one, s, c = np.zeros(STEPS), np.ones(STEPS), np.sin(pitch), np.cos(pitch)
    about_y = np.stack([np.stack([c, zero, s], -1), np.stack([zero, one, zero], -1), np.stack([-s, zero, c], -1)], axis=1)
    np.testing.assert_allclose(turned, about_y, atol=1e-6)
    assert np.ptp(pitch) > 0.2


def test_arrows_are_as_long_as_what_they_show(recorded: Columns, walking: Rollout) -> None:
    load = walking.foot_force[:, 1, 1]
    np.testing.assert_allclose(column(recorded, FORCE, ARROW), np.outer(load, [0, 0, 0.001]), atol=1e-6)
    push = column(recorded, "/world/RL_2/push", ARROW)
    np.testing.assert_allclose(push, PUSH_SCALE * walking.push_w[:, 1], atol=1e-6)
    assert np.abs(push).max() > 0.0
    actual = column(recorded, "/world/RL_2/velocity/actual", ARROW) / SPEED_SCALE
    np.testing.assert_allclose(actual[:, :2], walking.qvel[:, 1, :2], atol=1e-6)
    wanted = np.linalg.norm(column(recorded, "/world/RL_2/velocity/command", ARROW), axis=1)
    np.testing.assert_allclose(wanted, SPEED_SCALE * 0.7, rtol=1e-5)


def test_robots_stand_side_by_side(recorded: Columns) -> None:
    lanes = [column(recorded, f"/world/{name}", MOVED)[0, 1] for name in ("RL_1", "RL_2", "no_policy")]
    np.testing.assert_allclose(lanes, [LANE, 0.0, -LANE], atol=1e-6)


def test_the_layout_comes_with_the_recording(file: Path) -> None:
    assert len(chunk.RrdReader(file).blueprints()) == 1


def test_another_robot_is_recorded(four_joints: Robot, tmp_path: Path) -> None:
    cfg = load_task(str(ROOT / "tests" / "robots" / "four_joints.yaml"), ["num_envs=1"])
    env = TelebipEnv(cfg, four_joints, "cpu", "native")
    rollout = roll_out(env, Stateless(lambda obs: torch.zeros(1, 4)), 10)
    record(line_up([("zero", rollout)]), four_joints, tmp_path / "four.rrd")
    recorded = columns(tmp_path / "four.rrd")
    spring = column(recorded, "/world/zero/trunk/right_thigh/right_shank/right_foot", MOVED)
    np.testing.assert_allclose(spring[:, 2], rollout.qpos[:, 0, 9], atol=1e-6)  # which no actuator moves
    plotted = {name.removeprefix("/plot/zero/") for name in recorded if name.startswith("/plot/zero")}
    assert {"hip_pitch/left_target", "knee/right", "torque/left_hip_pitch", "force/right_knee"} <= plotted
    sole = column(recorded, "/world/zero/ground_force/left_foot", "Arrows3D:origins")[-1]
    assert sole[2] == pytest.approx(0.0, abs=0.02)  # m above the ground


def test_two_seconds_of_one_robot_are_small(walking: Rollout, robot: Robot, tmp_path: Path) -> None:
    record(line_up([("RL", walking)]), robot, tmp_path / "one.rrd")
    assert 50_000 < (tmp_path / "one.rrd").stat().st_size < 1_000_000


def test_a_place_that_cannot_be_written_is_one_line(walking: Rollout, robot: Robot, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"^cannot write recording '.*walk.rrd': [^\n]+$"):
        record(line_up([("RL", walking)]), robot, tmp_path / "file" / "walk.rrd")


def test_a_viewer_that_is_not_there_is_one_line(walking: Rollout, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UserError, match=r"^no rerun viewer answers at '127.0.0.1:1': [^\n]+$"):
        show(line_up([("RL", walking)]), robot, "127.0.0.1:1")
    with pytest.raises(UserError, match="is no address of a rerun viewer"):
        show(line_up([("RL", walking)]), robot, "here:there")
    for variable in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    with pytest.raises(UserError, match="needs a display; use --connect HOST:PORT"):
        show(line_up([("RL", walking)]), robot)
