"""What the networks see: groups of observations, known by the parts of their vectors, as an environment describes them."""

from collections.abc import Mapping, Sequence
from typing import Any

from telebip.config import TaskConfig

Image = tuple[Sequence[int], Sequence[float]]
"""A mirror image: which entry takes each place, and its sign."""
Layout = Mapping[str, Sequence[Mapping[str, Any]]]
"""Parts of one frame of each group (`TelebipEnv.layout`): name, size, unit, and `mirror`, an `Image` or why there is none."""


def obs_groups(layout: Layout) -> dict[str, list[str]]:
    """Return which groups actor and critic see, as rsl-rl wants to know it."""
    return {"actor": ["policy"], "critic": ["critic" if "critic" in layout else "policy"]}


def seen(layout: Layout) -> Layout:
    """Return the groups that actor and critic see."""
    return {name: layout[name] for names in obs_groups(layout).values() for name in names}


def width(layout: Layout, config: TaskConfig, group: str) -> int:
    """Return the length of a group's vector: its parts, in each frame of its history."""
    return config.observations[group].history * sum(part["size"] for part in layout[group])


def described(layout: Layout, config: TaskConfig, group: str) -> str:
    """Return in words all of a group that its vector's numbers depend on: "joint_pos (6), joint_vel (6), 5 times"."""
    if group not in layout:
        return "nothing"
    history = config.observations[group].history
    return ", ".join(f"{part['name']} ({part['size']})" for part in layout[group]) + f", {history} times" * (history > 1)
