"""Loading a task: what the shipped files say, what an override changes, and that every mistake is one line that names it."""

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
import yaml
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from telebip.config import (
    CONFIGS,
    ObservationGroup,
    TaskConfig,
    check,
    load,
    load_task,
    parse_config,
    study_names,
    task_names,
    to_yaml,
)
from telebip.errors import UserError
from telebip.mdp.term import TERMS, Quantity, reward

FLAT = load_task("telebip_flat")
EXACT = {"noise": 0.0, "delay": (0, 0)}
"""What an observation is if nothing is said of it."""
CHILDREN = (
    *("telebip_backward", "telebip_efficient", "telebip_fast", "telebip_omni", "telebip_quick", "telebip_robust"),
    *("telebip_real", "telebip_rotary", "telebip_rough", "telebip_slow", "telebip_stairs"),
)


RANGES = ("range", "scale", "inertia", "kp", "kv", "interval")
"""Parameters of events that are pairs."""


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
    assert cfg.rewards["cmd"] == {"k_xy": 0.2, "sigma_xy": 0.3, "k_w": 0.15, "sigma_w": 0.2}
    assert (cfg.rewards["foot"]["k_foot"], cfg.rewards["termination"]["k_termination"]) == (0.1, -1.0)
    assert (cfg.gait.period, cfg.terminations, cfg.sim.decimation) == (0.5, {"fallen": {"min_hip_height": 0.4}}, 4)


def test_the_policy_sees_what_the_article_says_in_its_order() -> None:
    policy = FLAT.observations["policy"]
    assert [*policy.terms] == [
        "joint_pos",
        "joint_vel",
        "last_action",
        "base_lin_vel",
        "base_ang_vel",
        "base_quat",
        "command",
        "phase",
    ]
    assert (policy.history, policy.delay, policy.noise) == (1, (0, 0), True)


@pytest.mark.parametrize(
    ("name", "lin_vel_x"),
    [("telebip_slow", (0.4, 0.7)), ("telebip_fast", (0.7, 1.0)), ("telebip_backward", (-0.5, -0.2))],
)
def test_child_task_is_the_articles_at_another_speed_learned_fast(name: str, lin_vel_x: tuple[float, float]) -> None:
    task, quick = load_task(name), load_task("telebip_quick")
    assert task.commands == dataclasses.replace(FLAT.commands, lin_vel_x=lin_vel_x)
    assert task.ppo == dataclasses.replace(quick.ppo, max_iterations=task.ppo.max_iterations)
    assert dataclasses.replace(task, commands=FLAT.commands, ppo=quick.ppo) == quick


@pytest.mark.parametrize("name", [*CHILDREN, *study_names()])
def test_child_file_states_exactly_what_differs_from_its_base(name: str) -> None:
    (file,) = CONFIGS.glob(f"**/{name}.yaml")
    stated = yaml.safe_load(file.read_text())
    base = dataclasses.asdict(load_task(stated.pop("base")))
    child = dataclasses.asdict(load_task(name))
    if name == "telebip_real":  # whose observations and events are new: what it does not state has its default
        known = {entry: params for entry, params in base.pop("events").items() if entry not in stated["events"]}
        for entry, params in child.pop("events").items():
            said = stated["events"].get(entry, known.get(entry))
            assert {key: params[key] for key in said} == {k: tuple(v) if k in RANGES else v for k, v in said.items()}
        del stated["events"]
    if "observations" in stated:  # a group is stated whole
        assert list(child.pop("observations")) == list(stated.pop("observations"))
        del base["observations"]
    base, child = leaves(base), leaves(child)
    removed = {key for key, value in leaves(stated).items() if value is None}
    assert {key for key in child if child[key] != base.get(key)} == set(leaves(stated)) - removed
    assert {key.rpartition(".")[0] for key in base.keys() - child.keys()} == removed


def test_task_is_loaded_by_path_as_by_name() -> None:
    assert load_task(str(CONFIGS / "telebip_flat.yaml")) == FLAT


def test_overrides_set_exactly_their_fields() -> None:
    overrides = ["seed=7", "commands.lin_vel_x=[0.5, 0.5]", "observations.policy.noise=false", "ppo.learning_rate=1e-3"]
    before, after = leaves(dataclasses.asdict(FLAT)), leaves(dataclasses.asdict(load_task(FLAT, overrides)))
    changed = {key: after[key] for key in after if after[key] != before[key]}
    assert changed == {
        "seed": 7,
        "commands.lin_vel_x": (0.5, 0.5),
        "observations.policy.noise": False,
        "ppo.learning_rate": 0.001,
    }


