"""From a tree to a dataclass: every field is there, of its type and within its bounds, or an error names it and its place."""

import dataclasses
import itertools
import math
import numbers
import operator
import re
import types
import typing
from collections.abc import Container, Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union

from telebip.config.tree import Entry, Tree, entry_of, plain
from telebip.errors import UserError, nearest
from telebip.mdp.term import TERMS, Kind, ObservationGroup, Parameter, Params, Quantity, Term

KINDS: dict[str, Kind] = {
    "rewards": "reward",
    "terminations": "termination",
    "events": "event",
    "terrain.types": "terrain",
}
BOUNDS = {"gt": (">", operator.gt), "ge": (">=", operator.ge), "lt": ("<", operator.lt), "le": ("<=", operator.le)}
GROUP_FIELDS = {f.name: Parameter.of(f.type, f.default) for f in dataclasses.fields(ObservationGroup) if f.name != "terms"}


@dataclass(frozen=True)
class Validator:
    """Makes values of entries; `key` is an entry's dotted name."""

    missing: list[str] | None = None  # takes the names of entries whose function is unknown, which are then no errors

    def section(self, schema: type, entry: Entry, key: str = "") -> Any:
        """Return an object of a dataclass."""
        hints = typing.get_type_hints(schema, include_extras=True)
        defaults = {f.name: ... if f.default is dataclasses.MISSING else f.default for f in dataclasses.fields(schema)}
        return schema(**self.fields({name: Parameter.of(hints[name], defaults[name]) for name in defaults}, entry, key))

    def fields(self, parameters: dict[str, Parameter], entry: Entry, key: str) -> dict[str, Any]:
        """Return the values of a section's fields, complete."""
        prefix = f"{key}." if key else ""
        tree = _tree_of(entry, key, f"set one of its fields: {', '.join(parameters)}" if parameters else "{} is its only value")
        for name, child in tree.items():
            if name not in parameters:
                valid = nearest(prefix + name, [prefix + p for p in parameters]) if parameters else f"'{key}' has no fields"
                raise UserError(f"{child.where}: unknown field '{prefix}{name}'; {valid}")
        values = {}
        for name, parameter in parameters.items():
            child = tree.get(name, entry_of(plain(parameter.default), entry.where))
            if child.value is ...:
                raise UserError(f"{entry.where}: field '{prefix}{name}' has no value")
            values[name] = self.value(parameter, child, prefix + name)
        return values

    def value(self, parameter: Parameter, entry: Entry, key: str) -> Any:
        """Return the value of one field, whatever its type."""
        kind = parameter.type
        if dataclasses.is_dataclass(kind):
            return self.section(typing.cast(type, kind), entry, key)
        if kind == dict[str, Params]:
            return self.terms(KINDS[key], _tree_of(entry, key, "name its entries"), key)
        if kind == dict[str, ObservationGroup]:
            return self.groups(entry, key)
        if typing.get_origin(kind) in (Union, types.UnionType):
            if entry.value is None:
                return None
            inner = next(part for part in typing.get_args(kind) if part is not types.NoneType)
            return self.value(_within(parameter, inner), entry, key)
        if typing.get_origin(kind) is dict and entry.is_section:
            inner = _within(parameter, typing.get_args(kind)[1])
            parts = {name: part for name, part in entry.value.items() if not part.removes}
            return {name: self.value(inner, part, f"{key}.{name}") for name, part in parts.items()}
        if entry.is_section and entry.value:
            name, child = next(iter(entry.value.items()))
            raise UserError(f"{child.where}: unknown field '{key}.{name}'; '{key}' is a value")
        try:
            value = _convert(kind, entry.value)
        except (OverflowError, ValueError) as error:
            raise UserError(f"{entry.where}: {key}: {_describe(entry.value)} is not {_type_name(kind)}") from error
        _check_bounds(value, parameter.quantity, f"{entry.where}: {key}")
        return value

    def groups(self, entry: Entry, key: str) -> dict[str, ObservationGroup]:
        """Return the groups of observations."""
        tree, groups = _tree_of(entry, key, "name its groups"), {}
        for name, place, child in _kept(tree, key):
            terms = dict(_tree_of(child, place, "name its terms"))
            own = Entry({n: terms.pop(n) for n in GROUP_FIELDS if n in terms}, child.where)
            if all(part.removes for part in terms.values()):
                raise UserError(f"{child.where}: {place} has no terms; {nearest('', _known('observation'))}")
            known = self.terms("observation", terms, place, is_needed=name == "policy")
            group = ObservationGroup(known, **self.fields(GROUP_FIELDS, own, place))
            groups |= {name: group} if known else {}
        if "policy" not in groups:
            raise UserError(f"{entry.where}: {key} needs a group 'policy', which the policy sees")
        return groups

    def terms(self, kind: Kind, tree: Tree, key: str, is_needed: bool = False) -> dict[str, Params]:
        """Return entries of functions of a kind with their parameters, complete; `is_needed`: `missing` takes none of them."""
        functions, entries = _known(kind), {}
        for name, place, entry in _kept(tree, key, functions):
            given = dict(entry.value) if entry.is_section else {}
            alias = {"term": self.value(Parameter(str), given.pop("term"), f"{place}.term")} if "term" in given else {}
            function = alias.get("term", name)
            if function not in functions and self.missing is not None and not is_needed:
                self.missing.append(place)
                continue
            if function not in functions:
                valid = {*functions, *(GROUP_FIELDS if kind == "observation" else ())}
                if not alias:  # it may be a mistyped name of an entry
                    valid |= {other for other, part in tree.items() if part.is_section and "term" in part.value}
                raise UserError(f"{entry.where}: {place}: unknown {kind} '{function}'; {nearest(function, valid)}")
            own = Entry(given, entry.where) if entry.is_section else entry
            entries[name] = alias | self.fields(functions[function].parameters, own, place)
        return entries


