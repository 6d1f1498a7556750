"""Walk a policy and keep what happened, as plain arrays for measuring, plotting and recording."""

import dataclasses
import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from telebip.control.policy import Policy
from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.sim import SimState


@dataclass(frozen=True)
class Rollout:
    """One row per policy step, in the order of `telebip.robot.JOINTS`. Where a world fell, its row shows its new start."""

    step_dt: float  # [s]
    weight: float  # m g of the robot [N]
    reward_names: tuple[str, ...]  # of the terms in `reward_terms`
    qpos: NDArray[np.float32]  # (steps, num_envs, 13), as in SimState
    qvel: NDArray[np.float32]  # (steps, num_envs, 12), as in SimState
    joint_target: NDArray[np.float32]  # (steps, num_envs, 6) [rad | m]
    joint_force: NDArray[np.float32]  # (steps, num_envs, 6), mean over the step [N m | N]
    joint_power: NDArray[np.float32]  # (steps, num_envs, 6), mean of |force x velocity| over the step [W]
    joint_net_power: NDArray[np.float32]  # (steps, num_envs, 6), mean of force x velocity over the step [W]
    foot_force: NDArray[np.float32]  # (steps, num_envs, 2), right and left, mean over the step [N]
    push_w: NDArray[np.float32]  # (steps, num_envs, 3): push on the trunk, world frame [N]
    phase: NDArray[np.float32]  # (steps, num_envs, 2): p_r, p_l
    command: NDArray[np.float32]  # (steps, num_envs, 3): the target command, without the heading hold [m/s, m/s, rad/s]
    reference_heading: NDArray[np.float32]  # (steps, num_envs) [rad]
    reward: NDArray[np.float32]  # (steps, num_envs)
    reward_terms: NDArray[np.float32]  # (steps, num_envs, terms); their sum is `reward`
    fallen: NDArray[np.bool_]  # (steps, num_envs): the episode ended here by a fall or a fault

    @property
    def time(self) -> NDArray[np.floating]:
        """Time of each row [s], (steps,)."""
        return self.step_dt * np.arange(1, len(self.qpos) + 1)

    def after(self, skip: float) -> "Rollout":
        """Return the rows after the first `skip` seconds, at least one; their `time` starts anew."""
        first = min(round(skip / self.step_dt), len(self.time) - 1)
        return self._map(lambda array: array[first:])

    def select(self, worlds: slice) -> "Rollout":
        """Return some of the worlds."""
        return self._map(lambda array: array[:, worlds])

    def _map(self, part: Callable[[np.ndarray], np.ndarray]) -> "Rollout":
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        arrays = {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
        return dataclasses.replace(self, **{name: part(array) for name, array in arrays.items()})


def roll_out(env: TelebipEnv, policy: Policy, steps: int, progress: Callable[[int], None] = lambda step: None) -> Rollout:
    """Walk `policy` for `steps` policy steps from the environment's present state.

    Args:
        env: fallen worlds are reset and go on.
        policy: what walks; its memory of all worlds is cleared first.
        steps: number of policy steps.
        progress: called with the number of finished steps.

    Raises:
        UserError: the engine had no room for a world's contacts or constraints.
    """
    rows: list[dict[str, Tensor]] = []
    with torch.inference_mode():
        policy.reset(torch.ones(env.num_envs, dtype=torch.bool, device=env.device))
        obs = env.get_observations()
        for step in range(steps):
            command = env.target_command.clone()
            obs, reward, dones, extras = env.step(policy(obs))
            policy.reset(dones)
            row = {
                **{field.name: getattr(env.sim.state, field.name) for field in dataclasses.fields(SimState)},
                "joint_target": env.joint_target,
                "phase": env.phase,
                "reference_heading": env.reference_heading,
                "push_w": env.push_wrench_w[:, :3],
                "reward_terms": env.reward_terms.T,
            }
            rows.append({name: value.clone() for name, value in row.items()})
            rows[-1] |= {"command": command, "reward": reward, "fallen": dones & ~extras["time_outs"]}
            progress(step + 1)
    judge_faults(env)
    arrays = {name: torch.stack([row[name] for row in rows]).cpu().numpy() for name in rows[0]}
    return Rollout(step_dt=env.step_dt, weight=env.robot.weight, reward_names=env.reward_names, **arrays)


def judge_faults(env: TelebipEnv) -> None:
    """Say on standard error which kinds of faults there were (`telebip.mdp.faults`): their worlds count as fallen.

    Raises:
        UserError: the engine had no room for a world's contacts or constraints; what it then did is no physics.
    """
    faults = env.take_faults()
    if "capacity" in faults:
        raise UserError(f"contacts or constraints did not fit; {env.sim.advice['capacity']}")
    if faults:
        first = ", ".join(f"{kind} (first at step {int(record['step'])})" for kind, record in faults.items())
        print(f"note: worlds count as fallen because of {first}", file=sys.stderr)
