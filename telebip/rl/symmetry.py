r"""A policy that treats right and left alike, exactly and at no cost.

A walk on a symmetric robot has a mirror image, so that the best action for a mirrored observation is the mirrored action:
pi(M o) = M pi(o), where M also exchanges the phase signals. A network can be taught this with twice the samples or with an
extra loss; here it holds by construction. The learner only ever sees the half of the gait in which the right foot's phase
signal is not negative; in the other half it is shown the mirrored robot, and its action is mirrored back:

    pi(o) = f(o) where p_r >= 0,    pi(o) = M f(M o) elsewhere

so that one half of the gait is all there is to learn. (The method PHASE of Abdolhosseini et al., On Learning Symmetric
Locomotion, 2019.) What M does to each number, the terms of the observations declare, and the robot says it of its joints.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor, nn

from telebip.config import TaskConfig
from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.rl.layout import Image, Layout, seen
from telebip.robot import Robot


class Mirror(nn.Module):
    """M for one vector: x -> sign * x[:, order]."""

    def __init__(self, order: Sequence[int], sign: Sequence[float]) -> None:
        """Keep the image's order and signs."""
        super().__init__()
        self.register_buffer("order", torch.tensor(order), persistent=False)
        self.register_buffer("sign", torch.tensor(sign, dtype=torch.float32), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """Return the mirror image of `x` (num_envs, size)."""
        return x[:, self.order] * self.sign  # type: ignore[index]


class Canonical(nn.Module):
    """The mirror that shows a learner one half of the gait only."""

    def __init__(self, config: TaskConfig, layout: Layout, joints: Image | str) -> None:
        """Read the images of what the learner sees.

        Args:
            config: of the task, for the histories of its groups.
            layout: the groups that are mirrored, "policy" among them.
            joints: how the joints, and so the actions, are mirrored; or why they cannot be.

        Raises:
            UserError: the robot or a part of a group has no mirror image, or the policy sees no phase signals.
        """
        super().__init__()
        if isinstance(joints, str):
            raise UserError(f"ppo.symmetry=phase: robot '{config.sim.robot}' is not its own mirror image: {joints}")
        self._phase = _phase_column(layout["policy"])
        self.joints = Mirror(*joints)
        self.groups = nn.ModuleDict(
            {name: Mirror(*_image(name, parts, config.observations[name].history)) for name, parts in layout.items()}
        )

    def is_mirrored(self, policy_obs: Tensor) -> Tensor:
        """Return where p_r < 0, bool (num_envs, 1), in observations of the policy (num_envs, size)."""
        return policy_obs[:, self._phase : self._phase + 1] < 0.0

    def observe(self, name: str, obs: Tensor, mirrored: Tensor) -> Tensor:
        """Return observations of a group (num_envs, size), mirrored where `mirrored` holds."""
        return torch.where(mirrored, self.groups[name](obs), obs)

    def act(self, action: Tensor, mirrored: Tensor) -> Tensor:
        """Return actions (num_envs, num_joints), mirrored back where `mirrored` holds."""
        return torch.where(mirrored, self.joints(action), action)


def _phase_column(parts: Sequence[Mapping[str, Any]]) -> int:
    """Return the column of p_r in the newest frame."""
    names = [part["name"] for part in parts]
    if "phase" not in names:
        raise UserError("ppo.symmetry=phase: observations.policy has no term 'phase', which tells the halves of the gait apart")
    return sum(part["size"] for part in parts[: names.index("phase")])


def _image(group: str, parts: Sequence[Mapping[str, Any]], history: int) -> Image:
    """Return the image of a group's vector: of its parts side by side, in each of the `history` frames."""
    order: list[int] = []
    sign: list[float] = []
    for part in history * list(parts):
        if isinstance(part["mirror"], str):
            raise UserError(f"ppo.symmetry=phase: observations.{group}.{part['name']} cannot be mirrored: {part['mirror']}")
        part_order, part_sign = part["mirror"]
        order += [len(sign) + i for i in part_order]
        sign += part_sign
    return order, sign


def joint_mirror(robot: Robot) -> Image | str:
    """Return how the robot's joints are mirrored, or why they cannot be."""
    return robot.mirror if isinstance(robot.mirror, str) else (robot.mirror.order, robot.mirror.sign)


class SymmetricPolicy(nn.Module):
    """A `Policy` made of another that has learned half of the gait."""

    def __init__(self, learned: nn.Module, canonical: Canonical) -> None:
        """Wrap `learned`, which maps {"policy": (num_envs, size)} to actions (num_envs, num_joints) where p_r >= 0."""
        super().__init__()
        self.learned, self.canonical = learned, canonical

    def forward(self, obs: TensorDict) -> Tensor:
        """See `Policy`."""
        mirrored = self.canonical.is_mirrored(obs["policy"])
        seen = self.canonical.observe("policy", obs["policy"], mirrored)
        return self.canonical.act(self.learned(TensorDict({"policy": seen}, batch_size=obs.batch_size)), mirrored)

    def reset(self, mask: Tensor) -> None:
        """Nothing to forget."""


class SymmetricEnv(VecEnv):
    """The environment as a learner sees it that only learns half of the gait."""

    def __init__(self, env: TelebipEnv) -> None:
        """Wrap `env`.

        Raises:
            UserError: see `Canonical`.
        """
        self.env = env
        self.canonical = Canonical(env.cfg, seen(env.layout()), joint_mirror(env.robot)).to(env.device)
        self.num_envs, self.num_actions, self.max_episode_length = env.num_envs, env.num_actions, env.max_episode_length
        self.device, self.cfg = env.device, env.cfg
        self._mirrored = torch.zeros(env.num_envs, 1, dtype=torch.bool, device=env.device)

    @property
    def episode_length_buf(self) -> Tensor:
        """Policy steps since the start of each world's episode, (num_envs,)."""
        return self.env.episode_length_buf

    @episode_length_buf.setter
    def episode_length_buf(self, value: Tensor) -> None:
        self.env.episode_length_buf = value

    def get_observations(self) -> TensorDict:
        """Return the groups, (num_envs, size) each, as the learner sees them."""
        return self._seen(self.env.get_observations())

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict]:
        """Apply the learner's `actions` (num_envs, num_joints), mirrored back; see `TelebipEnv.step`."""
        obs, rewards, dones, extras = self.env.step(self.canonical.act(actions, self._mirrored))
        return self._seen(obs), rewards, dones, extras

    def _seen(self, obs: TensorDict) -> TensorDict:
        self._mirrored.copy_(self.canonical.is_mirrored(obs["policy"]))
        seen = {name: self.canonical.observe(name, obs[name], self._mirrored) for name in self.canonical.groups}
        return TensorDict(seen, batch_size=[self.num_envs], device=self.device)
