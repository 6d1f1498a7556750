"""Under which conditions a policy is measured and shown."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from telebip.config import TaskConfig, load_task
from telebip.mdp.term import find

SPEEDS = (0.5, 0.7, 1.0, -0.3)
"""Forward speeds at which walking is measured, where a policy was trained on them [m/s]."""


def trained_speeds(config: TaskConfig) -> tuple[float, ...]:
    """Return those of `SPEEDS` that a task trains, or the middle of its range if there is none [m/s]."""
    low, high = config.commands.lin_vel_x
    return tuple(speed for speed in SPEEDS if low <= speed <= high) or (round(0.5 * (low + high), 3),)


def forward_commands(speeds: Sequence[float], worlds: int, device: torch.device) -> Tensor:
    """Return the commands of `worlds` worlds for each forward speed, one speed's worlds after the other's, (num_envs, 3)."""
    forward = torch.tensor(speeds, device=device).repeat_interleave(worlds)
    return torch.nn.functional.pad(forward[:, None], (0, 2))


def on_flat_ground(config: TaskConfig) -> TaskConfig:
    """Return a task on the floor of its MJCF."""
    return replace(config, terrain=replace(config.terrain, types={}))


def on_levels(config: TaskConfig, first: int, last: int) -> TaskConfig:
    """Return a task whose worlds start on these levels of its terrain, and keep their tiles."""
    events = {name: params for name, params in config.events.items() if params.get("term", name) != "terrain_level"}
    return replace(config, terrain=replace(config.terrain, start_level=(first, last)), events=events)


def as_evaluated(
    config: TaskConfig, num_envs: int, duration: float, overrides: Sequence[str] = (), disturbed: bool = False
) -> TaskConfig:
    """Return a task whose robots start facing x and walk `duration` s without a time-out.

    `disturbed` ones keep the task's disturbances; else there is no observation noise, nothing gets lost and delays have no
    jitter, and there is no event that is a disturbance, such as pushes and random friction, but those that `overrides` name.
    Delays remain. The group of observations `critic` is left out.
    """
    load_task(config, overrides)  # so that a mistake in them is told beside the whole task's names
    named = {override.partition("=")[0].split(".")[1] for override in overrides if override.startswith("events.")}
    events = {}
    for name, params in config.events.items():
        event = find("event", params.get("term", name))
        if disturbed or name in named or not event.is_disturbance:
            events[name] = {**params, "heading": 0.0} if event.name == "start_pose" else params
    groups = {
        name: group if disturbed else replace(group, noise=False, loss=0.0)
        for name, group in config.observations.items()
        if name != "critic"
    }
    episode = replace(config.episode, length=duration + 1.0)
    actions = config.actions if disturbed else replace(config.actions, jitter=(0, 0), loss=0.0)
    parts = {"episode": episode, "events": events, "observations": groups, "actions": actions}
    return load_task(replace(config, num_envs=num_envs, **parts), overrides)
