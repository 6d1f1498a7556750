"""A second of standing says what is wrong with a robot, before anything is trained."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import pytest
import torch
from torch import Tensor

from telebip import ROOT
from telebip.config import load_task
from telebip.eval.standing import Finding, clearance, standing_test
from telebip.mdp.step import Step
from telebip.mdp.term import TERMS, Quantity, observation, reward
from telebip.robot import load_robot

ROTARY = ROOT / "tests" / "robots" / "rotary_knee.xml"
SITES = {f'<site name="{side}_foot" pos="0 0 -0.335" size="0.04"/>': side for side in ("right", "left")}
TRUNK = 'pos="0 0 0.1" size="0.09 0.13 0.1" mass="10" conaffinity="1"'


@pytest.fixture
def findings(tmp_path: Path) -> Callable[..., list[Finding]]:
    """Return a function that edits the robot with rotary knees, and returns what is wrong with it, the errors first."""

    def stand(edits: dict[str, str], *overrides: str) -> list[Finding]:
        text = ROTARY.read_text(encoding="utf-8")
        for old, new in edits.items():
            assert old in text
            text = text.replace(old, new)
        (tmp_path / "mine.xml").write_text(text, encoding="utf-8")
        config = load_task("telebip_flat", ["actions.scale.knee=0.5", *overrides])
        found = [one for one in standing_test(config, load_robot(tmp_path / "mine.xml")) if one.verdict != "ok"]
        return sorted(found, key=lambda one: one.verdict != "error")

    return stand


def site(pos: str, size: str) -> dict[str, str]:
    """Sites of the touch sensors, elsewhere or of another size."""
    return {old: f'<site name="{side}_foot" pos="{pos}" size="{size}"/>' for old, side in SITES.items()}


@pytest.mark.parametrize(
    ("task", "robot"),
    [
        ("telebip_flat", "assets/telebip.xml"),
        ("telebip_efficient", "assets/telebip.xml"),
        *((f"tests/robots/{name}.yaml", f"tests/robots/{name}.xml") for name in ("rotary_knee", "ten_joints", "four_joints")),
    ],
)
def test_robots_that_walk_stand_without_a_word(task: str, robot: str) -> None:
    config = load_task(str(ROOT / task) if "/" in task else task)
    found = standing_test(config, load_robot(ROOT / robot))
    assert [str(one) for one in found if one.verdict != "ok"] == []
    assert clearance(load_robot(ROOT / robot)) == pytest.approx([0.0, 0.0], abs=1e-3)
    names = [one.check for one in found]
    assert {"hips", "stands", "sensor 'right_foot_force'", "reward 'foot'"} <= set(names)


@pytest.mark.parametrize(
    ("edits", "verdict", "said"),
    [
        (site("0 0 -0.335", "0.01"), "error", "sensor 'right_foot_force': feels 0 N of 6"),
        (site("0 0 -0.2", "0.04"), "error", "site 'right_foot' must be on the body of the foot's geoms and enclose them"),
        ({'qpos="0 0 0.6594': 'qpos="0 0 0.5'}, "error", "right_foot at home: 159.4 mm in the floor; a trunk at z = 0.6594"),
        (
            {'qpos="0 0 0.6594': 'qpos="0 0 0.81'},
            "error",
            "right_foot at home: 150.6 mm above the floor; a trunk at z = 0.6594",
        ),
        ({'qpos="0 0 0.6594': 'qpos="0 0 0.65'}, "warning", "right_foot at home: 9.4 mm in the floor"),
        ({'kp="300" kv="8" forcerange="-80 80"': 'kp="6" kv="2" forcerange="-80 80"'}, "warning", "joint 'right_knee': "),
        ({'kp="300" kv="8" forcerange="-80 80"': 'kp="300" kv="8" forcerange="-3 3"'}, "warning", "with all of its force"),
        ({'forcerange="-80 80"': 'forcerange="-80 80" ctrlrange="0.5 0.9"'}, "warning", "targets are clipped to 0.5 .. 0.9"),
        ({'kp="200" kv="6"': 'kp="2e6" kv="6"'}, "warning", "with all of its force, to and fro; lower its kp"),
        ({'kp="200" kv="6"': 'gear="100" kp="200" kv="6"'}, "error", "joint 'right_hip_pitch' is the stiffest, 2e+06 N m/rad"),
        ({' priority="1"': ""}, "warning", "right_foot: its own friction counts beside the floor's"),
        (
            {TRUNK: TRUNK.replace("0 0 0.1", "0 0 -0.4").replace("0.09 0.13 0.1", "0.3 0.05 0.2594")},  # a box on the ground
            "warning",
            "load on the feet: ",
        ),
    ],
    ids=lambda value: value[:30] if isinstance(value, str) else "",
)
def test_what_is_wrong_is_said(findings: Callable[..., list[Finding]], edits: dict[str, str], verdict: str, said: str) -> None:
    found = findings(edits)
    assert found and found[0].verdict == verdict, found
    assert any(said in str(one) for one in found), "\n".join(map(str, found))


@pytest.mark.parametrize("limit", [0.7, 2.0])
def test_hips_below_the_limit_of_a_fall_are_told_with_the_setting(findings: Callable[..., list[Finding]], limit: float) -> None:
    (found,) = findings({}, f"terminations.fallen.min_hip_height={limit}")
    assert found.verdict == "error"
    assert f"0.659 m at home, and below {limit:g} m (terminations.fallen.min_hip_height) is a fall" in str(found)
    assert "set terminations.fallen.min_hip_height=0.4" in str(found)


def test_a_termination_that_ends_everything_at_once_is_named(findings: Callable[..., list[Finding]]) -> None:
    found = findings({}, "terminations.tilted={max_tilt: 0.001}")
    assert found[0].verdict == "error"
    assert found[0].check == "terminations.tilted"


@pytest.fixture
def own_terms() -> Iterator[None]:
    """Terms of a user's, with mistakes."""

    @reward
    def logarithm(step: Step, *, k: Annotated[float, Quantity()]) -> Tensor:
        """Logarithm of a speed that may be negative."""
        return k * torch.log(step.base_lin_vel_b[:, 0])

    @reward
    def idle(step: Step, *, k: Annotated[float, Quantity()]) -> Tensor:
        """The same whatever happens."""
        return k * torch.ones_like(step.time)

    @observation(unit="-")
    def ratio(step: Step) -> Tensor:
        """Zero over zero at the start."""
        return (step.time / step.time)[:, None] * float("nan")

    yield
    del TERMS["reward"]["logarithm"], TERMS["reward"]["idle"], TERMS["observation"]["ratio"]


def test_a_reward_that_is_no_number_or_never_changes_is_named(findings: Callable[..., list[Finding]], own_terms: None) -> None:
    found = findings({}, "rewards.logarithm.k=1.0")
    assert found[0].verdict == "error"
    assert "reward 'logarithm' is nan in world" in str(found[0])
    (found,) = findings({}, "rewards.idle.k=2.0")
    assert (found.verdict, found.check) == ("warning", "reward 'idle'")
    assert "is 2 always" in found.found


def test_an_observation_that_is_no_number_is_named(findings: Callable[..., list[Finding]], own_terms: None) -> None:
    found = findings({}, "observations.policy={joint_pos: {}, joint_vel: {}, ratio: {}, command: {}, phase: {}}")
    assert next(str(one) for one in found if one.verdict == "error").startswith("observation 'policy.ratio': is not finite")


def test_the_test_draws_no_random_numbers_of_others(findings: Callable[..., list[Finding]]) -> None:
    torch.manual_seed(7)
    before = torch.get_rng_state()
    findings({})
    assert torch.equal(torch.get_rng_state(), before)
