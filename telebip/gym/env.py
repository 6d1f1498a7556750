# pyright: reportAttributeAccessIssue=false
"""`TelebipEnv` as Gymnasium environments: numpy in, numpy out. On a GPU, `TelebipEnv` itself spares the copies."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from telebip.config import TaskConfig, load_task
from telebip.env import TelebipEnv
from telebip.mdp.groups import Group
from telebip.robot import Robot, load_robot
from telebip.sim import Backend

Array = NDArray[np.float32]


class TelebipVectorEnv(VectorEnv[Array, Array, NDArray[Any]]):
    """`num_envs` worlds that reset in the step that ends their episode (`AutoresetMode.SAME_STEP`).

    They return the task's group of observations `policy`. Where an episode ended, `infos["final_obs"]` has its last one, and
    `infos["_final_obs"]` is true. A fall terminates, a time-out truncates. Names of the numbers:
    `metadata["observation_names"]` and `metadata["action_names"]`.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}  # noqa: RUF012 (Gymnasium's)

    def __init__(
        self,
        num_envs: int = 1,
        task: str | TaskConfig = "telebip_flat",
        overrides: Sequence[str] = (),
        device: str = "cpu",
        backend: Backend = "auto",
    ) -> None:
        """Create the worlds.

        Args:
            num_envs: number of worlds.
            task: name of a task, path of a YAML file, or a loaded configuration.
            overrides: `key.path=value` for any field of the task.
            device: where to simulate.
            backend: physics engine, see `telebip.sim.make_simulator`.

        Raises:
            UserError: something is wrong with the task.
        """
        cfg = load_task(replace(load_task(task), num_envs=num_envs), overrides)
        cfg = replace(cfg, observations={"policy": cfg.observations["policy"]})
        self.worlds = TelebipEnv(cfg, load_robot(cfg.sim.robot), device, backend, keep_final_obs=True)
        self.num_envs, seen = cfg.num_envs, self.worlds.groups["policy"]
        self.metadata = {
            **self.metadata,
            "render_fps": round(1.0 / self.worlds.step_dt),
            "observation_names": observation_names(seen),
            "action_names": self.worlds.robot.joint_names,
        }
        self.single_action_space = action_space(self.worlds.robot, self.worlds.world.action_scale.cpu().numpy())
        self.single_observation_space = observation_space(cfg, seen, self.single_action_space)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Start a new episode in every world; `seed` starts the generator that they share anew. There are no options."""
        super().reset(seed=seed)
        if seed is not None:
            self.worlds.generator.manual_seed(seed)
        return _numpy(self.worlds.reset()["policy"]), {}

    def step(self, actions: Array) -> tuple[Array, Array, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Hold the joint targets of `actions` (num_envs, num_joints), clipped to the action space, for one policy step."""
        low, high = self.single_action_space.low, self.single_action_space.high
        clipped = torch.as_tensor(np.clip(actions, low, high), dtype=torch.float32, device=self.worlds.device)
        with torch.inference_mode():
            obs, rewards, dones, extras = self.worlds.step(clipped)
        done, truncated = _numpy(dones), _numpy(extras["time_outs"])
        infos: dict[str, Any] = {}
        for row in np.flatnonzero(done):
            infos = self._add_info(infos, {"final_obs": _numpy(extras["final_obs"]["policy"][row])}, int(row))
        return _numpy(obs["policy"]), _numpy(rewards), done & ~truncated, truncated, infos


class TelebipSingleEnv(gymnasium.Env[Array, Array]):
    """One world, which waits for `reset` at the end of an episode; arguments as of `TelebipVectorEnv`."""

    def __init__(self, **arguments: Any) -> None:
        """Create the world."""
        self._vector = TelebipVectorEnv(num_envs=1, **arguments)
        self.metadata = {key: value for key, value in self._vector.metadata.items() if key != "autoreset_mode"}
        self.action_space, self.observation_space = self._vector.single_action_space, self._vector.single_observation_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Start a new episode; there are no options."""
        super().reset(seed=seed)
        obs, info = self._vector.reset(seed=seed)
        return obs[0], info

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Hold the joint targets of `action` (num_joints,) for one policy step."""
        obs, rewards, terminated, truncated, infos = self._vector.step(action[None])
        last = infos["final_obs"][0] if infos else obs[0]
        return last, float(rewards[0]), bool(terminated[0]), bool(truncated[0]), {}


def action_space(robot: Robot, scale: NDArray[np.floating]) -> Box:
    """Return the bounds of an action [-]: joint targets as far outside of the joint's range as saturates its actuator.

    `scale` is the displacement of each joint's target per unit of action [rad | m], (num_joints,).
    """
    beyond = robot.force_limit / robot.model.actuator_gainprm[:, 0]
    low = (robot.joint_range[:, 0] - beyond - robot.nominal) / scale
    high = (robot.joint_range[:, 1] + beyond - robot.nominal) / scale
    return Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)


def observation_names(group: Group) -> tuple[str, ...]:
    """Return the name of each number: `joint_pos/right_knee`, and `joint_pos/right_knee@-1` for one of a policy step before."""
    frame = [f"{part.name}/{axis}" for part in group.parts for axis in part.axes]
    return tuple(f"{name}@-{age}" if age else name for age in range(group.history) for name in frame)


def observation_space(cfg: TaskConfig, group: Group, actions: Box) -> Box:
    """Return the bounds of an observation, in the order of `observation_names`; what has none is unbounded."""
    command = cfg.commands
    turn = command.heading_limit if command.heading_gain > 0.0 else 0.0
    ranges = np.array([command.lin_vel_x, command.lin_vel_y, command.ang_vel_z]) + [[0.0, 0.0], [0.0, 0.0], [-turn, turn]]
    bounds = {
        "last_action": (actions.low, actions.high),
        "base_quat": (np.array([0.0, -1.0, -1.0, -1.0]), 1.0),
        "projected_gravity": (-1.0, 1.0),
        "command": (ranges[:, 0], ranges[:, 1]),
        "phase": (-1.0, 1.0),
    }
    lows, highs = [], []
    for part in group.parts:
        term = cfg.observations[group.name].terms[part.name].get("term", part.name)
        low, high = bounds.get(term, (-np.inf, np.inf))
        margin = np.full(part.size, part.noise + 1e-6)  # what is exactly at its bound may lie a rounding error outside of it
        lows.append(low - margin)
        highs.append(high + margin)
    low, high = (np.tile(np.concatenate(side), group.history).astype(np.float32) for side in (lows, highs))
    return Box(low, high, dtype=np.float32)


def _numpy(tensor: Tensor) -> NDArray[Any]:
    """Return a copy that no later step overwrites."""
    return tensor.detach().cpu().numpy().copy()
