"""Whether a policy walks: what a look sees, and when a training has passed."""

import math
from pathlib import Path

import pytest
import torch

from telebip.config import load_task
from telebip.control.policy import Stateless
from telebip.env import TelebipEnv
from telebip.eval.walking import EVERY, Look, UntilWalking, WalkingTest
from telebip.rl.checkpoint import load_checkpoint
from telebip.rl.policy import load_network
from telebip.rl.train import Trainer
from telebip.robot import Robot


@pytest.mark.parametrize(
    ("speeds", "passed"),
    [((0.5, 1.0), True), ((0.54, 0.91), True), ((0.56, 1.0), False), ((0.5, 0.89), False), ((math.nan, math.nan), False)],
)
def test_a_look_is_passed_within_a_tenth_of_every_command(speeds: tuple[float, ...], passed: bool) -> None:
    assert Look((0.5, 1.0), speeds, 10.0).passed is passed


def test_a_backward_command_has_a_tolerance_too() -> None:
    assert Look((-0.3,), (-0.32,), 10.0).passed
    assert not Look((-0.3,), (0.3,), 10.0).passed


def test_a_shipped_policy_walks_and_one_that_does_nothing_falls(robot: Robot) -> None:
    config = load_task("telebip_flat")
    test = WalkingTest(config, robot, torch.device("cpu"))
    assert test.commands == (0.5, 0.7, 1.0)
    look = test.look(load_network(load_checkpoint("telebip_flat")))
    assert look.passed and look.upright == 10.0
    assert look.speeds == pytest.approx(test.commands, rel=0.08)
    assert str(look) == f"{look.speeds[0]:.2f} / {look.speeds[1]:.2f} / {look.speeds[2]:.2f} of 0.50 / 0.70 / 1.00 m/s"

    still = test.look(Stateless(lambda obs: torch.zeros(48, 6)))
    assert not still.passed and 0.2 < still.upright < 5.0
    assert str(still) == f"falls after {still.upright:.1f} s"


class Seen(WalkingTest):
    """Looks that have been seen before, in their order."""

    def __init__(self, *speeds: float) -> None:
        self._speeds = iter(speeds)

    def look(self, policy) -> Look:
        return Look((0.5,), (next(self._speeds),), 10.0)


def test_two_looks_in_a_row_have_to_be_passed(robot: Robot) -> None:
    small = ("num_envs=4", "ppo.num_steps_per_env=2", "ppo.hidden_dims=[8]")
    trainer = Trainer(TelebipEnv(load_task("telebip_flat", small), robot, "cpu", "native"), "", Path())
    walking = UntilWalking(trainer)
    walking._test = Seen(0.5, math.nan, 0.51, 0.49)
    walked = []
    for trainer.iteration in range(1, 5 * EVERY + 1):
        if walking.walks():
            walked.append(trainer.iteration)
    assert walked == list(range(4 * EVERY, 5 * EVERY + 1))
    assert walking.last == Look((0.5,), (0.49,), 10.0)


def test_looking_leaves_the_training_as_it_is(robot: Robot) -> None:
    small = ("num_envs=4", "ppo.num_steps_per_env=2", "ppo.hidden_dims=[8]")
    returns = []
    for looks in (False, True):
        trainer = Trainer(TelebipEnv(load_task("telebip_flat", small), robot, "cpu", "native"), "", Path())
        walking = UntilWalking(trainer)
        for _ in range(EVERY + 1):
            trainer.iterate()
            if looks:
                walking.walks()
        assert (walking.last is not None) == looks
        returns.append(trainer.learner.actor.state_dict())
    for name, value in returns[0].items():
        assert torch.equal(returns[1][name], value)
