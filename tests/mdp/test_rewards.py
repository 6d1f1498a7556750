"""Every reward term at values worked out by hand."""

import dataclasses
import math

import pytest
import torch

from telebip.config.schema import (
    CmdRewardConfig,
    DiffRewardConfig,
    EnergyRewardConfig,
    FootRewardConfig,
    RewardConfig,
    TerminationRewardConfig,
    TqRewardConfig,
)
from telebip.mdp.context import StepContext
from telebip.mdp.rewards import (
    REWARDS,
    action_difference,
    periodic_foot_force,
    termination,
    torque,
    velocity_tracking,
    yaw_rate_tracking,
)
from telebip.sim.base import SimState

FORCE_LIMIT = torch.tensor([50.0, 50.0, 400.0, 50.0, 50.0, 400.0])


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


def test_action_difference_is_the_norm_of_the_change() -> None:
    last = torch.ones(2, 6)
    action = last + torch.tensor([[0.0] * 6, [3.0, 0.0, 0.0, 0.0, 4.0, 0.0]])
    torch.testing.assert_close(action_difference(action, last, k_diff=-0.02), torch.tensor([0.0, -0.1]))


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
    torch.testing.assert_close(torque(torch.tensor([force]), FORCE_LIMIT, k_tq=-0.05), torch.tensor([expected]))


def test_periodic_foot_force_weighs_each_sample_by_its_age() -> None:
    window = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, -2.0, 4.0]])
    weights = torch.tensor([1.0, 0.5, 0.25])
    torch.testing.assert_close(periodic_foot_force(window, weights, k_foot=0.1), torch.tensor([0.1, 0.025, 0.1]))


def test_only_a_fall_costs() -> None:
    torch.testing.assert_close(termination(torch.tensor([True, False]), -1.0), torch.tensor([-1.0, 0.0]))


def test_tracking_rewards_are_largest_at_the_command() -> None:
    command = torch.tensor([[0.7, 0.1, 0.2]]).expand(256, -1)
    velocity = torch.randn(256, 3, generator=torch.Generator().manual_seed(0))
    assert (velocity_tracking(velocity, command, 0.2, 0.3) < 0.2).all()
    assert (yaw_rate_tracking(velocity, command, 0.15, 0.2) < 0.15).all()


CFG = RewardConfig(
    cmd=CmdRewardConfig(k_xy=0.2, sigma_xy=0.3, k_w=0.15, sigma_w=0.2),
    diff=DiffRewardConfig(k_diff=-0.02),
    tq=TqRewardConfig(k_tq=-0.05),
    foot=FootRewardConfig(k_foot=0.1, gamma=0.5, first="newest", cap=100.0),
    energy=EnergyRewardConfig(k_energy=-0.3, ramp=(0.0, 0.0)),
    termination=TerminationRewardConfig(k_termination=-1.0),
)


def one_step() -> StepContext:
    """0.3 m/s too slow, 0.2 rad/s off, an action 2 away from the last, a saturated knee, 40 W, and a fall."""
    state = SimState.zeros(1, torch.device("cpu"))
    state.qvel[0, 5] = 0.2
    state.joint_force[0, 2] = 400.0
    state.joint_power[0] = torch.tensor([1.0, 2.0, 27.0, 0.0, 0.0, 10.0])
    return StepContext(
        state=state,
        base_lin_vel_b=torch.tensor([[0.4, 0.0, 0.0]]),
        command=torch.tensor([[0.7, 0.0, 0.0]]),
        action=torch.tensor([[0.0, 0.0, 1.0, 0.0, 0.0, 0.0]]),
        last_action=torch.tensor([[0.0, 0.0, -1.0, 0.0, 0.0, 0.0]]),
        force_limit=FORCE_LIMIT,
        weight=100.0,
        foot_window=torch.tensor([[1.0, 2.0]]),
        foot_weights=torch.tensor([1.0, 0.5]),
        energy_share=torch.tensor(0.5),
        fallen=torch.tensor([True]),
    )


def test_table_gives_the_modules_of_the_article_and_half_of_the_energy_term() -> None:
    values = {name: term(one_step(), CFG).item() for name, term in REWARDS.items()}
    article = {"cmd": 0.35 / math.e, "diff": -0.04, "tq": -0.05, "foot": 0.2, "termination": -1.0}
    assert values == pytest.approx(article | {"energy": 0.5 * -0.3 * 0.4})


def test_table_has_one_row_per_section_of_the_configuration() -> None:
    assert [*REWARDS, "extra"] == [field.name for field in dataclasses.fields(RewardConfig)]


@pytest.mark.parametrize("name", list(REWARDS))
def test_terms_do_not_change_what_they_are_given(name: str) -> None:
    context, untouched = one_step(), one_step()
    REWARDS[name](context, CFG)
    for field in dataclasses.fields(StepContext):
        if isinstance(value := getattr(context, field.name), torch.Tensor):
            assert torch.equal(value, getattr(untouched, field.name))
    for field in dataclasses.fields(SimState):
        assert torch.equal(getattr(context.state, field.name), getattr(untouched.state, field.name))