def test_the_last_override_of_a_field_wins() -> None:
    assert load_task(FLAT, ["seed=2", "seed=3"]).seed == 3


def test_loading_does_not_change_the_configuration_it_was_given() -> None:
    load_task(
        FLAT, ["gait.period=0.9", "ppo.hidden_dims=[8]", "rewards.foot.cap=1", "events.push=null", "actions.scale.knee=1"]
    )
    assert (FLAT.gait.period, FLAT.ppo.hidden_dims, FLAT.rewards["foot"]["cap"]) == (0.5, [512, 256, 128], 100.0)
    assert "push" in FLAT.events
    assert FLAT.actions.scale["knee"] == 0.1


def test_a_configuration_shares_no_list_with_the_one_it_was_made_of() -> None:
    other = load_task(FLAT)
    assert other.ppo.hidden_dims is not FLAT.ppo.hidden_dims
    assert other.rewards["foot"] is not FLAT.rewards["foot"]


def test_whole_number_is_accepted_where_a_number_is_asked_for() -> None:
    period = load_task(FLAT, ["gait.period=1"]).gait.period
    assert period == 1.0
    assert isinstance(period, float)


@pytest.mark.parametrize("text", ["1024", "1024.0", "1_024", "1.024e3", "'1024'"])
def test_number_without_a_fraction_is_accepted_where_a_whole_one_is_asked_for(text: str) -> None:
    num_envs = load_task(FLAT, [f"num_envs={text}"]).num_envs
    assert num_envs == 1024
    assert isinstance(num_envs, int)


@pytest.mark.parametrize("text", ["1e-3", "0.001", "1.0e-3", "'0.001'", "1E-3"])
def test_number_is_a_number_however_it_is_written(text: str) -> None:
    assert load_task(FLAT, [f"gait.period={text}"]).gait.period == 0.001


