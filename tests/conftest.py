"""Fixtures that several tests share: the robot, and real worlds made from the published task and overrides."""

from collections.abc import Callable, Iterator

import pytest
import torch

from telebip.viz.opengl import choose_opengl

choose_opengl()  # before the imports below import MuJoCo

from worlds import CALM

from telebip.config import load_task
from telebip.control.factory import with_estimate
from telebip.env import TelebipEnv
from telebip.robot import Robot, load_robot
from telebip.sim import Backend

torch.set_num_threads(1)


@pytest.fixture(params=[1, 2])
def torch_threads(request: pytest.FixtureRequest) -> Iterator[int]:
    """Let a test run with one thread of torch and with two."""
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def robot() -> Robot:
    return load_robot("assets/telebip.xml")


@pytest.fixture(scope="session")
def make_env(robot: Robot) -> Callable[..., TelebipEnv]:
    """Return a function that makes worlds of `telebip_flat` on the CPU.

    `calm` ones have no disturbances; those with an `estimate` have the group of observations that model-based walkers read.
    """

    def make(
        *overrides: str, num_envs: int = 4, calm: bool = False, estimate: bool = False, backend: Backend = "native"
    ) -> TelebipEnv:
        config = load_task("telebip_flat", [f"num_envs={num_envs}", *(CALM if calm else ()), *overrides])
        return TelebipEnv(with_estimate(config) if estimate else config, robot, "cpu", backend)

    return make
