"""How a policy walks on robots that are not quite the one of the MJCF: their masses, motors, delays and sensors are drawn."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from telebip.config import TaskConfig
from telebip.control.policy import Policy
from telebip.env import TelebipEnv
from telebip.eval.statistics import share_interval
from telebip.mdp.term import Params, find
from telebip.robot import FLOOR, Robot
from telebip.rollout import judge_faults, walk

Make = Callable[[TaskConfig], tuple[TelebipEnv, Policy]]
"""From a task to its worlds and to what walks in them."""

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


@dataclass(frozen=True)
class TransferProtocol:
    """Robots that walk straight ahead, in worlds drawn from a task's ranges, and from each of these ranges alone."""

    task: str = "telebip_real"  # whose ranges these are
    worlds: int = 512  # for each width
    widths: tuple[float, ...] = (1.0, 1.5)  # of the ranges, about what the robot's MJCF says
    points: int = 7  # of each range, from its low end to its high one; 0: no sweeps
    sweep_worlds: int = 64  # for each point
    command: float = 0.7  # m/s, forward
    duration: float = 20.0  # s
    skip: float = 5.0  # s, left out of speed and cost


@dataclass(frozen=True)
class Factor:
    """One thing that a task randomises."""

    entry: str  # of `events`; or "actions", "observations"
    parameter: str
    unit: str
    nominal: float  # the value that changes nothing
    low: float
    high: float
    is_amplitude: bool  # what is drawn is uniform within +- the value; else the value itself

    @property
    def name(self) -> str:
        """What tables call it: "mass.scale"."""
        return f"{self.entry}.{self.parameter}"

    def values(self, points: int) -> list[float]:
        """Return values from one end to the other; of a whole number, each."""
        if self.unit == "physics steps":
            return [float(value) for value in range(int(self.low), int(self.high) + 1)]
        return [round(float(value), 9) for value in np.linspace(self.low, self.high, points)]


def factors_of(ranges: TaskConfig, robot: Robot) -> list[Factor]:
    """Return what a task randomises: parameters of events with a nominal value, and what is late, lost or noisy."""
    found = [Factor(entry, *about) for entry, params in _disturbances(ranges) for about in _swept(entry, params, robot)]
    actions, policy = ranges.actions, ranges.observations["policy"]
    late = ranges.sim.decimation * actions.delay[1] + actions.physics_delay[1] + actions.jitter[1]
    others = [
        Factor("actions", "delay", "physics steps", 0.0, 0.0, late, False),
        Factor("actions", "jitter", "physics steps", 0.0, 0.0, actions.jitter[1], True),
        Factor("actions", "loss", "", 0.0, 0.0, actions.loss, False),
        Factor("observations", "noise", "of the task's", 0.0, 0.0, 1.0, True),
        Factor("observations", "loss", "", 0.0, 0.0, policy.loss, False),
    ]
    return found + [factor for factor in others if factor.high > 0.0]


def _disturbances(ranges: TaskConfig) -> Iterator[tuple[str, Params]]:
    for entry, params in ranges.events.items():
        if find("event", params.get("term", entry)).is_disturbance:
            yield entry, params


def _swept(entry: str, params: Params, robot: Robot) -> Iterator[tuple[str, str, float, float, float, bool]]:
    """Yield parameter, unit, nominal value, both ends and whether it is an amplitude, of what an event's entry randomises."""
    term = find("event", params.get("term", entry))
    for name, parameter in term.own_parameters.items():
        nominal, value = parameter.quantity.nominal, params[name]
        if term.name == "friction" and name == "range":
            nominal = float(robot.model.geom(FLOOR).friction[0])
        if term.name == "model_field" and name == "range":
            nominal = {"scale": 1.0, "add": 0.0}.get(params["operation"])
        if nominal is not None:
            low, high = value if isinstance(value, tuple) else (nominal, value)
            yield name, parameter.quantity.unit, nominal, low, high, not isinstance(value, tuple)