@pytest.mark.parametrize(
    ("override", "parts"),
    [
        ("rewards.foot.gama=0.9", ["unknown field 'rewards.foot.gama'", "did you mean 'rewards.foot.gamma'?"]),
        ("comands.lin_vel_x=[0, 1]", ["unknown field 'comands'", "did you mean 'commands'?"]),
        (
            "zzz=1",
            [
                "unknown field 'zzz'",
                "valid: actions, commands, episode, events, gait, num_envs, observations, ppo, rewards, seed, sim",
            ],
        ),
        ("reward.foot.cap=1", ["unknown field 'reward'", "did you mean 'rewards'?"]),
        ("gait.period.x=2", ["unknown field 'gait.period.x'", "'gait.period' is a value"]),
        ("seed=x", ["seed", "'x' is not a whole number"]),
        ("seed=1.5", ["seed", "1.5 is not a whole number"]),
        ("seed=true", ["seed", "True is not a whole number"]),
        ("gait.period=fast", ["gait.period", "'fast' is not a number"]),
        ("gait.period=", ["gait.period", "None is not a number"]),
        ("ppo.obs_normalization=maybe", ["ppo.obs_normalization", "'maybe' is not true or false"]),
        ("ppo.obs_normalization=1", ["ppo.obs_normalization", "1 is not true or false"]),
        ("gait.period=true", ["gait.period", "True is not a number"]),
        ("sim.robot=3", ["sim.robot", "3 is not a text"]),
        ("commands.lin_vel_x=0.5", ["commands.lin_vel_x", "0.5 is not a pair [low, high] of numbers"]),
        ("commands.lin_vel_x=[1]", ["commands.lin_vel_x", "[1] is not a pair [low, high] of numbers"]),
        ("commands.lin_vel_x=[0, 1, 2]", ["commands.lin_vel_x", "[0, 1, 2] is not a pair [low, high] of numbers"]),
        ("ppo.hidden_dims=[1.5]", ["ppo.hidden_dims", "[1.5] is not a list of whole numbers"]),
        ("num_envs=0", ["num_envs must be >= 1, got 0"]),
        ("seed=-1", ["seed must be >= 0, got -1"]),
        ("seed=4294967296", ["seed must be <= 4294967295, got 4294967296"]),
        ("gait.period=0", ["gait.period must be > 0 s, got 0.0"]),
        ("terminations.fallen.min_hip_height=-0.1", ["terminations.fallen.min_hip_height must be >= 0 m, got -0.1"]),
        ("rewards.cmd.sigma_xy=0", ["rewards.cmd.sigma_xy must be > 0 m/s, got 0.0"]),
        ("rewards.diff.k_diff=0.02", ["rewards.diff.k_diff must be <= 0, got 0.02"]),
        ("rewards.foot.gamma=1.1", ["rewards.foot.gamma must be <= 1, got 1.1"]),
        ("events.push.interval=[0, 1]", ["events.push.interval must be > 0 s, got 0.0"]),
        ("ppo.hidden_dims=[64, 0]", ["ppo.hidden_dims must be >= 1, got 0"]),
        ("gait.period=nan", ["gait.period must be finite, got nan"]),
        ("gait.period=.inf", ["gait.period must be finite, got inf"]),
        ("rewards.diff.k_diff=-.inf", ["rewards.diff.k_diff must be finite, got -inf"]),
        ("commands.lin_vel_x=[.nan, 1]", ["commands.lin_vel_x must be finite, got nan"]),
        ("gait=3", ["gait is a section; set one of its fields: period"]),
        ("rewards.foot=0.5", ["rewards.foot is a section; set one of its fields: k_foot, gamma, first, cap"]),
        ("rewards.foot.first=old", ["rewards.foot.first", "'old' is not one of newest, oldest"]),
        ("ppo.schedule=Fixed", ["ppo.schedule", "'Fixed' is not one of fixed, adaptive"]),
        ("commands.lin_vel_x=[1, 0]", ["commands.lin_vel_x must be [low, high], got [1.0, 0.0]"]),
        ("ppo.hidden_dims=[]", ["ppo.hidden_dims must not be empty"]),
        ("gait.period", ["is not of the form key.path=value"]),
        ("=3", ["is not of the form key.path=value"]),
        ("gait..period=3", ["is not of the form key.path=value"]),
        ("gait.period=[", ["while parsing"]),
        ("seed=${num_envs}", ["seed: '${num_envs}' is not a whole number"]),
        ("seed=???", ["seed: '???' is not a whole number"]),
        ("seed=[1, 2]", ["seed: [1, 2] is not a whole number"]),
        ("seed={}", ["seed: {} is not a whole number"]),
        ("actions.delay=[0, 1.5]", ["actions.delay: [0, 1.5] is not a pair [low, high] of whole numbers"]),
        ("actions.delay=[2, 1]", ["actions.delay must be [low, high], got [2, 1]"]),
        ("actions.delay=[0, 101]", ["actions.delay must be <= 100 policy steps, got 101"]),
        ("actions.scale=1", ["actions.scale: 1 is not a mapping of names to numbers"]),
        ("actions.scale.knee=0", ["actions.scale.knee must be > 0 rad | m, got 0.0"]),
        ("actions.scale.knee=long", ["actions.scale.knee: 'long' is not a number"]),
        ("actions.scale.knee.x=1", ["unknown field 'actions.scale.knee.x'; 'actions.scale.knee' is a value"]),
        ("actions.scale.ankle=null", ["actions.scale.ankle: None is not a number"]),
        ("rewards=1", ["rewards is a section; name its entries"]),
        ("rewards.fot.cap=1", ["rewards.fot: unknown reward 'fot'; did you mean 'foot'?"]),
        ("rewards.zzz={}", ["rewards.zzz: unknown reward 'zzz'; valid: cmd, diff, "]),
        ("rewards.soft.term=fot", ["rewards.soft: unknown reward 'fot'; did you mean 'foot'?"]),
        ("rewards.soft.term=3", ["rewards.soft.term: 3 is not a text"]),
        ("rewards.soft={term: foot, cap: 1}", ["field 'rewards.soft.k_foot' has no value"]),
        ("rewards.fot=null", ["rewards.fot is null", "did you mean 'foot'?"]),
        ("terminations.tilted={}", ["field 'terminations.tilted.max_tilt' has no value"]),
        ("terminations.tilted={max_tilt: 4}", ["terminations.tilted.max_tilt must be <= 3.2 rad, got 4.0"]),
        ("events.friction.when=never", ["events.friction.when: 'never' is not one of reset, once"]),
        ("events.push.fource=1", ["unknown field 'events.push.fource'; did you mean 'events.push.force'?"]),
        ("observations.policy=null", ["observations needs a group 'policy'"]),
        ("observations.critic=null", ["observations.critic is null"]),
        ("observations.critic={}", ["observations.critic has no terms; valid: action_delay, "]),
        ("observations.critic={noise: false}", ["observations.critic has no terms"]),
        ("observations.critic=3", ["observations.critic is a section; name its terms"]),
        ("observations.critic.histroy=5", ["observations.critic.histroy: unknown observation", "did you mean 'history'?"]),
        ("observations.policy.history=0", ["observations.policy.history must be >= 1 policy steps, got 0"]),
        ("observations.policy.delay=1", ["observations.policy.delay: 1 is not a pair [low, high] of whole numbers"]),
        ("observations.policy.joint_pos=0.1", ["observations.policy.joint_pos is a section; set one of its fields: noise"]),
        ("observations.policy.joint_pos.noise=-1", ["observations.policy.joint_pos.noise must be >= 0, got -1.0"]),
        ("observations.policy.joint_pso.noise=1", ["joint_pso: unknown observation", "did you mean 'joint_pos'?"]),
        ("observations.policy.friction=null", ["friction is null, which removes", "it has none; {} takes the defaults"]),
    ],
)
def test_bad_override_is_one_line_that_names_it(override: str, parts: list[str]) -> None:
    message = error_of(FLAT, override)
    for part in [f"override '{override}'", *parts]:
        assert part in message


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
        ("base: telebip_flat\ngait: &a\n  period: *a\n", ["task.yaml:3: a section contains itself"]),
        ("base: telebip_flat\nseed: !!python/name:os.system\n", ["task.yaml: not valid YAML", "os.system"]),
        ("seed: " + "[" * 1000, ["task.yaml: not valid YAML", "recursion"]),
        ("gait: !!map x\n", ["task.yaml: not valid YAML"]),
        ("base: telebip_flat\nppo: {}\ngait:\n", ["task.yaml:3: gait is a section"]),
        (
            "base: telebip_flat\nrewards:\n  energy:\n    k_energy: 1\n",
            ["task.yaml:4: rewards.energy.k_energy must be <= 0 s/m"],
        ),
        ("base: telebip_flat\nrewards:\n  a b: {term: tq, k_tq: -1}\n", ["task.yaml:3: rewards: 'a b' is no name"]),
        (
            "base: telebip_flat\nobservations:\n  policy:\n    joint_pos:\n",
            ["task.yaml:4: observations.policy.joint_pos is null", "{} takes the defaults"],
        ),
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
        ("walk", "unknown task 'walk'; valid: " + ", ".join(sorted([*CHILDREN, "telebip_flat", *study_names()]))),
        ("", "unknown task ''; valid: "),
        ("nowhere/task.yaml", "task file 'nowhere/task.yaml' does not exist"),
    ],
)
def test_unknown_task_is_told_the_valid_ones(task: str, part: str) -> None:
    assert part in error_of(task)


