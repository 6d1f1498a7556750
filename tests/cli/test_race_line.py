"""`race.py` as a user runs it, at toy sizes: what it prints and writes, never who won."""

import json
import re
from pathlib import Path

import pytest
from test_commands_line import ran, refusal

RACE = "scripts/race.py"
TINY = ("--device", "cpu", "num_envs=8", "ppo.num_steps_per_env=10", "ppo.hidden_dims=[8]", "episode.length=0.2", "seed=3")


@pytest.mark.parametrize(("precision", "arithmetic"), [("never", "float32"), ("always", "bfloat16")])
def test_two_seeds(tmp_path: Path, precision: str, arithmetic: str) -> None:
    file, plot = tmp_path / "race.json", tmp_path / "race.png"
    text = ran(
        RACE,
        "--samples",
        "2e2",
        "--seeds",
        "2",
        "--json",
        str(file),
        "--plot",
        str(plot),
        *TINY,
        f"ppo.mixed_precision={precision}",
    )
    first, second, about, both, *wrote = text.splitlines()
    number = r"-?\d+\.\d\d"
    assert re.fullmatch(f"seed 3: return {number}, rsl-rl's {number}; {number} times as fast", first)
    assert second.startswith("seed 4: ")
    assert about.startswith(f"telebip_flat, 8 worlds, networks in {arithmetic}, 240 samples on ")
    meet = r"\((they overlap|they do not overlap)\)"
    assert re.fullmatch(
        f"2 seeds: return {number} to {number}, rsl-rl's {number} to {number} {meet}; {number} times as fast", both
    )
    assert wrote == [f"wrote {file}", f"wrote {plot}"]
    assert plot.stat().st_size > 10_000

    content = json.loads(file.read_text())
    assert (content["task"], content["num_envs"], content["verdict"]["samples"]) == ("telebip_flat", 8, 240)
    assert [(race["seed"], race["arithmetic"]) for race in content["races"]] == [(3, arithmetic), (4, arithmetic)]


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--samples", "0"], "--samples must be at least 1, got 0"),
        (["--samples", "inf"], "'inf'"),
        (["--seeds", "0"], "--seeds must be at least 1, got 0"),
        (["--task", "telebip_slwo"], "did you mean 'telebip_slow'?"),
        (["--plot", "race.txt"], "race.txt"),
        (["--samples", "1", "--seeds", "1", *TINY, "ppo.num_steps_per_env=1", "episode.length=10"], "no episode has ended"),
    ],
    ids=lambda value: " ".join(value[:2]) if isinstance(value, list) else "",
)
def test_a_mistake_is_one_line(arguments: list[str], named: str) -> None:
    assert named in refusal(RACE, *arguments)
