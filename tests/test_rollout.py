"""The loop that walks a policy: what the caller may do between its steps, and what is said of faults."""

from itertools import islice

import pytest
import torch
from torch import Tensor
from worlds import MakeEnv

from telebip.control.policy import Stateless
from telebip.rollout import roll_out, walk

STAND = Stateless(lambda obs: torch.zeros(len(obs["policy"]), 6))


class Remembering:
    """Stands, and notes down when it is to forget."""

    def __init__(self) -> None:
        self.resets: list[list[bool]] = []

    def __call__(self, obs) -> Tensor:
        return torch.zeros(len(obs["policy"]), 6)

    def reset(self, mask: Tensor, /) -> None:
        self.resets.append(mask.tolist())


def test_a_policy_forgets_at_first_and_where_an_episode_ends(make_env: MakeEnv) -> None:
    env, policy = make_env("episode.length=0.06", calm=True, num_envs=2), Remembering()
    dones = [stride.dones.tolist() for stride in islice(walk(env, policy), 4)]
    assert dones == [[False, False], [False, False], [True, True], [False, False]]  # after 3 steps of 0.02 s
    assert policy.resets == [[True, True], *dones]


def test_pushes_and_commands_between_steps_act_from_the_next_one_on(make_env: MakeEnv) -> None:
    env = make_env(calm=True, num_envs=2)
    walking = walk(env, STAND)
    env.set_command(0.5, 0.0, 0.1)
    env.push(torch.tensor([0.0, 30.0, 0.0]))
    stride = next(walking)
    assert env.state.wrench_w.tolist() == [[0.0, 30.0, 0.0, 0.0, 0.0, 0.0]] * 2
    torch.testing.assert_close(stride.obs["policy"][:, 28], torch.full((2,), 0.5))
    env.push(torch.zeros(3))
    next(walking)
    assert not env.state.wrench_w.any()


def test_the_caller_is_left_in_its_own_mode(make_env: MakeEnv) -> None:
    for _ in islice(walk(make_env(calm=True, num_envs=2), STAND), 2):
        assert not torch.is_inference_mode_enabled()


def test_it_begins_anew_after_a_reset_of_the_environment(make_env: MakeEnv) -> None:
    env = make_env(calm=True, num_envs=2)
    for _ in islice(walk(env, STAND), 5):
        pass
    env.reset()
    assert env.episode_length_buf.tolist() == [0, 0]
    next(walk(env, STAND))
    assert env.episode_length_buf.tolist() == [1, 1]


def test_a_policy_that_gives_no_numbers_is_named_once(make_env: MakeEnv, capsys: pytest.CaptureFixture[str]) -> None:
    silent = Stateless(lambda obs: torch.full((2, 6), torch.nan))
    rollout = roll_out(make_env(calm=True, num_envs=2), silent, steps=3)
    assert rollout.fallen.all()
    assert capsys.readouterr().err == "note: worlds count as fallen because of non_finite_action (first at step 1)\n"
    roll_out(make_env(calm=True, num_envs=2), STAND, steps=3)
    assert capsys.readouterr().err == ""
