# pyright: reportAttributeAccessIssue=false
"""`TelebipEnv` as Gymnasium environments: numpy in, numpy out. On a GPU, `TelebipEnv` itself spares the copies."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from telebip.config import TaskConfig, load_task
from telebip.env import TelebipEnv
from telebip.errors import UserError, nearest
from telebip.mdp.groups import Group
from telebip.rl.checkpoint import Checkpoint, load_checkpoint
from telebip.rl.policy import require_fit
from telebip.robot import Robot, load_robot
from telebip.robot_record import describe_robot, differences
from telebip.sim import Backend
from telebip.viz.render import Renderer

Array = NDArray[np.float32]
SIZE = (480, 360)
"""Width and height of pictures [pixels]."""


class TelebipVectorEnv(VectorEnv[Array, Array, NDArray[Any]]):
    """`num_envs` worlds that return the task's group of observations `policy`. A fall terminates, a time-out truncates.

    What happens at the end of an episode is `autoreset_mode`, as Gymnasium's own vector environments have it:

    - `NEXT_STEP`: the step returns the last observation; the next one ignores the world's action, starts a new episode and
      returns its first observation with a reward of zero. The wrappers of observations need this one.
    - `SAME_STEP`: the step itself starts the new episode and returns its first observation; `infos["final_obs"]` has the last
      of the old one where `infos["_final_obs"]` is true.
    - `DISABLED`: the worlds wait for `reset(options={"reset_mask": ...})`.

    Names of the numbers: `metadata["observation_names"]` and `metadata["action_names"]`.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (Gymnasium's)
        "autoreset_mode": AutoresetMode.NEXT_STEP,
        "render_modes": ["rgb_array"],
    }

    def __init__(
        self,
        num_envs: int = 1,
        task: str | TaskConfig = "telebip_flat",
        overrides: Sequence[str] = (),
        device: str = "cpu",
        backend: Backend = "auto",
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        checkpoint: str | Path | None = None,
        allow_robot_change: bool = False,
    ) -> None:
        """Create the worlds.

        Args:
            num_envs: number of worlds.
            task: name of a task, path of a YAML file, or a loaded configuration.
            overrides: `key.path=value` for any field of the task.
            device: where to simulate.
            backend: physics engine, see `telebip.sim.make_simulator`.
            autoreset_mode: what happens at the end of an episode, as Gymnasium's enumeration or one of its values.
            render_mode: `rgb_array`, or None for no pictures.
            checkpoint: of a policy that is to walk here: Gymnasium warns of all in which the robot differs from its own.
            allow_robot_change: whether it may be a robot with other joints or another rate than the checkpoint's.

        Raises:
            UserError: something is wrong with the task, or the checkpoint's policy cannot walk here.
        """
        cfg = load_task(replace(load_task(task), num_envs=num_envs), overrides)
        cfg = replace(cfg, observations={"policy": cfg.observations["policy"]})
        self.autoreset_mode = _choice(autoreset_mode)
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise UserError(f"unknown render_mode '{render_mode}'; valid: rgb_array, or None")
        self.render_mode = render_mode
        self._renderer: Renderer | None = None
        self.worlds = TelebipEnv(cfg, load_robot(cfg.sim.robot), device, backend, keep_final_obs=True)
        if checkpoint is not None:
            _compare(load_checkpoint(checkpoint), self.worlds, allow_robot_change)
        self.num_envs, seen = cfg.num_envs, self.worlds.groups["policy"]
        self.metadata = {
            **self.metadata,
            "autoreset_mode": self.autoreset_mode,
            "render_fps": round(1.0 / self.worlds.step_dt),
            "observation_names": observation_names(seen),
            "action_names": self.worlds.robot.joint_names,
        }
        self.single_action_space = action_space(self.worlds.robot, self.worlds.world.action_scale.cpu().numpy())
        self.single_observation_space = observation_space(cfg, seen, self.single_action_space)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._ended = np.zeros(self.num_envs, dtype=bool)  # worlds whose episode is over and that no reset has followed
        self._obs = np.zeros(self.observation_space.shape or (), dtype=np.float32)  # as returned last

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Start new episodes; `seed` starts the generator that all worlds share anew.

        The one option is `reset_mask`, a boolean array (num_envs,) of the worlds to reset: the others go on, and their
        observations are those of the last step.

        Raises:
            TypeError: the mask is no boolean array.
            ValueError: it has another shape or is false everywhere; or there is no such option.
        """
        super().reset(seed=seed)
        if seed is not None:
            self.worlds.generator.manual_seed(seed)
        mask = _reset_mask(options, self.num_envs)
        self._start(mask)
        return self._obs.copy(), {}

    def step(self, actions: Array) -> tuple[Array, Array, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Hold the joint targets of `actions` (num_envs, num_joints), clipped to the action space, for one policy step.

        Raises:
            gymnasium.error.ResetNeeded: without automatic resets, an episode is over and its world was not reset.
        """
        if self.autoreset_mode is AutoresetMode.DISABLED and self._ended.any():
            raise ResetNeeded(f"the episodes of worlds {np.flatnonzero(self._ended).tolist()} are over; reset them first")
        low, high = self.single_action_space.low, self.single_action_space.high
        clipped = torch.as_tensor(np.clip(actions, low, high), dtype=torch.float32, device=self.worlds.device)
        with torch.inference_mode():
            obs, rewards, dones, extras = self.worlds.step(clipped)
        rewards, done, truncated = _numpy(rewards), _numpy(dones), _numpy(extras["time_outs"])
        infos: dict[str, Any] = {}
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            self._obs = _numpy(obs["policy"])
            for row in np.flatnonzero(done):
                last = {"final_obs": _numpy(extras["final_obs"]["policy"][row]), "final_info": {}}
                infos = self._add_info(infos, last, int(row))
            return self._obs.copy(), rewards, done & ~truncated, truncated, infos
        last = _numpy(extras["final_obs"]["policy"])
        self._obs = np.where(done[:, None], last, _numpy(obs["policy"]))
        starting, self._ended = self._ended, done & ~self._ended
        if starting.any():  # what they have just done was nobody's wish
            self._start(starting)
            rewards[starting], done[starting], truncated[starting] = 0.0, False, False
        return self._obs.copy(), rewards, done & ~truncated, truncated, infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return a picture (360, 480, 3) of every world with `render_mode="rgb_array"`, else None.

        Raises:
            UserError: there is no OpenGL.
        """
        if self.render_mode is None:
            return None
        if self._renderer is None:
            self._renderer = Renderer(self.worlds.robot, SIZE)
        height = float(self.worlds.robot.home_qpos[2])
        return tuple(self._picture(self._renderer, qpos, height) for qpos in _numpy(self.worlds.sim.state.qpos))

    def close_extras(self, **kwargs: Any) -> None:
        """Free the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _picture(self, renderer: Renderer, qpos: Array, height: float) -> NDArray[np.uint8]:
        renderer.look_at([float(qpos[0]), float(qpos[1]), 0.65 * height], 2.6 * height, azimuth=125.0, elevation=-12.0)
        renderer.place([qpos])
        return renderer.render().copy()

    def _start(self, mask: NDArray[np.bool_]) -> None:
        """Start new episodes where `mask` (num_envs,) holds."""
        with torch.inference_mode():
            obs = self.worlds.reset(torch.from_numpy(mask).to(self.worlds.device))
        self._obs = np.where(mask[:, None], _numpy(obs["policy"]), self._obs)
        self._ended = self._ended & ~mask


