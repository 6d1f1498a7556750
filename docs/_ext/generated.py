"""What the pages of the reference say of the code, read from the code as the site is built.

A line `<!-- generated: NAME -->` of a page becomes the Markdown that `PARTS[NAME]` returns.
"""

import inspect
import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any, Literal, get_args, get_origin

from sphinx.application import Sphinx

import telebip.mdp.term
import telebip.mdp.terms  # (enters telebip's terms)
from telebip import ROOT
from telebip.config import task_names
from telebip.config.schema import TaskConfig
from telebip.config.tree import Entry, read
from telebip.mdp.step import EnvState, World
from telebip.mdp.term import TERMS, Kind, ObservationGroup, Parameter, Term
from telebip.rollout import Rollout
from telebip.sim.base import SimState

BASE = "configs/telebip_flat.yaml"
TEXT = (ROOT / BASE).read_text(encoding="utf-8")
FLAT = read(TEXT, BASE)
OBSERVED = FLAT.value["observations"].value["policy"].value
KINDS: dict[Kind, str] = {"reward": "rewards", "termination": "terminations", "event": "events"}
COMMANDS = ("train", "play", "evaluate", "export", "reproduce", "sweep", "benchmark", "race", "gallery", "gpu_check")
NAMES = {float: "number", int: "whole number", str: "text", bool: "true, false"}
SIGNS = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}


def configuration() -> str:
    """Return a table of the fields of each section, terms aside."""
    sections: list[tuple[str, Any, Entry]] = [("", TaskConfig, FLAT)]
    for f in fields(TaskConfig):
        if is_dataclass(f.type):
            sections.append((f.name, f.type, FLAT.value[f.name]))
    return "\n".join(_section(*section) for section in sections) + _group()


def _section(name: str, schema: Any, entry: Entry) -> str:
    about = "Of the task itself." if schema is TaskConfig else (schema.__doc__ or "").splitlines()[0]
    rows = []
    for f in fields(schema):
        if not is_dataclass(f.type) and f.name not in (*KINDS.values(), "observations"):
            parameter = Parameter.of(f.type)
            rows.append(_row(f"{name}.{f.name}".lstrip("."), parameter, entry.value.get(f.name)))
    return "\n".join([f"\n## {name or 'Top level'}\n", about, "", *_table("field", rows)])


def _group() -> str:
    """Return the fields of a group of observations, beside its terms."""
    said = _comments(ObservationGroup)
    rows = [
        _row(f"observations.<group>.{f.name}", Parameter.of(f.type, f.default), said=said[f.name])
        for f in fields(ObservationGroup)
        if f.name != "terms"
    ]
    about = "Of a group, beside its [terms](terms.md#observations)."
    return "\n".join(["\n\n## observations\n", about, "", *_table("field", rows)])


def terms(kind: Kind) -> str:
    """Return what each term of a kind is, with a table of its parameters."""
    return "\n".join(_term(term) for term in TERMS[kind].values() if term.function.__module__.startswith("telebip."))


def observations() -> str:
    """Return what every observation may have, a table of all, and the parameters of those that have some of their own."""
    own = [term for term in TERMS["observation"].values() if term.function.__module__.startswith("telebip.")]
    said = dict(re.findall(r'^ +"(\w+)": Parameter\(.+\),  # (.+)$', inspect.getsource(telebip.mdp.term), re.MULTILINE))
    plain = next(term for term in own if not term.own_parameters)
    common = [_row(name, parameter, said=said[name]) for name, parameter in plain.parameters.items()]
    rows = []
    for term in own:
        noise, text = _in_base(term).get("noise"), " ".join(_docstring(term.function)[0].split("\n\n")[0].split())
        value = _shown(noise) if noise else "0" if term.name in OBSERVED else ""
        rows.append(f"| `{term.name}` | {value} | {_cell(term.unit)} | {_cell(text)} |")
    table = ["| observation | noise in `telebip_flat` | unit | what it is |", "|---|---|---|---|", *rows]
    return "\n".join([*_table("parameter", common), "", *table, *(_term(term) for term in own if term.own_parameters)])


def attributes(owner: type) -> str:
    """Return a table of a dataclass's fields, with the comments that stand beside them."""
    rows = (f"| `{name}` | {_cell(said)} |" for name, said in _comments(owner).items())
    return "\n".join(["| field | what it is |", "|---|---|", *rows])


def _comments(owner: type) -> dict[str, str]:
    """Return the comments that stand beside the fields of a dataclass."""
    return dict(re.findall(r"^    (\w+): [^#\n]+  # (.+)$", inspect.getsource(owner), re.MULTILINE))


def _term(term: Term) -> str:
    text, arguments = _docstring(term.function)
    given = _in_base(term)
    rows = [_row(name, p, given.get(name), arguments.get(name, "")) for name, p in term.parameters.items()]
    file, line = term.function.__module__.replace(".", "/"), inspect.getsourcelines(term.function)[1]
    notes = [f"Unit: {term.unit}."] * bool(term.unit) + [f"When: {', '.join(term.when)}."] * bool(term.when)
    where = " ".join([*notes, f"In `{file}.py`, line {line}."])
    return "\n".join([f"\n### {term.name}\n", text, "", where, "", *(_table("parameter", rows) if rows else [])])


