"""Whatever a file or an override says, it is a task or one line that names the mistake; drawn by hypothesis."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from loaded import EXACT, FLAT

from telebip.config import ObservationGroup, TaskConfig, check, load_task, parse_config, to_yaml
from telebip.errors import UserError

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
