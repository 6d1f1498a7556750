"""Fixtures that several tests share: the robot, and real worlds made from the published task and overrides."""

from collections.abc import Callable

import pytest
import torch

from telebip.viz.opengl import choose_opengl

choose_opengl()  # before the imports below import MuJoCo

from telebip.config import load_task
from telebip.env import TelebipEnv
from telebip.robot import Robot, load_robot
from telebip.sim import Backend

torch.set_num_threads(1)


@pytest.fixture(scope="session")
def robot() -> Robot:
    return load_robot("assets/telebip.xml")


@pytest.fixture(scope="session")
def make_env(robot: Robot) -> Callable[..., TelebipEnv]:
    """Return a function that makes worlds of `telebip_flat` on the CPU; `calm` ones have no disturbances."""

    def make(*overrides: str, num_envs: int = 4, calm: bool = False, backend: Backend = "native") -> TelebipEnv:
        switches = [f"disturbance.{name}.enabled=false" for name in ("push", "friction", "noise")] if calm else []
        return TelebipEnv(load_task("telebip_flat", [f"num_envs={num_envs}", *switches, *overrides]), robot, "cpu", backend)

    return make