# ---- terms --------------------------------------------------------------------------------------------------------


def task_file(folder: Path, text: str) -> str:
    (folder / "task.yaml").write_text(f"base: telebip_flat\n{text}")
    return str(folder / "task.yaml")


@pytest.mark.parametrize("section", ["rewards", "terminations", "events"])
def test_an_empty_section_of_a_child_changes_nothing(tmp_path: Path, section: str) -> None:
    assert load_task(task_file(tmp_path, f"{section}: {{}}\n")) == FLAT


def test_terms_merge_with_the_base_key_by_key(tmp_path: Path) -> None:
    task = load_task(task_file(tmp_path, "rewards:\n  foot: {cap: 1}\nterminations:\n  tilted: {max_tilt: 1}\n"))
    assert task.rewards == {**FLAT.rewards, "foot": {**FLAT.rewards["foot"], "cap": 1.0}}
    assert task.terminations == {**FLAT.terminations, "tilted": {"max_tilt": 1.0}}
    assert dataclasses.replace(task, rewards=FLAT.rewards, terminations=FLAT.terminations) == FLAT


def test_null_removes_a_term_and_a_later_file_may_state_it_anew(tmp_path: Path) -> None:
    without = task_file(tmp_path, "rewards: {energy: null}\nevents: {push: ~}\n")
    task = load_task(without)
    assert FLAT.rewards.keys() - task.rewards.keys() == {"energy"}
    assert FLAT.events.keys() - task.events.keys() == {"push"}
    (tmp_path / "again.yaml").write_text("base: task.yaml\nrewards: {energy: {k_energy: -1, ramp: [0, 0]}}\n")
    assert load_task(str(tmp_path / "again.yaml")).rewards["energy"] == {"k_energy": -1.0, "ramp": (0.0, 0.0)}
    (tmp_path / "half.yaml").write_text("base: task.yaml\nrewards:\n  energy: {k_energy: -1}\n")
    assert "half.yaml:3: field 'rewards.energy.ramp' has no value" in error_of(str(tmp_path / "half.yaml"))


def test_overrides_remove_and_add_terms() -> None:
    task = load_task(FLAT, ["events.push=null", "rewards.energy=", "terminations.tilted={max_tilt: 0.8}"])
    assert task.events.keys() == {"start_pose", "start_velocity", "friction"}
    assert "energy" not in task.rewards
    assert task.terminations["tilted"] == {"max_tilt": 0.8}


