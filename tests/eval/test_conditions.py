"""Under which conditions a policy is measured and shown."""

import pytest

from telebip.config import TaskConfig, load_task
from telebip.eval.conditions import as_evaluated

EVENTS = ["start_pose", "start_velocity", "push", "friction"]


def noisy_groups(config: TaskConfig) -> list[str]:
    return [name for name, group in config.observations.items() if group.noise]


@pytest.mark.parametrize(("disturbed", "events"), [(False, EVENTS[:2]), (True, EVENTS)])
def test_disturbances_are_kept_or_left_out_and_never_added(disturbed: bool, events: list[str]) -> None:
    task = load_task("telebip_flat")
    assert [*task.events] == EVENTS
    config = as_evaluated(task, 3, 2.0, disturbed=disturbed)
    assert [*config.events] == events
    assert noisy_groups(config) == (["policy"] if disturbed else [])
    assert noisy_groups(as_evaluated(load_task(task, ["observations.policy.noise=false"]), 1, 2.0, disturbed=disturbed)) == []
    assert (config.num_envs, config.episode.length) == (3, 3.0)
    assert config.events["start_pose"] == {**task.events["start_pose"], "heading": 0.0}
    assert config.events["start_velocity"] == task.events["start_velocity"]


def test_a_disturbance_is_told_by_its_function_not_by_the_name_of_its_entry() -> None:
    task = load_task("telebip_flat", ["events.push=null", "events.slippery={term: friction, range: [0.2, 0.3]}"])
    assert [*as_evaluated(task, 1, 2.0).events] == ["start_pose", "start_velocity"]


def test_overrides_come_last() -> None:
    overrides = ["observations.policy.noise=true", "events.start_pose.heading=3", "events.push.force=20", "num_envs=7"]
    task = load_task("telebip_flat")
    config = as_evaluated(task, 1, 2.0, overrides)
    assert noisy_groups(config) == ["policy"]
    assert config.events["start_pose"]["heading"] == 3.0
    assert config.events["push"] == {**task.events["push"], "force": 20.0}  # named, and so kept
    assert "friction" not in config.events
    assert config.num_envs == 7


def test_walking_needs_no_critic() -> None:
    task = load_task("telebip_flat", ["observations.critic={joint_pos: {}, foot_force: {}}"])
    assert [*task.observations] == ["policy", "critic"]
    assert [*as_evaluated(task, 1, 2.0).observations] == ["policy"]


@pytest.mark.parametrize("disturbed", [False, True])
def test_nothing_gets_lost_where_nothing_disturbs_and_delays_remain(disturbed: bool) -> None:
    task = as_evaluated(load_task("telebip_real"), 1, 1.0, disturbed=disturbed)
    assert task.observations["policy"].loss == task.actions.loss == (0.02 if disturbed else 0.0)
    assert task.actions.jitter == ((0, 2) if disturbed else (0, 0))
    assert task.actions.physics_delay == (0, 6)
