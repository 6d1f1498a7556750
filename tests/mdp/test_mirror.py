"""The mirror image of observations and actions."""

import torch

from telebip.mdp.mirror import ACTION, MIRROR, OBSERVATION, PHASE_RIGHT
from telebip.mdp.observations import LAYOUT


def test_mirroring_twice_changes_nothing() -> None:
    for index, sign in (OBSERVATION, ACTION):
        x = torch.randn(5, len(index))
        once = x[:, index] * sign
        assert not torch.equal(once, x)
        assert torch.equal(once[:, index] * sign, x)


def test_every_part_of_the_observation_has_its_mirror() -> None:
    assert list(MIRROR) == list(LAYOUT)
    assert {part: len(order) for part, (order, _) in MIRROR.items()} == LAYOUT
    assert len(OBSERVATION[0]) == 33


def test_the_right_leg_becomes_the_left_and_rolls_the_other_way() -> None:
    index, sign = ACTION
    action = torch.tensor([[0.1, 0.2, 0.3, 0.4, 0.5, 0.6]])
    torch.testing.assert_close(action[:, index] * sign, torch.tensor([[-0.4, 0.5, 0.6, -0.1, 0.2, 0.3]]))


def test_the_right_phase_signal_is_where_it_says() -> None:
    assert PHASE_RIGHT == 31