def test_a_function_may_stand_under_other_names(tmp_path: Path) -> None:
    soft = "{term: foot, k_foot: 1, gamma: 0.5, first: oldest, cap: 2}"
    task = load_task(task_file(tmp_path, f"rewards: {{soft: {soft}}}\n"), ["rewards.soft.cap=3"])
    assert task.rewards["soft"] == {"term": "foot", "k_foot": 1.0, "gamma": 0.5, "first": "oldest", "cap": 3.0}
    assert task.rewards["foot"] == FLAT.rewards["foot"]
    assert "did you mean 'soft'?" in error_of(task, "rewards.soff.cap=3")
    assert "rewards.soft.cap must be > 0 body weights, got -1.0" in error_of(task, "rewards.soft.cap=-1")


def test_an_entry_of_another_function_does_not_keep_the_parameters(tmp_path: Path) -> None:
    task = load_task(task_file(tmp_path, "terminations: {fallen: {term: tilted, max_tilt: 1}}\n"))
    assert task.terminations == {"fallen": {"term": "tilted", "max_tilt": 1.0}}
    assert load_task(task, ["terminations.fallen={term: tilted}"]) == task  # the same function: merged
    assert load_task(task, ["terminations.fallen={term: fallen, min_hip_height: 0.3}"]).terminations == {
        "fallen": {"term": "fallen", "min_hip_height": 0.3}
    }


def test_a_file_states_a_group_of_observations_as_a_whole(tmp_path: Path) -> None:
    text = "observations:\n  policy: {phase: {}, joint_pos: {noise: 0.1}, history: 3}\n"
    task = load_task(task_file(tmp_path, text))
    assert task.observations == {"policy": ObservationGroup({"phase": EXACT, "joint_pos": {**EXACT, "noise": 0.1}}, history=3)}
    assert [*task.observations["policy"].terms] == ["phase", "joint_pos"]


def test_a_group_more_leaves_the_others_as_they_are(tmp_path: Path) -> None:
    task = load_task(task_file(tmp_path, "observations:\n  critic: {friction: {}, noise: false, delay: [0, 2]}\n"))
    critic = ObservationGroup({"friction": EXACT}, delay=(0, 2), noise=False)
    assert task.observations == {**FLAT.observations, "critic": critic}
    (tmp_path / "child.yaml").write_text("base: task.yaml\nobservations: {critic: null}\n")
    assert load_task(str(tmp_path / "child.yaml")) == load_task(task, ["observations.critic=null"]) == FLAT


def test_overrides_change_single_fields_of_a_group() -> None:
    overrides = ["joint_pos.noise=0.01", "history=5", "base_lin_vel=null", "base_height={}"]
    policy = load_task(FLAT, [f"observations.policy.{override}" for override in overrides]).observations["policy"]
    assert [*policy.terms] == [*(n for n in FLAT.observations["policy"].terms if n != "base_lin_vel"), "base_height"]
    assert (policy.terms["joint_pos"], policy.history) == ({**EXACT, "noise": 0.01}, 5)
    whole = load_task(FLAT, ["observations.policy={phase: {}}"]).observations["policy"]
    assert whole == ObservationGroup({"phase": EXACT})


def test_names_merge_one_by_one_and_null_removes_one(tmp_path: Path) -> None:
    task = load_task(task_file(tmp_path, "actions: {scale: {knee: 0.5, ankle: 1, hip_roll: null}}\n"))
    assert task.actions.scale == {"hip_pitch": 0.5, "knee": 0.5, "ankle": 1.0}
    assert load_task(task, ["actions.scale.ankle=null", "actions.scale.knee=2"]).actions.scale == {
        "hip_pitch": 0.5,
        "knee": 2.0,
    }


@pytest.fixture
def bonus() -> Iterator[None]:
    """A reward of one's own, with parameters of every type."""

    @reward
    def bonus(
        step: Any,
        *,
        pace: Annotated[float, Quantity("m/s", gt=0, le=2)],
        count: Annotated[int, Quantity(ge=1)] | None = None,
        side: Literal["left", "right"] = "left",
        bodies: list[str] | None = None,
        gains: list[float] = [1, 2],  # noqa: B006
        ranges: dict[str, tuple[float, float]] = {"x": (0, 1)},  # noqa: B006
        weights: Annotated[dict[str, float], Quantity("kg", ge=0)] = {},  # noqa: B006
        is_on: bool = True,
        corner: tuple[float, float, float] = (3, 2, 1),
    ) -> None: ...

    yield
    del TERMS["reward"]["bonus"]


