"""Gymnasium's contract: spaces that hold, episodes that end as declared, its own checker and wrappers, and the same physics."""

import os
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.wrappers.vector import (
    ClipAction,
    NormalizeObservation,
    NormalizeReward,
    RecordEpisodeStatistics,
    RescaleAction,
)
from worlds import CALM

import telebip.gym
from telebip import ROOT
from telebip.config import load_task, task_names
from telebip.config.schema import ObservationGroup
from telebip.errors import UserError
from telebip.gym.env import TelebipVectorEnv
from telebip.robot import Robot

SHORT = "episode.length=0.2"  # ten policy steps


def make(*overrides: str, num_envs: int = 4, name: str = "telebip/Flat-v0", mode: str = "SameStep", **more) -> VectorEnv:
    return gymnasium.make_vec(name, num_envs=num_envs, overrides=overrides, autoreset_mode=mode, **more)


def actions(steps: int, num_envs: int = 4, scale: float = 0.3) -> np.ndarray:
    return (scale * np.random.default_rng(0).standard_normal((steps, num_envs, 6))).astype(np.float32)


def test_every_task_is_registered() -> None:
    names = {telebip.gym.env_id(task) for task in task_names()}
    assert {"telebip/Flat-v0", "telebip/Slow-v0", "telebip/Fast-v0", "telebip/Backward-v0"} <= names
    assert names <= set(gymnasium.registry)
    env = make(name="telebip/Slow-v0", num_envs=2)
    assert isinstance(env, TelebipVectorEnv)
    assert env.worlds.cfg.commands.lin_vel_x == (0.4, 0.7)
    assert env.spec is not None
    assert env.spec.id == "telebip/Slow-v0"


def test_the_omnidirectional_task_has_its_ranges() -> None:
    seen = make(name="telebip/Omni-v0", num_envs=1).single_observation_space
    assert isinstance(seen, gymnasium.spaces.Box)
    assert seen.low[28:31] == pytest.approx([-0.85, -0.6, -1.2], abs=1e-5)  # with the holds' 0.15 m/s and 0.3 rad/s
    assert seen.high[28:31] == pytest.approx([1.45, 0.6, 1.2], abs=1e-5)


def test_a_wrong_override_is_said_in_one_line() -> None:
    with pytest.raises(UserError, match=r"did you mean 'gait.period'"):
        make("gait.perod=1")


def test_the_spaces_have_shapes_bounds_and_names(robot: Robot) -> None:
    env = make(num_envs=3)
    assert env.observation_space.shape == (3, 33)
    assert env.action_space.shape == (3, 6)
    assert env.metadata["action_names"] == robot.joint_names
    names = env.metadata["observation_names"]
    assert names[2] == "joint_pos/right_knee"
    assert names[24:28] == ("base_quat/w", "base_quat/x", "base_quat/y", "base_quat/z")
    assert names[28:] == ("command/lin_vel_x", "command/lin_vel_y", "command/ang_vel_z", "phase/right", "phase/left")
    assert len(names) == 33
    space = env.single_action_space
    assert isinstance(space, gymnasium.spaces.Box)
    # Hip roll: range +-0.6 rad, 50 N m / (200 N m/rad) beyond it, scale 0.25 rad. Knee: from home at 0.04 m, scale 0.1 m.
    assert space.high[0] == pytest.approx((0.6 + 0.25) / 0.25)
    assert (space.low[2], space.high[2]) == pytest.approx(
        ((-0.15 - 0.0667 - 0.04) / 0.1, (0.2 + 0.0667 - 0.04) / 0.1), rel=1e-3
    )
    seen = env.single_observation_space
    assert isinstance(seen, gymnasium.spaces.Box)
    assert seen.high[28:] == pytest.approx([1.0, 0.0, 0.5, 1.0, 1.0], abs=1e-5)  # yaw rate 0.2 and the heading hold's 0.3 rad/s
    assert np.isinf(seen.high[:12]).all()
    assert seen.high[12:18] == pytest.approx(space.high)