def _in_base(term: Term) -> dict[str, Entry]:
    """Return the parameters that the base task gives a term; none where it has not got it."""
    if term.kind == "terrain":
        return {}
    entries = OBSERVED if term.kind == "observation" else FLAT.value[KINDS[term.kind]].value
    return entries[term.name].value if term.name in entries else {}


def _docstring(function: Callable[..., Any]) -> tuple[str, dict[str, str]]:
    """Return a docstring's text before its sections, and what it says of each argument."""
    text, _, rest = (inspect.getdoc(function) or "").partition("\nArgs:\n")
    arguments = re.split(r"\n\n\w+:\n", rest)[0]
    found = re.findall(r"^    (\w+): (.*(?:\n     .*)*)", arguments, re.MULTILINE)
    return re.split(r"\n(Returns|Raises):\n", text)[0].rstrip(), {name: " ".join(said.split()) for name, said in found}


def _table(what: str, rows: list[str]) -> list[str]:
    return [f"| {what} | `telebip_flat` | unit | may be | what it is |", "|---|---|---|---|---|", *rows]


def _row(name: str, parameter: Parameter, given: Entry | None = None, said: str = "") -> str:
    """Return a field's row: its value in the base task, else its default, and what its line there says of it."""
    unit, where = parameter.quantity.unit, ""
    if given:
        value, line = _shown(given), int(given.where.rpartition(":")[2])
        said = said or _comment(line)
        where = f"line {line}"
    else:
        value = "must be given" if parameter.default is ... else f"default {_yaml(parameter.default)}"
    said = said.removeprefix(f"{unit}; ") if unit else said
    cells = (f"`{name}`", value, unit, _bounds(parameter), f"{said} ({where})" if where and said else said or where)
    return "| " + " | ".join(map(_cell, cells)) + " |"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _shown(entry: Entry) -> str:
    if not entry.is_section:
        return _yaml(entry.value)
    return ", ".join(f"{name}: {_shown(part)}" for name, part in entry.value.items()) or "none"


def _yaml(value: Any) -> str:
    """Return a value as YAML has it."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_yaml, value))}]"
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def _comment(line: int) -> str:
    """Return the comment on a line of the base task."""
    return TEXT.splitlines()[line - 1].partition(" # ")[2].strip()


def _bounds(parameter: Parameter) -> str:
    """Return type and bounds of a field."""
    limits = [f"{sign} {limit:,}" for bound, sign in SIGNS.items() if (limit := getattr(parameter.quantity, bound)) is not None]
    return ", ".join([_type(parameter.type), *limits])


def _type(kind: Any) -> str:
    if kind in NAMES:
        return NAMES[kind]
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Literal:
        return ", ".join(map(str, arguments))
    if origin in (tuple, list):
        return f"{'low, high' if origin is tuple and len(arguments) == 2 else 'list'} of {_type(arguments[0])}s"
    if origin is dict:
        return f"name: {_type(arguments[1])}" if arguments[1] in NAMES else "name: parameters"
    return " or ".join("null" if part is type(None) else _type(part) for part in arguments)


def tasks() -> str:
    """Return the YAML of every task, the base of all first."""
    names = sorted(task_names(), key=lambda name: (name != "telebip_flat", name))
    files = {name: (ROOT / "configs" / f"{name}.yaml").read_text(encoding="utf-8") for name in names}
    return "\n".join(f"\n## {name}\n\n```yaml\n{text}```\n" for name, text in files.items())


def commands() -> str:
    """Return what `--help` says of every command."""
    environment = os.environ | {"COLUMNS": "100", "NO_COLOR": "1"}
    texts = []
    for name in COMMANDS:
        line = [sys.executable, str(ROOT / "scripts" / f"{name}.py"), "--help"]
        done = subprocess.run(line, capture_output=True, text=True, env=environment, check=True, cwd=ROOT)
        texts.append(f"\n## {name}\n\n```text\n{done.stdout.rstrip()}\n```\n")
    return "\n".join(texts)


PARTS: dict[str, Callable[[], str]] = {
    "configuration": configuration,
    "tasks": tasks,
    "commands": commands,
    "observations": observations,
    **{f"terms {kind}": lambda kind=kind: terms(kind) for kind in TERMS},
    **{f"fields {owner.__name__}": lambda owner=owner: attributes(owner) for owner in (SimState, World, EnvState, Rollout)},
}


def fill(app: Sphinx, page: str, source: list[str]) -> None:
    """Put the parts into a page as Sphinx reads it."""
    source[0] = re.sub(r"^<!-- generated: ([\w ]+) -->$", lambda m: PARTS[m[1]](), source[0], flags=re.MULTILINE)


def setup(app: Sphinx) -> dict[str, bool]:
    """Take part in the reading of pages."""
    app.connect("source-read", fill)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