DEFAULTS = {
    **{"count": None, "side": "left", "bodies": None, "gains": [1.0, 2.0], "ranges": {"x": (0.0, 1.0)}, "weights": {}},
    **{"is_on": True, "corner": (3.0, 2.0, 1.0)},
}


@pytest.mark.usefixtures("bonus")
def test_a_term_of_ones_own_has_its_defaults_and_types() -> None:
    task = load_task(FLAT, ["rewards.bonus={pace: 1}"])
    assert task.rewards["bonus"] == {"pace": 1.0, **DEFAULTS}
    given = "{pace: 2, count: 3, side: right, bodies: [a, b], ranges: {y: [1, 2]}, weights: {a: 1}, is_on: false}"
    task = load_task(FLAT, [f"rewards.bonus={given}"])
    assert task.rewards["bonus"] == {
        **{"pace": 2.0, "count": 3, "side": "right", "bodies": ["a", "b"], "gains": [1.0, 2.0], "ranges": {"y": (1.0, 2.0)}},
        **{"weights": {"a": 1.0}, "is_on": False, "corner": (3.0, 2.0, 1.0)},
    }
    assert parse_config(to_yaml(task), "a run") == task
    assert load_task(task, ["rewards.bonus.count=null"]).rewards["bonus"]["count"] is None


@pytest.mark.usefixtures("bonus")
@pytest.mark.parametrize(
    ("override", "part"),
    [
        ("rewards.bonus={}", "field 'rewards.bonus.pace' has no value"),
        ("rewards.bonus.pace=3", "rewards.bonus.pace must be <= 2 m/s, got 3.0"),
        ("rewards.bonus.pace=0", "rewards.bonus.pace must be > 0 m/s, got 0.0"),
        ("rewards.bonus.pase=1", "unknown field 'rewards.bonus.pase'; did you mean 'rewards.bonus.pace'?"),
        ("rewards.bonus={pace: 1, count: 0}", "rewards.bonus.count must be >= 1, got 0"),
        ("rewards.bonus={pace: 1, count: x}", "rewards.bonus.count: 'x' is not a whole number"),
        ("rewards.bonus={pace: 1, side: up}", "rewards.bonus.side: 'up' is not one of left, right"),
        ("rewards.bonus={pace: 1, bodies: a}", "rewards.bonus.bodies: 'a' is not a list of texts"),
        ("rewards.bonus={pace: 1, bodies: []}", "rewards.bonus.bodies must not be empty"),
        ("rewards.bonus={pace: 1, gains: [1, x]}", "rewards.bonus.gains: [1, 'x'] is not a list of numbers"),
        (
            "rewards.bonus={pace: 1, ranges: 1}",
            "rewards.bonus.ranges: 1 is not a mapping of names to pairs [low, high] of numbers",
        ),
        ("rewards.bonus={pace: 1, ranges: {x: 1}}", "rewards.bonus.ranges.x: 1 is not a pair [low, high] of numbers"),
        ("rewards.bonus={pace: 1, weights: {a: -1}}", "rewards.bonus.weights.a must be >= 0 kg, got -1.0"),
        ("rewards.bonus={pace: 1, corner: [1, 2]}", "rewards.bonus.corner: [1, 2] is not a list of 3 numbers"),
    ],
)
def test_wrong_parameter_of_a_term_of_ones_own_is_told_as_any_other(override: str, part: str) -> None:
    assert f"override '{override}': {part}" in error_of(FLAT, override)


# ---- configurations made in code ----------------------------------------------------------------------------------


def test_a_task_made_in_code_is_checked_and_completed() -> None:
    energy = {"k_energy": -1, "ramp": [0, 5]}
    critic = ObservationGroup({"friction": {}, "height": {"term": "base_height"}})
    made = dataclasses.replace(
        FLAT, num_envs=8, rewards={"energy": energy, "tq": None}, observations={**FLAT.observations, "critic": critic}
    )
    task = check(made)
    assert task.rewards == {"energy": {"k_energy": -1.0, "ramp": (0.0, 5.0)}}
    assert task.observations["critic"].terms == {"friction": EXACT, "height": {"term": "base_height", **EXACT}}
    assert check(task) == task == load_task(task)
    assert energy == {"k_energy": -1, "ramp": [0, 5]}  # what was given is as it was
    assert check(FLAT) == FLAT


