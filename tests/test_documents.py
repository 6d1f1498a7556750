"""The documents: their code runs, their commands are commands, their links lead to files, and the reference has every field."""

import importlib
import re
import shlex
import sys
from argparse import Namespace
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path

import pytest
import torch

import telebip
import telebip.mdp.terms  # (so that all terms are there before the fixture below looks)
from telebip import ROOT
from telebip.cli import export
from telebip.cli.common import Parser
from telebip.config.schema import TaskConfig
from telebip.mdp.term import TERMS
from telebip.rl import learner

PAGES = [*(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")), *sorted((ROOT / "docs").rglob("*.md"))]


def name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def blocks(page: Path, language: str) -> list[str]:
    """Return a page's code blocks in a language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def calls(page: Path) -> Iterator[tuple[str, ...]]:
    """Yield the calls of telebip's scripts in a page's blocks without a language: the script's name, then its arguments."""
    for line in "".join(blocks(page, "")).replace("\\\n", " ").splitlines():
        for part in line.split("&&"):
            if found := re.search(r"scripts/(\w+)\.py(.*)", part):
                yield found[1], *shlex.split(found[2], comments=True)


CALLS = sorted({call for page in PAGES for call in calls(page)})
PYTHON = [page for page in PAGES if blocks(page, "python") and page.name != "extending.md"]  # tests/test_extending.py has that


@pytest.fixture(autouse=True)
def what_pages_enter_is_taken_out_again(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    before = {kind: dict(terms) for kind, terms in TERMS.items()}
    monkeypatch.setattr(learner, "ALGORITHMS", dict(learner.ALGORITHMS))
    yield
    for kind, terms in TERMS.items():
        terms.clear()
        terms.update(before[kind])


class Parsed(Exception):
    """Ends a command once it has understood its arguments."""


@pytest.mark.parametrize("call", CALLS, ids=" ".join)
def test_the_commands_of_the_pages_are_understood(call: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    script, *arguments = call
    parse, seen = Parser.parse, []

    def parse_and_end(self: Parser, argv: list[str]) -> Namespace:
        seen.append(parse(self, argv))
        raise Parsed

    monkeypatch.setattr(Parser, "parse", parse_and_end)
    with pytest.raises(Parsed):
        importlib.import_module(f"telebip.cli.{script}").main(arguments)
    given = vars(seen[0])
    for key in ("checkpoint", "task"):
        if (given.get(key) or "").startswith("assets/"):
            assert (ROOT / given[key]).exists()
    if script == "train" and (given["task"] or "").startswith("telebip_"):
        telebip.load_task(given["task"], given["overrides"])


def test_enough_commands_are_found() -> None:
    assert {script for script, *_ in CALLS} >= {"train", "play", "evaluate", "export", "benchmark", "sweep", "gpu_check"}
    assert len(CALLS) > 40


@pytest.mark.parametrize("page", PYTHON, ids=name)
def test_the_python_of_the_pages_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    env = telebip.make("telebip_flat", num_envs=2)
    names = {"__name__": "page", "env": env, "actions": torch.zeros(2, env.num_actions)}
    if page.name == "export.md":
        export.main(["--checkpoint", str(ROOT / "assets" / "policies" / "telebip_efficient"), "--out", "policy.onnx"])
    for block in blocks(page, "python"):
        exec(block.replace("range(500)", "range(3)").replace("num_envs=64", "num_envs=4"), names)


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_lead_to_files(page: Path) -> None:
    text = re.sub(r"```.*?```|`[^`]*`", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    links = [link.partition("#")[0] for link in re.findall(r"\]\(([^)\s]+)\)", text) if "://" not in link]
    assert [link for link in links if link and not (page.parent / link).exists()] == []


def test_the_reference_has_every_field_and_term(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("sphinx")
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "_ext"))
    generated = importlib.import_module("generated")
    tables = generated.configuration()
    assert "| `commands.heading_gain` | 1.0 | 1/s | number, ≥ 0 | adds clip(gain * heading error)" in tables
    for section in (f for f in fields(TaskConfig) if is_dataclass(f.type)):
        for field in fields(section.type):  # type: ignore[arg-type]
            assert f"| `{section.name}.{field.name}` |" in tables
    for kind, terms in TERMS.items():
        text = generated.terms(kind)
        for term, about in terms.items():
            assert f"\n### {term}\n" in text
            assert all(f"| `{parameter}` |" in text.partition(f"\n### {term}\n")[2] for parameter in about.parameters)
    foot = generated.terms("reward").partition("\n### foot\n")[2]
    assert "| `cap` | 100.0 | body weights | number, > 0 | force that counts at most, in body weights" in foot
    del sys.modules["generated"]
