"""The networks: rsl-rl's, with matrix products in bfloat16 where that is faster."""

import math
from typing import Any

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution
from tensordict import TensorDict
from torch import Tensor, nn

from telebip.config.schema import PpoConfig


class Gaussian(GaussianDistribution):
    """rsl-rl's Gaussian with a sample that does not wait for CUDA to look whether every deviation is positive."""

    def sample(self) -> Tensor:
        """Return mean + std * noise, the same numbers as those of `torch.normal`."""
        return torch.randn_like(self.mean).mul_(self.std).add_(self.mean)


class Elu(torch.autograd.Function):
    """ELU as max(x, 2^(x log2 e) - 1), which is e^x - 1 where x < 0 and x elsewhere.

    torch computes its own with an exponential that does not use a CPU's vector unit; this takes half the time. The gradient
    comes from the result y, as y + 1 where x < 0. Equal to torch's ELU in bfloat16, and to 1e-7 in float32.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        """Return the ELU of `x`, of its shape and type."""
        negative = x.clamp(max=0.0) if x.dtype == torch.float32 else x.float().clamp_(max=0.0)
        y = torch.maximum(x, negative.mul_(math.log2(math.e)).exp2_().sub_(1.0).to(x.dtype))
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        """Return the gradient with respect to `x`, from that with respect to y."""
        return torch.ops.aten.elu_backward(gradients[0], 1.0, 1.0, 1.0, True, *ctx.saved_tensors)


class CpuElu(nn.Module):
    """`Elu` as a layer."""

    def forward(self, x: Tensor) -> Tensor:
        """Return the ELU of `x`."""
        return Elu.apply(x)


class Bfloat16Model(MLPModel):
    """rsl-rl's network with products in bfloat16: inputs, sums, outputs and weights stay in float32.

    rsl-rl's own `use_mixed_precision` lets the update run in bfloat16 and the rollout in float32. PPO then compares the policy
    with another rounding of itself: for a trained one, whose deviations are small, their KL divergence is 0.004, of 0.01 that
    the adaptive schedule aims at. This network rounds alike wherever it is asked, and its distribution and losses are float32.
    """

    def forward(
        self, obs: TensorDict, masks: Tensor | None = None, hidden_state: Any = None, stochastic_output: bool = False
    ) -> Tensor:
        """Return actions or values, see `MLPModel`."""
        value = output(self, self.get_latent(obs, masks, hidden_state))
        if self.distribution is None:
            return value
        if not stochastic_output:
            return self.distribution.deterministic_output(value)
        self.distribution.update(value)
        return self.distribution.sample()


def output(network: MLPModel, latent: Tensor) -> Tensor:
    """Return what a network makes of normalised observations (num_envs, size), before its distribution, in its arithmetic."""
    with torch.autocast(latent.device.type, torch.bfloat16, enabled=isinstance(network, Bfloat16Model)):
        return network.mlp(latent).float()


def make_networks(
    obs: TensorDict, obs_groups: dict[str, list[str]], num_actions: int, ppo: PpoConfig, device: torch.device
) -> tuple[MLPModel, MLPModel]:
    """Return a new actor and a new critic, which draw their weights from torch's generator."""
    model = Bfloat16Model if arithmetic(ppo.mixed_precision, device) == "bfloat16" else MLPModel
    actor = model(obs, obs_groups, "actor", num_actions, **actor_cfg(ppo))
    critic = model(obs, obs_groups, "critic", 1, **critic_cfg(ppo))
    with torch.no_grad():
        for parameter in actor.mlp[-1].parameters():
            parameter.mul_(ppo.init_output_scale)
    for network in (actor, critic):
        for i, layer in enumerate(network.mlp):
            if isinstance(layer, nn.ELU) and device.type == "cpu":
                network.mlp[i] = CpuElu()
    return actor, critic


def arithmetic(mixed_precision: str, device: torch.device) -> str:
    """Return what the networks compute in, bfloat16 or float32; `auto` asks the device whether it has instructions for it."""
    is_bfloat16 = has_bfloat16(device) if mixed_precision == "auto" else mixed_precision == "always"
    return "bfloat16" if is_bfloat16 else "float32"


def has_bfloat16(device: torch.device) -> bool:
    """Whether the device multiplies matrices in bfloat16 itself."""
    if device.type == "cuda":
        with torch.cuda.device(device):
            return torch.cuda.is_bf16_supported(including_emulation=False)
    capabilities = torch.cpu.get_capabilities() if hasattr(torch.cpu, "get_capabilities") else {}
    return bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16"))


def actor_cfg(ppo: PpoConfig) -> dict[str, Any]:
    """Arguments of the actor's `MLPModel`: a Gaussian whose mean is an MLP and whose deviation is a parameter."""
    return {
        **critic_cfg(ppo),
        "distribution_cfg": {"class_name": Gaussian, "init_std": ppo.init_std, "std_range": (ppo.min_std, 1e6)},
    }


def critic_cfg(ppo: PpoConfig) -> dict[str, Any]:
    """Arguments of the critic's `MLPModel`."""
    return {"hidden_dims": list(ppo.hidden_dims), "activation": ppo.activation, "obs_normalization": ppo.obs_normalization}
