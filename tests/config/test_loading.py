"""Loading a task: what the shipped files say, what an override changes, and that every mistake is one line that names it."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import pytest
import yaml
from loaded import EXACT, FLAT, error_of

from telebip.config import CONFIGS, ObservationGroup, check, load, load_task, study_names, task_names
from telebip.errors import UserError
from telebip.mdp.term import Quantity

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
        ("rewards.zzz={}", ["rewards.zzz: unknown reward 'zzz'; valid: cmd, cot, "]),
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
