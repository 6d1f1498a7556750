"""Walking a policy: what is said of faults."""

import pytest
import torch
from worlds import MakeEnv

from telebip.control.policy import Stateless
from telebip.eval.rollout import roll_out


def test_a_policy_that_gives_no_numbers_is_named_once(make_env: MakeEnv, capsys: pytest.CaptureFixture[str]) -> None:
    silent = Stateless(lambda obs: torch.full((2, 6), torch.nan))
    rollout = roll_out(make_env(calm=True, num_envs=2), silent, steps=3)
    assert rollout.fallen.all()
    assert capsys.readouterr().err == "note: worlds count as fallen because of non_finite_action (first at step 1)\n"
    roll_out(make_env(calm=True, num_envs=2), Stateless(lambda obs: torch.zeros(2, 6)), steps=3)
    assert capsys.readouterr().err == ""
