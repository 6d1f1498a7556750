"""The velocity command: when a new one is given and of which kind, and the holds that bend it towards what was commanded."""

import torch
from torch import Tensor

from telebip.math import columns, wrap_angle
from telebip.mdp.binding import Binder
from telebip.mdp.step import Step


class VelocityCommands:
    """Gives each world a new command where its last one has expired, and holds heading and speed.

    A command is uniform in its ranges. A share of them is to march in place, another to walk straight ahead, and another to
    turn to a heading. Each share is drawn by itself; where several hold, the first of these counts.
    """

    def __init__(
        self,
        binder: Binder,
        ranges: tuple[tuple[float, float], ...],
        resampling_time: float,
        *,
        standing: float = 0.0,
        forward: float = 0.0,
        heading: float = 0.0,
        heading_stiffness: float = 0.0,
        heading_hold: tuple[float, float] = (0.0, 0.0),
        velocity_hold: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Make room for the headings, and for how far the robots lag behind.

        Args:
            binder: of the worlds.
            ranges: of vx and vy [m/s] and the yaw rate [rad/s].
            resampling_time: between two commands [s].
            standing: share of commands that are zero: march in place [-].
            forward: share of commands that are vx alone, uniform in what of its range is not negative [-].
            heading: share of commands whose yaw rate turns to a heading, uniform in the world, see `turn_to` [-].
            heading_stiffness: k of `turn_to` [1/s].
            heading_hold: gain [1/s] and limit [rad/s] of `hold_heading`.
            velocity_hold: gain [1/s] and limit [m/s] of `hold_velocity`.
        """
        self._time, self._stiffness, self._turn_range = resampling_time, heading_stiffness, ranges[2]
        self._heading_hold, self._velocity_hold = heading_hold, velocity_hold
        self._share = {"standing": standing, "forward": forward, "heading": heading}
        (low, high), share, zero = ranges[0], (0.0, 1.0), binder.step.world.zeros
        drawn = {
            "command": list(ranges),
            "standing": [share] if standing else [],
            "forward": [share, (min(max(low, 0.0), high), high)] if forward else [],
            "heading": [share, (-torch.pi, torch.pi)] if heading else [],
        }
        self._random = binder.random("commands", drawn)
        headings = {"heading": zero(), "has_heading": zero().bool()} if heading else {}
        lag = {"lag": zero(2)} if velocity_hold[0] else {}
        self._memory = binder.memory("commands", headings | lag) if headings | lag else {}

    def advance(self, step: Step) -> None:
        """Let a step pass: the reference heading turns, and a robot that is too slow lags behind."""
        state, world = step.env, step.world
        turned = state.reference_heading + world.step_dt * state.target_command[:, 2]
        state.reference_heading.copy_(wrap_angle(turned))
        gain, limit = self._velocity_hold
        if gain:
            lag = self._memory["lag"]
            lag += world.step_dt * (state.target_command[:, :2] - step.measured.base_lin_vel_b[:, :2])
            lag.clamp_(-limit / gain, limit / gain)  # else it would have to be made up for after every change

    def update(self, step: Step) -> None:
        """Give new commands where they are due, and let those that have a heading turn to it."""
        state, memory = step.env, self._memory
        due = (state.command_timer < 0.5 * step.world.step_dt) & ~state.command_is_fixed
        torch.where(due[:, None], self._draw(), state.target_command, out=state.target_command)
        state.command_timer.masked_fill_(due, self._time)
        if "heading" in memory:
            has_heading = self._is_drawn("heading") & ~self._is_drawn("forward") & ~self._is_drawn("standing")
            torch.where(due, self._random["heading"][:, 1], memory["heading"], out=memory["heading"])
            torch.where(due, has_heading, memory["has_heading"], out=memory["has_heading"])
            rate = turn_to(memory["heading"], state.reference_heading, self._stiffness, self._turn_range)
            turns = memory["has_heading"] & ~state.command_is_fixed
            state.target_command[:, 2] = torch.where(turns, rate, state.target_command[:, 2])
        self.hold(step)

    def hold(self, step: Step) -> None:
        """Bend the target commands towards the reference heading and the way to go: what the policies see."""
        state = step.env
        heading = step.measured.heading  # what the robot takes for its own
        held = hold_heading(state.target_command, heading, state.reference_heading, *self._heading_hold)
        if "lag" in self._memory:
            held = hold_velocity(held, self._memory["lag"], *self._velocity_hold)
        state.command.copy_(held)

    def _draw(self) -> Tensor:
        """Return a command for each world from the step's random numbers, (num_envs, 3)."""
        command = self._random["command"]
        if self._share["forward"]:
            ahead = columns(self._random["forward"][:, 1], torch.zeros_like(command[:, :2]))
            command = torch.where(self._is_drawn("forward")[:, None], ahead, command)
        return command.masked_fill(self._is_drawn("standing")[:, None], 0.0)

    def _is_drawn(self, kind: str) -> Tensor:
        """Return which worlds' next command would be of a kind, bool, (num_envs,)."""
        if not self._share[kind]:
            return torch.zeros_like(self._random["command"][:, 0], dtype=torch.bool)
        return self._random[kind][:, 0] < self._share[kind]


def turn_to(goal: Tensor, reference: Tensor, stiffness: float, limits: tuple[float, float]) -> Tensor:
    r"""Yaw rate that turns the reference heading to a goal, w_cmd = clip(k (psi_goal - psi_ref), low, high).

    The heading command of legged_gym and mjlab, which take the robot's own heading in the place of psi_ref. Here that follows
    by `hold_heading`, so that the orientation that the policy sees, relative to psi_ref, stays small during a turn.

    Args:
        goal: psi_goal [rad], (num_envs,).
        reference: psi_ref, the integral of the commanded yaw rate [rad], (num_envs,).
        stiffness: k [1/s].
        limits: the range of commanded yaw rates [rad/s].

    Returns:
        The yaw rate [rad/s], (num_envs,).
    """
    return (stiffness * wrap_angle(goal - reference)).clamp(*limits)


def hold_heading(command: Tensor, heading: Tensor, reference: Tensor, gain: float, limit: float) -> Tensor:
    r"""Turn the yaw-rate command towards the reference heading.

        w = w_cmd + clip(k (psi_ref - psi), -limit, limit)

    A reward on yaw rate alone lets the heading drift; with k = 0 this is the article's MDP.

    Args:
        command: (vx, vy, yaw rate) [m/s, m/s, rad/s], (num_envs, 3).
        heading: psi of the robot [rad], (num_envs,).
        reference: psi_ref, the integral of the commanded yaw rate [rad], (num_envs,).
        gain: k [1/s].
        limit: bound of the correction [rad/s].

    Returns:
        The command that the policy sees and is rewarded for, (num_envs, 3).
    """
    correction = (gain * wrap_angle(reference - heading)).clamp(-limit, limit)
    return columns(command[:, :2], command[:, 2] + correction)


def hold_velocity(command: Tensor, lag: Tensor, gain: float, limit: float) -> Tensor:
    r"""Add to the commanded velocity what makes up for the way that the robot lags behind.

        v = v_cmd + clip(k e, -limit, limit),    e = integral of (v_cmd - v), body frame, |e| <= limit / k

    A policy that walks a little too slowly lags behind until the correction makes up for it, so that the mean velocity is the
    commanded one. This is to the velocity what `hold_heading` is to the yaw rate; with k = 0 it is the article's MDP.

    Args:
        command: (vx, vy, yaw rate) [m/s, m/s, rad/s], (num_envs, 3).
        lag: e [m], (num_envs, 2).
        gain: k [1/s].
        limit: bound of the correction [m/s].

    Returns:
        The command that the policy sees and is rewarded for, (num_envs, 3).
    """
    return columns(command[:, :2] + (gain * lag).clamp(-limit, limit), command[:, 2])
