"""The terms that a task names: how files and overrides merge, and the parameters of terms of one's own."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from loaded import EXACT, FLAT, error_of

from telebip.config import ObservationGroup, load_task, parse_config, to_yaml
from telebip.mdp.term import TERMS, Quantity, reward


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
