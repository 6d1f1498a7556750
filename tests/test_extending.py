# pyright: reportAttributeAccessIssue=false, reportArgumentType=false
"""Everything that docs/extending.md shows, done from the outside: a YAML file and, where the page says so, one script."""

import json
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import mujoco
import numpy as np
import pytest
import torch
import yaml
from processes import forked

import telebip.mdp.terms  # noqa: F401 (so that all terms are there before the fixture below looks)
from telebip import ROOT, Quantity, Step, load_task, observation, reward
from telebip.cli import evaluate, export, play, train
from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.mdp.term import TERMS
from telebip.rl import learner
from telebip.rl.checkpoint import load_checkpoint
from telebip.rl.curve import read_curve
from telebip.rl.onnx import OnnxPolicy
from telebip.robot import Robot, load_robot
from telebip.sim import Backend

TINY = ("--num-envs", "8", "--device", "cpu", "--max-iterations", "2", "ppo.num_steps_per_env=5", "ppo.hidden_dims=[8,8]")
CALM = ("events.push=null", "events.friction=null", "observations.policy.noise=false")
PAGE = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    """Return the page's code blocks in a language."""
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture(autouse=True)
def own_terms_only_in_this_test() -> Iterator[None]:
    before = {kind: dict(terms) for kind, terms in TERMS.items()}
    yield
    for kind, terms in before.items():
        TERMS[kind].clear()
        TERMS[kind].update(terms)


def write_task(folder: Path, text: str, name: str = "mine.yaml") -> str:
    (folder / name).write_text(text if "base:" in text else f"base: telebip_flat\n{text}")
    return str(folder / name)


def train_in(folder: Path, task: str, *more: str) -> Path:
    """Train two iterations and return the run's folder."""
    train.main(["--task", task, "--log-dir", str(folder / "runs"), *TINY, *more])
    (run_dir,) = (folder / "runs" / Path(task).stem).iterdir()
    return run_dir


# Terms of one's own


def test_a_script_with_terms_of_its_own_is_telebips_command(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(blocks("python")[0])
    write_task(tmp_path, blocks("yaml")[0])

    def run(*arguments: str) -> "subprocess.CompletedProcess[str]":
        done = subprocess.run(
            [sys.executable, "mine.py", *arguments], cwd=tmp_path, capture_output=True, text=True, timeout=300
        )
        assert (done.returncode, done.stderr) == (0, ""), done.stderr
        return done

    trained = run("train", "--task", "mine.yaml", *TINY)
    (run_dir,) = (tmp_path / "runs" / "mine").iterdir()
    assert f"{tmp_path / 'mine.py'} play --checkpoint {run_dir} --viewer rerun" in trained.stdout
    row = read_curve(run_dir)[-1]
    assert -0.5 < row["reward/level"] < 0.0
    assert row["termination/off_the_track_per_minute"] == 0.0
    assert "reward/tq" not in row
    assert "mean speed" in run("play", "--checkpoint", str(run_dir), "--duration", "0.2", "--device", "cpu").stdout

    alone = forked(str(ROOT / "scripts" / "play.py"), "--checkpoint", str(run_dir), "--duration", "0.2", cwd=tmp_path)
    assert alone.returncode == 2  # the policy's own observation is not there
    assert "unknown observation 'pitch'" in alone.stderr
    assert alone.stderr.count("\n") == 1


def test_a_policy_walks_without_the_rewards_that_it_was_trained_for(tmp_path: Path) -> None:
    @reward
    def hop(step: Step, *, k: float) -> torch.Tensor:
        return k * step.state.base_lin_vel_w[:, 2]

    run_dir = train_in(tmp_path, write_task(tmp_path, "rewards: {hop: {k: 0.1}}"))
    del TERMS["reward"]["hop"]
    play.main(["--checkpoint", str(run_dir), "--duration", "0.2", "--device", "cpu"])
    with pytest.raises(UserError, match=r"rewards\.hop"):
        train.main(["--resume", str(run_dir), "--max-iterations", "3"])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "rewards:\n  height: {gain: 1.0, lowest: 0.5}",
            r"mine.yaml:3: .*rewards\.height\.gain.*did you mean 'rewards\.height\.k'",
        ),
        ("rewards:\n  height: {k: 1.0, lowest: -1}", r"mine.yaml:3: rewards\.height\.lowest must be >= 0\S* m, got -1"),
        ("rewards:\n  height: {k: much, lowest: 1}", r"mine.yaml:3: rewards\.height\.k: 'much' is not a number"),
        ("rewards:\n  heigth: {k: 1.0}", r"mine.yaml:3: .*heigth.*did you mean 'height'"),
        ("rewards:\n  height: {k: 1.0}", r"rewards\.height\.lowest.* has no value"),
        ("events:\n  push: {strength: 3}", r"mine.yaml:3: .*events\.push\.strength"),
        ("terminations:\n  fallen: {min_hip_height: low}", r"mine.yaml:3: .*'low' is not a number"),
        ("observations:\n  policy:\n    joint_poss: {}", r"mine.yaml:4: .*joint_poss.*did you mean 'joint_pos'"),
        (
            "observations:\n  policy:\n    joint_pos: {noise: -1}",
            r"mine.yaml:4: observations\.policy\.joint_pos\.noise must be >= 0",
        ),
    ],
)
def test_what_is_wrong_with_a_term_is_said_with_its_place(tmp_path: Path, text: str, said: str) -> None:
    @reward
    def height(step: Step, *, k: float, lowest: Annotated[float, Quantity("m", ge=0)]) -> torch.Tensor:
        return k * (step.state.base_pos[:, 2] - lowest)

    with pytest.raises(UserError, match=said):
        load_task(write_task(tmp_path, text))


