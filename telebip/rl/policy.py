"""From a configuration to rsl-rl's networks, and from a checkpoint to a policy."""

from typing import Any

import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict

from telebip.config.schema import PpoConfig
from telebip.control.policy import Policy
from telebip.errors import UserError
from telebip.mdp.observations import LAYOUT
from telebip.rl.checkpoint import Checkpoint
from telebip.rl.onnx import OnnxPolicy
from telebip.rl.symmetry import SymmetricPolicy
from telebip.robot import JOINTS

OBS_GROUPS = {"actor": ["policy"], "critic": ["policy"]}


def actor_cfg(ppo: PpoConfig) -> dict[str, Any]:
    """Arguments of the actor's `MLPModel`: a Gaussian whose mean is an MLP and whose deviation is a parameter."""
    return {
        **critic_cfg(ppo),
        "distribution_cfg": {
            "class_name": "GaussianDistribution",
            "init_std": ppo.init_std,
            "std_range": (ppo.min_std, 1e6),
        },
    }


def critic_cfg(ppo: PpoConfig) -> dict[str, Any]:
    """Arguments of the critic's `MLPModel`."""
    return {"hidden_dims": list(ppo.hidden_dims), "activation": ppo.activation, "obs_normalization": ppo.obs_normalization}


def load_policy(checkpoint: Checkpoint, device: str | torch.device) -> Policy:
    """Return the checkpoint's deterministic policy: torch's network, or onnxruntime's where the checkpoint is an ONNX file.

    Raises:
        UserError: the weights do not fit the configuration they came with.
    """
    if checkpoint.is_onnx:
        return OnnxPolicy(checkpoint.path, device)
    return load_network(checkpoint, device)


def load_network(checkpoint: Checkpoint, device: str | torch.device = "cpu") -> MLPModel | SymmetricPolicy:
    """Return the checkpoint's network in evaluation mode.

    Raises:
        UserError: it is an ONNX file, or the weights do not fit the configuration they came with.
    """
    if checkpoint.is_onnx:
        raise UserError(f"'{checkpoint.path}' is an ONNX file already; export needs a checkpoint (.pt) or a run folder")
    obs = TensorDict({"policy": torch.zeros(1, sum(LAYOUT.values()))}, batch_size=[1])
    actor = MLPModel(obs, OBS_GROUPS, "actor", len(JOINTS), **actor_cfg(checkpoint.config.ppo))
    try:
        actor.load_state_dict(checkpoint.learner["actor_state_dict"])
    except (RuntimeError, KeyError, TypeError, AttributeError) as error:
        raise UserError(f"checkpoint '{checkpoint.path}': its weights do not fit its configuration") from error
    policy = SymmetricPolicy(actor, device) if checkpoint.config.ppo.symmetry == "phase" else actor
    return policy.to(device).eval()
