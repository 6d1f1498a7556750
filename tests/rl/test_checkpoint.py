"""Checkpoints come back as they were written; whatever else a file holds is one line to the user and is never run."""

import pickle
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from telebip import ROOT
from telebip.config import TaskConfig, load_task
from telebip.errors import UserError
from telebip.mdp.term import TERMS, observation, reward
from telebip.rl.checkpoint import FORMAT, Checkpoint, load_checkpoint, save_checkpoint
from telebip.rl.policy import load_policy
from telebip.rl.resume import require_complete


@pytest.fixture
def config() -> TaskConfig:
    return load_task("telebip_slow", ["num_envs=16", "gait.period=0.6"])


def learner() -> dict[str, Any]:
    weights = {"mlp.0.weight": torch.arange(12.0).reshape(3, 4), "std": torch.full((6,), 0.5)}
    return {"actor_state_dict": weights, "optimizer_state_dict": {"state": {}, "param_groups": [{"lr": 2e-4}]}}


LAYOUT = {"policy": [{"name": "phase", "size": 2, "unit": "-", "mirror": ([1, 0], [1.0, 1.0])}]}


def checkpoint(path: Path, config: TaskConfig, iteration: int = 7) -> Checkpoint:
    return Checkpoint(
        path=path,
        task="telebip_slow",
        config=config,
        iteration=iteration,
        samples=100 * iteration,
        observations=LAYOUT,
        joint_names=["right_knee", "left_knee"],
        joint_mirror=([1, 0], [1.0, 1.0]),
        learner=learner(),
        training=[],
        robot={"weight": [133.4]},
    )


def write(path: Path, config: TaskConfig, iteration: int = 7) -> Path:
    save_checkpoint(checkpoint(path, config, iteration))
    return path


def refusal(path: Path) -> str:
    """Return the one line that names the path and refuses it."""
    with pytest.raises(UserError) as caught:
        load_checkpoint(path)
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    assert str(path) in message
    return message


def test_a_checkpoint_comes_back_as_it_was_written(tmp_path: Path, config: TaskConfig) -> None:
    path = write(tmp_path / "model_7.pt", config)
    loaded = load_checkpoint(path)
    assert (loaded.path, loaded.task, loaded.iteration, loaded.samples) == (path, "telebip_slow", 7, 700)
    assert (loaded.config, loaded.observations, loaded.robot) == (config, LAYOUT, {"weight": [133.4]})
    assert (loaded.joint_names, loaded.joint_mirror) == (["right_knee", "left_knee"], ([1, 0], [1.0, 1.0]))
    assert (loaded.missing, loaded.training) == ((), [])
    assert set(loaded.learner) == {"actor_state_dict", "optimizer_state_dict"}
    for name, weight in learner()["actor_state_dict"].items():
        assert torch.equal(loaded.learner["actor_state_dict"][name], weight)
    assert loaded.learner["optimizer_state_dict"] == learner()["optimizer_state_dict"]
    assert load_checkpoint(str(path)).iteration == 7


def test_a_folder_stands_for_its_newest_checkpoint_by_number(tmp_path: Path, config: TaskConfig) -> None:
    for iteration in (10, 9, 2):
        write(tmp_path / f"model_{iteration}.pt", config, iteration)
    write(tmp_path / "policy.pt", config, 11)
    for name in ("model_12.partial", "model_13.pt.bak", "model_best.pt"):
        (tmp_path / name).write_bytes(b"not this one")
    assert load_checkpoint(tmp_path).path == tmp_path / "model_10.pt"


def test_a_folder_with_a_policy_alone_stands_for_it(tmp_path: Path, config: TaskConfig) -> None:
    assert load_checkpoint(write(tmp_path / "policy.pt", config).parent).path == tmp_path / "policy.pt"


def test_a_missing_path_and_an_empty_folder(tmp_path: Path) -> None:
    assert "does not exist" in refusal(tmp_path / "model_1.pt")
    assert "holds no checkpoint" in refusal(tmp_path)