def test_an_observation_of_another_shape_is_refused_by_name(robot: Robot) -> None:
    @observation(unit="m")
    def altitude(step: Step) -> torch.Tensor:
        return step.state.base_pos[:, 2]

    with pytest.raises(UserError, match=r"observations\.policy\.altitude must return \(num_envs, size\), got \(4,\)"):
        TelebipEnv(load_task("telebip_flat", ["num_envs=4", "observations.policy.altitude={}"]), robot)


def test_a_name_that_is_taken_is_refused() -> None:
    with pytest.raises(ValueError, match=r"there is a reward called 'cmd' already, in telebip\.mdp\.rewards"):

        @reward
        def cmd(step: Step) -> torch.Tensor:
            return step.state.base_pos[:, 2]


def test_an_algorithm_of_ones_own_is_one_class_and_one_line_of_yaml(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learner, "ALGORITHMS", dict(learner.ALGORITHMS))
    exec(blocks("python")[1].replace("from telebip.rl.learner import ALGORITHMS", ""), {"ALGORITHMS": learner.ALGORITHMS})
    (text,) = (block for block in blocks("yaml") if "algorithm" in block)
    run_dir = train_in(tmp_path, write_task(tmp_path, text))
    assert load_checkpoint(run_dir).config.ppo.algorithm == "no_entropy"
    with pytest.raises(UserError, match=r"ppo.algorithm: unknown algorithm 'no_entrpy'; did you mean 'no_entropy'\?"):
        train.main(["--task", "telebip_flat", "--log-dir", str(tmp_path), *TINY, "ppo.algorithm=no_entrpy"])


# Groups, history, delays


def test_a_critic_sees_what_the_policy_does_not(tmp_path: Path) -> None:
    (text,) = (block for block in blocks("yaml") if "critic:" in block)
    run_dir = train_in(tmp_path, write_task(tmp_path, text))
    checkpoint = load_checkpoint(run_dir)
    actor, critic = (checkpoint.learner[f"{who}_state_dict"] for who in ("actor", "critic"))
    assert actor["mlp.0.weight"].shape[1] == 5 * (6 + 6 + 3 + 3 + 6 + 3 + 2)
    assert critic["mlp.0.weight"].shape[1] == 6 + 6 + 3 + 3 + 3 + 6 + 3 + 2 + 2 + 1 + 3 + 1
    train.main(["--resume", str(run_dir), "--max-iterations", "3"])
    export.main(["--checkpoint", str(run_dir), "--out", str(tmp_path / "policy.onnx")])
    about = OnnxPolicy(tmp_path / "policy.onnx").metadata
    names = [part["name"] for part in about["observation"]]
    assert names == ["joint_pos", "joint_vel", "base_ang_vel", "projected_gravity", "last_action", "command", "phase"]
    play.main(["--checkpoint", str(tmp_path / "policy.onnx"), "--duration", "0.2", "--device", "cpu"])


