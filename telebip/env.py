"""The vectorised environment: the order of one step, and nothing else. Every term it calls lives in `telebip.mdp`."""

import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from telebip.config import TaskConfig
from telebip.graph import CudaGraph
from telebip.math import columns, norm, rotate_inverse, wrap_angle, yaw, zeros
from telebip.mdp import gait, terminations
from telebip.mdp.actions import action_scale, joint_targets
from telebip.mdp.commands import hold_heading
from telebip.mdp.context import StepContext
from telebip.mdp.curriculum import ramp
from telebip.mdp.faults import KINDS, FaultRecorder
from telebip.mdp.observations import heading_relative_quat, observation
from telebip.mdp.randomization import Draws, initial_qpos, push_force, ranges
from telebip.mdp.rewards import reward_terms
from telebip.robot import Robot
from telebip.sim import Backend, indexed, make_simulator

MODEL_FIELDS = ("geom_friction",)
"""Fields of the model that differ between worlds."""

MEMORY = (
    *("episode_length_buf", "last_action", "command", "target_command", "reference_heading", "push_wrench_w"),
    *("_push_timer", "_push_time_left", "_command_timer", "_foot_window", "_base_lin_vel_b", "_noise", "num_steps"),
    *("_command_is_fixed", "_push_share", "_energy_share"),
)
"""Buffers of the environment that outlast a step; all else is computed anew in each."""


LOG = ("error/lin_vel_mps", "error/yaw_rate_radps", "walk/cost_of_transport", "walk/falls_per_minute", "fault/worlds")
"""What `step` logs between the terms of the reward and the kinds of faults."""


class Outcome(NamedTuple):
    """What a step leaves for its caller."""

    obs: Tensor  # (num_envs, 33)
    rewards: Tensor  # (num_envs,)
    dones: Tensor  # bool, (num_envs,)
    time_outs: Tensor  # bool, (num_envs,)
    log: Tensor  # means and numbers over the worlds, in the order of `log_names`
    final_obs: Tensor | None  # (num_envs, 33)


