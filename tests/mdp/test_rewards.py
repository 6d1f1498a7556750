"""Every reward term at values worked out by hand."""

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from steps import again, bind, make_step
from torch import Tensor

from telebip.config import load_task
from telebip.mdp import rewards
from telebip.mdp.step import Step
from telebip.mdp.term import TERMS
from telebip.robot import Robot

FORCE_RANGE = torch.tensor([[-50.0, 50.0], [-50.0, 50.0], [-400.0, 400.0]] * 2)


def moving(command: Tensor, lin_vel: Tensor | None = None, ang_vel: Tensor | None = None) -> Any:
    """A step with these command and velocities of the trunk in the body frame."""
    still = torch.zeros_like(command)
    step: Any = SimpleNamespace(
        command=command,
        base_lin_vel_b=still if lin_vel is None else lin_vel,
        base_ang_vel_b=still if ang_vel is None else ang_vel,
    )
    step.command_error = Step.command_error.func(step)
    return step


def velocity_tracking(lin_vel: Tensor, command: Tensor, k_xy: float, sigma_xy: float) -> Tensor:
    return rewards.cmd(moving(command, lin_vel=lin_vel), k_xy=k_xy, sigma_xy=sigma_xy, k_w=0.0, sigma_w=1.0)


def yaw_rate_tracking(ang_vel: Tensor, command: Tensor, k_w: float, sigma_w: float) -> Tensor:
    return rewards.cmd(moving(command, ang_vel=ang_vel), k_xy=0.0, sigma_xy=1.0, k_w=k_w, sigma_w=sigma_w)


@pytest.mark.parametrize(("error", "expected"), [(0.0, 0.2), (0.3, 0.2 / math.e), (0.6, 0.2 / math.e**2)])
def test_velocity_tracking_decays_by_e_every_sigma(error: float, expected: float) -> None:
    command = torch.tensor([[0.7, 0.0, 0.0]])
    velocity = torch.tensor([[0.7 - error, 0.0, 9.0]])  # vertical speed must not matter
    reward = velocity_tracking(velocity, command, k_xy=0.2, sigma_xy=0.3)
    torch.testing.assert_close(reward, torch.tensor([expected]))


def test_velocity_error_is_the_length_of_the_planar_vector() -> None:
    command = torch.tensor([[0.3, 0.0, 5.0]])
    velocity = torch.tensor([[0.0, 0.4, 0.0]])  # 3-4-5: the error is 0.5 m/s
    torch.testing.assert_close(velocity_tracking(velocity, command, k_xy=1.0, sigma_xy=0.5), torch.tensor([1.0 / math.e]))


@pytest.mark.parametrize(("rate", "expected"), [(0.1, 0.15), (0.3, 0.15 / math.e), (-0.1, 0.15 / math.e)])
def test_yaw_rate_tracking_decays_alike_on_both_sides(rate: float, expected: float) -> None:
    command = torch.tensor([[0.7, 0.0, 0.1]])
    ang_vel = torch.tensor([[9.0, -9.0, rate]])  # roll and pitch rates must not matter
    torch.testing.assert_close(yaw_rate_tracking(ang_vel, command, k_w=0.15, sigma_w=0.2), torch.tensor([expected]))


def test_velocity_and_yaw_rate_pay_separately() -> None:
    command = torch.tensor([[0.7, 0.0, 0.1]])
    step = moving(command, lin_vel=torch.tensor([[0.4, 0.0, 0.0]]), ang_vel=torch.tensor([[0.0, 0.0, 0.3]]))
    reward = rewards.cmd(step, k_xy=0.2, sigma_xy=0.3, k_w=0.15, sigma_w=0.2)
    torch.testing.assert_close(reward, torch.tensor([0.35 / math.e]))


def test_tracking_rewards_are_largest_at_the_command() -> None:
    command = torch.tensor([[0.7, 0.1, 0.2]]).expand(256, -1)
    velocity = torch.randn(256, 3, generator=torch.Generator().manual_seed(0))
    assert (velocity_tracking(velocity, command, 0.2, 0.3) < 0.2).all()
    assert (yaw_rate_tracking(velocity, command, 0.15, 0.2) < 0.15).all()