def test_a_task_of_ones_own_has_its_own_names_and_bounds() -> None:
    task = load_task("telebip_flat")
    terms = {"gravity": {"term": "projected_gravity", "noise": 0.1}, "joint_pos": {"noise": 0.0}, "base_height": {"noise": 0.0}}
    groups = {"policy": ObservationGroup(terms, history=2), "critic": task.observations["policy"]}
    env = TelebipVectorEnv(2, replace(task, observations=groups))
    names = env.metadata["observation_names"]
    assert list(env.worlds.groups) == ["policy"]  # nobody sees the critic's
    assert names[:4] == ("gravity/x", "gravity/y", "gravity/z", "joint_pos/right_hip_roll")
    assert names[9:13] == ("base_height/0", "gravity/x@-1", "gravity/y@-1", "gravity/z@-1")
    seen = env.single_observation_space
    assert isinstance(seen, gymnasium.spaces.Box)
    assert seen.shape == (20,)
    assert seen.high[:3] == pytest.approx([1.1] * 3, abs=1e-5)
    assert np.isinf(seen.high[3:10]).all()
    np.testing.assert_array_equal(seen.low[:10], seen.low[10:])
    env.reset(seed=0)
    obs, *_ = env.step(np.zeros((2, 6), dtype=np.float32))
    assert env.observation_space.contains(obs)


@pytest.mark.parametrize("task", ["telebip_flat", "tests/robots/four_joints.yaml", "tests/robots/ten_joints.yaml"])
def test_observations_and_actions_stay_in_their_spaces(task: str) -> None:
    env = TelebipVectorEnv(16, task)
    assert env.single_action_space.shape == (len(env.metadata["action_names"]),)
    env.action_space.seed(0)
    obs, _ = env.reset(seed=0)
    assert env.observation_space.contains(obs)
    for _ in range(200):  # wild actions: robots fall, are pushed and get new commands
        obs, rewards, terminated, truncated, _ = env.step(env.action_space.sample())
        assert env.observation_space.contains(obs)
        assert rewards.shape == terminated.shape == truncated.shape == (16,)
        assert terminated.dtype == truncated.dtype == np.bool_


def test_actions_outside_of_the_space_are_clipped_to_it() -> None:
    env = make(*CALM)
    env.reset(seed=0)
    obs, *_ = env.step(np.full((4, 6), 100.0, dtype=np.float32))
    np.testing.assert_array_equal(obs[:, 12:18], env.action_space.high)  # type: ignore[attr-defined]


def test_a_seed_repeats_an_episode_and_another_does_not() -> None:
    env = make()
    runs = []
    for seed in (3, 3, 4):
        rows = [env.reset(seed=seed)[0], *(env.step(action)[0] for action in actions(20))]
        runs.append(np.stack(rows))
    np.testing.assert_array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])


def test_returned_arrays_are_the_callers() -> None:
    env = make()
    first, _ = env.reset(seed=0)
    kept = first.copy()
    second, *_ = env.step(actions(1)[0])
    env.step(actions(1)[0])
    np.testing.assert_array_equal(first, kept)
    assert not np.array_equal(second, first)


def test_a_time_out_truncates_and_its_final_observation_is_that_of_the_unbroken_episode() -> None:
    short, long = make(SHORT, *CALM), make(*CALM)
    start, _ = short.reset(seed=1)
    np.testing.assert_array_equal(long.reset(seed=1)[0], start)
    for step, action in enumerate(actions(10)):
        obs, _, terminated, truncated, infos = short.step(action)
        expected, *_, untouched = long.step(action)
        assert untouched == {}
        assert not terminated.any()
        if step < 9:
            assert infos == {}
            np.testing.assert_array_equal(obs, expected)
    assert truncated.all()
    assert infos["_final_obs"].all()
    np.testing.assert_array_equal(np.stack(infos["final_obs"]), expected)
    np.testing.assert_array_equal(obs[:, 12:18], 0.0)  # the next episode's: no last action
    assert np.abs(expected[:, 12:18]).min() > 0.0


def test_a_fall_terminates_in_its_own_world() -> None:
    env = make(*CALM)
    assert isinstance(env, TelebipVectorEnv)
    env.reset(seed=0)
    worlds = env.worlds
    qpos = worlds.sim.state.qpos.clone()
    qpos[1, 2] = 0.3  # m: hips below the 0.4 m of a fall
    worlds.sim.reset(worlds.episode_length_buf < 1, qpos, 0.0 * worlds.sim.state.qvel)
    _, _, terminated, truncated, infos = env.step(actions(1)[0])
    assert terminated.tolist() == infos["_final_obs"].tolist() == [False, True, False, False]
    assert not truncated.any()
    assert infos["final_obs"][0] is None
    np.testing.assert_array_equal(infos["final_obs"][1][12:18], actions(1)[0][1])  # what it had just done


def test_keeping_final_observations_changes_nothing_else(make_env) -> None:
    overrides = (SHORT, *CALM)
    env, plain = make(*overrides), make_env(*overrides)
    obs, _ = env.reset(seed=plain.cfg.seed)
    plain.generator.manual_seed(plain.cfg.seed)
    np.testing.assert_array_equal(obs, plain.reset()["policy"].numpy())
    for action in actions(25):
        obs, rewards, *_ = env.step(action)
        expected, expected_rewards, *_ = plain.step(torch.from_numpy(action))
        np.testing.assert_array_equal(obs, expected["policy"].numpy())
        np.testing.assert_array_equal(rewards, expected_rewards.numpy())


