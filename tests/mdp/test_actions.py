"""From actions to joint targets."""

import pytest
import torch
from steps import again, make_step
from torch import Tensor

from telebip.errors import UserError
from telebip.mdp.actions import DelayLine, joint_targets, scales
from telebip.mdp.binding import Binder
from telebip.mdp.step import Step
from telebip.robot import Robot

JOINTS = ("right_hip_roll", "right_knee", "left_hip_roll", "left_knee", "waist")


def test_targets_are_the_nominal_pose_plus_the_scaled_action() -> None:
    nominal = torch.tensor([0.0, 0.1, 0.04, 0.0, -0.1, 0.04])
    scale = torch.tensor([0.25, 0.5, 0.1, 0.25, 0.5, 0.1])
    action = torch.tensor([[0.0] * 6, [1.0, 1.0, 1.0, -2.0, -2.0, -2.0]])
    expected = torch.tensor([[0.0, 0.1, 0.04, 0.0, -0.1, 0.04], [0.25, 0.6, 0.14, -0.5, -1.1, -0.16]])
    torch.testing.assert_close(joint_targets(action, nominal, scale), expected)


def test_a_scale_is_given_for_both_sides_or_for_one_joint() -> None:
    assert scales({"hip_roll": 0.25, "knee": 0.1, "waist": 0.3}, JOINTS) == [0.25, 0.1, 0.25, 0.1, 0.3]
    assert scales({"hip_roll": 0.25, "knee": 0.1, "left_knee": 0.2, "waist": 0.3}, JOINTS) == [0.25, 0.1, 0.25, 0.2, 0.3]


def test_every_joint_has_a_scale_and_every_scale_a_joint() -> None:
    with pytest.raises(UserError, match=r"actions.scale: joint 'right_knee' has none; did you mean 'kne'\?"):
        scales({"hip_roll": 0.25, "kne": 0.1, "waist": 0.3}, JOINTS)
    with pytest.raises(UserError, match=r"actions.scale.ankle: the robot has no such joint; valid: hip_roll"):
        scales({"hip_roll": 0.25, "knee": 0.1, "waist": 0.3, "ankle": 0.1}, JOINTS)


def delayed(step: Step, delay: tuple[int, int], physics_delay: tuple[int, int], ages: list[int]) -> list[Tensor]:
    """What the engine is given in steps of these ages, relative to the nominal pose, if the target of step t is t + 1."""
    binder = Binder(step)
    line = DelayLine(binder, delay, physics_delay)
    draws = binder.allocate()
    generator, given = torch.Generator().manual_seed(0), []
    for t, age in enumerate(ages):
        draws.draw(generator)
        if age == 0:
            step.env.reset(torch.ones(step.world.num_envs, dtype=torch.bool))
        step.env.joint_target.copy_((step.world.nominal + t + 1.0).expand_as(step.env.joint_target))
        given.append(line(again(step, age)) - step.world.nominal)
    return given


def test_a_delay_of_two_steps_holds_the_home_pose_and_then_what_was_wanted_two_steps_ago(robot: Robot) -> None:
    given = torch.stack(delayed(make_step(robot, num_envs=2), (2, 2), (0, 0), [0, 1, 2, 3, 4]))
    assert given.shape == (5, 2, 6)  # one target for the whole step
    torch.testing.assert_close(given, torch.tensor([0.0, 0.0, 1.0, 2.0, 3.0])[:, None, None].expand(-1, 2, 6))


@pytest.mark.parametrize(
    ("delay", "physics_delay", "expected"),
    [
        (0, 1, [[0, 1, 1, 1], [1, 2, 2, 2], [2, 3, 3, 3]]),
        (0, 3, [[0, 0, 0, 1], [1, 1, 1, 2], [2, 2, 2, 3]]),
        (0, 4, [[0, 0, 0, 0], [1, 1, 1, 1], [2, 2, 2, 2]]),
        (1, 2, [[0, 0, 0, 0], [0, 0, 1, 1], [1, 1, 2, 2]]),
        (0, 9, [[0, 0, 0, 0], [0, 0, 0, 0], [0, 1, 1, 1]]),
    ],
)
def test_a_delay_in_physics_steps_changes_targets_in_the_midst_of_a_step(
    robot: Robot, delay: int, physics_delay: int, expected: list[list[int]]
) -> None:
    given = torch.stack(delayed(make_step(robot), (delay, delay), (physics_delay, physics_delay), [0, 1, 2]))
    assert given.shape == (3, 1, 4, 6)  # a target for each physics step
    wanted = torch.tensor(expected).float()[:, None, :, None].expand(-1, 1, -1, 6)
    torch.testing.assert_close(given, wanted, atol=1e-6, rtol=0.0)


