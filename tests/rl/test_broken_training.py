"""What a training does when its worlds, its engine or its networks break."""

import math
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import torch
from torch import Tensor

from telebip.config import load_task
from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.mdp.step import Step
from telebip.mdp.term import TERMS, reward
from telebip.replay import load_fault
from telebip.rl.checkpoint import load_checkpoint
from telebip.rl.train import Trainer
from telebip.robot import Robot
from telebip.sim import Backend, native

SMALL = ("num_envs=8", "ppo.num_steps_per_env=10", "ppo.hidden_dims=[16,16]", "ppo.save_interval=1")


class Training:
    """A trainer, what it says, and every rollout that its learner sees."""

    def __init__(self, robot: Robot, run_dir: Path, *overrides: str, backend: Backend = "native") -> None:
        self.notes: list[str] = []
        self.scalars: list[dict[str, float]] = []
        config = load_task("telebip_flat", [*SMALL, *overrides])
        self.env = TelebipEnv(config, robot, "cpu", backend)
        self.trainer = Trainer(self.env, "telebip_flat", run_dir, note=self.notes.append)
        update = self.trainer.learner.update

        def checked_update() -> dict[str, float]:
            storage = self.trainer.learner.storage
            for part in (storage.observations["policy"], storage.actions, storage.rewards, storage.values, storage.returns):
                assert part.isfinite().all()
            return update()

        self.trainer.learner.update = checked_update  # type: ignore[method-assign]

    def learn(self, before_step: Callable[[int], None] = lambda step: None) -> None:
        step = self.env.step

        def stepped(actions: Tensor):
            before_step(int(self.env.state.num_steps))
            return step(actions)

        self.env.step = stepped  # type: ignore[method-assign]
        self.trainer.learn(lambda: False, self.scalars.append)

    def break_world(self, world: int) -> None:
        mask = torch.arange(self.env.num_envs) == world
        broken = torch.full_like(self.env.sim.state.qpos, math.nan)
        self.env.sim.reset(mask, broken, self.env.sim.state.qvel.clone())


def test_a_broken_world_is_noted_dumped_and_never_learned_from(robot: Robot, tmp_path: Path) -> None:
    training = Training(robot, tmp_path, "ppo.max_iterations=3", "ppo.max_fault_rate=0.05")
    training.learn(before_step=lambda step: training.break_world(2) if step == 13 else None)
    assert [scalars["fault/non_finite_state"] for scalars in training.scalars] == [0.0, 1.0, 0.0]
    assert [scalars["fault/engine_warning"] for scalars in training.scalars] == [0.0, 1.0, 0.0]
    assert {file.name for file in (tmp_path / "faults").iterdir()} == {"non_finite_state.pt", "engine_warning.pt"}
    assert len(training.notes) == 2
    assert training.notes[0].startswith("fault: non_finite_state, world 2, environment step 14; dumped, for play --replay ")
    for scalars in training.scalars:
        assert all(math.isfinite(value) for name, value in scalars.items() if not name.startswith("train/episode"))


def test_a_fault_that_is_not_dumped_as_there_is_one_says_so(robot: Robot, tmp_path: Path) -> None:
    first = Training(robot, tmp_path, "ppo.max_iterations=1", "ppo.max_fault_rate=0.05")
    first.learn(before_step=lambda step: first.break_world(2) if step == 3 else None)
    second = Training(robot, tmp_path, "ppo.max_iterations=2", "ppo.max_fault_rate=0.05")
    second.trainer.resume(load_checkpoint(tmp_path))
    second.learn(before_step=lambda step: second.break_world(2) if step == 13 else None)
    assert "step 4; dumped, for play --replay " in first.notes[0]
    assert f"step 14; not dumped, as {tmp_path}/faults/non_finite_state.pt holds an earlier one" in second.notes[0]
    assert load_fault(tmp_path / "faults" / "non_finite_state.pt").record["step"] == 4