def test_history_and_delays_train_and_resume(tmp_path: Path) -> None:
    (text,) = (block for block in blocks("yaml") if "physics_delay" in block)
    run_dir = train_in(tmp_path, write_task(tmp_path, text))
    train.main(["--resume", str(run_dir), "--max-iterations", "3"])
    play.main(["--checkpoint", str(run_dir), "--duration", "0.2", "--device", "cpu"])


# Sensors and fields of the model


@pytest.mark.parametrize("backend", ["native", "warp"])
def test_a_sensor_is_an_observation_by_its_name(tmp_path: Path, robot: Robot, backend: Backend) -> None:
    (text,) = (block for block in blocks("yaml") if "accelerometer" in block)
    text = text.replace("sensor: accelerometer, mirror: polar, noise: 0.2", "sensor: gyro, mirror: axial")
    env = TelebipEnv(load_task(write_task(tmp_path, text), ["num_envs=3", *CALM]), robot, "cpu", backend)
    data, model = mujoco.MjData(robot.model), robot.model
    data.qpos[:], data.qvel[:] = (x[1].double().numpy() for x in (env.sim.state.qpos, env.sim.state.qvel))
    obs = env.step(torch.full((3, 6), 0.2))[0]["policy"]
    data.ctrl[:] = robot.nominal + 0.2 * env.world.action_scale.numpy()
    for _ in range(4):
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(obs[1, :3].numpy(), data.sensor("gyro").data, atol=2e-4)


def test_a_sensor_that_is_not_there_is_refused_by_name(robot: Robot) -> None:
    with pytest.raises(UserError, match="accellerometer"):
        TelebipEnv(
            load_task("telebip_flat", ["num_envs=1", "observations.policy.a={term: sensor, sensor: accellerometer}"]), robot
        )


FIELDS = {
    "trunk_mass: {term: mass, bodies: [trunk], scale: [1.5, 1.5]}": ("body_mass", "body_inertia"),
    "gains: {kp: [0.7, 0.7], kv: [1.3, 1.3]}": ("actuator_gainprm", "actuator_biasprm"),
    "damping: {term: model_field, field: dof_damping, range: [3.0, 3.0], operation: add}": ("dof_damping",),
    "armature: {term: model_field, field: dof_armature, range: [2.0, 2.0]}": ("dof_armature",),
    "centre: {term: model_field, field: body_ipos, names: [trunk], operation: add, range: [0.03, 0.03]}": ("body_ipos",),
    "limits: {term: model_field, field: actuator_forcerange, range: [0.2, 0.2]}": ("actuator_forcerange",),
    "mass: {scale: [0.6, 1.8], inertia: [0.5, 2.0]}": ("body_mass", "body_inertia"),
    "com: {bodies: [trunk, left_thigh, right_foot], offset: 0.05}": ("body_ipos",),
    "each: {term: gains, kp: [0.7, 1.3], kv: [0.7, 1.3]}": ("actuator_gainprm", "actuator_biasprm"),
    "spin: {term: model_field, field: geom_friction, names: [floor], column: 1, range: [3.0, 3.0]}": ("geom_friction",),
    "friction: {range: [0.1, 0.1], when: once}": ("geom_friction",),
}
"""An event's line of YAML, and what it changes."""


@pytest.mark.parametrize("backend", ["native", "warp"])
@pytest.mark.parametrize("line", FIELDS)
def test_a_randomised_field_moves_the_robot_as_an_edited_model_does(
    tmp_path: Path, robot: Robot, line: str, backend: Backend
) -> None:
    task = load_task(
        write_task(tmp_path, f"events:\n  push: null\n  {line}\n"), ["num_envs=2", "observations.policy.noise=false"]
    )
    env = TelebipEnv(task, robot, "cpu", backend)
    model = robot.engine_model()
    for name, values in env.sim.model_fields.items():
        field = getattr(model, name)
        changed = values[1].numpy().reshape(field.shape)
        assert name not in FIELDS[line] or np.abs(changed - field).max() > 1e-3, name
        field[:] = changed
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    data.qpos[:], data.qvel[:] = (x[1].double().numpy() for x in (env.sim.state.qpos, env.sim.state.qvel))
    for step in range(4):
        action = torch.full((2, 6), 0.5 if step % 2 else -0.5)
        env.step(action)
        data.ctrl[:] = env.state.joint_target[1].double().numpy()
        for _ in range(4):
            mujoco.mj_step(model, data)
    np.testing.assert_allclose(env.sim.state.qpos[1].numpy(), data.qpos, atol=1e-5 if backend == "native" else 1e-3)


