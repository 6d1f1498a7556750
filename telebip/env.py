"""The vectorised environment: the order of one step, and nothing else. Every term it calls lives in `telebip.mdp`."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from telebip.config import TaskConfig, check
from telebip.graph import CudaGraph
from telebip.math import zeros
from telebip.mdp import log
from telebip.mdp.actions import DelayLine, joint_targets, scales
from telebip.mdp.binding import Binder, Events, model_fields_of, sensors_of
from telebip.mdp.commands import VelocityCommands
from telebip.mdp.faults import FaultRecorder
from telebip.mdp.ground import Ground
from telebip.mdp.groups import Group
from telebip.mdp.step import EnvState, Step, World
from telebip.mdp.terminations import non_finite
from telebip.robot import Robot
from telebip.sim import Backend, indexed, make_simulator
from telebip.terrain import make_terrain


class Outcome(NamedTuple):
    """What a step leaves for its caller."""

    obs: dict[str, Tensor]  # of each group, (num_envs, size)
    rewards: Tensor  # (num_envs,)
    dones: Tensor  # bool, (num_envs,)
    time_outs: Tensor  # bool, (num_envs,)
    log: Tensor  # means and numbers over the worlds, in the order of `log_names`
    final_obs: dict[str, Tensor]  # as `obs`, from before resets; empty unless asked for


class TelebipEnv(VecEnv):
    """`num_envs` robots that follow velocity commands; implements `rsl_rl.env.VecEnv`.

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

        Raises:
            UserError: a term does not fit the robot.
        """
        self.cfg: TaskConfig = check(cfg)
        self.robot = robot.on(make_terrain(cfg.terrain))
        self.device: torch.device = indexed(torch.device(device))
        self.num_envs, self.num_actions = cfg.num_envs, len(robot.joint_names)
        self._keep_final_obs = keep_final_obs
        self.sim = make_simulator(
            backend,
            self.robot,
            self.num_envs,
            cfg.sim.decimation,
            self.device,
            model_fields_of(cfg.events),
            sensors_of(cfg.observations),
            (cfg.sim.max_contacts, cfg.sim.max_constraints),
            cfg.sim.deterministic,
        )
        self.step_dt = cfg.sim.decimation * robot.physics_dt  # [s]
        self.max_episode_length: int = max(1, round(cfg.episode.length / self.step_dt))  # policy steps
        self.generator = torch.Generator(self.device).manual_seed(cfg.seed)
        self.world = self._make_world()
        self.state = EnvState.zeros(self.world)
        if self.world.ground:
            self.state.tile.copy_(self.world.ground.tiles(self.num_envs, cfg.terrain.start_level))
        self._given = zeros(self.num_envs, self.num_actions, device=self.device)  # the policy's actions as they came
        self._finite = self._everywhere()  # and whether they are numbers
        self._action = torch.zeros_like(self._given)  # A_t, zero where they are not
        self._targets = self.state.joint_target  # what the engine is given
        self._bind_terms()
        self._fault_recorder = FaultRecorder(self.num_envs, self.device)
        self._before_physics, self._after_physics = self._prepare_step, self._finish_step
        self._is_recorded = self.device.type == "cuda" and cfg.sim.cuda_graph
        if self._is_recorded:
            self._before_physics = CudaGraph(self._prepare_step, self.device, self.generator)
            self._after_physics = CudaGraph(self._finish_step, self.device, self.generator)
        self._random.draw(self.generator)
        self._events.happen("once", self.view())
        self.sim.refresh_constants(self._everywhere())
        self.reset()

    def _make_world(self) -> World:
        def constant(values) -> Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=self.device)

        robot, cfg = self.robot, self.cfg
        return World(
            robot=robot,
            sim=self.sim,
            num_envs=self.num_envs,
            device=self.device,
            step_dt=self.step_dt,
            decimation=cfg.sim.decimation,
            episode_length=cfg.episode.length,
            gait_period=cfg.gait.period,
            home_qpos=constant(robot.home_qpos),
            nominal=constant(robot.nominal),
            force_range=constant(robot.force_range),
            action_scale=constant(scales(cfg.actions.scale, robot.joint_names)),
            foot_lift=constant(robot.foot_lift),
            ground=Ground(robot.terrain, self.device) if robot.terrain else None,
            nominal_fields={name: field[0].clone() for name, field in self.sim.model_fields.items()},
        )

    def _bind_terms(self) -> None:
        """Give every term its parameters, memory and random numbers."""
        cfg, binder, self._delay = self.cfg, Binder(self.view()), None
        delays = {name: getattr(cfg.actions, name) for name in ("delay", "physics_delay", "jitter", "loss")}
        if any(most for most in (delays["delay"][1], delays["physics_delay"][1], delays["jitter"][1], delays["loss"])):
            self._delay = DelayLine(binder, **delays)
            each = (cfg.sim.decimation,) if delays["physics_delay"][1] or delays["jitter"][1] else ()
            self._targets = torch.zeros(self.num_envs, *each, self.num_actions, device=self.device)
        self.groups = {name: Group(name, group, binder) for name, group in cfg.observations.items()}
        self._rewards = {name: binder.bind("reward", "rewards", name, params) for name, params in cfg.rewards.items()}
        self._terminations = {
            name: binder.bind("termination", "terminations", name, params) for name, params in cfg.terminations.items()
        }
        self._events = Events(cfg.events, binder)
        self._commands = VelocityCommands(
            binder,
            cfg.commands.ranges,
            cfg.commands.resampling_time,
            standing=cfg.commands.rel_standing_envs,
            forward=cfg.commands.rel_forward_envs,
            heading=cfg.commands.rel_heading_envs,
            heading_stiffness=cfg.commands.heading_control_stiffness,
            heading_hold=(cfg.commands.heading_gain, cfg.commands.heading_limit),
            velocity_hold=(cfg.commands.velocity_gain, cfg.commands.velocity_limit),
        )
        self._encoders = self.state.memory.get("encoder_bias")
        if self._encoders and not self._delay:
            self._targets = torch.zeros_like(self.state.joint_target)
        self._random = binder.allocate()
        self.state.reset(self._everywhere())  # of what finding the sizes has left
        self.reward_names = tuple(self._rewards)
        self.reward_terms = torch.zeros(len(self._rewards), self.num_envs, device=self.device)  # of the last step
        types = self.world.ground.types if self.world.ground else ()
        self.log_names = log.names(self.reward_names, tuple(self._terminations), types)

    def reset(self, mask: Tensor | None = None) -> TensorDict:
        """Start a new episode where `mask` (num_envs,) holds, in every world if not given, and return all observations.

        The other worlds never notice.
        """
        mask, before = self._everywhere() if mask is None else mask, self.state.random.clone()
        self._random.draw(self.generator)
        self.state.random.copy_(torch.where(mask[:, None], self.state.random, before))
        self._reset(mask)
        self.sim.refresh_constants(mask)
        return self.get_observations()

    def set_command(self, lin_vel_x: float, lin_vel_y: float, ang_vel_z: float) -> None:
        """Give every world this command [m/s, m/s, rad/s], for good: no random ones are drawn any more."""
        self.set_commands(torch.tensor([lin_vel_x, lin_vel_y, ang_vel_z]).expand(self.num_envs, -1))

    def set_commands(self, commands: Tensor) -> None:
        """Give each world its row of `commands` (num_envs, 3) [m/s, m/s, rad/s], for good."""
        self.state.command_is_fixed.fill_(True)
        self.state.target_command.copy_(commands)
        self._commands.hold(self.view())

    def push(self, force_w: Tensor) -> None:
        """Push every trunk's centre of mass with `force_w` (num_envs, 3) or (3,) [N], world frame, until called again."""
        self.state.held_wrench_w[:, :3] = force_w

    def set_samples(self, samples: float) -> None:
        """Bring the curriculum to where a training stands after `samples` environment steps; a new one is complete."""
        self.state.samples.fill_(samples)

    def view(self) -> Step:
        """Return the present step as terms see it."""
        return Step(self.world, self.state, self._action)

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict]:
        """Apply `actions` (num_envs, num_actions) for one policy step.

        A world with a fault (`mdp.faults.KINDS`) ends its episode as by a fall; nothing non-finite leaves it.

        Returns:
            Observations {group: (num_envs, size)}, rewards (num_envs,), dones (num_envs,) bool, and extras: `time_outs`
            (num_envs,) bool, and `log`, a dictionary of scalars on the device: each reward term's mean, errors and faults.
            With `keep_final_obs` also `final_obs`, observations from before any reset.

        Raises:
            ValueError: `actions` has another shape.
        """
        if actions.shape != (self.num_envs, self.num_actions):
            raise ValueError(f"actions must have shape {(self.num_envs, self.num_actions)}, got {tuple(actions.shape)}")
        self._given.copy_(actions)
        self._before_physics()
        self.sim.step(self._targets, self.state.wrench_w)  # held for `decimation` steps of the engine
        outcome = self._after_physics()
        if self._is_recorded:  # the next replay writes to the same memory
            outcome = Outcome(*(_copied(value) for value in outcome))
        if self._events.change_the_model:
            self.sim.refresh_constants(outcome.dones)
        extras: dict[str, Any] = {"time_outs": outcome.time_outs}
        extras["log"] = dict(zip(self.log_names, outcome.log.unbind(), strict=True))
        if self._keep_final_obs:
            extras["final_obs"] = self._observed(outcome.final_obs)
        return self._observed(outcome.obs), outcome.rewards, outcome.dones, extras

    def _prepare_step(self) -> None:
        """Draw the step's random numbers, and set the joint targets and the push."""
        state, step = self.state, self.view()
        self._random.draw(self.generator)
        for group in self.groups.values():
            group.advance()
        self._finite.copy_(self._given.isfinite().all(1))
        self._action.copy_(self._given).masked_fill_(~self._finite[:, None], 0.0)
        state.joint_target.copy_(joint_targets(self._action, self.world.nominal, self.world.action_scale))
        if self._delay or self._encoders:
            self._targets.copy_(self._delay(step) if self._delay else state.joint_target)
        if self._encoders:  # the motors' controllers, too, take the joints to be where these say
            bias = self._encoders["bias"]
            self._targets.sub_(bias if self._targets.dim() == 2 else bias[:, None])
        state.wrench_w.copy_(state.held_wrench_w)
        self._events.happen("step", step)

    def _finish_step(self) -> Outcome:
        """Judge what the physics has brought about, reset the worlds that have ended, and observe."""
        state = self.state
        # 1. Clocks at the new time.
        state.num_steps += 1
        state.episode_length += 1
        state.has_begun.fill_(True)
        state.command_timer -= self.step_dt
        step = self.view()
        self._commands.advance(step)

        # 2. Terminations. A world with a fault ends its episode like a fall, and is counted by the kind of fault.
        faults = self._find_faults()
        fault = faults.any(0)
        terminations = torch.stack([term(step) for term in self._terminations.values()] or [torch.zeros_like(fault)])
        step.fallen = terminations.any(0) | fault

        # 3. Rewards. What is not finite counts as zero and, where no other fault has made it so, is a fault of the term.
        if self._rewards:
            self.reward_terms.copy_(torch.stack([term(step) for term in self._rewards.values()]))
        broken = ~self.reward_terms.isfinite()
        torch.logical_and(broken.any(0), ~fault, out=faults[-1])
        self._note_faults(faults)
        step.fallen = step.fallen | faults[-1]
        rewards = self.reward_terms.masked_fill_(broken, 0.0)
        has_ended = state.episode_length >= self.max_episode_length
        if ground := self.world.ground:
            has_ended |= ground.distance(step.state.base_pos, state.tile) > 0.5 * ground.size
        time_outs = has_ended & ~step.fallen  # the learner bootstraps there
        dones, fault = step.fallen | time_outs, faults.any(0)
        logged = log.means(step, rewards, terminations[: len(self._terminations)], faults)
        state.last_action.copy_(self._action)

        # 4. Reset finished worlds, give new commands where they are due, observe.
        final_obs = {}
        if self._keep_final_obs:
            self._commands.hold(step)
            final_obs = self._observe(step)
        self._events.happen("end", step, dones)
        obs = self._observe(self._reset(dones))
        final_obs = {name: torch.where(fault[:, None], obs[name], value) for name, value in final_obs.items()}
        return Outcome(obs, rewards.sum(0), dones, time_outs, logged, final_obs)

    def _find_faults(self) -> Tensor:
        """Return which fault befell which world, bool, (kinds, num_envs); that of the rewards is yet to be found."""
        none = torch.zeros_like(self._finite)[None]
        return torch.cat([torch.stack([~self._finite, non_finite(self.sim.state)]), self.sim.faults, none])

    def _note_faults(self, faults: Tensor) -> None:
        """Keep the first fault of each kind."""
        sim, state = self.sim, self.state
        given = {"action": self._given, "targets": self._targets, "wrench_w": state.wrench_w}
        judged = {"reward_terms": self.reward_terms.T}
        self._fault_recorder.note(faults, {**sim.memory_before, **sim.model_fields, **given, **judged}, state.num_steps)

    def get_observations(self) -> TensorDict:
        """Return new observations {group: (num_envs, size)} of the present state, with the step's noise; see `groups`."""
        return self._observed(self._observe(self.view()))

    def layout(self) -> dict[str, list[dict[str, Any]]]:
        """Return what each group's vector holds, as plain data: name, size, unit and mirror image of each part of a frame."""
        return {name: group.layout() for name, group in self.groups.items()}

    def _observe(self, step: Step) -> dict[str, Tensor]:
        return {name: group.observe(step) for name, group in self.groups.items()}

    def _observed(self, obs: dict[str, Tensor]) -> TensorDict:
        return TensorDict(dict(obs), batch_size=[self.num_envs], device=self.device)

    def state_dict(self) -> dict[str, Any]:
        """Return a copy of all that the worlds' future depends on; `load_state_dict` goes on from it, bit for bit."""
        copies = {part: {name: value.clone() for name, value in values.items()} for part, values in self._live().items()}
        return {**copies, "generator": self.generator.get_state()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from another environment's `state_dict`.

        Raises:
            ValueError: it has other worlds: of another number, robot, engine, kind of device, or other terms.
        """
        live = self._live()
        if state["generator"].shape != self.generator.get_state().shape:
            raise ValueError("'generator' is another kind of device's")
        for part, values in live.items():
            for name, value in values.items():
                found = state[part].get(name)
                if found is None or (found.shape, found.dtype) != (value.shape, value.dtype):
                    raise ValueError(f"'{name}' differs")
        self.sim.load(state["sim"])
        for part in ("measured", "model", "env"):
            for name, value in live[part].items():
                value.copy_(state[part][name])
        self.sim.refresh_constants(self._everywhere())
        self.generator.set_state(state["generator"].cpu())

    def _live(self) -> dict[str, dict[str, Tensor]]:
        """Return the tensors themselves that the worlds' future depends on."""
        sim = self.sim
        return {
            "sim": sim.memory,
            "measured": sim.state.step_values,
            "model": sim.model_fields,
            "env": dict(self.state.items()),
        }

    def take_faults(self) -> dict[str, dict[str, Any]]:
        """Return the first faulty world of each kind that has not been taken yet; see `mdp.faults`. Waits for the device."""
        return self._fault_recorder.take()

    def broken_reward(self) -> str:
        """Return which reward term was the first that was not finite, and where; empty if all were. Waits for the device."""
        record = self._fault_recorder.first("non_finite_reward")
        if record is None:
            return ""
        values = zip(self.reward_names, record["reward_terms"].tolist(), strict=True)
        name, value = next((name, value) for name, value in values if not math.isfinite(value))
        return f"reward '{name}' is {value:g} in world {int(record['world'])}, environment step {int(record['step'])}"

    @property
    def episode_length_buf(self) -> Tensor:
        """Policy steps since the last reset, (num_envs,); rsl-rl assigns other ones, which are copied to the same memory."""
        return self.state.episode_length

    @episode_length_buf.setter
    def episode_length_buf(self, value: Tensor) -> None:
        self.state.episode_length.copy_(value)

    def _everywhere(self) -> Tensor:
        return torch.ones(self.num_envs, dtype=torch.bool, device=self.device)

    def _reset(self, mask: Tensor) -> Step:
        """Start a new episode in the worlds where `mask` (num_envs,) holds, give new commands, and return the view of it."""
        self.state.reset(mask)
        before, reference = self.view(), self.state.reference_heading
        self._events.happen("reset", before, mask)
        if self.world.ground:
            before.start_qpos[:, :3] += self.world.ground.origin(self.state.tile)
        self.sim.reset(mask, before.start_qpos, before.start_qvel)
        step = self.view()
        torch.where(mask, step.measured.heading, reference, out=reference)
        self._commands.update(step)
        return step


def _copied(value: Any) -> Any:
    return {name: part.clone() for name, part in value.items()} if isinstance(value, dict) else value.clone()
