# pyright: reportAttributeAccessIssue=false
"""The one state of the worlds: saved, taken over, reset, and gone on from bit for bit."""

from pathlib import Path

import pytest
import torch
from worlds import CALM, MORE_EVENTFUL, MakeEnv, random_actions, same, write_stateful

from telebip.config import load_task
from telebip.env import TelebipEnv
from telebip.robot import Robot, load_robot
from telebip.sim import Backend


@pytest.fixture(params=["telebip", "stateful"])
def any_robot(request: pytest.FixtureRequest, robot: Robot, tmp_path: Path) -> Robot:
    """Telebip as it is, and with filters, delays and so on: with more state than positions and velocities."""
    return robot if request.param == "telebip" else load_robot(write_stateful(robot.path, tmp_path))


def make(robot: Robot, backend: Backend, *overrides: str, num_envs: int = 4) -> TelebipEnv:
    return TelebipEnv(load_task("telebip_flat", [f"num_envs={num_envs}", *overrides]), robot, "cpu", backend)


@pytest.mark.parametrize("backend", ["native", "warp"])
def test_a_state_is_gone_on_from_bit_for_bit(any_robot: Robot, tmp_path: Path, backend: Backend) -> None:
    first, second = (make(any_robot, backend, *MORE_EVENTFUL, f"seed={seed}") for seed in (1, 2))
    actions = random_actions(40, 4, 0.7)
    for action in actions[:9]:
        first.step(action)
        second.step(-action)
    torch.save(first.state_dict(), tmp_path / "state.pt")
    kept = first.state_dict()
    first.step(actions[0])
    assert not torch.equal(first.state_dict()["sim"]["qpos"], kept["sim"]["qpos"])
    saved = torch.load(tmp_path / "state.pt", weights_only=True)
    same(saved, kept)  # a copy, which the step has not touched
    ended = 0
    for env in (first, second):
        env.load_state_dict(saved)
        same(env.state_dict(), saved)
    for action in actions[9:]:
        same(first.get_observations(), second.get_observations())
        result = first.step(action)
        same(result, second.step(action))
        ended += int(result[2].sum())
    same(first.state_dict(), second.state_dict())
    assert ended > 4


@pytest.mark.parametrize("backend", ["native", "warp"])
def test_what_was_last_seen_is_seen_again_after_loading(make_env: MakeEnv, backend: Backend) -> None:
    """A learner that is resumed observes before it steps; forces and sensors are those of the step before."""
    sensor = "observations.critic.accelerometer={term: sensor, sensor: accelerometer}"
    first, second = (make_env(*MORE_EVENTFUL, sensor, f"seed={seed}", backend=backend) for seed in (1, 2))
    for action in random_actions(9, 4, 0.7):
        obs = first.step(action)[0]
    assert obs["critic"].abs().amax() > 5.0  # the accelerometer shows gravity
    second.load_state_dict(first.state_dict())
    same(second.get_observations(), obs)
    same(first.get_observations(), obs)
    same(first.step(torch.ones(4, 6)), second.step(torch.ones(4, 6)))


@pytest.mark.parametrize("backend", ["native", "warp"])
def test_a_world_that_is_reset_is_a_new_one(any_robot: Robot, backend: Backend) -> None:
    """Same start, same actions: the step after a reset is that of a world that was never used."""
    calm = ("events.start_pose=null", "events.start_velocity=null", *CALM, "episode.length=0.2")
    old, new = make(any_robot, backend, *calm), make(any_robot, backend, *calm)
    for env in (old, new):
        env.set_command(0.7, 0.0, 0.0)
    for action in random_actions(10, 4, 0.7):
        dones = old.step(action)[2]
    assert dones.all()  # by time-out, or before
    same(dict(old.sim.memory.items()), dict(new.sim.memory.items()))
    action = random_actions(1, 4, 0.7, seed=1)[0]
    same(old.step(action)[0]["policy"], new.step(action)[0]["policy"])
    same(old.sim.state.joint_force, new.sim.state.joint_force)


@pytest.mark.parametrize(
    "other", [("num_envs=5",), ("events.push=null",), ("observations.policy.history=2",), ("events.mass=null",)]
)
def test_the_state_of_other_worlds_is_refused(make_env: MakeEnv, other: tuple[str, ...]) -> None:
    env, others = make_env(*MORE_EVENTFUL), make_env(*MORE_EVENTFUL, *other)
    before = env.state_dict()
    with pytest.raises(ValueError, match="differs"):
        env.load_state_dict(others.state_dict())
    same(env.state_dict(), before)


def test_a_clone_of_the_state_shares_nothing_and_can_be_taken_over(make_env: MakeEnv) -> None:
    env = make_env(*MORE_EVENTFUL)
    for action in random_actions(5, 4, 0.5):
        env.step(action)
    names = [name for name, _ in env.state.items()]
    assert {"episode_length", "target_command", "rewards.foot.window", "observations.policy.frames"} <= set(names)
    clone, places = env.state.clone(), [value.data_ptr() for _, value in env.state.items()]
    assert [name for name, _ in clone.items()] == names
    before = {name: value.clone() for name, value in clone.items()}
    for action in random_actions(5, 4, 0.5, seed=1):
        env.step(action)
    same(dict(clone.items()), before)
    assert not torch.equal(clone.joint_target, env.state.joint_target)
    env.state.copy_(clone)
    same(dict(env.state.items()), before)
    assert [value.data_ptr() for _, value in env.state.items()] == places  # in place


def test_a_reset_of_the_state_spares_other_worlds_and_what_lasts(make_env: MakeEnv) -> None:
    env = make_env(*MORE_EVENTFUL)
    for _, value in env.state.items():
        value.fill_(1)
    mask = torch.tensor([True, False, True, False])
    env.state.reset(mask)
    lasting = {"held_wrench_w", "target_command", "command", "command_is_fixed", "reference_heading", "joint_target"}
    lasting |= {"wrench_w", "random", "tile", "num_steps", "samples"}
    names = dict(env.state.items())
    assert lasting <= names.keys()
    for name, value in names.items():
        assert (value[~mask] == 1).all() if value.dim() else value == 1
        assert (value == 1).all() if name in lasting else not value[mask].any()
