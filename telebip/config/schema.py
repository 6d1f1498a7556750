"""Every section of a task, with the type, unit and bounds of its fields; no numbers, which stand in `configs/`.

The fields of `terrain.types`, `observations`, `rewards`, `terminations` and `events` are the parameters of the functions that
they name: see `telebip.mdp.term`.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

from telebip.mdp.term import ObservationGroup, Params, Quantity
from telebip.terrain import TerrainConfig

Samples = Annotated[tuple[float, float], Quantity("samples", ge=0)]
"""Environment steps of all worlds together between which something grows, or falls."""

Share = Annotated[float, Quantity(ge=0, le=1)]
"""Of all commands."""


@dataclass(frozen=True)
class SimConfig:
    """The physics."""

    robot: str
    decimation: Annotated[int, Quantity(ge=1, le=1000)]
    max_contacts: Annotated[int, Quantity(ge=1, le=10_000)]
    max_constraints: Annotated[int, Quantity(ge=1, le=100_000)]
    cuda_graph: bool
    deterministic: bool  # whether `warp` gives the same bits in every run on a GPU; `native` always does


@dataclass(frozen=True)
class EpisodeConfig:
    """How long worlds go on without a termination."""

    length: Annotated[float, Quantity("s", gt=0, le=1e6)]


@dataclass(frozen=True)
class GaitConfig:
    """The clock of the phase signals."""

    period: Annotated[float, Quantity("s", gt=0, le=60)]


@dataclass(frozen=True)
class ActionsConfig:
    """From actions to joint targets, see `telebip.mdp.actions`."""

    scale: Annotated[dict[str, float], Quantity("rad | m", gt=0)]
    delay: Annotated[tuple[int, int], Quantity("policy steps", ge=0, le=100)]
    physics_delay: Annotated[tuple[int, int], Quantity("physics steps", ge=0, le=1000)]
    jitter: Annotated[tuple[int, int], Quantity("physics steps", ge=0, le=1000)]
    loss: Annotated[float, Quantity(ge=0, lt=1)]


@dataclass(frozen=True)
class CommandsConfig:
    """The velocity command, see `telebip.mdp.commands`."""

    lin_vel_x: Annotated[tuple[float, float], Quantity("m/s")]
    lin_vel_y: Annotated[tuple[float, float], Quantity("m/s")]
    ang_vel_z: Annotated[tuple[float, float], Quantity("rad/s")]
    resampling_time: Annotated[float, Quantity("s", gt=0)]
    rel_standing_envs: Share
    rel_forward_envs: Share
    rel_heading_envs: Share
    heading_control_stiffness: Annotated[float, Quantity("1/s", ge=0)]
    heading_gain: Annotated[float, Quantity("1/s", ge=0)]
    heading_limit: Annotated[float, Quantity("rad/s", ge=0)]
    velocity_gain: Annotated[float, Quantity("1/s", ge=0)]
    velocity_limit: Annotated[float, Quantity("m/s", ge=0)]

    @property
    def ranges(self) -> tuple[tuple[float, float], ...]:
        """Of vx and vy [m/s] and the yaw rate [rad/s]."""
        return self.lin_vel_x, self.lin_vel_y, self.ang_vel_z


@dataclass(frozen=True)
class PpoConfig:
    """The learning."""

    algorithm: str  # of `telebip.rl.learner.ALGORITHMS`
    max_iterations: Annotated[int, Quantity(ge=1)]
    num_steps_per_env: Annotated[int, Quantity(ge=1)]
    num_learning_epochs: Annotated[int, Quantity(ge=1)]
    num_mini_batches: Annotated[int, Quantity(ge=1)]
    learning_rate: Annotated[float, Quantity(gt=0, le=1)]
    schedule: Literal["fixed", "adaptive"]
    desired_kl: Annotated[float, Quantity(gt=0)]
    gamma: Annotated[float, Quantity(ge=0, le=1)]
    lam: Annotated[float, Quantity(ge=0, le=1)]
    clip_param: Annotated[float, Quantity(gt=0)]
    clip_value_loss: bool
    value_loss_coef: Annotated[float, Quantity(ge=0)]
    entropy_coef: Annotated[float, Quantity(ge=0)]
    max_grad_norm: Annotated[float, Quantity(gt=0)]
    hidden_dims: Annotated[list[int], Quantity(ge=1)]
    activation: Literal["elu", "relu", "selu", "tanh"]
    symmetry: Literal["none", "phase"]
    obs_normalization: bool
    init_output_scale: Annotated[float, Quantity(ge=0)]
    init_std: Annotated[float, Quantity(gt=0)]
    min_std: Annotated[float, Quantity(gt=0)]
    final_min_std: Annotated[float, Quantity(gt=0)]
    min_std_ramp: Samples
    averaging: Annotated[float, Quantity(ge=0, le=1)]
    mixed_precision: Literal["auto", "always", "never"]
    save_interval: Annotated[int, Quantity(ge=1)]
    keep_checkpoints: Annotated[int, Quantity(ge=1)]
    max_fault_rate: Annotated[float, Quantity(ge=0, le=1)]


@dataclass(frozen=True)
class TaskConfig:
    """One task: the MDP and its training. Read `configs/telebip_flat.yaml` for values and explanations.

    Change it in code with `dataclasses.replace`; a term's parameters are a dictionary that is replaced as well:

        replace(task, num_envs=64, rewards={**task.rewards, "energy": {"k_energy": -0.3, "ramp": (0.0, 0.0)}})
    """

    seed: Annotated[int, Quantity(ge=0, le=2**32 - 1)]
    num_envs: Annotated[int, Quantity(ge=1, le=2**24)]
    sim: SimConfig
    terrain: TerrainConfig
    episode: EpisodeConfig
    gait: GaitConfig
    actions: ActionsConfig
    commands: CommandsConfig
    observations: dict[str, ObservationGroup]
    rewards: dict[str, Params]
    terminations: dict[str, Params]
    events: dict[str, Params]
    ppo: PpoConfig
