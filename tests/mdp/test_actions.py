"""From actions to joint targets."""

import torch

from telebip.mdp.actions import joint_targets


def test_targets_are_the_nominal_pose_plus_the_scaled_action() -> None:
    nominal = torch.tensor([0.0, 0.1, 0.04, 0.0, -0.1, 0.04])
    scale = torch.tensor([0.25, 0.5, 0.1, 0.25, 0.5, 0.1])
    action = torch.tensor([[0.0] * 6, [1.0, 1.0, 1.0, -2.0, -2.0, -2.0]])
    expected = torch.tensor([[0.0, 0.1, 0.04, 0.0, -0.1, 0.04], [0.25, 0.6, 0.14, -0.5, -1.1, -0.16]])
    torch.testing.assert_close(joint_targets(action, nominal, scale), expected)
