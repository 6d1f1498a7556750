"""What reward and termination terms look at."""

from dataclasses import dataclass

from torch import Tensor

from telebip.sim.base import SimState


@dataclass(frozen=True)
class StepContext:
    """One policy step of all worlds, after the physics and before resets. Right side first wherever there are two."""

    state: SimState
    base_lin_vel_b: Tensor  # velocity of the trunk's frame, body frame [m/s], (num_envs, 3)
    command: Tensor  # (vx, vy, yaw rate) that the policy saw when it acted [m/s, m/s, rad/s], (num_envs, 3)
    action: Tensor  # A_t [-], (num_envs, 6)
    last_action: Tensor  # A_{t-1}, (num_envs, 6)
    force_limit: Tensor  # of the six actuators [N m | N], (6,)
    weight: float  # m g [N]
    foot_window: Tensor  # p_r q_rf + p_l q_lf of the last gait period [-], newest first, (num_envs, window)
    foot_weights: Tensor  # weight of each age in that window [-], (window,)
    energy_share: Tensor  # how much of the energy term is switched on, 0 to 1 [-], ()
    fallen: Tensor  # bool, (num_envs,)