class TelebipSingleEnv(gymnasium.Env[Array, Array]):
    """One world, which waits for `reset` at the end of an episode; arguments as of `TelebipVectorEnv`."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012 (Gymnasium's)

    def __init__(self, **arguments: Any) -> None:
        """Create the world."""
        self._vector = TelebipVectorEnv(num_envs=1, autoreset_mode=AutoresetMode.DISABLED, **arguments)
        self.render_mode = self._vector.render_mode
        self.metadata = {key: value for key, value in self._vector.metadata.items() if key != "autoreset_mode"}
        self.action_space, self.observation_space = self._vector.single_action_space, self._vector.single_observation_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Start a new episode; there are no options."""
        super().reset(seed=seed)
        obs, info = self._vector.reset(seed=seed)
        return obs[0], info

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Hold the joint targets of `action` (num_joints,) for one policy step."""
        obs, rewards, terminated, truncated, _ = self._vector.step(action[None])
        return obs[0], float(rewards[0]), bool(terminated[0]), bool(truncated[0]), {}

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """Return a picture, see `TelebipVectorEnv.render`."""
        pictures = self._vector.render()
        return pictures[0] if pictures else None

    def close(self) -> None:
        """Free the renderer."""
        self._vector.close()


def _choice(mode: AutoresetMode | str) -> AutoresetMode:
    """Return the autoreset mode of this value or name."""
    found = next((one for one in AutoresetMode if mode in (one, one.value, one.name)), None)
    if found is None:
        raise UserError(f"unknown autoreset_mode '{mode}'; {nearest(str(mode), [one.value for one in AutoresetMode])}")
    return found


def _reset_mask(options: dict[str, Any] | None, num_envs: int) -> NDArray[np.bool_]:
    """Return which worlds are to be reset, checked as Gymnasium's `SyncVectorEnv` does."""
    for name in options or {}:
        if name != "reset_mask":
            raise ValueError(f"unknown option '{name}' of reset; valid: reset_mask")
    if not options:
        return np.ones(num_envs, dtype=bool)
    mask = options["reset_mask"]
    if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
        raise TypeError(f"options['reset_mask'] must be a numpy array of bool, got {getattr(mask, 'dtype', type(mask))}")
    if mask.shape != (num_envs,):
        raise ValueError(f"options['reset_mask'] must have shape ({num_envs},), got {mask.shape}")
    if not mask.any():
        raise ValueError("options['reset_mask'] must be true for at least one world")
    return mask


def _compare(checkpoint: Checkpoint, worlds: TelebipEnv, allow_robot_change: bool) -> None:
    """Warn, a line each, of all in which the robot differs from the checkpoint's; refuse one that its policy cannot mean."""
    own = describe_robot(worlds.robot, worlds.cfg.sim.decimation)
    for line in differences(checkpoint.robot_record, own):
        gymnasium.logger.warn(f"'{worlds.cfg.sim.robot}' is not the robot of '{checkpoint.path}': {line}")
    require_fit(checkpoint, worlds, allow_robot_change=allow_robot_change)


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
    speed = command.velocity_limit if command.velocity_gain > 0.0 else 0.0
    ranges = np.array(command.ranges) + np.outer([speed, speed, turn], [-1.0, 1.0])
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