def test_too_many_broken_worlds_stop_the_training_with_a_checkpoint(robot: Robot, tmp_path: Path) -> None:
    training = Training(robot, tmp_path, "ppo.max_iterations=5", "ppo.max_fault_rate=0.1")
    with pytest.raises(UserError, match=r"iteration 3: 0\.12 faulty worlds per .*\(10 non_finite_state, 10 engine_warning"):
        training.learn(before_step=lambda step: training.break_world(1) if step >= 20 else None)
    assert load_checkpoint(tmp_path).iteration == 2


def test_an_engine_without_room_stops_the_training_and_names_the_setting(robot: Robot, tmp_path: Path) -> None:
    training = Training(robot, tmp_path, "ppo.max_iterations=2", "sim.max_constraints=3", backend="warp")
    with pytest.raises(UserError, match=r"constraints did not fit.* raise sim\.max_contacts \(8\) or sim\.max_constr"):
        training.learn()
    assert load_checkpoint(tmp_path).iteration == 0
    enough = Training(robot, tmp_path, "ppo.max_iterations=1", "sim.max_constraints=64", backend="warp")
    assert enough.trainer.resume(load_checkpoint(tmp_path)) == ""
    enough.learn()
    assert enough.trainer.iteration == 1


def test_networks_that_an_update_ruins_are_not_saved(robot: Robot, tmp_path: Path) -> None:
    training = Training(robot, tmp_path, "ppo.max_iterations=5")
    update = training.trainer.learner.update

    def ruin() -> dict[str, float]:
        losses = update()
        if training.trainer.iteration == 2:
            with torch.no_grad():
                next(training.trainer.learner.critic.parameters())[0] = math.nan
        return losses

    training.trainer.learner.update = ruin  # type: ignore[method-assign]
    with pytest.raises(UserError, match=r"the update of iteration 3 made the networks non-finite .*--resume"):
        training.learn()
    checkpoint = load_checkpoint(tmp_path)
    assert checkpoint.iteration == 2
    assert all(value.isfinite().all() for value in checkpoint.learner["critic_state_dict"].values())


def test_networks_ruined_before_the_first_checkpoint_have_none_to_go_on_from(robot: Robot, tmp_path: Path) -> None:
    training = Training(robot, tmp_path)
    training.trainer.learner.update = lambda: {"value": math.nan}  # type: ignore[method-assign]
    with pytest.raises(UserError, match=r"update of iteration 1 .*; start again with a lower ppo\.learning_rate$"):
        training.learn()


def test_another_robot_is_named(robot: Robot, tmp_path: Path) -> None:
    Training(robot, tmp_path, "ppo.max_iterations=1").learn()
    checkpoint = load_checkpoint(tmp_path)
    checkpoint.robot["values"]["mass [kg]"]["trunk"] = [99.0]
    other = Training(robot, tmp_path, "ppo.max_iterations=2").trainer
    with pytest.raises(
        UserError, match=r"was trained on another robot than 'assets/telebip.xml': mass \[kg\]: trunk 99 -> 10; go"
    ):
        other.resume(checkpoint)
    assert "of another robot" in other.resume(checkpoint, allow_robot_change=True)
    assert other.iteration == 1


@pytest.mark.parametrize(
    ("overrides", "why"),
    [
        (["num_envs=4"], "the checkpoint's worlds are others: '.*' differs"),
        (["gait.period=0.6"], "'rewards.foot.window' differs"),
    ],
)
def test_other_worlds_start_anew_and_that_is_said(robot: Robot, tmp_path: Path, overrides: list[str], why: str) -> None:
    Training(robot, tmp_path, "ppo.max_iterations=1").learn()
    other = Training(robot, tmp_path, "ppo.max_iterations=2", *overrides)
    assert re.search(why, other.trainer.resume(load_checkpoint(tmp_path)))
    other.learn()
    assert other.trainer.iteration == 2


