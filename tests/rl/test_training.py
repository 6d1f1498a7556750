"""Training in real worlds: what a run leaves, how it goes on, and that it can be repeated."""

import math
import re
from pathlib import Path

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from telebip.config import load_task
from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.rl.averaging import Average
from telebip.rl.checkpoint import load_checkpoint
from telebip.rl.curve import CurveWriter, read_curve
from telebip.rl.learner import min_std
from telebip.rl.log import EpisodeStatistics, RunLog
from telebip.rl.policy import load_network, load_policy
from telebip.rl.train import Trainer
from telebip.robot import Robot

SMALL = ("num_envs=8", "ppo.num_steps_per_env=10", "ppo.hidden_dims=[16,16]", "episode.length=0.2")


def trainer(robot: Robot, run_dir: Path, iterations: int, *overrides: str) -> Trainer:
    config = load_task("telebip_flat", [*SMALL, f"ppo.max_iterations={iterations}", *overrides])
    return Trainer(TelebipEnv(config, robot, "cpu", "native"), "telebip_flat", run_dir)


def train(robot: Robot, run_dir: Path, iterations: int, *overrides: str) -> Trainer:
    done = trainer(robot, run_dir, iterations, *overrides)
    done.learn(stop=lambda: False, report=lambda scalars: None)
    return done