def test_the_pages_randomisation_differs_between_worlds_and_trains(tmp_path: Path, robot: Robot) -> None:
    (text,) = (block for block in blocks("yaml") if "trunk_mass" in block)
    task = write_task(tmp_path, text)
    env = TelebipEnv(load_task(task, ["num_envs=4"]), robot)
    mass = env.sim.model_fields["body_mass"][:, env.sim.model.body("trunk").id]
    assert len(mass.unique()) == 4
    assert ((mass >= 9.0) & (mass <= 12.0)).all()
    run_dir = train_in(tmp_path, task)
    train.main(["--resume", str(run_dir), "--max-iterations", "3"])


# Robots with another number of joints


@pytest.mark.parametrize(("name", "joints"), [("ten_joints", 10), pytest.param("four_joints", 4, marks=pytest.mark.slow)])
def test_a_robot_with_another_number_of_joints_goes_through_everything(
    tmp_path: Path, name: str, joints: int, capsys: pytest.CaptureFixture[str]
) -> None:
    task = str(ROOT / "tests" / "robots" / f"{name}.yaml")
    robot = load_robot(load_task(task).sim.robot)
    assert len(robot.joint_names) == joints
    assert not isinstance(robot.mirror, str), robot.mirror
    run_dir = train_in(tmp_path, task, "ppo.symmetry=phase")
    train.main(["--resume", str(run_dir), "--max-iterations", "3"])
    play.main(["--checkpoint", str(run_dir), "--duration", "0.4", "--device", "cpu", "--record", str(tmp_path / "walk.gif")])
    assert (tmp_path / "walk.gif").stat().st_size > 1000
    measure = ["--suite", "tracking,push,gait", "--num-envs", "2", "--duration", "1", "--max-force", "5", "--push-worlds", "1"]
    evaluate.main(["--checkpoint", str(run_dir), *measure, "--device", "cpu", "--out", str(tmp_path / "report")])
    assert json.loads((tmp_path / "report" / "results.json").read_text())["tracking"]
    export.main(["--checkpoint", str(run_dir), "--out", str(tmp_path / "policy.onnx")])
    about = OnnxPolicy(tmp_path / "policy.onnx").metadata
    assert about["joint_names"] == list(robot.joint_names)
    assert len(about["stiffness"]) == joints
    capsys.readouterr()


def test_symmetry_is_refused_where_there_is_none(tmp_path: Path, robot: Robot) -> None:
    lame = (
        (ROOT / "assets" / "telebip.xml")
        .read_text()
        .replace(
            'name="left_thigh" type="cylinder" size="0.03 0.18" pos="0 0 -0.18" mass="0.8"',
            'name="left_thigh" type="cylinder" size="0.03 0.18" pos="0 0 -0.18" mass="1.8"',
        )
    )
    (tmp_path / "lame.xml").write_text(lame)
    task = write_task(tmp_path, "sim: {robot: lame.xml}\nppo: {symmetry: phase}\n")
    with pytest.raises(UserError, match=r"ppo\.symmetry=phase: .*not its own mirror image: mass"):
        train_in(tmp_path, task)


# Python


def test_the_pages_python_makes_worlds(capsys: pytest.CaptureFixture[str]) -> None:
    names: dict = {}
    exec(blocks("python")[2], names)
    assert names["env"].num_envs == 16
    assert names["env"].cfg.rewards["energy"]["k_energy"] == -0.3


def test_the_first_import_is_quick_and_touches_neither_torch_nor_an_engine() -> None:
    code = "import sys, telebip; print({'torch', 'warp', 'mujoco', 'rsl_rl'} & set(sys.modules)); print(telebip.make)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, cwd=ROOT)
    assert done.stdout.splitlines()[0] == "set()", done.stderr
    assert "function make" in done.stdout


def test_every_yaml_of_the_page_is_a_task(tmp_path: Path) -> None:
    exec(blocks("python")[0].replace('if __name__ == "__main__":', "if False:"), {})
    texts: Sequence[str] = blocks("yaml")
    assert len(texts) >= 5
    for text in texts:
        assert yaml.safe_load(text)
        load_task(write_task(tmp_path, text))
