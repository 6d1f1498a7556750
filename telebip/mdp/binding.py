"""From the entries of a task to functions of the step: parameters, memory and random numbers given to each term."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

from telebip.errors import UserError
from telebip.mdp.random_numbers import RandomNumbers, Ranges
from telebip.mdp.step import Memory, Step
from telebip.mdp.term import Kind, ObservationGroup, Params, Term, find

Bound = Callable[..., Any]
"""A term with all that it needs but the step (and the mask of an event)."""


def find_term(kind: Kind, entry: str, params: Params) -> Term:
    """Return the term that an entry means: the one it names with `term`, else the one that is called as it is."""
    return find(kind, params.get("term", entry))


def own(term: Term, params: Params) -> Params:
    """Return the parameters that are the function's own."""
    return {name: params[name] for name in term.own_parameters}


def model_fields_of(events: dict[str, Params]) -> tuple[str, ...]:
    """Return the fields of the model that a task's events change, each once."""
    terms = [(find_term("event", entry, params), params) for entry, params in events.items()]
    return _each_once(term.fields(**own(term, params)) for term, params in terms if term.fields)


def sensors_of(groups: dict[str, ObservationGroup]) -> tuple[str, ...]:
    """Return the sensors of the MJCF that a task observes, each once."""
    entries = [item for group in groups.values() for item in group.terms.items()]
    terms = [(find_term("observation", entry, params), params) for entry, params in entries]
    return _each_once(term.sensors(**own(term, params)) for term, params in terms if term.sensors)


def _each_once(names: Iterable[tuple[str, ...]]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for some in names for name in some))


class Binder:
    """Binds terms one by one, and then draws random numbers for all of them at once."""

    def __init__(self, step: Step) -> None:
        """Bind for the worlds and the state that `step` looks at."""
        self.step = step
        self._ranges: dict[str, list[tuple[float, float]]] = {}
        self._given: dict[str, dict[str, Tensor]] = {}

    def bind(self, kind: Kind, section: str, entry: str, params: Params) -> Bound:
        """Return the term of an entry, to be called with the step (an event with the step and a mask)."""
        term, world = find_term(kind, entry, params), self.step.world
        keywords, name = own(term, params), f"{section}.{entry}"
        more: list[Any] = []
        if term.memory:
            if term.memory_name in self.step.env.memory:
                raise UserError(f"{name}: there is a '{term.name}' already, and it can be there once")
            more.append(self.memory(term.memory_name or name, term.memory(world, **keywords)))
        if term.random:
            more.append(self.random(name, term.random(world, **keywords)))
        return lambda *arguments: term.function(*arguments, *more, **keywords)

    def memory(self, name: str, tensors: Mapping[str, Tensor]) -> Memory:
        """Make tensors a part of the state, under a name of their own."""
        self.step.env.memory[name] = dict(tensors)
        return self.step.env.memory[name]

    def random(self, name: str, ranges: Ranges) -> dict[str, Tensor]:
        """Return the random numbers of these ranges: zeros until `allocate` has been called, and drawn in every step after."""
        kept = {part: list(bounds) for part, bounds in ranges.items() if bounds}
        self._ranges |= {f"{name}.{part}": bounds for part, bounds in kept.items()}
        self._given[name] = {part: self.step.world.zeros(len(bounds)) for part, bounds in kept.items()}
        return self._given[name]

    def allocate(self) -> RandomNumbers:
        """Make room in the state for all random numbers of a step."""
        env, world = self.step.env, self.step.world
        env.random = world.zeros(RandomNumbers.count(self._ranges))
        numbers = RandomNumbers(self._ranges, env.random)
        for name in self._ranges:
            term, _, part = name.rpartition(".")
            self._given[term][part] = numbers.part(name)
        return numbers


class Events:
    """The events of a task, by when they happen."""

    def __init__(self, entries: dict[str, Params], binder: Binder) -> None:
        """Bind them."""
        self._bound: dict[str, list[Bound]] = {"once": [], "reset": [], "end": [], "step": []}
        self.change_the_model = False
        for entry, params in entries.items():
            term = find_term("event", entry, params)
            when = params.get("when", term.when[0])
            bound = binder.bind("event", "events", entry, params)
            if when == "interval":
                bound, when = _at_intervals(bound, f"events.{entry}.timer", params["interval"], binder), "step"
            self._bound[when].append(bound)
            self.change_the_model |= term.fields is not None and when == "reset"

    def happen(self, when: str, step: Step, mask: Tensor | None = None) -> None:
        """Let those of "once", "reset", "end" or "step" happen, in the worlds of `mask`, or in all."""
        everywhere = torch.ones_like(step.is_new) if mask is None else mask
        for bound in self._bound[when]:
            bound(step, everywhere)


def _at_intervals(bound: Bound, name: str, interval: tuple[float, float], binder: Binder) -> Bound:
    """Return an event that happens in a world whenever the time drawn for it is over."""
    timer = binder.memory(name, {"time_left": binder.step.world.zeros()})["time_left"]
    random = binder.random(name, {"interval": [interval]})

    def event(step: Step, mask: Tensor) -> None:
        bound(step, step.is_due(timer, random["interval"][:, 0]) & mask)

    return event
