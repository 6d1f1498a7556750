"""A group of observations: its noise, and what is late or remembered."""

import pytest
import torch
from steps import again, make_step
from torch import Tensor

from telebip.errors import UserError
from telebip.mdp.binding import Binder
from telebip.mdp.groups import Group
from telebip.mdp.random_numbers import RandomNumbers
from telebip.mdp.step import Step, World
from telebip.mdp.term import TERMS, ObservationGroup, observation
from telebip.robot import Robot

CLOCK = {"base_height": {"noise": 0.0}, "command": {"noise": 0.0}}
"""What a test sets to the number of the step: 1 + 3 numbers."""


def grouped(step: Step, group: ObservationGroup) -> tuple[Group, RandomNumbers]:
    binder = Binder(step)
    return Group("policy", group, binder), binder.allocate()


def seen(step: Step, group: ObservationGroup, ages: list[Tensor], seed: int = 0) -> Tensor:
    """What is seen (steps, num_envs, history, 4) of worlds of these ages, if height and command are t in step t."""
    runtime, draws = grouped(step, group)
    generator, result = torch.Generator().manual_seed(seed), []
    for t, age in enumerate(ages):
        draws.draw(generator)
        runtime.advance()
        step.env.reset(age == 0)
        step.state.qpos[:, 2] = t
        step.env.command.fill_(t)
        result.append(runtime.observe(again(step, age)))
        assert torch.equal(runtime.observe(again(step)), result[-1])  # seen twice, it is the same
        assert result[-1].is_contiguous()
    assert runtime.size == 4 * group.history
    return torch.stack(result).unflatten(2, (group.history, 4))


AGES = [torch.tensor([t, t if t < 4 else t - 4]) for t in range(7)]
"""The second world begins anew in step 4."""


def test_a_history_has_the_newest_frame_first_and_does_not_reach_into_the_episode_before(robot: Robot) -> None:
    frames = seen(make_step(robot, 2), ObservationGroup(CLOCK, history=3), AGES)
    first = [[0, 0, 0], [1, 0, 0], [2, 1, 0], [3, 2, 1], [4, 3, 2], [5, 4, 3], [6, 5, 4]]
    second = first[:4] + [[4, 4, 4], [5, 4, 4], [6, 5, 4]]
    for world, expected in enumerate((first, second)):
        torch.testing.assert_close(frames[:, world], torch.tensor(expected).float()[:, :, None].expand(-1, -1, 4))


def test_a_delay_shows_what_was_so_many_steps_ago(robot: Robot) -> None:
    frames = seen(make_step(robot, 2), ObservationGroup(CLOCK, delay=(2, 2)), AGES)[:, :, 0, 0]
    assert frames[:, 0].tolist() == [0, 0, 0, 1, 2, 3, 4]
    assert frames[:, 1].tolist() == [0, 0, 0, 1, 4, 4, 4]


def test_a_late_history_is_late_as_a_whole(robot: Robot) -> None:
    frames = seen(make_step(robot, 2), ObservationGroup(CLOCK, history=2, delay=(1, 1)), AGES)[:, 0, :, 0]
    assert frames.tolist() == [[0, 0], [0, 0], [1, 0], [2, 1], [3, 2], [4, 3], [5, 4]]


def test_a_term_may_be_later_than_its_group(robot: Robot) -> None:
    terms = {**CLOCK, "command": {"noise": 0.0, "delay": (2, 2)}}
    frames = seen(make_step(robot, 2), ObservationGroup(terms, history=2, delay=(1, 1)), AGES)[:, 0]
    assert frames[:, :, 0].tolist() == [[0, 0], [0, 0], [1, 0], [2, 1], [3, 2], [4, 3], [5, 4]]
    assert frames[:, :, 2].tolist() == [[0, 0], [0, 0], [0, 0], [0, 0], [1, 0], [2, 1], [3, 2]]


def test_delays_are_drawn_once_per_world_and_episode(robot: Robot) -> None:
    ages = [torch.full((512,), t % 6) for t in range(12)]
    frames = seen(make_step(robot, 512), ObservationGroup(CLOCK, delay=(1, 3)), ages)[:, :, 0, 0]
    late = 5 - frames[5]
    assert set(late.tolist()) == {1.0, 2.0, 3.0}
    assert ((late[:, None] == torch.tensor([1.0, 2.0, 3.0])).sum(0) > 512 / 4).all()
    for t in range(6):
        assert torch.equal(frames[t], (t - late).clamp(min=0.0))
    assert not torch.equal(11 - frames[11], late)