def undisturbed(ranges: TaskConfig) -> TaskConfig:
    """Return a task without any of what it randomises."""
    policy = ranges.observations["policy"]
    terms = {name: {**params, "noise": 0.0} for name, params in policy.terms.items()}
    return replace(
        ranges,
        events={},
        actions=replace(ranges.actions, delay=(0, 0), physics_delay=(0, 0), jitter=(0, 0), loss=0.0),
        observations={"policy": replace(policy, terms=terms, loss=0.0)},
    )


def alone(ranges: TaskConfig, factor: Factor, value: float, factors: list[Factor]) -> TaskConfig:
    """Return a task in which one factor has a value, and all others are nominal."""
    quiet = undisturbed(ranges)
    if factor.entry == "observations":
        policy = ranges.observations["policy"]
        terms = {name: {**params, "noise": value * params["noise"]} for name, params in policy.terms.items()}
        changed = replace(
            quiet.observations["policy"], **({"terms": terms} if factor.parameter == "noise" else {"loss": value})
        )
        return replace(quiet, observations={"policy": changed})
    if factor.entry == "actions":
        change = {
            "delay": {"physics_delay": (int(value), int(value))},
            "jitter": {"jitter": (0, int(value))},
            "loss": {"loss": value},
        }
        return replace(quiet, actions=replace(quiet.actions, **change[factor.parameter]))
    params = dict(ranges.events[factor.entry])
    for other in factors:
        if other.entry == factor.entry:
            at = value if other.parameter == factor.parameter else other.nominal
            params[other.parameter] = at if other.is_amplitude else (at, at)
    return replace(quiet, events={factor.entry: params})


def widened(ranges: TaskConfig, width: float, factors: list[Factor]) -> TaskConfig:
    """Return a task whose ranges are `width` times as wide about the nominal values; with 1 it is the same."""
    events = {entry: dict(params) for entry, params in _disturbances(ranges)}
    for factor in factors:
        if factor.entry in events:
            low, high = (factor.nominal + width * (end - factor.nominal) for end in (factor.low, factor.high))
            events[factor.entry][factor.parameter] = high if factor.is_amplitude else (low, high)
    actions, policy = ranges.actions, ranges.observations["policy"]
    steps = {name: _wider(getattr(actions, name), width) for name in ("delay", "physics_delay", "jitter")}
    terms = {name: {**params, "noise": width * params["noise"]} for name, params in policy.terms.items()}
    return replace(
        ranges,
        events=events,
        actions=replace(actions, **steps, loss=width * actions.loss),
        observations={"policy": replace(policy, terms=terms, loss=width * policy.loss)},
    )


def _wider(steps: tuple[int, int], width: float) -> tuple[int, int]:
    return round(width * steps[0]), round(width * steps[1])


def in_worlds(config: TaskConfig, ranges: TaskConfig) -> TaskConfig:
    """Return an undisturbed task of `as_evaluated` with the events, delays, losses and noise of another.

    Terms of the observation that the other does not have keep their own noise where the other has noise at all.
    """
    given = {params.get("term", name): params["noise"] for name, params in ranges.observations["policy"].terms.items()}
    policy = config.observations["policy"]
    is_noisy = any(given.values())
    terms = {
        name: {**params, "noise": given.get(params.get("term", name), params["noise"] if is_noisy else 0.0)}
        for name, params in policy.terms.items()
    }
    seen = replace(policy, terms=terms, loss=ranges.observations["policy"].loss, noise=True)
    late = {name: getattr(ranges.actions, name) for name in ("delay", "physics_delay", "jitter", "loss")}
    return replace(
        config,
        events={**config.events, **dict(_disturbances(ranges))},
        actions=replace(config.actions, **late),
        observations={**config.observations, "policy": seen},
    )


