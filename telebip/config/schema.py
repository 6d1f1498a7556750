"""Every field of a task, with its type, its unit and its bounds; no numbers, which stand in `configs/`."""

from dataclasses import dataclass, field
from typing import Any, Literal

from omegaconf import MISSING


def quantity(unit: str = "", **bounds: float) -> Any:
    """Declare a required number with its unit and bounds (`gt`, `ge`, `lt`, `le`), which hold for every entry of a tuple."""
    return field(default=MISSING, metadata={"unit": unit, "bounds": bounds})


def section(schema: type) -> Any:
    """Declare a nested section."""
    return field(default_factory=schema)


@dataclass
class SimConfig:
    robot: str = MISSING
    decimation: int = quantity(ge=1, le=1000)
    max_contacts: int = quantity(ge=1, le=10_000)
    max_constraints: int = quantity(ge=1, le=100_000)
    cuda_graph: bool = MISSING


@dataclass
class EpisodeConfig:
    length: float = quantity("s", gt=0, le=1e6)
    min_hip_height: float = quantity("m", ge=0)
    reset_joint_pos: float = quantity(ge=0)
    reset_joint_vel: float = quantity(ge=0)
    reset_lin_vel: float = quantity("m/s", ge=0)
    reset_ang_vel: float = quantity("rad/s", ge=0)
    reset_heading: float = quantity("rad", ge=0)


@dataclass
class ActionConfig:
    hip_roll: float = quantity("rad", gt=0)
    hip_pitch: float = quantity("rad", gt=0)
    knee: float = quantity("m | rad", gt=0)


@dataclass
class CommandConfig:
    lin_vel_x: tuple[float, float] = quantity("m/s")
    lin_vel_y: tuple[float, float] = quantity("m/s")
    ang_vel_z: tuple[float, float] = quantity("rad/s")
    resampling_time: float = quantity("s", gt=0)
    heading_gain: float = quantity("1/s", ge=0)
    heading_limit: float = quantity("rad/s", ge=0)


@dataclass
class GaitConfig:
    period: float = quantity("s", gt=0, le=60)


@dataclass
class CmdRewardConfig:
    k_xy: float = quantity()
    sigma_xy: float = quantity("m/s", gt=0)
    k_w: float = quantity()
    sigma_w: float = quantity("rad/s", gt=0)


@dataclass
class DiffRewardConfig:
    k_diff: float = quantity(le=0)


@dataclass
class TqRewardConfig:
    k_tq: float = quantity(le=0)


@dataclass
class FootRewardConfig:
    k_foot: float = quantity()
    gamma: float = quantity(gt=0, le=1)
    first: Literal["newest", "oldest"] = MISSING
    cap: float = quantity("body weights", gt=0)


@dataclass
class EnergyRewardConfig:
    k_energy: float = quantity("s/m", le=0)
    ramp: tuple[float, float] = quantity("samples", ge=0)


@dataclass
class TerminationRewardConfig:
    k_termination: float = quantity(le=0)


@dataclass
class RewardConfig:
    cmd: CmdRewardConfig = section(CmdRewardConfig)
    diff: DiffRewardConfig = section(DiffRewardConfig)
    tq: TqRewardConfig = section(TqRewardConfig)
    foot: FootRewardConfig = section(FootRewardConfig)
    energy: EnergyRewardConfig = section(EnergyRewardConfig)
    termination: TerminationRewardConfig = section(TerminationRewardConfig)
    extra: dict[str, float] = field(default_factory=dict)


@dataclass
class PushConfig:
    enabled: bool = MISSING
    force: float = quantity("N", ge=0)
    duration: float = quantity("s", gt=0)
    interval: tuple[float, float] = quantity("s", gt=0)
    ramp: tuple[float, float] = quantity("samples", ge=0)


@dataclass
class FrictionConfig:
    enabled: bool = MISSING
    range: tuple[float, float] = quantity(gt=0)


@dataclass
class NoiseConfig:
    enabled: bool = MISSING
    joint_pos: float = quantity(ge=0)
    joint_vel: float = quantity(ge=0)
    base_lin_vel: float = quantity("m/s", ge=0)
    base_ang_vel: float = quantity("rad/s", ge=0)
    base_quat: float = quantity(ge=0)


@dataclass
class DisturbanceConfig:
    push: PushConfig = section(PushConfig)
    friction: FrictionConfig = section(FrictionConfig)
    noise: NoiseConfig = section(NoiseConfig)


@dataclass
class PpoConfig:
    max_iterations: int = quantity(ge=1)
    num_steps_per_env: int = quantity(ge=1)
    num_learning_epochs: int = quantity(ge=1)
    num_mini_batches: int = quantity(ge=1)
    learning_rate: float = quantity(gt=0, le=1)
    schedule: Literal["fixed", "adaptive"] = MISSING
    desired_kl: float = quantity(gt=0)
    gamma: float = quantity(ge=0, le=1)
    lam: float = quantity(ge=0, le=1)
    clip_param: float = quantity(gt=0)
    value_loss_coef: float = quantity(ge=0)
    entropy_coef: float = quantity(ge=0)
    max_grad_norm: float = quantity(gt=0)
    hidden_dims: list[int] = quantity(ge=1)
    activation: Literal["elu", "relu", "selu", "tanh"] = MISSING
    symmetry: Literal["none", "phase"] = MISSING
    obs_normalization: bool = MISSING
    init_std: float = quantity(gt=0)
    min_std: float = quantity(gt=0)
    final_min_std: float = quantity(gt=0)
    min_std_ramp: tuple[float, float] = quantity("samples", ge=0)
    mixed_precision: Literal["auto", "always", "never"] = MISSING
    save_interval: int = quantity(ge=1)
    keep_checkpoints: int = quantity(ge=1)
    max_fault_rate: float = quantity(ge=0, le=1)


@dataclass
class TaskConfig:
    """One task: the MDP and its training. Read `configs/telebip_flat.yaml` for values and explanations."""

    seed: int = quantity(ge=0, le=2**32 - 1)
    num_envs: int = quantity(ge=1, le=2**24)
    sim: SimConfig = section(SimConfig)
    episode: EpisodeConfig = section(EpisodeConfig)
    action: ActionConfig = section(ActionConfig)
    command: CommandConfig = section(CommandConfig)
    gait: GaitConfig = section(GaitConfig)
    reward: RewardConfig = section(RewardConfig)
    disturbance: DisturbanceConfig = section(DisturbanceConfig)
    ppo: PpoConfig = section(PpoConfig)
