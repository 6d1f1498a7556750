"""Random draws: where they lie, that they are independent, and that a seed repeats them."""

import pytest
import torch
from steps import fills, make_step
from torch import Tensor

from telebip.config import TaskConfig, load_task
from telebip.mdp.binding import Binder, Events
from telebip.mdp.groups import Group
from telebip.mdp.random_numbers import RandomNumbers
from telebip.robot import Robot

RANGES = {"first": [(-1.0, 3.0)], "second": [(0.0, 0.0), (5.0, 6.0)]}


def draw(ranges: dict[str, list[tuple[float, float]]], num_envs: int, seed: int = 0) -> dict[str, Tensor]:
    draws = RandomNumbers(ranges, torch.zeros(num_envs, RandomNumbers.count(ranges)))
    draws.draw(torch.Generator().manual_seed(seed))
    return {name: draws.part(name).clone() for name in ranges}


def numbers_of(robot: Robot, cfg: TaskConfig, num_envs: int, seed: int = 0) -> tuple[dict[str, Tensor], RandomNumbers]:
    """What the events and the observations of a task draw, by name, and all of its draws."""
    step = make_step(robot, num_envs, fields=("geom_friction",))
    binder = Binder(step)
    Events(cfg.events, binder)
    Group("policy", cfg.observations["policy"], binder)
    commands = cfg.commands
    binder.random("commands", {"command": [commands.lin_vel_x, commands.lin_vel_y, commands.ang_vel_z]})
    draws = binder.allocate()
    draws.draw(torch.Generator().manual_seed(seed))
    assert step.env.random.shape == (num_envs, sum(part.shape[1] for part in draws._parts.values()))
    return draws._parts, draws


def test_numbers_fill_their_ranges() -> None:
    numbers = draw(RANGES, 2048)
    fills(numbers["first"], -1.0, 3.0)
    assert not numbers["second"][:, 0].any()
    fills(numbers["second"][:, 1:], 5.0, 6.0)


@pytest.mark.parametrize("num_envs", [1, 2, 3, 5])
def test_any_number_of_worlds_draws(num_envs: int) -> None:
    """Four numbers come from 64 bits; what is left over belongs to nobody."""
    assert {name: part.shape for name, part in draw(RANGES, num_envs).items()} == {
        "first": (num_envs, 1),
        "second": (num_envs, 2),
    }


def test_nothing_to_draw_is_nothing_drawn() -> None:
    assert draw({}, 3) == {}


def test_the_lowest_and_the_highest_number_are_in_range() -> None:
    """The high bound is excluded, so that the floor of a number below N + 1 is at most N."""
    draws = RandomNumbers({"delay": [(0.0, 4.0)]}, torch.zeros(4, 1))
    draws._numbers.copy_(torch.tensor([[-(2**15)], [2**15 - 1], [0], [-1]]))
    draws._values.copy_(draws._numbers).mul_(draws._spacing).add_(draws._middle)
    assert draws.part("delay").floor()[:, 0].tolist() == [0.0, 3.0, 2.0, 1.0]
    assert draws.part("delay")[0].item() == 0.0


def test_same_seed_same_numbers(robot: Robot) -> None:
    cfg = load_task("telebip_flat")
    (first, _), (second, _), (other, _) = (numbers_of(robot, cfg, 64, seed) for seed in (1, 1, 2))
    for name, numbers in first.items():
        assert torch.equal(numbers, second[name])
        assert not torch.equal(numbers, other[name])


def test_every_draw_is_new(robot: Robot) -> None:
    numbers, draws = numbers_of(robot, load_task("telebip_flat"), 64)
    generator = torch.Generator().manual_seed(0)
    draws.draw(generator)
    before = {name: part.clone() for name, part in numbers.items()}
    draws.draw(generator)
    for name, part in numbers.items():
        assert not torch.equal(part, before[name])


def test_every_number_fills_its_range_and_is_drawn_independently(robot: Robot) -> None:
    settings = ("events.push.interval=[1,3]", "events.friction.range=[0.5,1.1]", "commands.ang_vel_z=[-0.2,0.3]")
    numbers, _ = numbers_of(robot, load_task("telebip_flat", settings), 8192)
    assert {name: part.shape[1] for name, part in numbers.items()} == {
        "events.start_pose.joint_pos": 6,
        "events.start_pose.heading": 1,
        "events.start_velocity.trunk": 6,
        "events.start_velocity.joint_vel": 6,
        "events.push.interval": 1,
        "events.push.push": 2,
        "events.friction.friction": 1,
        "observations.policy.noise": 33,
        "commands.command": 3,
    }
    fills(numbers["events.push.interval"], 1.0, 3.0)
    fills(numbers["events.friction.friction"], 0.5, 1.1)
    for column, (low, high) in enumerate(((0.4, 1.0), (0.0, 0.0), (-0.2, 0.3))):
        if low < high:
            fills(numbers["commands.command"][:, [column]], low, high)
        else:
            assert not numbers["commands.command"][:, column].any()
    columns = torch.cat(list(numbers.values()), dim=1).T
    varied = columns[columns.std(1) > 0.0]
    correlation = torch.corrcoef(varied) - torch.eye(len(varied))
    exact = 2 + 11  # two velocities that are always zero, and what the policy knows exactly
    assert len(varied) == len(columns) - exact
    assert correlation.abs().max() < 0.06  # of 1035 pairs, 8192 samples each: 5.4 standard deviations