def test_an_episode_does_not_get_the_targets_of_the_one_before(robot: Robot) -> None:
    given = torch.stack(delayed(make_step(robot), (1, 1), (0, 0), [0, 1, 2, 0, 1]))
    torch.testing.assert_close(given[:, 0, 0], torch.tensor([0.0, 1.0, 2.0, 0.0, 4.0]))


def test_delays_are_drawn_once_per_world_and_episode(robot: Robot) -> None:
    given = torch.stack(delayed(make_step(robot, num_envs=512), (1, 3), (0, 0), [0, 1, 2, 3, 4, 5, 0, 1, 2, 3, 4, 5]))[..., 0]
    for episode, start in ((given[:6], 0), (given[6:], 6)):
        late = start + 6 - episode[5].round().long()
        assert late.bincount(minlength=4).tolist()[0] == 0
        assert (late.bincount(minlength=4)[1:] > 512 / 4).all()  # each of 1, 2, 3, a third of the worlds
        for age in range(6):
            expected = torch.where(age >= late, start + age + 1 - late, 0).float()
            torch.testing.assert_close(episode[age], expected, atol=1e-6, rtol=0.0)
    first, second = given[5], given[11] - 6.0
    assert not torch.equal(first.round(), second.round())


def arrivals(due: list[int | None], steps: int) -> list[list[int]]:
    """What is held at each physics step if the target of step t is t + 1 and arrives in physics step `due[t]`, or never."""
    held = []
    for substep in range(4 * steps):
        there = [t + 1 for t, time in enumerate(due) if time is not None and time <= substep]
        held.append(max(there, default=0))
    return [held[4 * t : 4 * t + 4] for t in range(steps)]


def test_jitter_lets_the_newest_target_that_has_arrived_be_held_and_loss_keeps_the_one_before(robot: Robot) -> None:
    worlds, steps = 64, 40
    step = make_step(robot, worlds)
    binder = Binder(step)
    line = DelayLine(binder, delay=(0, 1), physics_delay=(1, 3), jitter=(0, 6), loss=0.2)
    draws, generator, given = binder.allocate(), torch.Generator().manual_seed(0), []
    late: list[list[int | None]] = [[] for _ in range(worlds)]
    for t in range(steps):
        draws.draw(generator)
        step.env.joint_target.copy_((step.world.nominal + t + 1.0).expand_as(step.env.joint_target))
        given.append(line(again(step, t)) - step.world.nominal)
        jitter, is_lost = draws.part("actions.jitter").floor(), draws.part("actions.loss") < 0.2
        for world in range(worlds):
            delay = int(step.env.memory["actions"]["delay"][world] + jitter[world, 0])
            late[world].append(None if is_lost[world, 0] else 4 * t + delay)
    held = torch.stack(given)  # (steps, worlds, 4, joints)
    for world in range(worlds):
        expected = torch.tensor(arrivals(late[world], steps)).float()
        torch.testing.assert_close(held[:, world], expected[:, :, None].expand(-1, -1, 6), atol=1e-5, rtol=0.0)
    lost = sum(time is None for times in late for time in times) / (worlds * steps)
    assert lost == pytest.approx(0.2, abs=0.03)
    jitters = {time - 4 * t for times in late[:1] for t, time in enumerate(times) if time is not None}
    assert max(jitters) - min(jitters) == 6


def test_actions_that_are_lost_without_a_delay_are_those_before(robot: Robot) -> None:
    step = make_step(robot, 512)
    binder = Binder(step)
    line = DelayLine(binder, loss=0.5)
    draws = binder.allocate()
    draws.draw(torch.Generator().manual_seed(0))
    step.env.joint_target.copy_((step.world.nominal + 1.0).expand_as(step.env.joint_target))
    given = line(again(step, 0)) - step.world.nominal
    assert given.shape == (512, 6)
    assert given.mean().item() == pytest.approx(0.5, abs=0.08)
    assert set(given[:, 0].round(decimals=4).tolist()) == {0.0, 1.0}
