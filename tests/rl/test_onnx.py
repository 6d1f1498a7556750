"""Policies exported to ONNX: the same actions, the whole description, and one line for whatever is wrong with a file."""

import json
from dataclasses import replace
from pathlib import Path

import onnx
import onnxruntime
import pytest
import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict

from telebip import ROOT
from telebip.config import load_task
from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.rl import export as exporting
from telebip.rl.checkpoint import Checkpoint, load_checkpoint
from telebip.rl.export import describe, export, largest_difference
from telebip.rl.onnx import OnnxPolicy
from telebip.rl.policy import load_network, load_policy, require_fit
from telebip.rl.symmetry import SymmetricPolicy
from telebip.robot import Robot

SHIPPED = ROOT / "assets" / "policies" / "telebip_flat"


@pytest.fixture(scope="module")
def shipped() -> Checkpoint:
    return load_checkpoint(SHIPPED)


@pytest.fixture(scope="module")
def exported(shipped: Checkpoint, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("export") / "policy.onnx"
    assert export(shipped, path) < 1e-5
    return path


def test_actions_are_those_of_the_checkpoint(shipped: Checkpoint, exported: Path) -> None:
    obs = torch.randn(1000, 33, generator=torch.Generator().manual_seed(3))
    expected = load_policy(shipped, "cpu")(TensorDict({"policy": obs}, batch_size=[1000]))
    policy = load_policy(load_checkpoint(exported), "cpu")
    assert isinstance(policy, OnnxPolicy)
    torch.testing.assert_close(policy(TensorDict({"policy": obs}, batch_size=[1000])), expected.detach(), atol=1e-5, rtol=1e-5)
    one = TensorDict({"policy": obs[:1]}, batch_size=[1])
    torch.testing.assert_close(policy(one), expected[:1].detach(), atol=1e-5, rtol=1e-5)  # any number of worlds


def test_normalisation_is_inside(shipped: Checkpoint, exported: Path) -> None:
    assert shipped.config.ppo.obs_normalization
    nodes = [node.op_type for node in onnx.load(exported).graph.node]
    assert nodes[:2] == ["Sub", "Div"]


def test_a_policy_without_normalisation(shipped: Checkpoint, tmp_path: Path) -> None:
    config = load_task("telebip_flat", ["ppo.obs_normalization=false", "ppo.hidden_dims=[8]"])
    weights = {"mlp.0.weight": (8, 33), "mlp.0.bias": (8,), "mlp.2.weight": (6, 8), "mlp.2.bias": (6,)}
    generator = torch.Generator().manual_seed(1)
    state = {name: torch.randn(shape, generator=generator) for name, shape in weights.items()}
    state["distribution.std_param"] = torch.ones(6)
    checkpoint = replace(shipped, path=tmp_path / "model_1.pt", task="mine", config=config, learner={"actor_state_dict": state})
    assert export(checkpoint, tmp_path / "policy.onnx", samples=100) < 1e-5
    assert load_checkpoint(tmp_path / "policy.onnx").task == "mine"


def test_a_symmetric_policy_brings_its_mirror(shipped: Checkpoint, tmp_path: Path) -> None:
    config = load_task(shipped.config, ["ppo.symmetry=phase"])
    symmetric = replace(shipped, config=config)  # any network serves: the mirror makes it symmetric
    assert export(symmetric, tmp_path / "policy.onnx") < 1e-5
    policy = load_policy(load_checkpoint(tmp_path / "policy.onnx"), "cpu")
    obs = torch.randn(100, 33, generator=torch.Generator().manual_seed(5))
    obs[:, 32] = -obs[:, 31]  # p_l = -p_r
    network = load_network(symmetric)
    assert isinstance(network, SymmetricPolicy)
    action = policy(TensorDict({"policy": obs}, batch_size=[100]))
    mirrored = policy(TensorDict({"policy": network.canonical.groups["policy"](obs)}, batch_size=[100]))
    torch.testing.assert_close(mirrored, network.canonical.joints(action), atol=1e-5, rtol=1e-5)


def test_the_description_is_complete_and_true(exported: Path, shipped: Checkpoint, robot: Robot) -> None:
    texts = onnxruntime.InferenceSession(str(exported)).get_modelmeta().custom_metadata_map  # as anyone would read it
    about = {key: json.loads(text) for key, text in texts.items()}
    assert about["joint_names"] == [
        f"{side}_{joint}" for side in ("right", "left") for joint in ("hip_roll", "hip_pitch", "knee")
    ]
    assert about["joint_unit"] == ["rad", "rad", "m"] * 2
    assert about["nominal_pose"] == [0.0, 0.0, 0.04] * 2
    assert about["action_scale"] == [0.25, 0.5, 0.1] * 2
    assert about["stiffness"] == [200.0, 200.0, 6000.0] * 2
    assert about["damping"] == [6.0, 6.0, 200.0] * 2
    assert about["force_range"] == [[-50.0, 50.0], [-50.0, 50.0], [-400.0, 400.0]] * 2
    assert about["force_unit"] == ["N m", "N m", "N"] * 2
    assert [(part["name"], part["size"]) for part in about["observation"]][:2] == [("joint_pos", 6), ("joint_vel", 6)]
    assert sum(part["size"] for part in about["observation"]) == 33
    assert all(part["scale"] == 1.0 and part["unit"] for part in about["observation"])
    assert about["history"] == 1
    assert (about["physics_dt"], about["step_dt"], about["gait_period"]) == (0.005, 0.02, 0.5)
    assert about["command_range"] == {"lin_vel_x": [0.4, 1.0], "lin_vel_y": [0.0, 0.0], "ang_vel_z": [-0.2, 0.2]}
    assert about["training_git_revision"] == json.loads((SHIPPED / "run.json").read_text())["starts"][-1]["git_revision"]
    assert about["git_revision"] is None or len(about["git_revision"]) == 40
    assert {**describe(shipped, robot), "format": about["format"]} == about


def test_no_path_of_this_machine_leaks(exported: Path) -> None:
    content = exported.read_bytes()
    assert str(ROOT).encode() not in content
    assert b"site-packages" not in content


def test_an_onnx_file_is_a_checkpoint_that_can_be_walked(exported: Path, shipped: Checkpoint) -> None:
    checkpoint = load_checkpoint(exported)
    assert (checkpoint.task, checkpoint.config, checkpoint.iteration) == (shipped.task, shipped.config, shipped.iteration)
    assert checkpoint.learner == {}
    with pytest.raises(UserError, match="is an ONNX file already"):
        export(checkpoint, exported)


def test_a_difference_is_found_and_nothing_is_written(
    shipped: Checkpoint, exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    actor = load_network(shipped)
    assert isinstance(actor, MLPModel)
    with torch.no_grad():
        actor.mlp[-1].bias[2] += 1e-3  # type: ignore[operator]
    assert largest_difference(actor, OnnxPolicy(exported), 100) == pytest.approx(1e-3, rel=0.01)  # of small actions
    monkeypatch.setattr(exporting, "TOLERANCE", 1e-12)
    with pytest.raises(UserError, match=r"not exported: .* differ by .*e-0[67]"):
        export(shipped, tmp_path / "policy.onnx", samples=100)
    assert list(tmp_path.iterdir()) == []


def test_files_that_are_no_policy(tmp_path: Path, exported: Path) -> None:
    garbage = tmp_path / "garbage.onnx"
    garbage.write_bytes(b"not a protocol buffer")
    with pytest.raises(UserError, match=r"garbage.onnx' is not a valid ONNX file"):
        load_checkpoint(garbage)
    foreign = onnx.load(exported)
    foreign.ClearField("metadata_props")
    onnx.save(foreign, tmp_path / "foreign.onnx")
    with pytest.raises(UserError, match=r"foreign.onnx' was not exported by telebip"):
        load_checkpoint(tmp_path / "foreign.onnx")


def test_a_policy_of_another_robot_is_refused(shipped: Checkpoint, exported: Path, robot: Robot, tmp_path: Path) -> None:
    other = replace(shipped, joint_names=[*shipped.joint_names[:5], "left_ankle"])
    with pytest.raises(UserError, match=r"has joints .*left_knee.*; the policy moves .*left_ankle"):
        export(other, tmp_path / "policy.onnx")
    env = TelebipEnv(load_task("telebip_flat", ["num_envs=1"]), robot)
    require_fit(load_checkpoint(exported), env)
    with pytest.raises(UserError, match=r"trained on another robot than .*: it moves the joints .*left_ankle, not .*left_knee"):
        require_fit(other, env)
    more = TelebipEnv(load_task("telebip_flat", ["num_envs=1", "observations.policy.history=2"]), robot)
    with pytest.raises(UserError, match=r"sees observations\.policy as .*phase \(2\); here it is .*phase \(2\), 2 times$"):
        require_fit(shipped, more)


def test_a_folder_that_is_not_there(shipped: Checkpoint, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"cannot write .*nowhere"):
        export(shipped, tmp_path / "nowhere" / "policy.onnx", samples=10)


def test_a_run_folder_without_notes(shipped: Checkpoint, robot: Robot, tmp_path: Path) -> None:
    assert describe(replace(shipped, path=tmp_path / "policy.pt"), robot)["training_git_revision"] is None
