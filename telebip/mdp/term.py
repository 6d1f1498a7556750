"""What a term is: one function of the step, and what stands beside it in its decorator.

    @reward
    def torque(step: Step, *, k: Annotated[float, Quantity(le=0)]) -> Tensor: ...

The keyword-only parameters are the term's configuration: their annotations hold type, unit and bounds, and YAML gives the
values. What a term remembers from step to step it declares as `memory`, and the random numbers that it needs as `random`; both
are functions of a `World` and of the term's parameters, and the term is called with what they made:

    term(step, [mask of an event], [memory], [random], **parameters)

`memory` returns a dictionary of tensors, which live in `EnvState`: they are reset to zero with their world, saved and restored.
`random` returns a dictionary of lists of (low, high): one uniform number per world for each, drawn anew in every step.
"""

import inspect
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from telebip.errors import UserError, nearest

Params = dict[str, Any]
"""A term's parameters by name, as YAML gives them; the key `term` names the function where the entry has another name."""

Kind = Literal["observation", "reward", "termination", "event", "terrain"]
When = Literal["reset", "end", "once", "interval", "step"]
Mirror = Literal["joints", "polar", "axial", "quat", "command", "feet", "same", "none"]
"""How an observation is mirrored at the plane y = 0, see `telebip.mdp.mirror`."""
Image = tuple[list[int], list[float]]
"""A mirror image in numbers: which entry takes each place, and its sign."""


@dataclass(frozen=True)
class Quantity:
    """Unit and bounds of a number, in an annotation: `Annotated[float, Quantity("m", gt=0)]`. They hold for every entry."""

    unit: str = ""
    gt: float | None = None
    ge: float | None = None
    lt: float | None = None
    le: float | None = None
    nominal: float | None = None  # of what an event randomises: the value that changes nothing


@dataclass(frozen=True)
class Parameter:
    """What a configuration field may be."""

    type: Any  # float, int, bool, str, a Literal, tuple[float, float], list[int], list[str], dict[str, float], or None with |
    quantity: Quantity = Quantity()
    default: Any = ...  # `...` where it has none

    @staticmethod
    def of(annotation: Any, default: Any = ...) -> "Parameter":
        """Read an annotation, `Annotated` with a `Quantity` or not."""
        if typing.get_origin(annotation) is Annotated:
            plain, *notes = typing.get_args(annotation)
            return Parameter(plain, next((note for note in notes if isinstance(note, Quantity)), Quantity()), default)
        return Parameter(annotation, Quantity(), default)


@dataclass(frozen=True)
class Term:
    """A function that a task may name, with what its decorator says of it."""

    kind: Kind
    function: Callable[..., Any]
    memory: Callable[..., Mapping[str, Any]] | None = None  # (world, **parameters) -> tensors
    memory_name: str = ""  # under which others find it in `EnvState.memory`; else it is the entry's own
    random: Callable[..., Mapping[str, list[tuple[float, float]]]] | None = None  # (world, **parameters) -> ranges
    unit: str = ""  # of an observation
    mirror: Mirror | Callable[..., Mirror | Image] = "none"  # of an observation, or (**parameters) -> that
    sensors: Callable[..., tuple[str, ...]] | None = None  # of an observation: (**parameters) -> sensors of the MJCF
    when: tuple[When, ...] = ()  # of an event: when it may happen, the usual one first
    is_sensed: bool = True  # of an observation: whether a sensor measures it, so that a frame may get lost
    fields: Callable[..., tuple[str, ...]] | None = None  # of an event: (**parameters) -> fields of the model that it writes
    is_disturbance: bool = False  # of an event: left out where a policy is measured undisturbed
    own_parameters: dict[str, Parameter] = field(init=False)  # of the function
    parameters: dict[str, Parameter] = field(init=False)  # and those that every term of the kind has

    def __post_init__(self) -> None:
        """Read the parameters from the signature."""
        keywords = [p for p in inspect.signature(self.function).parameters.values() if p.kind is p.KEYWORD_ONLY]
        names = self.function.__globals__
        own = {
            p.name: Parameter.of(
                eval(p.annotation, names) if isinstance(p.annotation, str) else p.annotation,
                ... if p.default is p.empty else p.default,
            )
            for p in keywords
        }
        reserved = {
            "term",
            *_COMMON[self.kind],
            *(("when", "interval") if len(self.when) > 1 or "interval" in self.when else ()),
        }
        if taken := sorted(reserved & own.keys()):
            raise ValueError(
                f"{self.kind} '{self.name}': every {self.kind} may have '{taken[0]}' already; rename the parameter"
            )
        object.__setattr__(self, "own_parameters", own)
        object.__setattr__(self, "parameters", own | _COMMON[self.kind] | _when(self.when))

    @property
    def name(self) -> str:
        """The function's name, by which YAML calls it."""
        return self.function.__name__


