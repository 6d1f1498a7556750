"""`sweep.py` as a user runs it, at toy sizes."""

import json
from pathlib import Path

import pytest
from test_commands_line import ran, refusal

SWEEP = "scripts/sweep.py"
TINY = ("num_envs=8", "ppo.num_steps_per_env=4", "ppo.hidden_dims=[8]", "ppo.max_iterations=2", "seed=3")


def test_settings_times_seeds(tmp_path: Path) -> None:
    file, plot = tmp_path / "sweep.json", tmp_path / "sweep.png"
    settings = ("--setting", "kl 0.02: ppo.desired_kl=0.02", "--setting", "as it is:")
    text = ran(SWEEP, "--seeds", "2", *settings, "--json", str(file), "--plot", str(plot), "--device", "cpu", *TINY)
    lines = text.splitlines()
    assert lines[:4] == [f"{label}, seed {seed}: does not walk" for label in ("kl 0.02", "as it is") for seed in (3, 4)]
    assert lines[5].startswith("telebip_quick on ") and lines[5].endswith("2 seeds: median (worst)")
    assert lines[6:] == ["  kl 0.02: does not walk", "  as it is: does not walk", f"wrote {plot}"]
    assert plot.stat().st_size > 10_000
    content = json.loads(file.read_text())
    assert content["settings"] == ["kl 0.02: ppo.desired_kl=0.02", "as it is:"]
    assert [(label, len(results), len(results[0]["samples"])) for label, results in content["results"].items()] == [
        ("kl 0.02", 2, 2),
        ("as it is", 2, 2),
    ]
    assert content["results"]["kl 0.02"][0]["learning_rate"] != content["results"]["as it is"][0]["learning_rate"]


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--seeds", "0"], "--seeds must be at least 1, got 0"),
        (["--task", "telebip_quikc"], "did you mean 'telebip_quick'?"),
        (["--setting", "ppo.desired_kl=0.02"], "--setting is 'LABEL: key.path=value ...', got 'ppo.desired_kl=0.02'"),
        (["--setting", "a: ppo.desired_lk=0.02"], "did you mean 'ppo.desired_kl'?"),
        (["--setting", "a: seed=1", "--setting", "a: seed=2"], "two settings have the same label"),
        (["--plot", "sweep.txt"], "sweep.txt"),
    ],
    ids=lambda value: " ".join(value[:2]) if isinstance(value, list) else "",
)
def test_a_mistake_is_one_line(arguments: list[str], named: str) -> None:
    assert named in refusal(SWEEP, *arguments)