def transfer_results(
    make: Make,
    config: TaskConfig,
    ranges: TaskConfig,
    robot: Robot,
    protocol: TransferProtocol,
    progress: Callable[[str, int, int], None] = lambda *args: None,
) -> dict[str, Any]:
    """Walk in worlds drawn from a task's ranges, all at once, and then from one after the other.

    Args:
        make: makes worlds of a task, and the policy.
        config: the policy's own task, undisturbed, `as_evaluated` for any number of worlds.
        ranges: the task that randomises.
        robot: the robot.
        protocol: how.
        progress: called with what is running, the finished policy steps, and their total.

    Returns:
        `worlds`: a row of `_row` for each width; `factors`: of each factor its name, unit and nominal value, and a row for each
        of its values. docs/evaluation.md describes the fields.

    Raises:
        UserError: the robot lacks what the ranges name, or the engine had no room for a world's contacts or constraints.
    """
    factors = factors_of(ranges, robot)

    def row(worlds: int, of: TaskConfig, name: str) -> dict[str, Any]:
        env, policy = make(in_worlds(replace(config, num_envs=worlds), of))
        steps = max(1, round(protocol.duration / env.step_dt))
        return walk_worlds(env, policy, protocol, lambda step: progress(name, step, steps))

    wide = [
        {"width": width, **row(protocol.worlds, widened(ranges, width, factors), f"ranges {width:g} times as wide")}
        for width in protocol.widths
    ]
    swept: list[dict[str, Any]] = []
    if protocol.points:
        nominal = row(protocol.sweep_worlds, undisturbed(ranges), "nominal worlds")
        for factor in factors:
            rows = [
                {"value": value}
                | (
                    nominal
                    if value == factor.nominal
                    else row(protocol.sweep_worlds, alone(ranges, factor, value, factors), f"{factor.name} {value:g}")
                )
                for value in factor.values(protocol.points)
            ]
            swept.append({"name": factor.name, "unit": factor.unit, "nominal": factor.nominal, "points": rows})
    return {"physics_dt": robot.physics_dt, "worlds": wide, "factors": swept}


def walk_worlds(
    env: TelebipEnv, policy: Policy, protocol: TransferProtocol, progress: Callable[[int], None] = lambda step: None
) -> dict[str, Any]:
    """Walk straight ahead in all worlds as one batch, and return what `_row` makes of it."""
    env.set_command(protocol.command, 0.0, 0.0)
    walks = torch.ones(env.num_envs, dtype=torch.bool, device=env.device)
    distance, energy = torch.zeros(2, env.num_envs, device=env.device).unbind()
    steps, skipped = max(1, round(protocol.duration / env.step_dt)), round(protocol.skip / env.step_dt)
    for step, stride in zip(range(1, steps + 1), walk(env, policy), strict=False):
        view = env.view()
        walks &= ~stride.dones
        if step > skipped:
            distance += env.step_dt * view.heading_lin_vel[:, 0]
            energy += env.step_dt * view.state.joint_power.sum(1)
        progress(step)
        if not walks.any():
            break
    judge_faults(env)
    speed = distance / (env.step_dt * max(1, steps - skipped))
    return _row(walks, {"speed": speed, "cot": energy / (_weight(env) * distance)}, protocol.command)


def _weight(env: TelebipEnv) -> Tensor | float:
    """Return each robot's own weight [N], (num_envs,)."""
    mass = env.sim.model_fields.get("body_mass")
    if mass is None:
        return env.robot.weight
    return env.robot.weight * (mass.sum(1) / env.world.nominal_fields["body_mass"].sum()).float()


def _row(walks: Tensor, measured: Mapping[str, Tensor], command: float) -> dict[str, Any]:
    """Return the share of worlds without a fall with its 95 % interval, and of these the speed and the cost of transport."""
    upright = walks.cpu().numpy()
    speed, cot = (measured[name].cpu().numpy()[upright] for name in ("speed", "cot"))
    number, worlds = len(speed), len(upright)
    low, high = share_interval(number, worlds)
    error = np.abs(speed - command) / abs(command)
    quantiles = np.quantile(error, QUANTILES) if number else np.full(len(QUANTILES), math.nan)
    row = {
        "success": number / worlds,
        "success_low": low,
        "success_high": high,
        "speed_mps": float(np.median(speed)) if number else math.nan,
        "speed_error": float(quantiles[QUANTILES.index(0.5)]),
        "cot": float(np.median(cot)) if number else math.nan,
    }
    return {
        "worlds": worlds,
        "falls": worlds - number,
        **{name: round(value, 5) for name, value in row.items()},
        "speed_error_quantiles": {f"{q:g}": round(float(value), 5) for q, value in zip(QUANTILES, quantiles, strict=True)},
    }
