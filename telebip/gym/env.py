# pyright: reportAttributeAccessIssue=false
"""`TelebipEnv` as Gymnasium environments: numpy in, numpy out. On a GPU, `TelebipEnv` itself spares the copies."""

from collections.abc import Sequence
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
from telebip.mdp.observations import LAYOUT
from telebip.robot import JOINTS, Robot, load_robot
from telebip.sim import Backend

Array = NDArray[np.float32]

AXES = {
    "base_lin_vel": ("x", "y", "z"),
    "base_ang_vel": ("x", "y", "z"),
    "base_quat": ("w", "x", "y", "z"),
    "command": ("lin_vel_x", "lin_vel_y", "ang_vel_z"),
    "phase": ("right", "left"),
}
ACTION_NAMES = JOINTS
OBSERVATION_NAMES = tuple(f"{part}/{axis}" for part in LAYOUT for axis in AXES.get(part, JOINTS))


class TelebipVectorEnv(VectorEnv[Array, Array, NDArray[Any]]):
    """`num_envs` worlds that reset in the step that ends their episode (`AutoresetMode.SAME_STEP`).

    Where an episode ended, `infos["final_obs"]` has its last observation, and `infos["_final_obs"]` is true. A fall terminates,
    a time-out truncates. Names of the numbers: `metadata["observation_names"]` and `metadata["action_names"]`.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (Gymnasium's own declaration)
        "autoreset_mode": AutoresetMode.SAME_STEP,
        "render_modes": [],
        "observation_names": OBSERVATION_NAMES,
        "action_names": ACTION_NAMES,
    }

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
        cfg = load_task(task, [f"num_envs={num_envs}", *overrides])
        self.worlds = TelebipEnv(cfg, load_robot(cfg.sim.robot), device, backend, keep_final_obs=True)
        self.num_envs = cfg.num_envs
        self.metadata = {**self.metadata, "render_fps": round(1.0 / self.worlds.step_dt)}
        self.single_action_space = action_space(cfg, self.worlds.robot)
        self.single_observation_space = observation_space(cfg, self.single_action_space)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Start a new episode in every world; `seed` starts the generator that they share anew. There are no options."""
        super().reset(seed=seed)
        if seed is not None:
            self.worlds.generator.manual_seed(seed)
        return _numpy(self.worlds.reset()["policy"]), {}

    def step(self, actions: Array) -> tuple[Array, Array, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Hold the joint targets of `actions` (num_envs, 6), clipped to the action space, for one policy step."""
        low, high = self.single_action_space.low, self.single_action_space.high
        clipped = torch.as_tensor(np.clip(actions, low, high), dtype=torch.float32, device=self.worlds.device)
        with torch.inference_mode():
            obs, rewards, dones, extras = self.worlds.step(clipped)
        done, truncated = _numpy(dones), _numpy(extras["time_outs"])
        infos: dict[str, Any] = {}
        if done.any():
            final = np.full(self.num_envs, None, dtype=object)  # as Gymnasium's own vector environments have it
            rows = np.flatnonzero(done)
            for row, last in zip(rows, _numpy(extras["final_obs"]["policy"])[rows], strict=True):
                final[row] = last
            infos = {"final_obs": final, "_final_obs": done.copy()}
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
        """Hold the joint targets of `action` (6,) for one policy step."""
        obs, rewards, terminated, truncated, infos = self._vector.step(action[None])
        last = infos["final_obs"][0] if infos else obs[0]
        return last, float(rewards[0]), bool(terminated[0]), bool(truncated[0]), {}


def action_space(cfg: TaskConfig, robot: Robot) -> Box:
    """Return the bounds of an action [-]: joint targets as far outside of the joint's range as saturates its actuator.

    From there on a larger action changes nothing for a joint at rest, wherever in its range it stands.
    """
    scale = np.array([cfg.action.hip_roll, cfg.action.hip_pitch, cfg.action.knee] * 2)
    beyond = robot.force_limit / robot.model.actuator_gainprm[:, 0]
    low = (robot.joint_range[:, 0] - beyond - robot.nominal) / scale
    high = (robot.joint_range[:, 1] + beyond - robot.nominal) / scale
    return Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)


def observation_space(cfg: TaskConfig, actions: Box) -> Box:
    """Return the bounds of an observation, in the order of `telebip.mdp.observations.LAYOUT`; what has none is unbounded."""
    command, noise = cfg.command, cfg.disturbance.noise
    turn = command.heading_limit if command.heading_gain > 0.0 else 0.0
    ranges = np.array([command.lin_vel_x, command.lin_vel_y, command.ang_vel_z]) + [[0.0, 0.0], [0.0, 0.0], [-turn, turn]]
    blur = noise.base_quat if noise.enabled else 0.0
    bounds = {
        "last_action": (actions.low, actions.high),
        "base_quat": (np.array([0.0, -1.0, -1.0, -1.0]) - blur, np.ones(4) + blur),
        "command": (ranges[:, 0], ranges[:, 1]),
        "phase": (-np.ones(2), np.ones(2)),
    }
    low, high = (
        np.concatenate([bounds[part][side] if part in bounds else np.full(size, infinity) for part, size in LAYOUT.items()])
        for side, infinity in ((0, -np.inf), (1, np.inf))
    )
    rounding = 1e-6  # what is exactly at its bound may lie a rounding error outside of it
    return Box((low - rounding).astype(np.float32), (high + rounding).astype(np.float32), dtype=np.float32)


def _numpy(tensor: Tensor) -> NDArray[Any]:
    """Return a copy that no later step overwrites."""
    return tensor.detach().cpu().numpy().copy()
