"""Real walks to look at: the shipped policy and a robot that stands, pushed once."""

from pathlib import Path

import pytest
import torch

from telebip import ROOT
from telebip.config import load_task
from telebip.control.policy import Stateless
from telebip.env import TelebipEnv
from telebip.eval.rollout import Rollout, roll_out
from telebip.rl.checkpoint import load_checkpoint
from telebip.rl.policy import load_policy
from telebip.robot import Robot

STEPS, STANDING_STEPS = 100, 20  # 2 s and 0.4 s


@pytest.fixture(scope="session")
def urdf(robot: Robot) -> Path:
    return robot.path.with_suffix(".urdf")


@pytest.fixture(scope="session")
def walking(robot: Robot) -> Rollout:
    """Three worlds of the shipped policy that walk at 0.7 m/s and are pushed within the first second."""
    checkpoint = load_checkpoint(ROOT / "assets" / "policies" / "telebip_flat")
    overrides = ["seed=2", "num_envs=3", "episode.reset_heading=0", "disturbance.push.interval=[0.3,0.6]"]
    env = TelebipEnv(load_task(checkpoint.config, overrides), robot, "cpu", "native")
    env.set_command(0.7, 0.0, 0.0)
    return roll_out(env, load_policy(checkpoint, "cpu"), STEPS)


@pytest.fixture(scope="session")
def standing(robot: Robot) -> Rollout:
    """One world that holds the nominal pose."""
    env = TelebipEnv(load_task("telebip_flat", ["num_envs=1", "episode.reset_heading=0"]), robot, "cpu", "native")
    return roll_out(env, Stateless(lambda obs: torch.zeros(1, 6)), STANDING_STEPS)
