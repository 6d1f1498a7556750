"""The text of a task that checkpoints and run folders hold."""

import dataclasses

import pytest
import yaml
from loaded import EXACT, FLAT

from telebip.config import ObservationGroup, load_task, parse_config, study_names, task_names, to_yaml
from telebip.errors import UserError


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
