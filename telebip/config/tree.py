"""YAML as a tree whose entries know where they stand, and how one tree is laid over another."""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import yaml

from telebip.errors import UserError
from telebip.mdp.term import ObservationGroup

Tree = dict[str, "Entry"]


@dataclass(frozen=True)
class Entry:
    """A value, or a section of further entries."""

    value: Any  # a `Tree` where it is a section
    where: str  # "file:line" or "override '...'", to name in errors
    removes: bool = False  # whether it is a null that stands over something

    @property
    def is_section(self) -> bool:
        """Whether its value is a `Tree`: no YAML value is a dictionary otherwise."""
        return isinstance(self.value, dict)


def read(text: str, source: str, line_by_line: bool = True) -> Entry:
    """Return YAML text as an entry; places are lines of `source`, or `source` itself.

    Raises:
        UserError: the text is not YAML.
    """

    def place(node: yaml.Node) -> str:
        return f"{source}:{node.start_mark.line + 1}" if line_by_line else source

    def entry(node: yaml.Node, where: str, above: tuple[yaml.Node, ...] = ()) -> Entry:
        if node.tag != "tag:yaml.org,2002:map":
            value = loader.construct_document(node)
            str(value)  # fails for an integer of so many digits that no error could quote it
            return Entry(value, where)
        if node in above:
            raise UserError(f"{where}: a section contains itself")
        tree: Tree = {}
        for key_node, value_node in node.value:
            name, where_key = str(key_node.value), place(key_node)
            if name in tree:
                raise UserError(f"{where_key}: field '{name}' stands there twice")
            tree[name] = entry(value_node, where_key, (*above, node))
        return Entry(tree, where)

    try:
        loader = yaml.SafeLoader(text)
        node = loader.get_single_node()
        return entry(node, source) if node else Entry(None, source)
    except UserError:
        raise
    except Exception as error:  # PyYAML lets more than YAMLError escape, as from `!!int x`
        raise UserError(f"{source}: not valid YAML: {error}") from error


def merge(base: Tree, layer: Tree, is_whole: Callable[[str], bool], prefix: str = "") -> Tree:
    """Lay one tree over another: sections are merged entry by entry, and other entries replaced.

    A section is replaced as a whole where `is_whole(dotted key)` holds and where its `term` names another function.
    """
    merged = dict(base)
    for name, entry in layer.items():
        below, key = base.get(name), f"{prefix}{name}"
        if below and below.is_section and entry.is_section and not (is_whole(key) or _is_of_another_term(entry, below, name)):
            entry = Entry(merge(below.value, entry.value, is_whole, f"{key}."), entry.where)
        elif entry.value is None:
            entry = Entry(None, entry.where, removes=below is not None)
        merged[name] = entry
    return merged


def _is_of_another_term(entry: Entry, below: Entry, name: str) -> bool:
    """Whether an entry says `term: function` and the one below it is not that function's, by its `term` or its name."""
    function = below.value["term"].value if "term" in below.value else name
    return "term" in entry.value and entry.value["term"].value != function


def plain(value: Any) -> Any:
    """Return a configuration as dictionaries, lists and values, as YAML has them."""
    if isinstance(value, ObservationGroup):
        own = {f.name: getattr(value, f.name) for f in dataclasses.fields(value) if f.name != "terms"}
        return plain({**value.terms, **own})
    if dataclasses.is_dataclass(value):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(name): plain(entry) for name, entry in value.items()}
    return [plain(entry) for entry in value] if isinstance(value, list | tuple) else value


def entry_of(value: Any, where: str) -> Entry:
    """Return what `plain` returns as an entry; `None` removes, as nothing is laid over it any more."""
    if isinstance(value, dict):
        return Entry({name: entry_of(part, where) for name, part in value.items()}, where)
    return Entry(value, where, removes=value is None)


class Dumper(yaml.SafeDumper):
    """Writes a list in one line."""


Dumper.add_representer(list, lambda dumper, value: dumper.represent_sequence("tag:yaml.org,2002:seq", value, flow_style=True))