def test_truncated_files_are_refused(tmp_path: Path, config: TaskConfig) -> None:
    content = write(tmp_path / "whole.pt", config).read_bytes()
    for length in (0, 1, 10, 100, len(content) // 2, len(content) - 1):
        path = tmp_path / f"first_{length}_bytes.pt"
        path.write_bytes(content[:length])
        refusal(path)


def test_random_bytes_are_refused(tmp_path: Path) -> None:
    for seed in range(40):
        path = tmp_path / f"random_{seed}.pt"
        path.write_bytes(np.random.default_rng(seed).bytes(1 + 50 * seed))
        refusal(path)


def test_a_single_flipped_bit_is_noticed_or_harmless(tmp_path: Path, config: TaskConfig) -> None:
    path = write(tmp_path / "whole.pt", config)
    content, whole = path.read_bytes(), load_checkpoint(path)
    random, refused = np.random.default_rng(1), 0
    for i in range(200):
        damaged = bytearray(content)
        damaged[int(random.integers(len(content)))] ^= 1 << int(random.integers(8))
        path = tmp_path / f"flipped_{i}.pt"
        path.write_bytes(bytes(damaged))
        try:
            loaded = load_checkpoint(path)
        except UserError as error:
            assert str(path) in str(error)
            refused += 1
        else:  # it was between the records
            assert loaded.config == whole.config
            assert (loaded.iteration, loaded.samples) == (7, 700)
            for name, weight in learner()["actor_state_dict"].items():
                assert torch.equal(loaded.learner["actor_state_dict"][name], weight)
    assert refused > 50


def test_scribbled_files_are_refused_or_still_whole(tmp_path: Path, config: TaskConfig) -> None:
    content = write(tmp_path / "whole.pt", config).read_bytes()
    random = np.random.default_rng(0)
    for i in range(40):
        damaged = bytearray(content)
        start = int(random.integers(len(content) - 64))
        damaged[start : start + 64] = random.bytes(64)
        path = tmp_path / f"scribbled_{i}.pt"
        path.write_bytes(bytes(damaged))
        try:
            assert load_checkpoint(path).iteration == 7
        except UserError as error:
            assert len(str(error).splitlines()) == 1
            assert str(path) in str(error)


class RunsCode:
    """Unpickling an object of this class creates a file."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (self.marker,))


def test_a_pickle_that_would_run_code_is_refused_and_not_run(tmp_path: Path) -> None:
    marker, path = tmp_path / "marker", tmp_path / "model_1.pt"
    torch.save({"format": FORMAT, "payload": RunsCode(marker)}, path)
    assert "more than data" in refusal(path)
    assert not marker.exists()
    pickle.loads(pickle.dumps(RunsCode(marker)))
    assert marker.exists()  # pickle would have run it


@pytest.mark.parametrize(
    "content", [{"model_state_dict": {}, "iter": 3}, [1, 2, 3], torch.zeros(3)], ids=["dict", "list", "tensor"]
)
def test_a_foreign_file_is_refused(tmp_path: Path, content: Any) -> None:
    torch.save(content, tmp_path / "foreign.pt")
    assert "is not a telebip checkpoint" in refusal(tmp_path / "foreign.pt")


def edited(path: Path, config: TaskConfig, changes: dict[str, Any]) -> Path:
    """Write a checkpoint with some of its entries replaced, or dropped where the change is None."""
    content = torch.load(write(path, config), weights_only=True) | changes
    torch.save({key: value for key, value in content.items() if value is not None}, path)
    return path


def test_another_format_is_refused(tmp_path: Path, config: TaskConfig) -> None:
    for other in ("telebip-checkpoint-1", "telebip-checkpoint-9"):
        message = refusal(edited(tmp_path / "model_1.pt", config, {"format": other}))
        assert f"has format '{other}', this version reads '{FORMAT}'" in message


@pytest.fixture
def own_terms() -> Iterator[None]:
    before = [(terms, dict(terms)) for terms in TERMS.values()]
    yield
    for terms, own in before:
        terms.clear()
        terms.update(own)


def test_terms_that_are_unknown_here_are_left_out_and_named(tmp_path: Path, own_terms: None) -> None:
    @reward
    def level(step, *, k: float):
        return k * step.time

    @observation(unit="s")
    def clock(step):
        return step.time[:, None]

    config = load_task("telebip_flat", ["rewards.level.k=0.5", "observations.critic={phase: {}, clock: {}}"])
    path = write(tmp_path / "model_7.pt", config)
    assert load_checkpoint(path).missing == ()
    require_complete(load_checkpoint(path))
    del TERMS["reward"]["level"], TERMS["observation"]["clock"]
    loaded = load_checkpoint(path)
    assert set(loaded.missing) == {"rewards.level", "observations.critic.clock"}
    assert "level" not in loaded.config.rewards
    assert loaded.config.rewards["cmd"] == config.rewards["cmd"]
    with pytest.raises(UserError, match=r"model_7.pt' cannot be resumed without .*rewards\.level.*: go on with the program"):
        require_complete(loaded)


def test_a_policy_that_sees_an_unknown_term_is_refused(tmp_path: Path, own_terms: None) -> None:
    @observation(unit="s")
    def clock(step):
        return step.time[:, None]

    path = write(tmp_path / "model_7.pt", load_task("telebip_flat", ["observations.policy.clock={}"]))
    del TERMS["observation"]["clock"]
    assert "unknown observation 'clock'" in refusal(path)


def test_the_network_has_the_layouts_size(tmp_path: Path, config: TaskConfig) -> None:
    small = replace(config, ppo=replace(config.ppo, hidden_dims=[4], obs_normalization=False))
    shapes = {
        "mlp.0.weight": (4, 2),
        "mlp.0.bias": (4,),
        "mlp.2.weight": (2, 4),
        "mlp.2.bias": (2,),
        "distribution.std_param": (2,),
    }
    weights = {name: torch.ones(shape) for name, shape in shapes.items()}
    fits = replace(checkpoint(tmp_path / "policy.pt", small), learner={"actor_state_dict": weights})
    save_checkpoint(fits)
    action = load_policy(load_checkpoint(tmp_path), "cpu")(TensorDict({"policy": torch.zeros(3, 2)}, batch_size=[3]))
    assert action.tolist() == [[5.0, 5.0]] * 3  # 4 x elu(1) + 1
    with pytest.raises(UserError, match="its weights do not fit its configuration"):
        load_policy(replace(fits, joint_names=["knee"]), "cpu")


@pytest.mark.parametrize("entry", ["task", "config", "observations", "joint_names", "joint_mirror", "iteration", "samples"])
def test_a_missing_entry_is_refused(tmp_path: Path, config: TaskConfig, entry: str) -> None:
    refusal(edited(tmp_path / "model_1.pt", config, {entry: None}))


def test_a_configuration_of_another_version_is_refused(tmp_path: Path, config: TaskConfig) -> None:
    message = refusal(edited(tmp_path / "model_1.pt", config, {"config": "gait: {perod: 0.5}\n"}))
    assert "gait.period" in message


def test_interrupted_writing_leaves_the_older_file(tmp_path: Path, config: TaskConfig) -> None:
    path = write(tmp_path / "model_7.pt", config)
    before = path.read_bytes()
    with pytest.raises(Exception, match=r"pickle|local|lambda"):  # breaks off amidst the writing
        save_checkpoint(replace(checkpoint(path, config, 8), learner={"weights": torch.zeros(9), "bad": lambda: None}))
    assert path.read_bytes() == before
    assert load_checkpoint(tmp_path).iteration == 7


@pytest.mark.parametrize(
    ("entry", "value"),
    [
        *[("task", 3), ("iteration", "x"), ("samples", 1.5), ("actor_state_dict", [1]), ("training", 5), ("robot", ["mass"])],
        *[("observations", []), ("joint_names", "knee"), ("joint_mirror", 1.0)],
    ],
)
def test_an_entry_of_another_kind_is_refused(tmp_path: Path, config: TaskConfig, entry: str, value: Any) -> None:
    assert f"its {entry} is no " in refusal(edited(tmp_path / "model_1.pt", config, {entry: value}))


def test_a_folder_without_checkpoints_hides_no_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "telebip_flat").mkdir()  # as in `runs/`, which has a folder for each task
    assert load_checkpoint("telebip_flat").path == ROOT / "assets" / "policies" / "telebip_flat" / "policy.pt"
