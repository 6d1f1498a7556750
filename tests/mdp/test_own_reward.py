"""A reward by one function and one line of YAML: docs/rewards.md does what it says."""

import math
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from processes import forked
from worlds import MakeEnv, put

from telebip import ROOT
from telebip.config import load_task
from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.mdp import rewards
from telebip.mdp.context import StepContext
from telebip.mdp.rewards import EXTRA, reward_term
from telebip.rl.curve import read_curve

TINY = ("--num-envs", "4", "--device", "cpu", "--max-iterations", "1", "ppo.num_steps_per_env=4", "ppo.hidden_dims=[8,8]")
SHORT = ("--duration", "0.1", "--device", "cpu")


@pytest.fixture(autouse=True)
def own_terms_only_in_this_test() -> Iterator[None]:
    yield
    EXTRA.clear()


def block(language: str) -> str:
    """Return the code block of the page."""
    text = (ROOT / "docs" / "rewards.md").read_text(encoding="utf-8")
    (code,) = re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)
    return code


def test_the_page_trains_as_it_says(tmp_path: Path) -> None:
    (tmp_path / "train_level.py").write_text(block("python"))
    (tmp_path / "level.yaml").write_text(block("yaml"))
    done = subprocess.run(
        [sys.executable, "train_level.py", "--task", "level.yaml", *TINY],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert (done.returncode, done.stderr) == (0, "")
    (run_dir,) = (tmp_path / "runs" / "level").iterdir()
    (row,) = read_curve(run_dir)
    assert -0.05 < row["reward/level"] < 0.0  # the trunk tilts by a few degrees in the first steps

    play = forked(str(ROOT / "scripts" / "play.py"), "--checkpoint", str(run_dir), *SHORT, cwd=tmp_path)
    assert play.returncode == 0, play.stderr  # the function is not there


def test_the_environment_adds_weight_times_function(make_env: MakeEnv) -> None:
    exec(block("python").replace('if __name__ == "__main__":', "if False:"), {})
    plain, env = make_env(calm=True), make_env("reward.extra.level=-0.5", calm=True)
    angle = 0.2  # rad of roll
    for worlds in (plain, env):
        qpos = worlds.sim.state.qpos.clone()
        qpos[:, 2] = 2.0  # in free fall, so that it stays tilted
        qpos[:, 3:7] = torch.tensor([math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0])
        put(worlds, [0, 1, 2, 3], qpos, torch.zeros(4, 12))
    _, expected, *_ = plain.step(torch.zeros(4, 6))
    _, reward, _, extras = env.step(torch.zeros(4, 6))
    torch.testing.assert_close(reward - expected, torch.full((4,), -0.5 * math.sin(angle) ** 2), atol=1e-3, rtol=0.0)
    assert extras["log"]["reward/level"].item() == pytest.approx(-0.5 * math.sin(angle) ** 2, abs=1e-3)


def test_a_name_without_a_function_is_one_line(robot) -> None:
    def make(name: str) -> None:
        TelebipEnv(load_task("telebip_flat", ["num_envs=1", f"reward.extra.{name}=1"]), robot, "cpu", "native")

    with pytest.raises(UserError, match=r"^reward.extra.level: no function 'level' is marked @reward_term; no function is"):
        make("level")
    reward_term(height)
    with pytest.raises(UserError, match=r"reward.extra.heigth: .*did you mean 'height'\?"):
        make("heigth")
    make("height")


def height(step: StepContext) -> torch.Tensor:
    return step.state.base_pos[:, 2]


def test_a_name_that_is_taken() -> None:
    def cmd(step: StepContext) -> torch.Tensor:
        return height(step)

    with pytest.raises(ValueError, match="is called 'cmd'"):
        reward_term(cmd)


def test_weights_are_numbers_and_can_be_taken_back() -> None:
    weighted = load_task("telebip_flat", ["reward.extra={level: -0.5, height: 1}"])
    assert weighted.reward.extra == {"level": -0.5, "height": 1.0}
    assert load_task(weighted, ["reward.extra.level=-1"]).reward.extra == {"level": -1.0, "height": 1.0}
    assert load_task(weighted, ["reward.extra={}"]).reward.extra == {}
    with pytest.raises(UserError, match=r"reward.extra.level=much': reward.extra.level: 'much' is not a number"):
        load_task("telebip_flat", ["reward.extra.level=much"])
    with pytest.raises(UserError, match=r"reward.extra.level must be finite"):
        load_task("telebip_flat", ["reward.extra.level=.inf"])
    with pytest.raises(UserError, match=r"reward.extra: 3 is not a mapping of names to numbers"):
        load_task("telebip_flat", ["reward.extra=3"])
    assert rewards.reward_terms(load_task("telebip_flat").reward).keys() == rewards.REWARDS.keys()
