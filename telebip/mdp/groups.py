"""Groups of observations: terms side by side, their noise, and what is late or remembered of them."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from telebip.errors import UserError
from telebip.math import columns
from telebip.mdp.binding import Binder, Bound, find_term, own
from telebip.mdp.mirror import image_of
from telebip.mdp.step import Step
from telebip.mdp.term import Image, Mirror, ObservationGroup, Params

AXES: dict[Mirror, tuple[str, ...]] = {
    **{"polar": ("x", "y", "z"), "axial": ("x", "y", "z"), "quat": ("w", "x", "y", "z")},
    **{"command": ("lin_vel_x", "lin_vel_y", "ang_vel_z"), "feet": ("right", "left")},
}
"""What the numbers of a vector are called, by its kind."""


@dataclass(frozen=True)
class Part:
    """What one term is in a group's vector."""

    name: str
    size: int
    unit: str
    axes: tuple[str, ...]  # names of its numbers
    image: Image | str  # how it is mirrored, or why it cannot be
    noise: float  # amplitude, in its unit
    delay: tuple[int, int]  # least and most [policy steps], on top of the group's


class Group:
    """One vector of observations of every world.

    With a `history` of N it is the latest N frames, the newest first, and with a `delay` they are that many policy steps old,
    those of a term with a `delay` of its own by that much more; where an episode is younger than that, its first frame stands
    for those before. With a `loss`, that share of the frames
    keeps what the sensors told in the frame before. Without `noise`, the truth is seen: no noise, and no errors of the sensors.
    """

    def __init__(self, name: str, cfg: ObservationGroup, binder: Binder) -> None:
        """Bind the terms, and find their sizes by observing once."""
        self.name, self.history = name, cfg.history
        section, world = f"observations.{name}", binder.step.world
        self._terms = [binder.bind("observation", section, entry, params) for entry, params in cfg.terms.items()]
        self.parts = [
            _part(f"{section}.{entry}", entry, params, cfg.noise, term, binder.step)
            for term, (entry, params) in zip(self._terms, cfg.terms.items(), strict=True)
        ]
        self._shows_truth, self._loss = not cfg.noise, cfg.loss
        self.frame_size = sum(part.size for part in self.parts)
        self.size = cfg.history * self.frame_size
        self._has_noise = any(part.noise for part in self.parts)
        noise = [(-part.noise, part.noise) for part in self.parts for _ in range(part.size)]
        is_sensed = [find_term("observation", *item).is_sensed for item in cfg.terms.items()]
        sensed = [yes for yes, part in zip(is_sensed, self.parts, strict=True) for _ in range(part.size)]
        self._is_sensed = torch.tensor(sensed, device=world.device)
        delays = [cfg.delay, *(part.delay for part in self.parts)]
        longest = cfg.delay[1] + max(part.delay[1] for part in self.parts)
        late = [(float(low), float(high + 1)) for low, high in delays] if longest else []  # of numbers whose floor counts
        sizes = torch.tensor([part.size for part in self.parts], device=world.device)
        self._is_late, self._part = longest > 0, torch.arange(len(sizes), device=world.device).repeat_interleave(sizes)
        lost = [(0.0, 1.0)] if cfg.loss else []
        self._random = binder.random(section, {"noise": noise if self._has_noise else [], "delay": late, "loss": lost})
        kept = cfg.history + longest
        frames = {"frames": world.zeros(kept * self.frame_size), "age": world.zeros(len(self.parts))}
        self._memory = binder.memory(section, frames) if kept > 1 or cfg.loss else None

    def layout(self) -> list[dict[str, Any]]:
        """Return what each part of a frame is, as plain data."""
        return [{"name": part.name, "size": part.size, "unit": part.unit, "mirror": part.image} for part in self.parts]

    def advance(self) -> None:
        """Make room for the next frame, before the worlds move on."""
        if self._memory:
            frames, size = self._memory["frames"], self.frame_size
            frames.copy_(columns(frames[:, :size], frames[:, :-size]))

    def observe(self, step: Step) -> Tensor:
        """Return what is seen now, (num_envs, size); seen twice in a step, it is the same."""
        seen_as = step if self._shows_truth else step.measured
        frame = columns(*(term(seen_as) for term in self._terms))
        if self._has_noise:
            frame += self._random["noise"]
        if not self._memory:
            return frame.contiguous()  # by rows, as everyone expects
        frames, size = self._memory["frames"], self.frame_size
        kept = frames.shape[1] // size
        if self._loss:
            is_lost = (self._random["loss"] < self._loss) & self._is_sensed & ~step.is_new[:, None]
            frame = torch.where(is_lost, frames[:, :size], frame)
        frames[:, :size] = frame
        frames.copy_(torch.where(step.is_new[:, None], frame.repeat(1, kept), frames))
        if not self._is_late:
            return frames.contiguous()
        age, late = self._memory["age"], self._random["delay"].floor()
        torch.where(step.is_new[:, None], late[:, :1] + late[:, 1:], age, out=age)
        index = age.long()[:, None, self._part] + torch.arange(self.history, device=frame.device)[:, None]
        return frames.unflatten(1, (kept, size)).gather(1, index).flatten(1).contiguous()


def _part(where: str, entry: str, params: Params, has_noise: bool, bound: Bound, step: Step) -> Part:
    """Return what an entry is, from its term and from what it returns."""
    value = bound(step)
    if not isinstance(value, Tensor) or value.dim() != 2 or len(value) != step.world.num_envs:
        found = tuple(value.shape) if isinstance(value, Tensor) else value
        raise UserError(f"{where} must return (num_envs, size), got {found}")
    term, robot, size = find_term("observation", entry, params), step.world.robot, value.shape[1]
    mirror = term.mirror(**own(term, params)) if callable(term.mirror) else term.mirror
    names = robot.joint_names if mirror == "joints" else AXES.get(mirror, ()) if isinstance(mirror, str) else ()
    axes = names if len(names) == size else tuple(map(str, range(size)))
    noise = params.get("noise", 0.0) if has_noise else 0.0
    return Part(entry, size, term.unit, axes, image_of(mirror, size, robot), noise, params.get("delay", (0, 0)))