@pytest.mark.parametrize(
    ("change", "part"),
    [
        ({"num_envs": 0}, "num_envs must be >= 1, got 0"),
        ({"seed": None}, "seed: None is not a whole number"),
        ({"gait": 3}, "gait is a section; set one of its fields: period"),
        ({"rewards": {"tq": {}}}, "field 'rewards.tq.k_tq' has no value"),
        ({"rewards": {"tq": {"k_tq": 1}}}, "rewards.tq.k_tq must be <= 0, got 1.0"),
        ({"rewards": {"qt": {"k_tq": -1}}}, "rewards.qt: unknown reward 'qt'; did you mean 'tq'?"),
        ({"terminations": None}, "terminations is a section; name its entries"),
        ({"observations": {}}, "observations needs a group 'policy'"),
        ({"observations": {"policy": ObservationGroup({})}}, "observations.policy has no terms"),
        ({"observations": {"policy": ObservationGroup({"phase": {}}, history=0)}}, "observations.policy.history must be >= 1"),
        ({"events": {"friction": {"range": (2.0, 1.0)}}}, "events.friction.range must be [low, high], got [2.0, 1.0]"),
    ],
)
def test_mistake_made_in_code_names_the_field(change: dict[str, Any], part: str) -> None:
    with pytest.raises(UserError) as caught:
        check(dataclasses.replace(FLAT, **change))
    assert str(caught.value).startswith(f"configuration: {part}")


def test_any_dataclass_of_annotated_fields_is_loaded_likewise(tmp_path: Path) -> None:
    @dataclasses.dataclass(frozen=True)
    class Inner:
        width: Annotated[float, Quantity("m", gt=0)]
        count: int = 3

    @dataclasses.dataclass(frozen=True)
    class Outer:
        inner: Inner

    (tmp_path / "outer.yaml").write_text("inner: {width: 1}\n")
    assert load(Outer, str(tmp_path / "outer.yaml")) == Outer(Inner(1.0, 3))
    assert load(Outer, Outer(Inner(2.0)), ["inner.count=5"]) == Outer(Inner(2.0, 5))
    with pytest.raises(UserError, match=r"override 'inner.width=0': inner.width must be > 0 m, got 0.0"):
        load(Outer, Outer(Inner(2.0)), ["inner.width=0"])


# ---- text that checkpoints and run folders hold -------------------------------------------------------------------


def test_yaml_round_trip_keeps_every_field() -> None:
    config = load_task(FLAT, ["gait.period=0.6", "ppo.hidden_dims=[64, 32]", "rewards.foot.first=oldest", "seed=4294967295"])
    assert parse_config(to_yaml(config), "a run") == config


@pytest.mark.parametrize("task", [*task_names(), *study_names()])
def test_round_trip_of_every_task(task: str) -> None:
    config = load_task(task)
    again = parse_config(to_yaml(config), "a run")
    assert again == config
    assert [*again.observations["policy"].terms] == [*config.observations["policy"].terms]


def test_text_of_a_checkpoint_needs_no_base_for_its_terms_and_names() -> None:
    without = ["rewards.energy=null", "events.push=null", "actions.scale.knee=null", "actions.scale.ankle=1"]
    config = load_task(FLAT, [*without, "observations.policy={phase: {}}", "observations.critic={friction: {}}"])
    assert parse_config(to_yaml(config), "a run") == config


def without_lines(text: str, *starts: str) -> str:
    return "\n".join(line for line in text.splitlines() if not line.strip().startswith(starts))


def test_fields_younger_than_the_text_have_the_values_of_telebip_flat() -> None:
    config = load_task("telebip_flat", ["ppo.gamma=0.5", "seed=3"])
    text = without_lines(to_yaml(config), "gamma: 0.5", "seed:", "gait:", "period:", "history:")
    assert parse_config(text, "old.pt") == FLAT


@pytest.mark.parametrize("section", ["rewards", "terminations", "events", "observations"])
def test_sections_of_terms_are_exactly_the_texts(section: str) -> None:
    tree = yaml.safe_load(to_yaml(FLAT))
    del tree[section]
    with pytest.raises(UserError, match=rf"^old\.pt: field '{section}' has no value$"):
        parse_config(yaml.safe_dump(tree), "old.pt")


def with_unknown_terms() -> str:
    tree = yaml.safe_load(to_yaml(FLAT))
    tree["rewards"] |= {"lost": {"k": 1, "deep": {"x": 1}}, "soft": {"term": "gone"}}
    tree["terminations"]["over"] = {}
    tree["events"]["storm"] = {"force": 3}
    tree["observations"] |= {"critic": {"phase": {}, "smell": {"noise": 1}}, "nose": {"smell": {}, "history": 2}}
    return yaml.safe_dump(tree, sort_keys=False)


