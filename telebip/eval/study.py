"""The study: which policies are trained, what they are compared with, and where the results go."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Training:
    """One policy of the study. Everything else about it stands in its task's YAML file."""

    name: str  # of its folders, and of its shipped policy
    label: str  # in tables and plots
    task: str
    overrides: tuple[str, ...] = ()
    suites: tuple[str, ...] = ("tracking", "gait", "learning")


@dataclass(frozen=True)
class Baseline:
    """One model-based walker of the study."""

    name: str
    label: str
    controller: str
    overrides: tuple[str, ...] = ()
    suites: tuple[str, ...] = ("tracking", "push", "gait")


SHORT = ("num_envs=2048", "ppo.num_steps_per_env=24", "ppo.symmetry=phase", "ppo.max_iterations=150")
"""7.4 M samples, enough for a policy that learns half of the gait from many small batches."""

ALL = ("tracking", "push", "gait", "learning")

TRAININGS = (
    Training("telebip_efficient", "RL, efficient", "telebip_efficient", suites=ALL),
    Training("telebip_robust", "RL, robust", "telebip_robust", suites=ALL),
    Training("telebip_flat", "RL, article's rewards", "telebip_flat", suites=ALL),
    Training("no_foot_reward", "RL, no foot reward", "telebip_flat", ("rewards.foot.k_foot=0", "ppo.max_iterations=100")),
    Training("period_06", "RL, period 0.6 s", "telebip_flat", ("gait.period=0.6", *SHORT)),
    Training("telebip_slow", "RL, slow", "telebip_slow", SHORT),
    Training("telebip_fast", "RL, fast", "telebip_fast", SHORT),
    Training("telebip_backward", "RL, backward", "telebip_backward", SHORT),
)

BASELINES = (Baseline("alip", "angular momentum", "alip"), Baseline("dcm", "DCM", "dcm"))
