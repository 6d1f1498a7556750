r"""A policy that treats right and left alike, exactly and at no cost.

A walk on this robot has a mirror image, so that the best action for a mirrored observation is the mirrored action:
pi(M o) = M pi(o), where M also exchanges the phase signals. A network can be taught this with twice the samples or with an
extra loss; here it holds by construction. The learner only ever sees the half of the gait in which the right foot's phase
signal is not negative; in the other half it is shown the mirrored robot, and its action is mirrored back:

    pi(o) = f(o) where p_r >= 0,    pi(o) = M f(M o) elsewhere

so that one half of the gait is all there is to learn. (The method PHASE of Abdolhosseini et al., On Learning Symmetric
Locomotion, 2019.)
"""

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor, nn

from telebip.env import TelebipEnv
from telebip.mdp.mirror import ACTION, OBSERVATION, PHASE_RIGHT


class Canonical(nn.Module):
    """The mirror that shows a learner one half of the gait only."""

    def __init__(self, device: str | torch.device = "cpu") -> None:
        """Put the mirror on `device`."""
        super().__init__()
        self._obs_index, self._obs_sign = (part.to(device) for part in OBSERVATION)
        self._action_index, self._action_sign = (part.to(device) for part in ACTION)

    def observe(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Return the observation (num_envs, 33), mirrored where p_r < 0, and where that is, (num_envs, 1) bool."""
        mirrored = obs[:, PHASE_RIGHT : PHASE_RIGHT + 1] < 0.0
        return torch.where(mirrored, obs[:, self._obs_index] * self._obs_sign, obs), mirrored

    def act(self, action: Tensor, mirrored: Tensor) -> Tensor:
        """Return actions (num_envs, 6), mirrored back where `mirrored` holds."""
        return torch.where(mirrored, action[:, self._action_index] * self._action_sign, action)


class SymmetricPolicy(nn.Module):
    """A `Policy` made of another that has learned half of the gait."""

    def __init__(self, learned: nn.Module, device: str | torch.device = "cpu") -> None:
        """Wrap `learned`, which maps {"policy": (num_envs, 33)} to actions (num_envs, 6) where p_r >= 0."""
        super().__init__()
        self.learned = learned
        self.canonical = Canonical(device)

    def forward(self, obs: TensorDict) -> Tensor:
        """See `Policy`."""
        seen, mirrored = self.canonical.observe(obs["policy"])
        return self.canonical.act(self.learned(TensorDict({"policy": seen}, batch_size=obs.batch_size)), mirrored)

    def reset(self, mask: Tensor) -> None:
        """Nothing to forget."""


class SymmetricEnv(VecEnv):
    """The environment as a learner sees it that only learns half of the gait."""

    def __init__(self, env: TelebipEnv) -> None:
        """Wrap `env`."""
        self.env, self.canonical = env, Canonical(env.device)
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
        """Return {"policy": (num_envs, 33)} as the learner sees it."""
        return self._seen(self.env.get_observations())

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict]:
        """Apply the learner's `actions` (num_envs, 6), mirrored back; see `TelebipEnv.step`."""
        obs, rewards, dones, extras = self.env.step(self.canonical.act(actions, self._mirrored))
        return self._seen(obs), rewards, dones, extras

    def _seen(self, obs: TensorDict) -> TensorDict:
        seen, mirrored = self.canonical.observe(obs["policy"])
        self._mirrored.copy_(mirrored)
        return TensorDict({"policy": seen}, batch_size=[self.num_envs], device=self.device)