def test_worlds_of_another_kind_of_device_start_anew(robot: Robot, tmp_path: Path) -> None:
    Training(robot, tmp_path, "ppo.max_iterations=1").learn()
    checkpoint = load_checkpoint(tmp_path)
    checkpoint.training[0]["env"]["generator"] = torch.zeros(16, dtype=torch.uint8)  # as CUDA's
    other = Training(robot, tmp_path, "ppo.max_iterations=2")
    before = other.env.state_dict()["sim"]["qpos"]
    assert "'generator' is another kind of device's" in other.trainer.resume(checkpoint)
    assert torch.equal(other.env.state_dict()["sim"]["qpos"], before)
    other.learn()


def test_a_copied_state_keeps_its_command_and_its_place_in_the_curriculum(robot: Robot) -> None:
    first, second = (TelebipEnv(load_task("telebip_efficient", ["num_envs=2"]), robot, "cpu", "native") for _ in range(2))
    first.set_command(0.7, 0.0, 0.0)
    first.set_samples(6.5e6)
    second.load_state_dict(first.state_dict())
    for _ in range(2):
        ours, theirs = first.step(torch.zeros(2, 6)), second.step(torch.zeros(2, 6))
        assert torch.equal(ours[0]["policy"], theirs[0]["policy"])
        assert torch.equal(ours[1], theirs[1])


@pytest.mark.parametrize("backend", ["native", "warp"])
def test_a_copied_state_goes_on_bit_for_bit(robot: Robot, backend: Backend) -> None:
    config = load_task("telebip_flat", ["num_envs=8", "episode.length=0.3", "events.push.interval=[0.1,0.2]"])
    first = TelebipEnv(config, robot, "cpu", backend)
    actions = 0.5 * torch.randn(40, 8, 6, generator=torch.Generator().manual_seed(0))
    for action in actions[:20]:
        first.step(action)
    second = TelebipEnv(load_task(config, ["seed=5"]), robot, "cpu", backend)
    second.load_state_dict(first.state_dict())
    assert torch.equal(second.get_observations()["policy"], first.get_observations()["policy"])
    for action in actions[20:]:
        ours, theirs = first.step(action), second.step(action)
        assert torch.equal(ours[0]["policy"], theirs[0]["policy"])
        assert torch.equal(ours[1], theirs[1])
        assert torch.equal(ours[2], theirs[2])


def test_training_is_the_same_for_any_number_of_physics_threads(robot: Robot, tmp_path: Path, monkeypatch) -> None:
    weights = []
    make = native.NativeSimulator
    for threads in (1, 2, 5):
        monkeypatch.setattr(native, "NativeSimulator", partial(make, num_threads=threads))
        training = Training(robot, tmp_path / str(threads), "ppo.max_iterations=3", "num_envs=64", "episode.length=0.3")
        (tmp_path / str(threads)).mkdir()
        training.learn()
        weights.append((training.trainer.learner.get_policy().state_dict(), training.env.sim.memory["qpos"].clone()))
    for policy, qpos in weights[1:]:
        assert all(torch.equal(policy[name], value) for name, value in weights[0][0].items())
        assert torch.equal(qpos, weights[0][1])


def test_a_reward_that_is_not_finite_names_its_term_and_world(robot: Robot, tmp_path: Path) -> None:
    @reward
    def breaks(step: Step) -> Tensor:
        """Not a number in world 5 from its fourth step on."""
        return torch.where((torch.arange(8) == 5) & (step.env.num_steps > 3), math.nan, 0.1)

    try:
        training = Training(robot, tmp_path, "rewards.breaks={}", "ppo.max_iterations=3", "ppo.max_fault_rate=0.05")
        with pytest.raises(UserError) as error:
            training.learn()
    finally:
        del TERMS["reward"]["breaks"]
    assert "reward 'breaks' is nan in world 5, environment step 4" in str(error.value)
    assert "learning_rate" not in str(error.value)