def _known(kind: Kind) -> dict[str, Term]:
    """Return the functions of a kind by name, telebip's own and those that were entered elsewhere."""
    import telebip.mdp.terms  # noqa: F401  here, as it imports torch

    return TERMS[kind]


def _within(parameter: Parameter, kind: Any) -> Parameter:
    """Return what a part of a field may be: with its own unit and bounds, or the field's."""
    return Parameter.of(kind if typing.get_origin(kind) is Annotated else Annotated[kind, parameter.quantity])


def _tree_of(entry: Entry, key: str, advice: str) -> Tree:
    if not entry.is_section:
        raise UserError(f"{entry.where}: {key} is a section; {advice}")
    return entry.value


def _kept(tree: Tree, key: str, known: Container[str] = ()) -> Iterator[tuple[str, str, Entry]]:
    """Yield (name, dotted name, entry) of what no null removes; a null that has nothing to remove is a mistake."""
    for name, entry in tree.items():
        place = f"{key}.{name}"
        if not re.fullmatch(r"\w+", name):
            raise UserError(f"{entry.where}: {key}: '{name}' is no name; it must be of letters, digits and _")
        if entry.value is None and not entry.removes:
            others = [other for other, part in tree.items() if part.value is not None]
            advice = "{} takes the defaults" if name in known or not others else nearest(name, others)
            raise UserError(f"{entry.where}: {place} is null, which removes what the base has, and it has none; {advice}")
        if not entry.removes:
            yield name, place, entry


def _convert(kind: Any, value: Any) -> Any:
    """Return a value as an annotation's type; an `OverflowError` or a `ValueError` if it is none."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if kind in (int, float):
        return _number(kind, value)
    if origin in (list, tuple):
        is_valid = isinstance(value, list) and (origin is list or len(value) == len(arguments))
        value = origin(map(_convert, itertools.cycle(arguments), value)) if is_valid else value
    elif origin is Literal:
        is_valid = any(type(value) is type(valid) and value == valid for valid in arguments)
    elif kind in (bool, str):
        is_valid = type(value) is kind
    elif origin is dict:
        is_valid = False
    else:
        raise TypeError(f"a configuration can have no {kind}")
    if not is_valid:
        raise ValueError(value)
    return value


def _number(kind: type, value: Any) -> Any:
    """Return a number, or a text such as 1e-3, which YAML 1.1 takes for one, as `int` or `float`."""
    if isinstance(value, bool) or not isinstance(value, str | numbers.Real):
        raise ValueError(value)
    if kind is int and isinstance(value, numbers.Integral):
        return int(value)
    number = float(value)
    if kind is int and not number.is_integer():
        raise ValueError(value)
    return kind(number)


def _check_bounds(value: Any, quantity: Quantity, named: str) -> None:
    for entry in value if isinstance(value, tuple | list) else [value]:
        if isinstance(entry, float) and not math.isfinite(entry):
            raise UserError(f"{named} must be finite, got {entry}")
        for bound, (sign, holds) in BOUNDS.items():
            limit = getattr(quantity, bound)
            if limit is not None and not holds(entry, limit):
                raise UserError(f"{named} must be {sign} {limit}{' ' + quantity.unit if quantity.unit else ''}, got {entry}")
    if isinstance(value, tuple) and len(value) == 2 and value[0] > value[1]:
        raise UserError(f"{named} must be [low, high], got [{value[0]}, {value[1]}]")
    if value == []:
        raise UserError(f"{named} must not be empty")


def _describe(value: Any) -> str:
    text = repr(value) if isinstance(value, str) else str(value)
    return text if len(text) <= 40 else text[:37] + "..."


def _type_name(kind: Any, several: bool = False) -> str:
    """Return what a type is called in errors: one of it, or several."""
    one = {float: "a number", int: "a whole number", str: "a text", bool: "true or false"}
    if kind in one:
        return f"{one[kind].removeprefix('a ')}s" if several and kind is not bool else one[kind]
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        return "one of " + ", ".join(map(str, arguments))
    if origin is dict:
        return f"a mapping of names to {_type_name(arguments[1], several=True)}"
    entries = _type_name(arguments[0], several=True)
    if origin is tuple and len(arguments) == 2:
        return f"{'pairs' if several else 'a pair'} [low, high] of {entries}"
    return f"a list of {len(arguments)} {entries}" if origin is tuple else f"a list of {entries}"
