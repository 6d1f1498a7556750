"""Keys of the MuJoCo viewer do to the robot what they say; the window itself takes a display."""

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.viz.viewer import BACKSPACE, DOWN, END, ENTER, HOME, LEFT, PUSH_FORCE, RIGHT, SPACE, UP, KeyboardSteering, steer


class Zero:
    """Holds the nominal pose, and counts how often it is told to forget everything."""

    def __init__(self) -> None:
        self.resets = 0

    def __call__(self, obs: TensorDict) -> Tensor:
        return torch.zeros(obs.batch_size[0], 6)

    def reset(self, mask: Tensor, /) -> None:
        self.resets += bool(mask.all())


@pytest.fixture
def policy() -> Zero:
    return Zero()


@pytest.fixture
def steering(make_env: Callable[..., TelebipEnv], policy: Zero) -> KeyboardSteering:
    env = make_env("events.start_pose.heading=0", num_envs=1, calm=True)
    env.set_command(0.5, 0.0, 0.0)
    steering = KeyboardSteering(env, policy)
    steering.step()
    return steering


@pytest.mark.parametrize(
    ("keys", "command"),
    [
        ([UP, UP], [0.7, 0.0, 0.0]),
        ([DOWN], [0.4, 0.0, 0.0]),
        ([LEFT], [0.5, 0.0, 0.1]),
        ([RIGHT, RIGHT, UP], [0.6, 0.0, -0.2]),
        ([HOME, HOME, LEFT], [0.5, 0.2, 0.1]),
        ([END], [0.5, -0.1, 0.0]),
        ([DOWN] * 8, [-0.3, 0.0, 0.0]),  # backward
        ([ord("W")], [0.5, 0.0, 0.0]),
    ],
)
def test_keys_change_the_command(steering: KeyboardSteering, keys: list[int], command: list[float]) -> None:
    for key in keys:
        steering.press(key)
    steering.step()
    torch.testing.assert_close(steering.env.state.target_command, torch.tensor([command]))


def test_enter_pushes_for_a_tenth_of_a_second_from_either_side(steering: KeyboardSteering) -> None:
    pushes = []
    for _ in range(2):
        steering.press(ENTER)
        for _ in range(7):
            steering.step()
            pushes.append(steering.env.state.wrench_w[0, 1].item())
    assert pushes == [-PUSH_FORCE] * 5 + [0.0, 0.0] + [PUSH_FORCE] * 5 + [0.0, 0.0]


def test_a_push_moves_the_robot(steering: KeyboardSteering) -> None:
    steering.press(ENTER)
    for _ in range(5):
        steering.step()
    # 60 N for 0.1 s on 13.6 kg; the feet hold some of it back.
    assert -0.5 < steering.env.sim.state.base_lin_vel_w[0, 1] < -0.1


def test_space_pauses(steering: KeyboardSteering) -> None:
    steering.press(SPACE)
    before = steering.env.sim.state.qpos.clone()
    steering.step()
    assert torch.equal(steering.env.sim.state.qpos, before)
    steering.press(SPACE)
    steering.step()
    assert not torch.equal(steering.env.sim.state.qpos, before)


def test_backspace_starts_anew_even_in_a_pause(steering: KeyboardSteering, policy: Zero) -> None:
    for key in (UP, ENTER, SPACE):
        steering.press(key)
    for _ in range(10):
        steering.step()
    assert policy.resets == 1
    steering.press(BACKSPACE)
    steering.step()
    assert steering.env.episode_length_buf.item() == 0
    assert steering.command == [0.5, 0.0, 0.0]
    assert steering.force_w.abs().max() == 0.0
    steering.press(SPACE)
    steering.step()
    assert policy.resets == 2
    assert steering.env.episode_length_buf.item() == 1
    assert steering.env.state.wrench_w.abs().max() == 0.0


def test_numbers_are_of_the_last_second(steering: KeyboardSteering) -> None:
    names, values = steering.numbers()
    assert names.splitlines() == ["command", "speed", "cost of transport"]
    command, speed, _ = values.splitlines()
    assert command == "0.5 m/s, 0.0 m/s left, +0.0 rad/s"
    assert float(speed.split()[0]) == pytest.approx(steering.env.sim.state.base_lin_vel_w[0, 0].item(), abs=0.02)


def test_no_display_is_one_line(steering: KeyboardSteering, policy: Zero, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(UserError, match=r"^the MuJoCo viewer needs a display, .* or --record FILE\.mp4$"):
        steer(steering.env, policy)
    monkeypatch.setenv("DISPLAY", ":4711")
    with pytest.raises(UserError, match=r"cannot open the display ':4711'"):
        steer(steering.env, policy)
