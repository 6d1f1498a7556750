"""A training with a tab open: the newest policy walks there, and the training does not notice."""

import socket
import time
from contextlib import suppress
from pathlib import Path

import pytest
import torch
from served import PATIENCE, open_tab, read

from telebip.config import load_task
from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.rl.train import Trainer
from telebip.robot import Robot
from telebip.viz.browser.server import Address
from telebip.viz.browser.training import live_session

SMALL = ("num_envs=8", "ppo.num_steps_per_env=10", "ppo.hidden_dims=[16,16]", "ppo.max_iterations=100000")


def make_trainer(robot: Robot) -> Trainer:
    return Trainer(TelebipEnv(load_task("telebip_flat", SMALL), robot, "cpu", "native"), "telebip_flat", Path())


def test_the_newest_policy_walks_and_the_training_is_the_same_bit_for_bit(robot: Robot) -> None:
    watched = make_trainer(robot)
    with live_session(watched, Address()) as (address, report), open_tab(address.url) as tab:
        end, told = time.monotonic() + PATIENCE, False
        while not told:
            assert time.monotonic() < end, "no policy of the training walks in the tab"
            report(watched.iterate())
            pause = time.monotonic() + 1.0
            with suppress(TimeoutError):
                while not told and time.monotonic() < pause:
                    told = b"the policy of iteration" in read(tab, timeout=0.5)
    alone = make_trainer(robot)
    for _ in range(watched.iteration):
        alone.iterate()
    for name, weight in alone.learner.get_policy().state_dict().items():
        assert torch.equal(watched.learner.get_policy().state_dict()[name], weight), name


def test_a_port_in_use_is_one_line_before_the_training_begins(robot: Robot) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = Address(port=taken.getsockname()[1], is_given=True)
        with pytest.raises(UserError, match="is in use"), live_session(make_trainer(robot), address):
            pass
