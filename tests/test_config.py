"""Loading a task: what the shipped files say, what an override changes, and that every mistake is one line that names it."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from telebip.config import CONFIGS, TaskConfig, load_task, parse_config, task_names, to_yaml
from telebip.errors import UserError

FLAT = load_task("telebip_flat")
CHILDREN = ("telebip_backward", "telebip_efficient", "telebip_fast", "telebip_robust", "telebip_slow")


def leaves(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested mappings to dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        flat |= leaves(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat


def error_of(task: str | TaskConfig, *overrides: str) -> str:
    with pytest.raises(UserError) as caught:
        load_task(task, overrides)
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    return message


def test_the_published_tasks_are_these() -> None:
    assert task_names() == sorted([*CHILDREN, "telebip_flat"])


def test_telebip_flat_holds_the_numbers_of_the_article() -> None:
    cfg = FLAT
    assert (cfg.num_envs, cfg.ppo.num_steps_per_env, cfg.ppo.num_learning_epochs, cfg.ppo.num_mini_batches) == (4096, 20, 4, 4)
    assert (cfg.ppo.learning_rate, cfg.ppo.gamma, cfg.ppo.lam) == (2e-4, 0.99, 0.95)
    assert (cfg.ppo.hidden_dims, cfg.ppo.activation) == ([512, 256, 128], "elu")
    assert (cfg.reward.cmd.k_xy, cfg.reward.cmd.sigma_xy, cfg.reward.cmd.k_w, cfg.reward.cmd.sigma_w) == (0.2, 0.3, 0.15, 0.2)
    assert (cfg.reward.foot.k_foot, cfg.reward.termination.k_termination) == (0.1, -1.0)
    assert (cfg.gait.period, cfg.episode.min_hip_height, cfg.sim.decimation) == (0.5, 0.4, 4)


@pytest.mark.parametrize(
    ("name", "lin_vel_x"),
    [("telebip_slow", (0.4, 0.7)), ("telebip_fast", (0.7, 1.0)), ("telebip_backward", (-0.5, -0.2))],
)
def test_child_task_is_telebip_flat_at_another_speed(name: str, lin_vel_x: tuple[float, float]) -> None:
    assert load_task(name) == dataclasses.replace(FLAT, command=dataclasses.replace(FLAT.command, lin_vel_x=lin_vel_x))


@pytest.mark.parametrize("name", CHILDREN)
def test_child_file_states_exactly_what_differs_from_its_base(name: str) -> None:
    stated = yaml.safe_load((CONFIGS / f"{name}.yaml").read_text())
    base = leaves(dataclasses.asdict(load_task(stated.pop("base"))))
    child = leaves(dataclasses.asdict(load_task(name)))
    assert {key for key in child if child[key] != base[key]} == set(leaves(stated))


def test_task_is_loaded_by_path_as_by_name() -> None:
    assert load_task(str(CONFIGS / "telebip_flat.yaml")) == FLAT


def test_yaml_round_trip_keeps_every_field() -> None:
    config = load_task(FLAT, ["gait.period=0.6", "ppo.hidden_dims=[64, 32]", "reward.foot.first=oldest", "seed=4294967295"])
    assert parse_config(to_yaml(config), "a run") == config


def test_overrides_set_exactly_their_fields() -> None:
    overrides = ["seed=7", "command.lin_vel_x=[0.5, 0.5]", "disturbance.push.enabled=false", "ppo.learning_rate=1e-3"]
    before, after = leaves(dataclasses.asdict(FLAT)), leaves(dataclasses.asdict(load_task(FLAT, overrides)))
    changed = {key: after[key] for key in after if after[key] != before[key]}
    assert changed == {
        "seed": 7,
        "command.lin_vel_x": (0.5, 0.5),
        "disturbance.push.enabled": False,
        "ppo.learning_rate": 0.001,
    }


def test_the_last_override_of_a_field_wins() -> None:
    assert load_task(FLAT, ["seed=2", "seed=3"]).seed == 3


def test_loading_does_not_change_the_configuration_it_was_given() -> None:
    load_task(FLAT, ["gait.period=0.9", "ppo.hidden_dims=[8]"])
    assert (FLAT.gait.period, FLAT.ppo.hidden_dims) == (0.5, [512, 256, 128])


def test_whole_number_is_accepted_where_a_number_is_asked_for() -> None:
    period = load_task(FLAT, ["gait.period=1"]).gait.period
    assert period == 1.0
    assert isinstance(period, float)


@pytest.mark.parametrize(
    ("override", "parts"),
    [
        ("reward.foot.gama=0.9", ["unknown field 'reward.foot.gama'", "did you mean 'reward.foot.gamma'?"]),
        ("comand.lin_vel_x=[0, 1]", ["unknown field 'comand.lin_vel_x'", "did you mean 'command'?"]),
        ("zzz=1", ["unknown field 'zzz'", "valid: action, command, disturbance, episode, gait, num_envs, ppo, reward"]),
        ("gait.period.x=2", ["unknown field 'gait.period.x'", "'gait.period' is a value"]),
        ("seed=x", ["seed", "'x' is not a whole number"]),
        ("seed=1.5", ["seed", "1.5 is not a whole number"]),
        ("seed=true", ["seed", "True is not a whole number"]),
        ("gait.period=fast", ["gait.period", "'fast' is not a number"]),
        ("gait.period=", ["gait.period", "None is not a number"]),
        ("disturbance.push.enabled=maybe", ["disturbance.push.enabled", "'maybe' is not true or false"]),
        ("command.lin_vel_x=0.5", ["command.lin_vel_x", "0.5 is not a pair [low, high] of numbers"]),
        ("command.lin_vel_x=[1]", ["command.lin_vel_x", "[1] is not a pair [low, high] of numbers"]),
        ("command.lin_vel_x=[0, 1, 2]", ["command.lin_vel_x", "[0, 1, 2] is not a pair [low, high] of numbers"]),
        ("ppo.hidden_dims=[1.5]", ["ppo.hidden_dims", "[1.5] is not a list of whole numbers"]),
        ("num_envs=0", ["num_envs must be >= 1, got 0"]),
        ("seed=-1", ["seed must be >= 0, got -1"]),
        ("seed=4294967296", ["seed must be <= 4294967295, got 4294967296"]),
        ("gait.period=0", ["gait.period must be > 0 s, got 0.0"]),
        ("episode.min_hip_height=-0.1", ["episode.min_hip_height must be >= 0 m, got -0.1"]),
        ("reward.cmd.sigma_xy=0", ["reward.cmd.sigma_xy must be > 0 m/s, got 0.0"]),
        ("reward.diff.k_diff=0.02", ["reward.diff.k_diff must be <= 0, got 0.02"]),
        ("reward.foot.gamma=1.1", ["reward.foot.gamma must be <= 1, got 1.1"]),
        ("disturbance.push.interval=[0, 1]", ["disturbance.push.interval must be > 0 s, got 0.0"]),
        ("ppo.hidden_dims=[64, 0]", ["ppo.hidden_dims must be >= 1, got 0"]),
        ("gait.period=nan", ["gait.period must be finite, got nan"]),
        ("gait.period=.inf", ["gait.period must be finite, got inf"]),
        ("reward.diff.k_diff=-.inf", ["reward.diff.k_diff must be finite, got -inf"]),
        ("command.lin_vel_x=[.nan, 1]", ["command.lin_vel_x must be finite, got nan"]),
        ("gait=3", ["gait is a section; set one of its fields: period"]),
        ("reward.foot={gamma: 0.5}", ["reward.foot is a section; set one of its fields: k_foot, gamma, first"]),
        ("reward.foot.first=old", ["reward.foot.first", "'old' is not one of newest, oldest"]),
        ("ppo.schedule=Fixed", ["ppo.schedule", "'Fixed' is not one of fixed, adaptive"]),
        ("command.lin_vel_x=[1, 0]", ["command.lin_vel_x must be [low, high], got [1.0, 0.0]"]),
        ("ppo.hidden_dims=[]", ["ppo.hidden_dims must not be empty"]),
        ("gait.period", ["is not of the form key.path=value"]),
        ("=3", ["is not of the form key.path=value"]),
        ("gait..period=3", ["is not of the form key.path=value"]),
        ("gait.period=[", ["while parsing"]),
        ("seed=${num_envs}", ["seed: '${num_envs}' is not a whole number"]),
    ],
)
def test_bad_override_is_one_line_that_names_it(override: str, parts: list[str]) -> None:
    message = error_of(FLAT, override)
    for part in [f"override '{override}'", *parts]:
        assert part in message


def test_unset_value_is_reported_as_missing() -> None:
    assert "field 'seed' has no value" in error_of(FLAT, "seed=???")


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("gait: {period: 0.5\n", ["task.yaml: not valid YAML", "expected ',' or '}'"]),
        ("- 1\n- 2\n", ["task.yaml: a task is a mapping"]),
        ("base: telebip_flat\ngait:\n  # T\n  perod: 0.5\n", ["task.yaml:4:", "'gait.perod'", "did you mean 'gait.period'?"]),
        ("base: telebip_flat\nseed: 1\ngait:\n  period: -1\n", ["task.yaml:4: gait.period must be > 0 s, got -1.0"]),
        ("base: telebip_flat\ngait: 3\n", ["task.yaml:2: gait is a section"]),
        ("base: telebip_flat\nseed: 2020-01-01\n", ["task.yaml:2: seed: 2020-01-01 is not a whole number"]),
        ("seed: 1\n", ["task.yaml: field ", " has no value"]),
        ("", ["task.yaml: field ", " has no value"]),
        ("base: telebip_flatt\n", ["unknown task 'telebip_flatt'", "did you mean 'telebip_flat'?"]),
        ("base: nowhere.yaml\n", ["'nowhere.yaml' does not exist"]),
        ("base: [telebip_flat]\n", ["task.yaml:1: base must be the name of a task"]),
        ("base: telebip_flat\nseed: 1\nseed: 2\n", ["task.yaml:3: field 'seed' stands there twice"]),
        ("base: telebip_flat\n---\nseed: 2\n", ["task.yaml: not valid YAML", "single document"]),
        ("base: telebip_flat\ngait: &a\n  period: *a\n", ["task.yaml: a section contains itself"]),
        ("base: telebip_flat\nseed: !!python/name:os.system\n", ["task.yaml: not valid YAML", "os.system"]),
        ("seed: " + "[" * 1000, ["task.yaml: not valid YAML", "recursion"]),
    ],
)
def test_bad_file_is_one_line_that_names_the_place(tmp_path: Path, text: str, parts: list[str]) -> None:
    path = tmp_path / "task.yaml"
    path.write_text(text)
    message = error_of(str(path))
    for part in parts:
        assert part in message


def test_binary_file_is_no_task(tmp_path: Path) -> None:
    path = tmp_path / "task.yaml"
    path.write_bytes(bytes(range(256)))
    assert "task.yaml: 'utf-8' codec can't decode byte 0x80" in error_of(str(path))


@pytest.mark.parametrize("files", [["a.yaml"], ["a.yaml", "b.yaml"], ["a.yaml", "b.yaml", "c.yaml"]])
def test_base_cycle_of_any_length_is_found(tmp_path: Path, files: list[str]) -> None:
    for file, base in zip(files, files[1:] + files[:1], strict=True):
        (tmp_path / file).write_text(f"base: {tmp_path / base}\n")
    message = error_of(str(tmp_path / "a.yaml"))
    assert f"{files[-1]}:1: base '{tmp_path / 'a.yaml'}' leads back to itself" in message
    assert "leads back to itself" in message


def test_the_nearer_file_wins_along_a_chain_of_bases(tmp_path: Path) -> None:
    (tmp_path / "parent.yaml").write_text("base: telebip_flat\nseed: 5\nnum_envs: 8\n")
    (tmp_path / "child.yaml").write_text(f"base: {tmp_path / 'parent.yaml'}\nseed: 6\n")
    config = load_task(str(tmp_path / "child.yaml"))
    assert config == dataclasses.replace(FLAT, seed=6, num_envs=8)


@pytest.mark.parametrize(
    ("task", "part"),
    [
        ("telebip_flt", "unknown task 'telebip_flt'; did you mean 'telebip_flat'?"),
        ("walk", "unknown task 'walk'; valid: " + ", ".join(sorted([*CHILDREN, "telebip_flat"]))),
        ("", "unknown task ''; valid: "),
        ("nowhere/task.yaml", "task file 'nowhere/task.yaml' does not exist"),
    ],
)
def test_unknown_task_is_told_the_valid_ones(task: str, part: str) -> None:
    assert part in error_of(task)


def test_parse_config_names_its_source() -> None:
    with pytest.raises(UserError, match=r"^model_25\.pt:2: unknown field 'sed'; did you mean 'seed'\?$"):
        parse_config("num_envs: 4\nsed: 1\n", "model_25.pt")


@pytest.mark.parametrize("text", ["hello\n", "seed\n", "!!set {a, b}\n", 'base: telebip_flat\n"a\\nb": 1\n'])
def test_odd_file_is_one_line_of_user_error(tmp_path: Path, text: str) -> None:
    path = tmp_path / "task.yaml"
    path.write_text(text)
    assert "task.yaml" in error_of(str(path))


@pytest.mark.parametrize("task", ["x" * 300, "x" * 300 + ".yaml", "telebip\nflat"])
def test_odd_task_name_is_one_line_of_user_error(task: str) -> None:
    assert "task" in error_of(task)


@pytest.mark.parametrize(
    "override", ["seed=" + "9" * 5000, "seed=!!int x", "seed=!!bool x", "seed=\ud800", "seed=1\n2", "a\nb=1"]
)
def test_odd_override_is_one_line_of_user_error(override: str) -> None:
    assert "override" in error_of(FLAT, override)


KEYS = [
    "seed",
    "num_envs",
    "gait",
    "gait.period",
    "command.lin_vel_x",
    "ppo.hidden_dims",
    "reward.foot.first",
    "sim.robot",
    "a",
]
TOKENS = [
    *KEYS,
    "base",
    "telebip_flat",
    "period",
    "lin_vel_x",
    ": ",
    ":",
    "- ",
    ", ",
    "[",
    "]",
    "{",
    "}",
    "\n",
    "\n  ",
    " ",
    "#",
]
TOKENS += [
    "0",
    "1",
    "-1",
    "0.5",
    "1e9",
    ".nan",
    ".inf",
    "null",
    "~",
    "true",
    "???",
    "${seed}",
    "${",
    "&a ",
    "*a",
    "!!set",
    "!!int ",
]
TOKENS += [
    "'",
    '"',
    "|",
    ">",
    "%",
    "@",
    "`",
    "---",
    "...",
    "? ",
    "<<",
    "\t",
    "\0",
    "é",
    "\u2028",
    "2020-01-01",
    "0x1f",
    "1:30",
    "=",
]
YAMLISH = st.lists(st.sampled_from(TOKENS) | st.text(max_size=3), max_size=12).map("".join)

fuzz = settings(
    max_examples=60,
    deadline=None,
    derandomize=True,
    database=None,
    phases=[Phase.generate],
    suppress_health_check=[HealthCheck.too_slow],
)


thorough = settings(fuzz, max_examples=5000)
OVERRIDES = st.builds("{}={}".format, st.sampled_from(KEYS), YAMLISH) | YAMLISH


def assert_a_text_is_a_task_or_a_user_error(text: str, path: Path) -> None:
    path.write_text(text, encoding="utf-8", errors="surrogatepass")
    try:
        config = load_task(str(path))
    except UserError as error:
        assert len(str(error).splitlines()) == 1
    else:
        assert isinstance(config, TaskConfig)


def assert_an_override_is_applied_or_a_user_error(override: str) -> None:
    try:
        config = load_task(FLAT, [override])
    except UserError as error:
        assert len(str(error).splitlines()) == 1
    else:
        assert math.isfinite(config.gait.period)


@fuzz
@given(text=YAMLISH)
def test_any_text_in_a_file_is_a_task_or_a_user_error(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    assert_a_text_is_a_task_or_a_user_error(text, tmp_path_factory.getbasetemp() / "random.yaml")


@fuzz
@given(override=OVERRIDES)
def test_any_override_is_applied_or_a_user_error(override: str) -> None:
    assert_an_override_is_applied_or_a_user_error(override)


@pytest.mark.slow
@thorough
@given(text=YAMLISH)
def test_thousands_of_texts(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    assert_a_text_is_a_task_or_a_user_error(text, tmp_path_factory.getbasetemp() / "random.yaml")


@pytest.mark.slow
@thorough
@given(override=OVERRIDES)
def test_thousands_of_overrides(override: str) -> None:
    assert_an_override_is_applied_or_a_user_error(override)