def scalars(run_dir: Path) -> dict[str, list[tuple[int, float]]]:
    """Return what TensorBoard shows: (samples, value) for each name."""
    events = EventAccumulator(str(run_dir))
    events.Reload()
    return {tag: [(event.step, event.value) for event in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


def test_a_run_leaves_checkpoints_and_curves_and_goes_on(robot: Robot, tmp_path: Path) -> None:
    first = train(robot, tmp_path, 2)
    assert (first.iteration, first.samples) == (2, 2 * 8 * 10)
    assert {path.name for path in tmp_path.glob("*.pt")} == {"model_2.pt", "policy.pt"}
    curves = scalars(tmp_path)
    assert set(curves) >= {
        *(f"reward/{name}" for name in first.env.cfg.rewards),
        *("error/lin_vel_mps", "error/yaw_rate_radps", "walk/cost_of_transport", "walk/falls_per_minute"),
        *("fault/non_finite_state", "train/episode_return", "train/episode_length", "train/action_std"),
        *("train/learning_rate", "loss/value", "loss/surrogate", "speed/samples_per_s"),
    }
    for name, curve in curves.items():
        assert [samples for samples, _ in curve] == [80, 160], name
        assert all(math.isfinite(value) for _, value in curve), name
    assert [value for _, value in curves["fault/non_finite_state"]] == [0.0, 0.0]
    assert 0.0 < curves["reward/cmd"][0][1] <= 0.35  # k_xy + k_w
    assert curves["reward/diff"][0][1] < 0.0

    checkpoint = load_checkpoint(tmp_path)
    second = trainer(robot, tmp_path, 4)
    second.resume(checkpoint)
    assert (second.iteration, second.samples) == (2, 160)
    for name, weight in first.learner.get_policy().state_dict().items():
        assert torch.equal(second.learner.get_policy().state_dict()[name], weight)
    moments = second.learner.optimizer.state_dict()["state"]
    assert moments[0]["step"] == first.learner.optimizer.state_dict()["state"][0]["step"] > 0
    second.learn(stop=lambda: False, report=lambda scalars: None)
    assert (second.iteration, second.samples) == (4, 320)
    assert {path.name for path in tmp_path.glob("*.pt")} == {"model_2.pt", "model_4.pt", "policy.pt"}
    assert [samples for samples, _ in scalars(tmp_path)["reward/cmd"]] == [80, 160, 240, 320]
    assert load_checkpoint(tmp_path / "policy.pt").iteration == 4


@pytest.mark.parametrize(("precision", "tolerance"), [("never", 1e-6), ("always", 0.02)])
def test_the_written_policy_acts_as_the_learner(robot: Robot, tmp_path: Path, precision: str, tolerance: float) -> None:
    """In float32 always: what the learner rounds to bfloat16 is a part of its learning."""
    done = train(robot, tmp_path, 2, f"ppo.mixed_precision={precision}")
    actor = done.learner.get_policy().eval()
    obs = done.env.get_observations()
    with torch.inference_mode():
        expected = actor(obs)
        for name in ("policy.pt", "model_2.pt"):
            policy = load_policy(load_checkpoint(tmp_path / name), "cpu")
            torch.testing.assert_close(policy(obs), expected, atol=tolerance, rtol=0.0)
            assert torch.equal(policy(obs), policy(obs))
    assert expected.abs().max() > 0.0
    assert set(load_checkpoint(tmp_path / "policy.pt").learner) == {"actor_state_dict"}


@pytest.mark.usefixtures("torch_threads")
@pytest.mark.parametrize("precision", ["never", "always"])
def test_the_same_seed_gives_the_same_weights_bit_for_bit(robot: Robot, tmp_path: Path, precision: str) -> None:
    runs, arithmetic = [("a", "seed=1"), ("b", "seed=1"), ("c", "seed=2")], f"ppo.mixed_precision={precision}"
    a, b, c = (train(robot, tmp_path / name, 2, seed, arithmetic).learner.get_policy().state_dict() for name, seed in runs)
    assert all(torch.equal(a[name], b[name]) for name in a)
    assert not all(torch.equal(a[name], c[name]) for name in a)


def test_the_floor_of_the_exploration_noise_falls_geometrically_between_its_ends() -> None:
    cfg = load_task("telebip_flat", ["ppo.min_std=0.16", "ppo.final_min_std=0.04", "ppo.min_std_ramp=[100,300]"]).ppo
    assert [min_std(cfg, samples) for samples in (0, 100, 200, 300, 10**9)] == pytest.approx([0.16, 0.16, 0.08, 0.04, 0.04])


def test_the_exploration_noise_keeps_to_its_floor(robot: Robot, tmp_path: Path) -> None:
    floor = ("ppo.init_std=0.1", "ppo.min_std=0.3", "ppo.final_min_std=0.2", "ppo.min_std_ramp=[80,160]")
    seen: list[float] = []
    trainer(robot, tmp_path, 3, *floor).learn(lambda: False, lambda scalars: seen.append(scalars["train/action_std"]))
    assert seen == pytest.approx([0.3, 0.3, 0.2])


def test_stopping_saves_what_was_learned(robot: Robot, tmp_path: Path) -> None:
    stopped = trainer(robot, tmp_path, 1000)
    stopped.learn(stop=lambda: stopped.iteration == 1, report=lambda scalars: None)
    assert load_checkpoint(tmp_path).iteration == 1


def test_a_checkpoint_of_other_networks_is_refused_in_one_line(robot: Robot, tmp_path: Path) -> None:
    train(robot, tmp_path, 1)
    checkpoint = load_checkpoint(tmp_path)
    with pytest.raises(UserError, match=r"^checkpoint '.*model_1.pt' cannot be resumed: [^\n]*$"):
        trainer(robot, tmp_path, 2, "ppo.hidden_dims=[8]").resume(checkpoint)


def test_more_mini_batches_than_samples_are_refused(robot: Robot, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"ppo.num_mini_batches is 81, but an iteration has only 8 worlds x 10 steps"):
        trainer(robot, tmp_path, 1, "ppo.num_mini_batches=81")


def test_a_single_sample_is_refused(robot: Robot, tmp_path: Path) -> None:
    single = ("num_envs=1", "ppo.num_steps_per_env=1", "ppo.num_mini_batches=1")
    with pytest.raises(UserError, match=r"one sample has nothing to compare; raise num_envs or ppo\.num_steps_per_env"):
        trainer(robot, tmp_path, 1, *single)


@pytest.mark.parametrize(
    ("overrides", "rate"), [([], None), (["ppo.learning_rate=1e-5"], 1e-5), (["ppo.schedule=fixed"], 2e-4)]
)
def test_a_new_learning_rate_is_heeded_and_an_adapted_one_kept(
    robot: Robot, tmp_path: Path, overrides: list[str], rate: float | None
) -> None:
    adapted = train(robot, tmp_path, 2).learner.learning_rate
    assert adapted != 2e-4
    second = trainer(robot, tmp_path, 3, *overrides)
    second.resume(load_checkpoint(tmp_path))
    assert second.learner.learning_rate == pytest.approx(rate or adapted, rel=1e-6)
    rates = [float(group["lr"]) for group in second.learner.optimizer.param_groups]
    assert rates == pytest.approx([rate or adapted], rel=1e-6)


def test_a_curve_counts_samples_exactly(tmp_path: Path) -> None:
    writer = CurveWriter(tmp_path, 0)
    writer.add({"samples": 10_403_840.0, "loss": 0.12345678})
    writer.add({"samples": 10_485_760.0, "loss": math.nan})
    CurveWriter(tmp_path, 10_485_760)
    lines = (tmp_path / "learning.csv").read_text().splitlines()
    assert lines == ["samples,loss", "10403840,0.123457", "10485760,nan"]


def test_a_curve_takes_new_columns(tmp_path: Path) -> None:
    """As when a run goes on with a version that logs more, or less."""
    older = CurveWriter(tmp_path, 0)
    older.add({"samples": 1.0, "old": 2.0})
    newer = CurveWriter(tmp_path, 1)
    newer.add({"samples": 2.0, "new": 3.0})
    first, second = read_curve(tmp_path)
    assert (first["samples"], first["old"], second["samples"], second["new"]) == (1.0, 2.0, 2.0, 3.0)
    assert math.isnan(first["new"]) and math.isnan(second["old"])
    with (tmp_path / "learning.csv").open("a") as file:
        file.write("3,4")  # killed while it was writing
    assert len(read_curve(tmp_path)) == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("samples,loss\n1,2\n2,3,4\n", "at line 3: 3 numbers under 2 names"),
        ("samples,loss\n1,2\n2\n", "at line 3: 1 numbers under 2 names"),
        ("samples,loss\n1,many\n", "at line 2: could not convert string to float: 'many'"),
        ("1,2\n", "its first line names no column 'samples'"),
    ],
)
def test_a_damaged_curve_is_named_before_a_run_goes_on(robot: Robot, tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "learning.csv").write_text(text)
    with pytest.raises(UserError, match=re.escape(message)):
        train(robot, tmp_path, 1)
    assert (tmp_path / "learning.csv").read_text() == text


