"""Robots with something broken at random: what the fuzz test runs, in processes of its own.

    python tests/broken_robots.py mjcf|urdf FOLDER FIRST LAST

prints a line for each mutant before and after it is tried.
"""

import copy
import random
import re
import sys
import traceback
import xml.etree.ElementTree as ET
from pathlib import Path

from telebip import ROOT

NUMBER = re.compile(r"-?\d+\.?\d*(?:e-?\d+)?")
TINY = ("--num-envs", "4", "--device", "cpu", "--max-iterations", "1", "ppo.num_steps_per_env=4", "ppo.hidden_dims=[8]")
TAGS = (
    "body",
    "geom",
    "joint",
    "site",
    "position",
    "motor",
    "touch",
    "freejoint",
    "key",
    "mesh",
    "box",
    "link",
    "inertial",
    "nonsense",
)
WORDS = (
    "",
    "nonsense",
    "trunk",
    "right_foot",
    "left_knee",
    "hinge",
    "slide",
    "ball",
    "free",
    "box",
    "mesh",
    "true",
    "prismatic",
    "fixed",
)


def mutate(root: ET.Element, rng: random.Random) -> str:
    """Change one thing of an XML tree, and return what."""
    parents = {child: parent for parent in root.iter() for child in parent}
    element = rng.choice(list(parents))
    names = sorted(element.attrib)
    name = rng.choice(names) if names else ""
    kind = rng.choice(
        (
            "drop",
            "drop",
            "rename",
            "retype",
            "scale",
            "scale",
            "scale",
            "scale",
            "nan",
            "huge",
            "huge",
            "swap",
            "lose",
            "double",
        )
    )
    if kind == "drop":
        parents[element].remove(element)
    elif kind == "double":
        parents[element].append(copy.deepcopy(element))
    elif kind == "retype":
        element.tag = rng.choice(TAGS)
    elif kind == "swap":
        other = rng.choice(list(parents))
        element.attrib, other.attrib = dict(other.attrib), dict(element.attrib)
    elif not name:
        return mutate(root, rng)
    elif kind == "lose":
        del element.attrib[name]
    elif kind == "rename":
        element.set(name, rng.choice(WORDS))
    else:
        numbers = NUMBER.findall(element.get(name, ""))
        if not numbers:
            return mutate(root, rng)
        old = rng.choice(numbers)
        factor = rng.choice((-1.0, 0.0, 1e-6, 0.1, 0.5, 2.0, 10.0, 1e3, 1e9))
        new = {
            "nan": "nan",
            "huge": rng.choice(("1e30", "1e308", "-1e30", "inf", "99999999")),
            "scale": f"{float(old) * factor:.6g}",
        }
        element.set(name, element.get(name, "").replace(old, new[kind], 1))
    return f"{kind} {element.tag} {name} {element.attrib}"


def mutant(shipped: Path, seed: int) -> tuple[str, str]:
    """Return the text of a shipped file with one to three mutations, and what they are."""
    rng, tree = random.Random(seed), ET.parse(shipped)
    done = [mutate(tree.getroot(), rng) for _ in range(rng.choice((1, 1, 1, 2, 3)))]
    return ET.tostring(tree.getroot(), encoding="unicode"), "; ".join(done)


def train_on(folder: Path, text: str) -> None:
    """Train for an iteration on a robot's MJCF, by the command."""
    from telebip.cli import train

    (folder / "robot.xml").write_text(text)
    train.main(["--task", "telebip_flat", "--log-dir", str(folder / "runs"), f"sim.robot={folder / 'robot.xml'}", *TINY])


def draw(folder: Path, text: str) -> None:
    """Record two steps of the shipped robot with another URDF."""
    from telebip.cli import play

    (folder / "robot.xml").write_text((ROOT / "assets" / "telebip.xml").read_text())
    (folder / "robot.urdf").write_text(text)
    robot = f"sim.robot={folder / 'robot.xml'}"
    play.main(["--agent", "zero", "--duration", "0.04", "--record", str(folder / "walk.rrd"), "--device", "cpu", robot])


def outcome(kind: str, folder: Path, seed: int) -> str:
    """Try one mutant, and return "runs", "refused: ..." or "BROKEN: ..."."""
    from telebip.errors import UserError

    shipped, attempt = {"mjcf": ("telebip.xml", train_on), "urdf": ("telebip.urdf", draw)}[kind]
    text, done = mutant(ROOT / "assets" / shipped, seed)
    try:
        attempt(folder, text)
    except UserError as error:
        message = str(error)
        return f"refused: {message}" if message and "\n" not in message else f"BROKEN: {message!r} after {done}"
    except BaseException:
        return f"BROKEN: {traceback.format_exc()} after {done}".replace("\n", " | ")
    return "runs"


if __name__ == "__main__":
    import contextlib
    import os

    kind, folder, first, last = sys.argv[1], Path(sys.argv[2]).resolve(), int(sys.argv[3]), int(sys.argv[4])
    os.chdir(folder)
    for seed in range(first, last):
        print(f"{seed} tried", flush=True)
        with Path(os.devnull).open("w") as nowhere, contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere):
            result = outcome(kind, folder, seed)
        print(f"{seed} {result}", flush=True)