_COMMON: dict[Kind, dict[str, Parameter]] = {
    "observation": {
        "noise": Parameter(float, Quantity(ge=0), 0.0),  # amplitude of the uniform noise, in the term's unit
        "delay": Parameter(tuple[int, int], Quantity("policy steps", ge=0, le=100), (0, 0)),  # on top of the group's
    },
    "reward": {},
    "termination": {},
    "event": {},
    "terrain": {},
}
"""Parameters that every term of a kind has; they are not passed to its function."""


def _when(when: tuple[When, ...]) -> dict[str, Parameter]:
    """Return the parameters that tell when an event happens."""
    own = {"when": Parameter(Literal[when], Quantity(), when[0])} if len(when) > 1 else {}  # type: ignore[valid-type]
    if "interval" in when:
        own["interval"] = Parameter(tuple[float, float], Quantity("s", gt=0), ... if len(when) == 1 else (1.0, 1.0))
    return own


@dataclass(frozen=True)
class ObservationGroup:
    """One vector that somebody sees: terms in their order, and what happens to them together.

    In YAML the terms stand beside the other fields: `policy: {joint_pos: {noise: 0.005}, joint_vel: {}, history: 5}`.
    """

    terms: dict[str, Params]
    history: Annotated[int, Quantity("policy steps", ge=1, le=1000)] = 1  # how many of the latest are seen, the newest first
    delay: Annotated[tuple[int, int], Quantity("policy steps", ge=0, le=100)] = (0, 0)  # uniform per world and episode
    noise: bool = True  # whether it sees what the sensors tell, with the terms' noise and the events' errors, or the truth
    loss: Annotated[float, Quantity(ge=0, le=1)] = 0.0  # share of frames whose sensors' part does not come: the last one holds


TERMS: dict[Kind, dict[str, Term]] = {"observation": {}, "reward": {}, "termination": {}, "event": {}, "terrain": {}}
"""Every term that there is, by kind and name; the decorators below enter them."""


def find(kind: Kind, name: str) -> Term:
    """Return a term by its name.

    Raises:
        UserError: there is none.
    """
    if name not in TERMS[kind]:
        raise UserError(f"unknown {kind} '{name}'; {nearest(name, TERMS[kind])}")
    return TERMS[kind][name]


def reward(function: Callable[..., Any] | None = None, /, **about: Any) -> Any:
    """Let tasks name a function (step, **parameters) -> (num_envs,) in their `rewards`; the environment sums them all."""
    return _enter("reward", function, about)


def termination(function: Callable[..., Any] | None = None, /, **about: Any) -> Any:
    """Let tasks name a function (step, **parameters) -> bool (num_envs,) in their `terminations`."""
    return _enter("termination", function, about)


def observation(function: Callable[..., Any] | None = None, /, **about: Any) -> Any:
    """Let tasks name a function (step, **parameters) -> (num_envs, size) in a group of their `observations`.

    `unit` tells what its numbers are, `mirror` how they are mirrored (see `telebip.mdp.mirror`), for `ppo.symmetry`. What the
    policy's computer knows by itself has `is_sensed=False`.
    """
    return _enter("observation", function, about)


def event(*when: When, **about: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Let tasks name a function (step, mask, **parameters) -> None in their `events`; it changes worlds in place.

    Args:
        when: "reset", in the worlds that begin an episode; "end", in those that end one, before anything is reset; "once",
            in all worlds, as they are made; "interval", in the worlds whose time has come, every `interval` [s] of a range;
            "step", in all worlds, before each step. With several, the YAML's `when` chooses.
        about: `memory`, `memory_name`, `random`, `fields` and `is_disturbance` of `Term`.
    """
    return lambda function: _enter("event", function, {"when": when, "is_disturbance": True, **about})


def terrain(function: Callable[..., Any] | None = None, /, **about: Any) -> Any:
    """Let tasks name a function (tile, **parameters) -> heights in their `terrain.types`, see `telebip.terrain`."""
    return _enter("terrain", function, about)


def _enter(kind: Kind, function: Callable[..., Any] | None, about: dict[str, Any]) -> Any:
    if function is None:
        return lambda function: _enter(kind, function, about)
    known = TERMS[kind].get(function.__name__)
    if kind == "observation" and function.__name__ in ("history", "delay", "loss", "noise"):
        raise ValueError(f"an observation cannot be called '{function.__name__}', as a group has a field of this name")
    if known and (known.function.__module__, known.function.__qualname__) != (function.__module__, function.__qualname__):
        raise ValueError(f"there is a {kind} called '{function.__name__}' already, in {known.function.__module__}")
    TERMS[kind][function.__name__] = Term(kind, function, **about)
    return function