def test_gymnasiums_checker_finds_nothing(recwarn: pytest.WarningsRecorder) -> None:
    check_env(gymnasium.make("telebip/Flat-v0", render_mode="rgb_array").unwrapped, skip_render_check=not has_opengl())
    advice = ("infinity", "symmetric and normalized")  # velocities have no bounds; RescaleAction normalises actions
    assert [w for w in recwarn if not any(part in str(w.message) for part in advice)] == []


def test_one_world_waits_at_the_end_of_its_episode() -> None:
    env = gymnasium.make("telebip/Flat-v0", overrides=(SHORT, *CALM))
    env.reset(seed=0)
    for step, action in enumerate(actions(10, num_envs=1)[:, 0]):
        obs, _, terminated, truncated, _ = env.step(action)
        assert (terminated, truncated) == (False, step == 9)
    np.testing.assert_array_equal(obs[12:18], action)
    with pytest.raises(ResetNeeded):
        env.unwrapped.step(action)
    env.reset()
    env.step(action)


def has_opengl() -> bool:
    return os.environ.get("MUJOCO_GL") != "disable"


def test_the_next_step_starts_the_next_episode() -> None:
    """By default: the last observation is the step's own, and the action of the step after it is nobody's."""
    env, same = gymnasium.make_vec("telebip/Flat-v0", num_envs=4, overrides=(SHORT, *CALM)), make(SHORT, *CALM)
    assert env.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    np.testing.assert_array_equal(env.reset(seed=1)[0], same.reset(seed=1)[0])
    for step, action in enumerate(actions(10)):
        obs, rewards, terminated, truncated, infos = env.step(action)
        expected, expected_rewards, *_, other = same.step(action)
        np.testing.assert_array_equal(rewards, expected_rewards)
        np.testing.assert_array_equal(obs, np.stack(other["final_obs"]) if step == 9 else expected)
        assert infos == {}
        assert truncated.all() == (step == 9)
    obs, rewards, terminated, truncated, _ = env.step(actions(1)[0])
    assert not (terminated.any() or truncated.any() or rewards.any())
    np.testing.assert_array_equal(obs[:, 12:18], 0.0)  # a first observation has no last action
    np.testing.assert_allclose(obs[:, 31:], 0.0, atol=1e-6)  # and the clock stands at zero
    for step, action in enumerate(actions(10)):
        assert env.step(action)[3].all() == (step == 9)  # an episode is as long as the first


def test_a_fall_ends_one_world_and_the_others_never_notice() -> None:
    env, plain = make(*CALM, mode="NextStep"), make(*CALM, mode="NextStep")
    for one in (env, plain):
        one.reset(seed=0)
    worlds = env.unwrapped.worlds  # type: ignore[attr-defined]
    qpos = worlds.sim.state.qpos.clone()
    qpos[1, 2] = 0.3  # m: hips below the 0.4 m of a fall
    worlds.sim.reset(torch.tensor([False, True, False, False]), qpos, 0.0 * worlds.sim.state.qvel)
    ends, others = [], [0, 2, 3]
    for action in actions(3):
        obs, rewards, terminated, *_ = env.step(action)
        expected, expected_rewards, *_ = plain.step(action)
        np.testing.assert_array_equal(obs[others], expected[others])
        np.testing.assert_array_equal(rewards[others], expected_rewards[others])
        ends.append(terminated.tolist())
    assert ends == [[False, True, False, False], [False] * 4, [False] * 4]


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_a_mask_resets_its_worlds_alone(mode: str) -> None:
    env, plain = make(mode=mode), make(mode=mode)
    mask = np.array([False, True, False, True])
    for one in (env, plain):
        one.reset(seed=0)
        before = [one.step(action)[0] for action in actions(5)][-1]
    obs, _ = env.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(obs[~mask], before[~mask])
    np.testing.assert_array_equal(obs[mask, 12:18], 0.0)
    assert np.abs(obs[~mask, 12:18]).min() > 0.0
    assert env.unwrapped.worlds.episode_length_buf.tolist() == [5, 0, 5, 0]  # type: ignore[attr-defined]
    state, untouched = (one.unwrapped.worlds.sim.state.qpos[~mask] for one in (env, plain))  # type: ignore[attr-defined]
    assert torch.equal(state, untouched)
    env.step(actions(1)[0])