class TelebipEnv(VecEnv):
    """`num_envs` robots that follow velocity commands on flat ground; implements `rsl_rl.env.VecEnv`.

    All buffers are preallocated and written in place; choices between worlds are masks. `step` never waits for the device
    and never changes a shape; on CUDA its tensor work before and after the physics is recorded and replayed as two graphs.
    Finished worlds are reset within the step that ends them: their reward and done flag belong to the old episode, their
    observation to the new one.
    """

    def __init__(
        self,
        cfg: TaskConfig,
        robot: Robot,
        device: str | torch.device = "cpu",
        backend: Backend = "auto",
        keep_final_obs: bool = False,
    ) -> None:
        """Create and reset the worlds.

        Args:
            cfg: the task.
            robot: from `telebip.robot.load_robot(cfg.sim.robot)`.
            device: where tensors live.
            backend: physics engine, see `telebip.sim.make_simulator`.
            keep_final_obs: whether `step` also returns what ending episodes saw last, before their worlds were reset.
        """
        self.cfg: TaskConfig = cfg
        self.robot = robot
        self.device: torch.device = indexed(torch.device(device))
        self.num_envs, self.num_actions = cfg.num_envs, 6
        self._keep_final_obs = keep_final_obs
        self._rewards = reward_terms(cfg.reward)
        capacity = cfg.sim.max_contacts, cfg.sim.max_constraints
        self.sim = make_simulator(backend, robot, self.num_envs, cfg.sim.decimation, self.device, MODEL_FIELDS, capacity)
        self.step_dt = cfg.sim.decimation * robot.physics_dt  # [s]
        self.max_episode_length: int = max(1, round(cfg.episode.length / self.step_dt))  # policy steps
        self.generator = torch.Generator(self.device).manual_seed(cfg.seed)

        def constant(values) -> Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=self.device)

        buffer = functools.partial(zeros, self.num_envs, device=self.device)

        window = gait.window_length(cfg.gait.period, self.step_dt)
        self._home_qpos, self._nominal, self._force_limit = map(constant, (robot.home_qpos, robot.nominal, robot.force_limit))
        self._action_scale = constant(action_scale(cfg.action))
        self._draws = Draws(ranges(cfg), self.num_envs, self.device)
        self._foot_weights = constant(gait.window_weights(window, cfg.reward.foot.gamma, cfg.reward.foot.first))
        self._friction = self.sim.model_fields["geom_friction"][:, robot.engine_floor_id, 0]  # live, one per world

        self._episode_length = torch.zeros(self.num_envs, dtype=torch.long, device=self.device)  # policy steps since reset
        self._given = buffer(6)  # the policy's actions as they came
        self._finite = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)  # and whether they are numbers
        self._action = buffer(6)  # A_t, zero where they are not
        self.last_action = buffer(6)
        self.joint_target = buffer(6)  # [rad | m]
        self.command = buffer(3)  # what the policy sees: the target command and the heading hold's correction
        self.target_command = buffer(3)
        self.reference_heading = buffer()  # [rad]
        self.reward_names = tuple(self._rewards)
        self.log_names = (*(f"reward/{name}" for name in self._rewards), *LOG, *(f"fault/{kind}" for kind in KINDS))
        self.reward_terms = torch.zeros(len(self._rewards), self.num_envs, device=self.device)  # of the last step
        self.push_wrench_w = buffer(6)  # on the trunk's centre of mass, world frame [N, N m]
        self._push_timer = buffer()  # time until the next push starts [s]
        self._push_time_left = buffer()  # of the present push [s]
        self._command_timer = buffer()  # time until the next command [s]
        self._foot_window = buffer(window)
        self._base_lin_vel_b = buffer(3)
        self._energy_share = torch.ones((), device=self.device)
        self._push_share = torch.ones((), device=self.device)
        self._command_is_fixed = torch.zeros((), dtype=torch.bool, device=self.device)
        self._noise = self._draws["noise"]  # on the present observation
        self.num_steps = torch.zeros((), dtype=torch.long, device=self.device)  # since the worlds were made
        self._fault_recorder = FaultRecorder(self.num_envs, self.device)
        self._before_physics, self._after_physics = self._prepare_step, self._finish_step
        self._is_recorded = self.device.type == "cuda" and cfg.sim.cuda_graph
        if self._is_recorded:
            self._before_physics = CudaGraph(self._prepare_step, self.device, self.generator)
            self._after_physics = CudaGraph(self._finish_step, self.device, self.generator)

        self.reset()

    def reset(self) -> TensorDict:
        """Start a new episode in every world and return its observation."""
        self._draws.draw(self.generator)
        self._reset(torch.ones(self.num_envs, dtype=torch.bool, device=self.device))
        state = self.sim.state
        self._base_lin_vel_b.copy_(rotate_inverse(state.base_quat, state.base_lin_vel_w))
        self._update_commands()
        return self.get_observations()

    def set_command(self, lin_vel_x: float, lin_vel_y: float, ang_vel_z: float) -> None:
        """Give every world this command [m/s, m/s, rad/s], for good: no random ones are drawn any more."""
        self.set_commands(torch.tensor([lin_vel_x, lin_vel_y, ang_vel_z]).expand(self.num_envs, -1))

    def set_commands(self, commands: Tensor) -> None:
        """Give each world its row of `commands` (num_envs, 3) [m/s, m/s, rad/s], for good."""
        self._command_is_fixed.fill_(True)
        self.target_command.copy_(commands)
        self._hold_heading()

    def set_progress(self, samples: float) -> None:
        """Bring the curriculum to where a training stands after `samples` environment steps; a new one is complete."""
        self._energy_share.fill_(ramp(samples, self.cfg.reward.energy.ramp))
        self._push_share.fill_(ramp(samples, self.cfg.disturbance.push.ramp))

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict]:
        """Apply `actions` (num_envs, 6) for one policy step.

        A world with a fault (`mdp.faults.KINDS`) ends its episode as by a fall; nothing non-finite leaves it.

        Returns:
            Observations {"policy": (num_envs, 33)}, rewards (num_envs,), dones (num_envs,) bool, and extras: `time_outs`
            (num_envs,) bool, and `log`, a dictionary of scalars on the device: each reward term's mean, errors and faults.
            With `keep_final_obs` also `final_obs`, observations from before any reset.

        Raises:
            ValueError: `actions` has another shape.
        """
        if actions.shape != (self.num_envs, self.num_actions):
            raise ValueError(f"actions must have shape {(self.num_envs, self.num_actions)}, got {tuple(actions.shape)}")
        self._given.copy_(actions)
        self._before_physics()
        self.sim.step(self.joint_target, self.push_wrench_w)  # held for `decimation` steps of the engine
        outcome = self._after_physics()
        if self._is_recorded:  # the next replay writes to the same memory
            outcome = Outcome._make(value if value is None else value.clone() for value in outcome)
        extras: dict[str, Any] = {"time_outs": outcome.time_outs}
        extras["log"] = dict(zip(self.log_names, outcome.log.unbind(), strict=True))
        if outcome.final_obs is not None:
            extras["final_obs"] = self._observed(outcome.final_obs)
        return self._observed(outcome.obs), outcome.rewards, outcome.dones, extras

    def _prepare_step(self) -> None:
        """Draw the step's random numbers, and set the joint targets and the push."""
        self._draws.draw(self.generator)
        self._update_pushes()
        self._finite.copy_(self._given.isfinite().all(1))
        self._action.copy_(self._given).masked_fill_(~self._finite[:, None], 0.0)
        self.joint_target.copy_(joint_targets(self._action, self._nominal, self._action_scale))

    def _finish_step(self) -> Outcome:
        """Judge what the physics has brought about, reset the worlds that have ended, and observe."""
        cfg, state = self.cfg, self.sim.state
        # 1. Clocks and derived quantities at the new time.
        self.num_steps += 1
        self._episode_length += 1
        self._command_timer -= self.step_dt
        self.reference_heading.copy_(wrap_angle(self.reference_heading + self.step_dt * self.target_command[:, 2]))
        self._base_lin_vel_b.copy_(rotate_inverse(state.base_quat, state.base_lin_vel_w))
        sample = gait.foot_sample(self.phase, state.foot_force, self.robot.weight, cfg.reward.foot.cap)
        self._foot_window.copy_(gait.push_sample(self._foot_window, sample))

        # 2. Terminations. A world with a fault ends its episode like a fall, and is counted by the kind of fault.
        faults = torch.cat([torch.stack([~self._finite, terminations.non_finite(state)]), self.sim.faults])
        cause = {**self.sim.memory_before, **self.sim.model_fields, "action": self._given, "push_wrench_w": self.push_wrench_w}
        self._fault_recorder.note(faults, cause, self.num_steps)
        fault = faults.any(0)
        terminated = terminations.fallen(state, cfg.episode.min_hip_height) | fault
        time_outs = terminations.timed_out(self._episode_length, self.max_episode_length) & ~terminated
        dones = terminated | time_outs

        # 3. Rewards. What a fault has made non-finite counts as zero, in its own world alone.
        context = StepContext(
            state=state,
            base_lin_vel_b=self._base_lin_vel_b,
            command=self.command,
            action=self._action,
            last_action=self.last_action,
            force_limit=self._force_limit,
            weight=self.robot.weight,
            foot_window=self._foot_window,
            foot_weights=self._foot_weights,
            energy_share=self._energy_share,
            fallen=terminated,
        )
        self.reward_terms.copy_(torch.stack([term(context) for term in self._rewards.values()]))
        terms = self.reward_terms.masked_fill_(fault & ~self.reward_terms.isfinite(), 0.0)
        log = self._log(context, terms, faults)
        self.last_action.copy_(self._action)

        # 4. Reset finished worlds, give new commands where they are due, observe.
        final_obs = None
        if self._keep_final_obs:
            self._hold_heading()
            final_obs = self._observe()
        self._reset(dones)
        self._base_lin_vel_b.copy_(rotate_inverse(state.base_quat, state.base_lin_vel_w))
        self._update_commands()
        obs = self._observe()
        if final_obs is not None:
            final_obs = torch.where(fault[:, None], obs, final_obs)
        return Outcome(obs, terms.sum(0), dones, time_outs, log, final_obs)

    def get_observations(self) -> TensorDict:
        """Return a new {"policy": (num_envs, 33)} of the present state and its noise; see `mdp.observations.LAYOUT`."""
        return self._observed(self._observe())

    def _observe(self) -> Tensor:
        state = self.sim.state
        quat = heading_relative_quat(state.base_quat, self.reference_heading)
        obs = observation(state, self._nominal, self.last_action, self._base_lin_vel_b, quat, self.command, self.phase)
        if self.cfg.disturbance.noise.enabled:
            obs += self._noise
        return obs.contiguous()  # by rows, as everyone expects

    def _observed(self, obs: Tensor) -> TensorDict:
        return TensorDict({"policy": obs}, batch_size=[self.num_envs], device=self.device)

    def state_dict(self) -> dict[str, Any]:
        """Return a copy of all that the worlds' future depends on; `load_state_dict` goes on from it, bit for bit."""
        copies = {part: {name: value.clone() for name, value in values.items()} for part, values in self._live.items()}
        return {**copies, "generator": self.generator.get_state()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from another environment's `state_dict`.

        Raises:
            ValueError: it has other worlds: of another number, robot, engine, kind of device, or length of the gait's period.
        """
        live = self._live
        if state["generator"].shape != self.generator.get_state().shape:
            raise ValueError("'generator' is another kind of device's")
        for part, values in live.items():
            for name, value in values.items():
                found = state[part].get(name)
                if found is None or (found.shape, found.dtype) != (value.shape, value.dtype):
                    raise ValueError(f"'{name}' differs")
        self.sim.load(state["sim"])
        for part in ("model", "mdp"):
            for name, value in live[part].items():
                value.copy_(state[part][name])
        self.generator.set_state(state["generator"].cpu())

    @property
    def _live(self) -> dict[str, dict[str, Tensor]]:
        """The tensors themselves that the worlds' future depends on."""
        return {"sim": self.sim.memory, "model": self.sim.model_fields, "mdp": {name: getattr(self, name) for name in MEMORY}}

    def take_faults(self) -> dict[str, dict[str, Any]]:
        """Return the first faulty world of each kind that has not been taken yet; see `mdp.faults`. Waits for the device."""
        return self._fault_recorder.take()

    @property
    def episode_length_buf(self) -> Tensor:
        """Policy steps since the last reset, (num_envs,); rsl-rl assigns other ones, which are copied to the same memory."""
        return self._episode_length

    @episode_length_buf.setter
    def episode_length_buf(self, value: Tensor) -> None:
        self._episode_length.copy_(value)

    @property
    def phase(self) -> Tensor:
        """Phase signals (p_r, p_l) at the present time, (num_envs, 2)."""
        return gait.phase_signals(self._episode_length * self.step_dt, self.cfg.gait.period)

    def _reset(self, mask: Tensor) -> None:
        """Start a new episode in the worlds where `mask` (num_envs,) holds."""
        draws = self._draws
        heading = draws["heading"]
        self.sim.reset(mask, initial_qpos(self._home_qpos, draws["joint_offset"], heading), draws["qvel"])
        if self.cfg.disturbance.friction.enabled:
            torch.where(mask, draws["friction"][:, 0], self._friction, out=self._friction)
        torch.where(mask, draws["push_interval"][:, 0], self._push_timer, out=self._push_timer)
        torch.where(mask, heading[:, 0], self.reference_heading, out=self.reference_heading)
        for buffer in (self._episode_length, self._command_timer):
            buffer.masked_fill_(mask, 0)
        for buffer in (self.last_action, self._foot_window, self.push_wrench_w):
            buffer.masked_fill_(mask[:, None], 0.0)

    def _update_pushes(self) -> None:
        """Start a push where its time has come and end it after its duration. The timer counts down to the next start."""
        cfg = self.cfg.disturbance.push
        if not cfg.enabled:
            return
        force = self._push_share * push_force(self._draws["push"])
        start = self._push_timer <= 0.0
        torch.where(start, self._draws["push_interval"][:, 0], self._push_timer, out=self._push_timer)
        self._push_timer -= self.step_dt
        self._push_time_left -= self.step_dt
        self._push_time_left.masked_fill_(start, cfg.duration)
        kept = torch.where(start[:, None], force, self.push_wrench_w[:, :2])
        self.push_wrench_w[:, :2] = kept.masked_fill(self._push_time_left[:, None] < 0.5 * self.step_dt, 0.0)

    def _update_commands(self) -> None:
        """Give a new command where the last one has expired, and bring the heading hold up to date."""
        due = (self._command_timer < 0.5 * self.step_dt) & ~self._command_is_fixed
        torch.where(due[:, None], self._draws["command"], self.target_command, out=self.target_command)
        self._command_timer.masked_fill_(due, self.cfg.command.resampling_time)
        self._hold_heading()

    def _hold_heading(self) -> None:
        """Turn the target command's yaw rate towards the reference heading."""
        heading = yaw(self.sim.state.base_quat)
        gain, limit = self.cfg.command.heading_gain, self.cfg.command.heading_limit
        self.command.copy_(hold_heading(self.target_command, heading, self.reference_heading, gain, limit))

    def _log(self, context: StepContext, terms: Tensor, faults: Tensor) -> Tensor:
        """Return what `log_names` names; faulty worlds are left out of all but their own numbers."""
        state, fault = context.state, faults.any(0)
        error = context.command - columns(context.base_lin_vel_b[:, :2], state.base_ang_vel_b[:, 2])
        rows = torch.stack(
            [
                *terms,
                norm(error[:, :2]),
                error[:, 2].abs(),
                state.joint_power.sum(1),
                norm(context.base_lin_vel_b[:, :2]),
                context.fallen.float(),
            ]
        )
        means = rows.masked_fill(fault, 0.0).sum(1) / (~fault).sum()
        power, speed, falls = means[-3:]
        cost_of_transport = power / (self.robot.weight * speed)
        falls_per_minute = falls * (60.0 / self.step_dt)
        return torch.cat([means[:-3], torch.stack([cost_of_transport, falls_per_minute, fault.sum()]), faults.sum(1)])