def test_the_mean_over_a_stride_forgives_the_sway_and_not_the_bias(robot: Robot) -> None:
    """Errors of +-0.3 m/s to the side in turn, and always 0.06 m/s too slow, and 0.05 rad/s in turning."""
    step = make_step(robot, gait_period=0.08)  # 4 steps
    reward = bind(step, "reward", "stride_cmd", k_xy=0.8, sigma_xy=0.06, k_w=0.2, sigma_w=0.05)
    values = []
    for i in range(8):
        step.env.command.copy_(torch.tensor([[0.7, 0.0, 0.05]]))
        step.state.qvel[0, 0], step.state.qvel[0, 1] = 0.64, 0.3 if i % 2 else -0.3
        values.append(reward(again(step)).item())
    # At first a quarter of the errors counts: (0.06, 0.3) / 4 and 0.05 / 4. Over whole strides the sway cancels.
    assert values[0] == pytest.approx(0.8 * math.exp(-math.hypot(0.015, 0.075) / 0.06) + 0.2 * math.exp(-0.25), rel=1e-4)
    assert values[3:] == pytest.approx([1.0 / math.e] * 5, rel=1e-4)


def test_action_difference_is_the_norm_of_the_change() -> None:
    last = torch.ones(2, 6)
    action = last + torch.tensor([[0.0] * 6, [3.0, 0.0, 0.0, 0.0, 4.0, 0.0]])
    step: Any = SimpleNamespace(action=action, last_action=last)
    torch.testing.assert_close(rewards.diff(step, k_diff=-0.02), torch.tensor([0.0, -0.1]))


@pytest.mark.parametrize(
    ("force", "expected"),
    [
        ([0.0] * 6, 0.0),
        ([50.0, 0.0, 0.0, 0.0, 0.0, 0.0], -0.05),  # one saturated hip
        ([0.0, 0.0, 0.0, 0.0, 0.0, -400.0], -0.05),  # weighs as much as one saturated knee
        ([50.0, -50.0, 400.0, 0.0, 0.0, -400.0], -0.1),  # four: the norm is 2
        ([30.0, 0.0, 320.0, 0.0, 0.0, 0.0], -0.05),  # 0.6 and 0.8
    ],
)
def test_torque_counts_saturated_actuators(force: list[float], expected: float) -> None:
    state, world = SimpleNamespace(joint_force=torch.tensor([force])), SimpleNamespace(force_range=FORCE_RANGE)
    step: Any = SimpleNamespace(state=state, world=world)
    torch.testing.assert_close(rewards.tq(step, k_tq=-0.05), torch.tensor([expected]))


def test_periodic_foot_force_weighs_each_sample_by_its_age() -> None:
    # The newest samples are 1, 0 and 1: half of them from the right foot where the phase asks for it.
    state = SimpleNamespace(foot_force=torch.tensor([[100.0, 0.0], [0.0, 0.0], [0.0, 100.0]]))
    phase = torch.tensor([[1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]])
    step: Any = SimpleNamespace(state=state, phase=phase, world=SimpleNamespace(weight=100.0))
    memory = {"window": torch.tensor([[0.0, 0.0, 9.0], [0.0, 1.0, 9.0], [-2.0, 4.0, 9.0]])}
    reward = rewards.foot(step, memory, k_foot=0.1, gamma=0.5, first="newest", cap=100.0)
    torch.testing.assert_close(memory["window"], torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, -2.0, 4.0]]))
    torch.testing.assert_close(reward, torch.tensor([0.1, 0.025, 0.1]))


@pytest.mark.parametrize(("samples", "share"), [(0.0, 0.0), (1000.0, 0.0), (2000.0, 0.5), (3000.0, 1.0), (math.inf, 1.0)])
def test_energy_is_the_power_in_body_weights_times_its_share(samples: float, share: float) -> None:
    state = SimpleNamespace(joint_power=torch.tensor([[1.0, 2.0, 27.0, 0.0, 0.0, 10.0], [0.0] * 6]))
    env, world = SimpleNamespace(samples=torch.tensor(samples)), SimpleNamespace(weight=100.0)
    step: Any = SimpleNamespace(state=state, env=env, world=world)
    reward = rewards.energy(step, k_energy=-0.3, ramp=(1000.0, 3000.0))
    torch.testing.assert_close(reward, torch.tensor([share * -0.3 * 0.4, 0.0]))


