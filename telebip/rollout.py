"""Walk a policy in an environment: the one loop for it, and what happened as plain arrays for measuring and drawing."""

import dataclasses
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor

from telebip.control.policy import Policy
from telebip.env import TelebipEnv
from telebip.errors import UserError

Row = dict[str, Tensor]
"""One policy step of a `Rollout`: its arrays' rows by their names, (num_envs, ...) each."""


class Stride(NamedTuple):
    """What `TelebipEnv.step` returned for one policy step; the worlds' state is that of the environment."""

    obs: TensorDict
    rewards: Tensor  # (num_envs,)
    dones: Tensor  # bool, (num_envs,)
    extras: dict[str, Any]


@torch.inference_mode()
def walk(env: TelebipEnv, policy: Policy) -> Iterator[Stride]:
    """Walk `policy` from the environment's present state, without end; yield after every policy step.

    Between steps the caller may give commands (`env.set_command`) and push (`env.push`). To start anew, reset the environment
    and walk again. Worlds that end are reset and go on; the policy's memory is cleared with them, and of all worlds at first.
    """
    policy.reset(torch.ones(env.num_envs, dtype=torch.bool, device=env.device))
    obs = env.get_observations()
    while True:
        stride = Stride(*env.step(policy(obs)))
        policy.reset(stride.dones)
        obs = stride.obs
        yield stride


@dataclass(frozen=True)
class Rollout:
    """One row per policy step, joints in the order of `joint_names`. Where a world fell, its row shows its new start."""

    step_dt: float  # [s]
    weight: float  # m g of the robot [N]
    joint_names: tuple[str, ...]  # of the actuated joints
    reward_names: tuple[str, ...]  # of the terms in `reward_terms`
    qpos: NDArray[np.float32]  # (steps, num_envs, nq), as in SimState
    qvel: NDArray[np.float32]  # (steps, num_envs, nv), as in SimState
    joint_pos: NDArray[np.float32]  # (steps, num_envs, num_joints) [rad | m]
    joint_target: NDArray[np.float32]  # (steps, num_envs, num_joints) [rad | m]
    joint_force: NDArray[np.float32]  # (steps, num_envs, num_joints), mean over the step [N m | N]
    joint_power: NDArray[np.float32]  # (steps, num_envs, num_joints), mean of |force x velocity| over the step [W]
    joint_net_power: NDArray[np.float32]  # (steps, num_envs, num_joints), mean of force x velocity over the step [W]
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
    rows: list[Row] = []
    walking = walk(env, policy)
    for step in range(steps):
        rows.append(next_row(env, walking))
        progress(step + 1)
    judge_faults(env)
    return as_rollout(env, rows)


def next_row(env: TelebipEnv, walking: Iterator[Stride]) -> Row:
    """Walk on by one policy step, and return a copy of what a rollout keeps of it."""
    command = env.state.target_command.clone()  # a world that ends may get another one
    stride = next(walking)
    return {name: value.clone() for name, value in _row(env, stride).items()} | {"command": command}


def as_rollout(env: TelebipEnv, rows: Sequence[Row]) -> Rollout:
    """Return rows, at least one, as a rollout."""
    arrays = {name: torch.stack([row[name] for row in rows]).cpu().numpy() for name in rows[0]}
    return Rollout(
        step_dt=env.step_dt,
        weight=env.robot.weight,
        joint_names=env.robot.joint_names,
        reward_names=env.reward_names,
        **arrays,
    )


def _row(env: TelebipEnv, stride: Stride) -> Row:
    """Return a step's row of the rollout, (num_envs, ...) each, but for the command."""
    sim, state = env.sim.state, env.state
    return {
        "qpos": sim.qpos,
        "qvel": sim.qvel,
        "joint_pos": sim.joint_pos,
        "joint_target": state.joint_target,
        "joint_force": sim.joint_force,
        "joint_power": sim.joint_power,
        "joint_net_power": sim.joint_net_power,
        "foot_force": sim.foot_force,
        "push_w": state.wrench_w[:, :3],
        "phase": env.view().phase,
        "reference_heading": state.reference_heading,
        "reward": stride.rewards,
        "reward_terms": env.reward_terms.T,
        "fallen": stride.dones & ~stride.extras["time_outs"],
    }


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
        which = f": {env.broken_reward()}" if "non_finite_reward" in faults else ""
        print(f"note: worlds count as fallen because of {first}{which}", file=sys.stderr)