def test_a_curve_damaged_during_a_run_costs_its_rows_and_no_more(tmp_path: Path) -> None:
    notes: list[str] = []
    log = RunLog(tmp_path, 0, notes.append)
    log.add(1, 80, {"loss": 1.0})
    with (tmp_path / "learning.csv").open("a") as file:
        file.write("saved,by,a,spreadsheet\n")
    log.add(2, 160, {"loss": 1.0, "new": 2.0})
    log.add(3, 240, {"loss": 1.0, "new": 2.0})
    log.close()
    assert (tmp_path / "learning.csv").read_text().splitlines()[2:] == ["saved,by,a,spreadsheet"]
    assert len(notes) == 1 and "learning.csv is damaged at line 3" in notes[0]
    assert [samples for samples, _ in scalars(tmp_path)["loss"]] == [80, 160, 240]


def test_episode_statistics_by_hand() -> None:
    statistics = EpisodeStatistics(2, torch.device("cpu"), min_episodes=2)
    assert all(math.isnan(value) for value in statistics.recent())
    for rewards, dones in (([1.0, 10.0], [False, False]), ([2.0, 20.0], [True, False]), ([4.0, 40.0], [False, True])):
        statistics.add(torch.tensor(rewards), torch.tensor(dones))
    # World 0 ended with 1 + 2 after 2 steps, world 1 with 10 + 20 + 40 after 3.
    assert statistics.recent() == (36.5, 2.5)
    statistics.add(torch.tensor([8.0, 80.0]), torch.tensor([True, False]))
    # World 0 ended with 4 + 8 after 2 steps; one episode is too few, so that the two before still count.
    assert statistics.recent() == pytest.approx(((3 + 70 + 12) / 3, 7 / 3))
    statistics.add(torch.tensor([5.0, 1.0]), torch.tensor([True, True]))
    # World 0 ended with 5 after 1 step, world 1 with 80 + 1 after 2: two episodes are enough, the older ones are dropped.
    assert statistics.recent() == (43.0, 1.5)
    statistics.add(torch.tensor([1.0, 1.0]), torch.tensor([False, False]))
    assert statistics.recent() == (43.0, 1.5)


def test_an_average_covers_the_latest_share_of_the_iterations() -> None:
    average = Average(0.5, {"w": torch.zeros(1), "count": torch.tensor(0)})
    seen = []
    for iteration, value in enumerate((4.0, 8.0, 2.0, 10.0), start=1):
        average.add({"w": torch.tensor([value]), "count": torch.tensor(iteration)}, iteration)
        seen.append(average.weights["w"].item())
    assert seen == pytest.approx([4.0, 8.0, 4.0, 7.0])  # all of it, all of it, two thirds of the way, half of it
    assert average.weights["count"] == 4


def test_what_is_saved_to_walk_is_the_average(robot: Robot, tmp_path: Path) -> None:
    done = train(robot, tmp_path, 3, "ppo.averaging=1.0")
    checkpoint, policy = load_checkpoint(tmp_path / "model_3.pt"), load_checkpoint(tmp_path / "policy.pt")
    name = "mlp.0.weight"
    latest, average = checkpoint.learner["actor_state_dict"][name], checkpoint.policy_weights[name]
    assert torch.equal(latest, done.learner.get_policy().state_dict()[name])
    assert not torch.equal(latest, average)
    assert torch.equal(policy.policy_weights[name], average)
    assert torch.equal(load_network(checkpoint).state_dict()[name], average)

    other = trainer(robot, tmp_path / "other", 3, "ppo.averaging=1.0")
    other.resume(checkpoint)
    assert torch.equal(other.policy().policy_weights[name], average)
    alone = train(robot, tmp_path / "alone", 3)
    assert torch.equal(alone.policy().policy_weights[name], latest)  # averaging changes nothing that is learned