@pytest.mark.parametrize(("samples", "share"), [(0.0, 0.0), (2000.0, 0.5), (math.inf, 1.0)])
def test_cost_of_transport_is_the_power_in_body_weights_over_the_commanded_speed(samples: float, share: float) -> None:
    state = SimpleNamespace(joint_power=torch.tensor([[1.0, 2.0, 27.0, 0.0, 0.0, 10.0]] * 3))
    env, world = SimpleNamespace(samples=torch.tensor(samples)), SimpleNamespace(weight=100.0)
    command = torch.tensor([[0.5, 0.0, 0.9], [-0.3, 0.4, 0.0], [0.1, 0.0, 0.9]])  # the last is slower than min_speed
    step: Any = SimpleNamespace(state=state, env=env, world=world, command=command)
    reward = rewards.cot(step, k_cot=-1.5, min_speed=0.2, ramp=(1000.0, 3000.0))
    torch.testing.assert_close(reward, share * -1.5 * torch.tensor([0.8, 0.8, 2.0]))


def test_only_a_fall_costs() -> None:
    step: Any = SimpleNamespace(fallen=torch.tensor([True, False]))
    torch.testing.assert_close(rewards.termination(step, k_termination=-1.0), torch.tensor([-1.0, 0.0]))


TASK = load_task("telebip_flat", ["rewards.foot.gamma=0.5", "rewards.energy.k_energy=-0.3", "rewards.energy.ramp=[0,200]"])


def one_step(robot: Robot) -> Step:
    """0.3 m/s too slow, 0.2 rad/s off, an action 2 away from the last, a saturated knee, 40 W, and a fall; phase (1, -1)."""
    step = make_step(robot, gait_period=0.48)
    state, env = step.state, step.env
    env.episode_length.fill_(6)  # a quarter of the period
    state.qvel[0, 0], state.qvel[0, 5] = 0.4, 0.2
    env.command.copy_(torch.tensor([[0.7, 0.0, 0.0]]))
    state.joint_force[0, 2] = 400.0
    state.joint_power[0] = torch.tensor([1.0, 2.0, 27.0, 0.0, 0.0, 10.0]) * step.world.weight / 100.0
    state.foot_force[0, 0] = step.world.weight
    step.action[0, 2], env.last_action[0, 2] = 1.0, -1.0
    env.samples.fill_(100.0)  # half of the ramp
    step.fallen.fill_(True)
    return step


def evaluate(step: Step, name: str) -> float:
    """A term of the published task, the last foot samples being 0 and 2."""
    term = bind(step, "reward", name, **TASK.rewards[name])
    if name == "foot":
        step.env.memory["rewards.foot"]["window"][0, 0] = 2.0
    return term(step).item()


def test_the_published_task_gives_the_modules_of_the_article_and_the_energy_term(robot: Robot) -> None:
    step = one_step(robot)
    values = {name: evaluate(step, name) for name in TASK.rewards}
    article = {"cmd": 0.35 / math.e, "diff": -0.04, "tq": -0.05, "foot": 0.2, "termination": -1.0}
    assert values == pytest.approx(article | {"energy": 0.5 * -0.3 * 0.4}, rel=1e-5)


def test_the_published_task_names_every_reward_but_two_of_ours() -> None:
    own = {name for name, term in TERMS["reward"].items() if term.function.__module__ == rewards.__name__}
    own -= {"stride_cmd", "cot"}
    assert set(TASK.rewards) == own
    assert {name: set(params) for name, params in TASK.rewards.items()} == {
        name: set(TERMS["reward"][name].parameters) for name in own
    }


@pytest.mark.parametrize("name", list(TASK.rewards))
def test_terms_do_not_change_what_they_are_given(robot: Robot, name: str) -> None:
    step, untouched = one_step(robot), one_step(robot)
    evaluate(step, name)
    assert torch.equal(step.action, untouched.action)
    assert torch.equal(step.fallen, untouched.fallen)
    after = dict(step.env.items())
    for part, value in untouched.env.items():
        assert torch.equal(after[part], value)
    for part in (lambda state: state.qpos, lambda state: state.qvel):
        assert torch.equal(part(step.state), part(untouched.state))
    for part, value in untouched.state.step_values.items():
        assert torch.equal(step.state.step_values[part], value)
