"""Under which conditions a policy is measured and shown."""

import pytest

from telebip.config import TaskConfig, load_task
from telebip.eval.conditions import as_evaluated


def disturbances(config: TaskConfig) -> list[str]:
    return [name for name in ("push", "friction", "noise") if getattr(config.disturbance, name).enabled]


@pytest.mark.parametrize(("disturbed", "left"), [(False, []), (True, ["push", "friction"])])
def test_disturbances_are_kept_or_switched_off_and_never_on(disturbed: bool, left: list[str]) -> None:
    task = load_task("telebip_flat", ["disturbance.noise.enabled=false"])
    assert disturbances(task) == ["push", "friction"]
    assert disturbances(as_evaluated(task, 1, 2.0, disturbed=disturbed)) == left


def test_overrides_come_last() -> None:
    config = as_evaluated(load_task("telebip_flat"), 1, 2.0, ["disturbance.noise.enabled=true", "episode.reset_heading=3"])
    assert disturbances(config) == ["noise"]
    assert config.episode.reset_heading == 3.0
