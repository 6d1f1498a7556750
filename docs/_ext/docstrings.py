"""telebip's docstrings, which are plain text, as the reStructuredText that autodoc reads."""

import re
from typing import Any

from sphinx.application import Sphinx

SECTION = re.compile(r"(Args|Returns|Raises|Yields):$")


def to_rst(lines: list[str]) -> list[str]:
    """Return a docstring with its indented blocks, equations and code, as literal blocks, and with its signs escaped."""
    out: list[str] = []
    is_literal = in_section = False
    for line in lines:
        in_section |= bool(SECTION.match(line))
        is_indented = line.startswith("    ") and not in_section
        if is_indented and not is_literal and out and not out[-1].strip():
            is_literal = True
            out += [".. code-block:: text", ""]
        elif line.strip() and not is_indented:
            is_literal = False
        out.append(line if is_literal else escaped(line))
    return out


def escaped(line: str) -> str:
    """Return a line with code marked as reStructuredText has it, and without what else it would take for markup."""
    parts = re.split(r"(`[^`]+`)", line)
    return "".join(
        f"`{part}`" if i % 2 else re.sub(r"([\\*|])|(_)(?!\w)", lambda m: f"\\{m[0]}", part) for i, part in enumerate(parts)
    )


def process(app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Rewrite a docstring in place, before napoleon reads its sections."""
    lines[:] = to_rst(lines)
    if what in ("property", "attribute"):  # napoleon takes what stands before a colon of the first line for a type
        lines.insert(0, "")


def setup(app: Sphinx) -> dict[str, bool]:
    """Take part in autodoc."""
    app.connect("autodoc-process-docstring", process, priority=100)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