def test_noise_is_uniform_within_each_term_s_amplitude_and_kept_in_the_history(robot: Robot) -> None:
    terms = {"base_height": {"noise": 0.1}, "command": {"noise": 0.0}, "phase": {"noise": 0.5}}
    step = make_step(robot, 512)
    runtime, draws = grouped(step, ObservationGroup(terms, history=2))
    generator = torch.Generator().manual_seed(0)
    draws.draw(generator)
    first = runtime.observe(again(step)).clone()
    draws.draw(generator)
    runtime.advance()
    second = runtime.observe(again(step, 1))
    assert torch.equal(second[:, 6:], first[:, :6])
    noise = first[:, :6] - torch.tensor([0.66, 0.0, 0.0, 0.0, 0.0, 0.0])
    amplitude = torch.tensor([0.1, 0.0, 0.0, 0.0, 0.5, 0.5])
    assert (noise.abs() <= amplitude + 1e-6).all()
    assert (noise.amax(0) >= 0.98 * amplitude - 1e-6).all()
    assert (noise.amin(0) <= -0.98 * amplitude + 1e-6).all()
    assert (second[:, 0] != first[:, 0]).all()


def test_a_group_without_noise_has_none_whatever_its_terms_say(robot: Robot) -> None:
    step = make_step(robot, 4)
    runtime, draws = grouped(step, ObservationGroup({"base_height": {"noise": 0.1}}, noise=False))
    draws.draw(torch.Generator().manual_seed(0))
    torch.testing.assert_close(runtime.observe(step), torch.full((4, 1), 0.66))
    assert [part.noise for part in runtime.parts] == [0.0]
    assert step.env.random.shape == (4, 0)


def test_parts_have_names_for_their_numbers(robot: Robot) -> None:
    terms = {name: {"noise": 0.0} for name in ("joint_pos", "base_quat", "command", "phase", "base_height")}
    runtime, _ = grouped(make_step(robot), ObservationGroup(terms))
    assert [part.axes for part in runtime.parts] == [
        robot.joint_names,
        ("w", "x", "y", "z"),
        ("lin_vel_x", "lin_vel_y", "ang_vel_z"),
        ("right", "left"),
        ("0",),
    ]
    assert runtime.layout()[2] == {
        "name": "command",
        "size": 3,
        "unit": "m/s forward, m/s left, rad/s",
        "mirror": ([0, 1, 2], [1.0, -1.0, -1.0]),
    }


@pytest.fixture
def own_terms():
    """Entered in a test and forgotten after it."""
    before = dict(TERMS["observation"])
    yield
    TERMS["observation"].clear()
    TERMS["observation"].update(before)


def test_what_is_no_matrix_of_a_row_per_world_is_refused(robot: Robot, own_terms: None) -> None:
    @observation
    def height(step: Step) -> Tensor:
        return step.state.base_pos[:, 2]

    with pytest.raises(UserError, match=r"observations.policy.height must return \(num_envs, size\), got \(3,\)"):
        grouped(make_step(robot, 3), ObservationGroup({"height": {"noise": 0.0}}))


def test_a_term_may_remember_and_draw(robot: Robot, own_terms: None) -> None:
    def constant(world: World, *, amplitude: float) -> dict[str, Tensor]:
        return {"bias": world.zeros(2)}

    @observation(memory=constant, random=lambda world, *, amplitude: {"bias": [(-amplitude, amplitude)] * 2})
    def biased(step: Step, memory: dict[str, Tensor], random: dict[str, Tensor], *, amplitude: float) -> Tensor:
        torch.where(step.is_new[:, None], random["bias"], memory["bias"], out=memory["bias"])
        return memory["bias"] + step.state.base_pos[:, 2:3]

    step = make_step(robot, 64)
    runtime, draws = grouped(step, ObservationGroup({"biased": {"noise": 0.0, "amplitude": 0.1}}))
    draws.draw(torch.Generator().manual_seed(0))
    first = runtime.observe(again(step)).clone()
    assert ((first - 0.66).abs() <= 0.1 + 1e-6).all()
    assert len(first.unique()) > 100
    draws.draw(torch.Generator().manual_seed(1))
    assert torch.equal(runtime.observe(again(step, 1)), first)