def test_terms_unknown_here_are_left_out_of_a_checkpoints_task_and_named() -> None:
    missing: list[str] = []
    task = parse_config(with_unknown_terms(), "model_25.pt", missing)
    assert sorted(missing) == [
        *("events.storm", "observations.critic.smell", "observations.nose.smell"),
        *("rewards.lost", "rewards.soft", "terminations.over"),
    ]
    critic = ObservationGroup({"phase": EXACT})
    assert task == dataclasses.replace(FLAT, observations={**FLAT.observations, "critic": critic})


def test_terms_unknown_here_are_errors_otherwise() -> None:
    with pytest.raises(UserError, match=r"^model_25\.pt:\d+: observations\.critic\.smell: unknown observation 'smell'; "):
        parse_config(with_unknown_terms(), "model_25.pt")


def test_a_policys_own_terms_are_never_left_out() -> None:
    text = to_yaml(FLAT).replace("  policy:\n", "  policy:\n    smell: {}\n")
    with pytest.raises(UserError, match=r"^model_25\.pt:\d+: observations\.policy\.smell: unknown observation 'smell'; "):
        parse_config(text, "model_25.pt", [])


def test_wrong_parameters_of_known_terms_are_errors_in_a_checkpoint_too() -> None:
    with pytest.raises(
        UserError, match=r"^model_25\.pt:\d+: unknown field 'rewards\.tq\.k_qt'; did you mean 'rewards\.tq\.k_tq'\?$"
    ):
        parse_config(to_yaml(FLAT).replace("k_tq", "k_qt"), "model_25.pt", [])


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
    "override",
    ["seed=" + "9" * 5000, "seed=0x" + "f" * 9000, "seed=!!int x", "seed=!!bool x", "seed=\ud800", "seed=1\n2", "a\nb=1"],
)
def test_odd_override_is_one_line_of_user_error(override: str) -> None:
    assert "override" in error_of(FLAT, override)


KEYS = [
    "seed",
    "num_envs",
    "gait",
    "gait.period",
    "actions.scale",
    "actions.delay",
    "commands.lin_vel_x",
    "ppo.hidden_dims",
    "observations",
    "observations.policy",
    "observations.policy.history",
    "observations.policy.phase",
    "rewards",
    "rewards.foot",
    "rewards.foot.first",
    "rewards.foot.term",
    "events.push",
    "sim.robot",
    "a",
]
TOKENS = [
    *KEYS,
    "base",
    "telebip_flat",
    "period",
    "lin_vel_x",
    "policy",
    "joint_pos",
    "noise",
    "foot",
    "term",
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


def finite(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, exclude_min=True)


def pairs(numbers: st.SearchStrategy[Any]) -> st.SearchStrategy[tuple[Any, ...]]:
    return st.tuples(numbers, numbers).map(sorted).map(tuple)


GROUPS = st.builds(
    ObservationGroup,
    st.dictionaries(
        st.sampled_from(["phase", "joint_pos", "base_quat", "friction"]),
        st.builds(lambda noise: {**EXACT, "noise": noise}, finite(0, 1e30)),
        min_size=1,
    ),
    st.integers(1, 1000),
    pairs(st.integers(0, 100)),
    st.booleans(),
)


@fuzz
@given(
    seed=st.integers(0, 2**32 - 1),
    robot=st.text(),
    period=finite(0, 60),
    lin_vel_x=pairs(finite(-1e300, 1e300)),
    scale=st.dictionaries(st.text(), finite(0, 1e9)),
    hidden_dims=st.lists(st.integers(1), min_size=1),
    k_diff=finite(-1e300, 0),
    groups=st.dictionaries(st.from_regex(r"\w+", fullmatch=True), GROUPS),
    policy=GROUPS,
)
def test_any_valid_task_is_the_same_after_a_round_trip(
    seed: int,
    robot: str,
    period: float,
    lin_vel_x: tuple[float, float],
    scale: dict[str, float],
    hidden_dims: list[int],
    k_diff: float,
    groups: dict[str, ObservationGroup],
    policy: ObservationGroup,
) -> None:
    task = dataclasses.replace(
        FLAT,
        seed=seed,
        sim=dataclasses.replace(FLAT.sim, robot=robot),
        gait=dataclasses.replace(FLAT.gait, period=period),
        commands=dataclasses.replace(FLAT.commands, lin_vel_x=lin_vel_x),
        actions=dataclasses.replace(FLAT.actions, scale=scale),
        ppo=dataclasses.replace(FLAT.ppo, hidden_dims=hidden_dims),
        rewards={"diff": {"k_diff": k_diff}},
        observations={**groups, "policy": policy},
    )
    assert check(task) == task
    again = parse_config(to_yaml(task), "a run")
    assert again == task
    assert to_yaml(again) == to_yaml(task)  # order included


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
