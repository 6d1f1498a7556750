"""`benchmark.py` as a user runs it, at toy sizes: what it prints and writes, never how fast it was."""

import json
import math
from pathlib import Path

import pytest
from processes import fresh
from test_commands_line import ran, refusal

from telebip.tools.benchmark import summary

BENCHMARK = "scripts/benchmark.py"
TINY = ("--device", "cpu", "--rounds", "2", "ppo.num_steps_per_env=3")


def test_the_table_and_its_json(tmp_path: Path) -> None:
    file, plot = tmp_path / "speed.json", tmp_path / "speed.png"
    text = ran(BENCHMARK, "--num-envs", "4", "8", "--stock", "--json", str(file), "--plot", str(plot), *TINY, run=fresh)
    measured, (header, *lines) = text.splitlines()[:2], text.splitlines()[3:6]
    assert measured == ["measured 4 worlds", "measured 8 worlds"]
    assert header.split()[:5] == ["worlds", "engine", "env", "env/engine", "collect"]
    assert [line.split()[0] for line in lines] == ["4", "8"]
    assert plot.stat().st_size > 10_000

    content = json.loads(file.read_text())
    assert (content["task"], content["policy"]) == ("telebip_flat", "telebip_flat")
    for row, num_envs in zip(content["rows"], (4, 8), strict=True):
        assert (row["backend"], row["device"], row["num_envs"]) == ("native", "cpu", num_envs)
        assert row["env_steps_per_round"] == 3 * num_envs
        assert len(row["rounds_s"]) == 2
        for seconds in row["rounds_s"]:
            assert set(seconds) == {"engine", "env", "collect", "learn", "stock_collect", "stock_learn"}
            assert all(value > 0.0 for value in seconds.values())
        for name, value in summary(row["rounds_s"], row["env_steps_per_round"]).items():
            assert math.isfinite(value)
            assert row[name] == pytest.approx(value)
        assert row["train_env_steps_per_s"] < min(row["collect_env_steps_per_s"], row["learn_env_steps_per_s"])
        storage = 3 * (33 + 6) * 4  # of observations and actions, three steps of float32
        assert storage < row["bytes_per_env"] < 10_000_000


@pytest.mark.slow
@pytest.mark.parametrize("task", ["telebip_slow", "configs/telebip_efficient.yaml"])
def test_a_policy_of_the_same_kind_walks_where_none_is_named(task: str) -> None:
    text = ran(BENCHMARK, "--task", task, "--num-envs", "4", *TINY)
    assert f"{task} on " in text


def test_a_failure_leaves_no_empty_file(tmp_path: Path) -> None:
    file = tmp_path / "speed.json"
    refusal(BENCHMARK, "--checkpoint", "nowhere", "--json", str(file))
    assert not file.exists()


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--num-envs", "0"], "--num-envs must be at least 1, got 0"),
        (["--num-envs", "many"], "invalid int value: 'many'"),
        (["--backend", "wrap"], "'wrap'"),
        (["--task", "telebip_slwo"], "did you mean 'telebip_slow'?"),
        (["--checkpoint", "nowhere"], "checkpoint 'nowhere' does not exist"),
        (["--checkpoint", "telebip_flat", "--task", "telebip_efficient"], "ppo.symmetry=none"),
        (["ppo.hidden_dims=[8]", "--num-envs", "4", "--device", "cpu"], "no weights that fit"),
        (["--plot", "speed.txt"], "speed.txt"),
        (["--json", "/nowhere/speed.json"], "cannot write to '/nowhere/speed.json'"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_mistake_is_one_line(arguments: list[str], named: str) -> None:
    assert named in refusal(BENCHMARK, *arguments)