def test_without_automatic_resets_an_episode_waits() -> None:
    env = make(SHORT, *CALM, mode="Disabled")
    env.reset(seed=0)
    for action in actions(10):
        truncated = env.step(action)[3]
    with pytest.raises(ResetNeeded, match=r"the episodes of worlds \[0, 1, 2, 3\] are over"):
        env.step(action)
    env.reset(options={"reset_mask": truncated})
    env.step(action)


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"reset_mask": [True] * 4}, TypeError),
        ({"reset_mask": np.ones(4)}, TypeError),
        ({"reset_mask": np.ones(3, dtype=bool)}, ValueError),
        ({"reset_mask": np.zeros(4, dtype=bool)}, ValueError),
        ({"mask": np.ones(4, dtype=bool)}, ValueError),
    ],
)
def test_a_wrong_mask_is_named(options: dict, error: type[Exception]) -> None:
    with pytest.raises(error, match="mask"):
        make().reset(options=options)


def test_wrong_modes_are_one_line() -> None:
    with pytest.raises(UserError, match=r"^unknown autoreset_mode 'NextStap'; did you mean 'NextStep'\?$"):
        make(mode="NextStap")
    with pytest.raises(UserError, match=r"^unknown render_mode 'human'; valid: rgb_array, or None$"):
        make(render_mode="human")


@pytest.mark.skipif(not has_opengl(), reason="no OpenGL")
def test_pictures_are_of_each_world() -> None:
    env = make(num_envs=2, render_mode="rgb_array")
    env.reset(seed=0)
    pictures = env.render()
    assert pictures is not None
    assert [(picture.shape, picture.dtype) for picture in pictures] == [((360, 480, 3), np.uint8)] * 2  # type: ignore[union-attr]
    assert all(np.std(picture) > 10.0 for picture in pictures)  # type: ignore[arg-type]
    env.close()
    one = gymnasium.make("telebip/Flat-v0", render_mode="rgb_array")
    one.reset(seed=0)
    assert one.render().shape == (360, 480, 3)  # type: ignore[union-attr]
    one.close()
    assert make(num_envs=1).render() is None


def test_a_checkpoints_robot_is_compared(tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    text = (ROOT / "assets" / "telebip.xml").read_text()
    (tmp_path / "soft.xml").write_text(text.replace('kp="200"', 'kp="100"'))
    (tmp_path / "fast.xml").write_text(text.replace('timestep="0.005"', 'timestep="0.001"'))
    make(checkpoint="telebip_flat")
    assert not [w for w in recwarn if "is not the robot of" in str(w.message)]
    make(f"sim.robot={tmp_path / 'soft.xml'}", checkpoint="telebip_flat")
    assert len([w for w in recwarn if "stiffness kp [N m/rad | N/m]: right_hip_roll 200 -> 100" in str(w.message)]) == 1
    with pytest.raises(UserError, match=r"its policy step is 0\.02 s, not 0\.004 s"):
        make(f"sim.robot={tmp_path / 'fast.xml'}", checkpoint="telebip_flat")
    make(f"sim.robot={tmp_path / 'fast.xml'}", checkpoint="telebip_flat", allow_robot_change=True)


def test_wrappers_of_observations_apply() -> None:
    env = NormalizeObservation(gymnasium.make_vec("telebip/Flat-v0", num_envs=4, overrides=(SHORT,)))
    obs, _ = env.reset(seed=0)
    for action in actions(25):
        obs, *_ = env.step(action)
    assert np.isfinite(obs).all()
    assert env.obs_rms.count > 100
    statistics = RecordEpisodeStatistics(make(SHORT, *CALM, mode="NextStep"))
    statistics.reset(seed=0)
    for action in actions(22):
        statistics.step(action)
    assert list(statistics.length_queue) == [10] * 8


def test_gymnasiums_wrappers_apply() -> None:
    """Those that know of same-step resets."""
    env = RecordEpisodeStatistics(make(SHORT, *CALM))
    env.reset(seed=0)
    for action in actions(21):
        env.step(action)
    assert list(env.length_queue) == [10] * 8
    assert len(env.return_queue) == 8

    wrapped = NormalizeReward(ClipAction(RescaleAction(make(SHORT, *CALM), -1.0, 1.0)))
    wrapped.reset(seed=0)
    wrapped.step(np.full((4, 6), 2.0, dtype=np.float32))
    unwrapped = wrapped.unwrapped
    assert isinstance(unwrapped, TelebipVectorEnv)
    np.testing.assert_allclose(unwrapped.worlds.state.last_action.numpy(), unwrapped.action_space.high, rtol=1e-5)  # type: ignore[attr-defined]
