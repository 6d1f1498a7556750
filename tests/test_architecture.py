"""Imports point one way, the engine stays behind its boundary, and the README names files that exist."""

import ast
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest

import telebip
from telebip import ROOT

LAYERS = [
    {"telebip", "telebip.archive", "telebip.errors", "telebip.files", "telebip.graph", "telebip.math"},
    {"telebip.mdp.term"},  # what a term is, which whoever writes one, or checks a task, needs to know
    {"telebip.terrain"},
    {"telebip.robot", "telebip.robot_check", "telebip.robot_record"},
    {"telebip.sim"},
    {"telebip.mdp"},
    {"telebip.config"},
    {"telebip.env"},
    {"telebip.control"},
    {"telebip.rollout", "telebip.replay"},
    {"telebip.rl", "telebip.eval", "telebip.viz", "telebip.gym"},
    {"telebip.api"},
    {"telebip.tools"},
    {"telebip.cli"},
    {"scripts"},
]
"""From the bottom up: a file may import from its own layer and from those below it."""

FILES = sorted([*ROOT.glob("telebip/**/*.py"), *ROOT.glob("scripts/*.py")])


def module_name(file: Path) -> str:
    return ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def layer(module: str) -> int:
    """Return the layer of `telebip.sim.native`, say: that of `telebip.sim`, unless it has one of its own."""
    part = ".".join(module.split(".")[:2]) if module.startswith("telebip.") else module.split(".")[0]
    return next(i for i, parts in enumerate(LAYERS) if module in parts or (part in parts and not _has_its_own(module)))


def _has_its_own(module: str) -> bool:
    return any(module in parts for parts in LAYERS)


def imports(file: Path) -> Iterator[str]:
    """Yield the modules that a file imports, anywhere in it; but what `telebip` itself imports at its first use."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    if module_name(file) == "telebip":
        tree.body = [node for node in tree.body if not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0 and node.module, f"{file}: imports are absolute"
            package = ROOT / Path(*node.module.split("."))
            submodules = {path.stem for path in package.glob("*")} if node.module.startswith("telebip") else set()
            yield from (f"{node.module}.{alias.name}" if alias.name in submodules else node.module for alias in node.names)


def test_every_file_has_a_layer() -> None:
    assert len(FILES) > 25
    for file in FILES:
        layer(module_name(file))


def test_layers_are_found() -> None:
    assert layer("telebip.sim.native") == layer("telebip.sim") == 4
    assert layer("telebip.mdp.term") == 1 < layer("telebip.mdp.step") == layer("telebip.mdp") == 5
    assert layer("telebip") == 0
    with pytest.raises(StopIteration):
        layer("telebip.unheard_of")


@pytest.mark.parametrize("file", FILES, ids=module_name)
def test_imports_point_one_way(file: Path) -> None:
    own = layer(module_name(file))
    for module in imports(file):
        if module.split(".")[0] in ("telebip", "scripts"):
            assert layer(module) <= own, f"{module_name(file)} must not import {module}"


@pytest.mark.parametrize(
    ("engine", "owners"),
    [
        ("mujoco_warp", {"telebip.sim.warp", "telebip.tools.engines"}),  # tools measure the engine without the rest
        ("warp", {"telebip.sim.warp", "telebip.sim.ordering", "telebip.tools.engines"}),
        ("viser", {f"telebip.viz.browser.{name}" for name in ("charts", "scene", "server", "session", "training")}),
        ("rerun", {"telebip.viz.rerun", "telebip.viz.blueprint", "telebip.viz.live"}),
    ],
)
def test_an_engine_has_one_owner(engine: str, owners: set[str]) -> None:
    users = {module_name(file) for file in FILES if any(module.split(".")[0] == engine for module in imports(file))}
    assert users == owners


def test_the_names_of_telebip_are_those_that_a_type_checker_sees() -> None:
    tree = ast.parse((ROOT / "telebip" / "__init__.py").read_text(encoding="utf-8"))
    (seen,) = (node.body for node in tree.body if isinstance(node, ast.If))
    homes = {str(node.module): tuple(a.name for a in node.names) for node in seen if isinstance(node, ast.ImportFrom)}
    assert {name for names in homes.values() for name in names} == set(telebip.__all__)
    for module, names in homes.items():
        for name in names:
            assert getattr(telebip, name) is getattr(import_module(module), name)


def test_the_mdp_knows_no_physics_engine() -> None:
    for file in ROOT.glob("telebip/mdp/*.py"):
        assert not {"mujoco", "mujoco_warp", "warp"} & {module.split(".")[0] for module in imports(file)}, file


def test_paths_in_the_readme_exist() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    paths = set(re.findall(r"\b(?:scripts/\w+\.py|configs/\w+\.yaml|assets/\w[\w./]*\w)", text))
    assert {"scripts/train.py", "scripts/play.py", "configs/telebip_flat.yaml"} <= paths
    assert [path for path in sorted(paths) if not (ROOT / path).exists()] == []
