"""Random draws: where they lie, what they leave alone, and that a seed repeats them."""

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from telebip.config import TaskConfig, load_task
from telebip.config.schema import EpisodeConfig
from telebip.math import yaw
from telebip.mdp.randomization import Draws, initial_qpos, push_force, ranges, uniform

HOME = torch.tensor([0.0, 0.0, 0.66, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.04, 0.0, 0.0, 0.04])
EPISODE = EpisodeConfig(
    length=10.0,
    min_hip_height=0.4,
    reset_joint_pos=0.02,
    reset_joint_vel=0.1,
    reset_lin_vel=0.2,
    reset_ang_vel=0.3,
    reset_heading=math.pi,
)


def draws(cfg: TaskConfig, seed: int = 0, num_envs: int = 2048) -> dict[str, Tensor]:
    draws = Draws(ranges(cfg), num_envs, torch.device("cpu"))
    draws.draw(torch.Generator().manual_seed(seed))
    return {name: draws[name] for name in ranges(cfg)}


def draw(episode: EpisodeConfig = EPISODE, seed: int = 0, num_envs: int = 2048) -> tuple[Tensor, Tensor]:
    """Initial qpos and qvel."""
    numbers = draws(dataclasses.replace(load_task("telebip_flat"), episode=episode), seed, num_envs)
    return initial_qpos(HOME, numbers["joint_offset"], numbers["heading"]), numbers["qvel"]


def clearance(qpos: Tensor) -> Tensor:
    """Height of the feet's lowest points above the ground, trunk upright: z - (0.67 - knee) cos(roll) cos(pitch) - 0.03 [m]."""
    roll, pitch, knee = qpos[:, 7:].reshape(-1, 2, 3).unbind(-1)
    return qpos[:, 2:3] - (0.67 - knee) * torch.cos(roll) * torch.cos(pitch) - 0.03


def fills(values: Tensor, low: float, high: float) -> None:
    """Assert that each column stays within [low, high] and comes within 1 % of both ends."""
    margin = 0.01 * (high - low)
    assert (values >= low - 1e-6).all()
    assert (values <= high + 1e-6).all()
    assert (values.amin(0) < low + margin).all()
    assert (values.amax(0) > high - margin).all()


def test_uniform_fills_its_range() -> None:
    fills(uniform((2048, 2), -1.0, 3.0, torch.Generator().manual_seed(0)), -1.0, 3.0)


@pytest.mark.parametrize("amplitude", [0.0, 0.02, 0.1])
def test_no_foot_starts_in_the_ground_nor_far_above_it(amplitude: float) -> None:
    qpos, _ = draw(dataclasses.replace(EPISODE, reset_joint_pos=amplitude))
    lowest = clearance(qpos).amin(1)
    assert lowest.min().item() > -1e-6
    # Both knees shorter by the amplitude, and both hips at its end: (0.63 - a)(1 - cos^2 a) more.
    assert lowest.max().item() < amplitude + 0.63 * (1.0 - math.cos(amplitude) ** 2) + 1e-6


def test_longer_legs_lift_the_robot_by_the_longer_one_alone() -> None:
    qpos, _ = draw()
    longer = (0.04 - qpos[:, [9, 12]]).amax(1).clamp(min=0.0)
    torch.testing.assert_close(qpos[:, 2], 0.66 + longer)


def test_positions_vary_about_home_within_their_amplitudes() -> None:
    qpos, _ = draw()
    torch.testing.assert_close(qpos[:, :2], torch.zeros(2048, 2))
    fills(qpos[:, 7:] - HOME[7:], -0.02, 0.02)


def test_trunk_starts_upright_with_any_heading() -> None:
    quat = draw()[0][:, 3:7]
    torch.testing.assert_close(torch.linalg.vector_norm(quat, dim=1), torch.ones(2048))
    torch.testing.assert_close(quat[:, 1:3], torch.zeros(2048, 2))
    fills(yaw(quat)[:, None], -math.pi, math.pi)


def test_velocities_stay_within_their_amplitudes() -> None:
    _, qvel = draw()
    fills(qvel[:, :2], -0.2, 0.2)
    torch.testing.assert_close(qvel[:, 2], torch.zeros(2048))
    fills(qvel[:, 3:6], -0.3, 0.3)
    fills(qvel[:, 6:], -0.1, 0.1)


def test_without_amplitudes_every_world_starts_at_home() -> None:
    still = dataclasses.replace(
        EPISODE, reset_joint_pos=0.0, reset_joint_vel=0.0, reset_lin_vel=0.0, reset_ang_vel=0.0, reset_heading=0.0
    )
    qpos, qvel = draw(still, num_envs=3)
    torch.testing.assert_close(qpos, HOME.expand(3, -1))
    torch.testing.assert_close(qvel, torch.zeros(3, 12))


def test_same_seed_same_states() -> None:
    for first, second, other in zip(draw(seed=1), draw(seed=1), draw(seed=2), strict=True):
        assert torch.equal(first, second)
        assert not torch.equal(first, other)


def test_every_number_fills_its_range_and_is_drawn_independently() -> None:
    settings = ("disturbance.push.interval=[1,3]", "disturbance.friction.range=[0.5,1.1]", "command.ang_vel_z=[-0.2,0.3]")
    cfg = load_task("telebip_flat", settings)
    numbers = draws(cfg, num_envs=8192)
    assert {name: part.shape for name, part in numbers.items()} == {k: (8192, len(v)) for k, v in ranges(cfg).items()}
    fills(numbers["push_interval"], 1.0, 3.0)
    fills(numbers["friction"], 0.5, 1.1)
    for column, (low, high) in enumerate(((0.4, 1.0), (0.0, 0.0), (-0.2, 0.3))):
        if low < high:
            fills(numbers["command"][:, [column]], low, high)
        else:
            assert not numbers["command"][:, column].any()
    columns = torch.cat(list(numbers.values()), dim=1).T
    varied = columns[columns.std(1) > 0.0]
    correlation = torch.corrcoef(varied) - torch.eye(len(varied))
    exact = 2 + 11  # two velocities that are always zero, and what the policy knows exactly
    assert len(varied) == sum(map(len, ranges(cfg).values())) - exact
    assert correlation.abs().max() < 0.06  # of 1035 pairs, 8192 samples each: 5.4 standard deviations


def test_pushes_are_uniform_in_magnitude_and_direction() -> None:
    force = push_force(draws(load_task("telebip_flat", ["disturbance.push.force=50"]), num_envs=4096)["push"])
    magnitude = torch.linalg.vector_norm(force, dim=1)
    fills(magnitude[:, None], 0.0, 50.0)
    assert magnitude.mean().item() == pytest.approx(25.0, abs=1.0)
    fills(torch.atan2(force[:, 1], force[:, 0])[:, None], -math.pi, math.pi)
    torch.testing.assert_close(force.mean(0), torch.zeros(2), atol=1.5, rtol=0.0)


def test_a_push_points_where_its_direction_says() -> None:
    force = push_force(torch.tensor([[10.0, 0.0], [10.0, math.pi / 2], [0.0, 1.0]]))
    torch.testing.assert_close(force, torch.tensor([[10.0, 0.0], [0.0, 10.0], [0.0, 0.0]]), atol=1e-5, rtol=0.0)
