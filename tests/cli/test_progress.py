"""What a training shows on a terminal: iteration, time left and speed error are whole, however narrow it is."""

import io

import pytest
from rich.console import Console

from telebip.cli.progress import sparkline, training_progress
from telebip.config import load_task
from telebip.env import TelebipEnv
from telebip.rl.train import Trainer
from telebip.robot import Robot

SMALL = ("num_envs=8", "ppo.num_steps_per_env=10", "ppo.hidden_dims=[16,16]", "ppo.max_iterations=3000")


@pytest.mark.parametrize("width", [60, 80, 120, 200])
def test_the_progress_is_whole_on_a_terminal(robot: Robot, tmp_path, width: int) -> None:
    trainer = Trainer(TelebipEnv(load_task("telebip_flat", SMALL), robot, "cpu", "native"), "telebip_flat", tmp_path)
    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, width=width, highlight=False, color_system=None)
    with training_progress(console, trainer) as show:
        scalars = trainer.iterate()
        show(scalars)
    text = screen.getvalue()
    assert "1/3000 eta " in text
    assert f"error {scalars['error/lin_vel_mps']:.2f} m/s | {scalars['walk/falls_per_minute']:.1f} falls/min" in text
    assert "k/s" in text
    assert "…" not in text


def test_a_sparkline_rises_with_its_numbers() -> None:
    assert sparkline([0.0, 0.13, 0.5, 0.99, 1.0]) == "▁▂▅██"
