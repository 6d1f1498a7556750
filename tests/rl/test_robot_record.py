"""A checkpoint knows its robot: every difference is a line, and what a policy cannot mean is refused."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from telebip import ROOT
from telebip.cli import evaluate, export, play
from telebip.cli.evaluate import checkpoint_candidate, controller_candidate
from telebip.errors import UserError
from telebip.rl.checkpoint import load_checkpoint
from telebip.robot import load_robot
from telebip.robot_record import describe_robot, differences, is_record, obstacles

MJCF = ROOT / "assets" / "telebip.xml"
SIDES = {"right": "left", "left": "right"}


def edited(folder: Path, edits: dict[str, str]) -> Path:
    text = MJCF.read_text()
    for before, after in edits.items():
        assert before in text
        text = text.replace(before, after)
    (folder / "other.xml").write_text(text)
    return folder / "other.xml"


def record(path: Path = MJCF, decimation: int = 4) -> dict:
    return describe_robot(load_robot(path), decimation)


@pytest.mark.parametrize(
    ("edits", "line"),
    [
        ({'kp="200"': 'kp="100"'}, "stiffness kp [N m/rad | N/m]: right_hip_roll 200 -> 100, right_hip_pitch 200 -> 100, "),
        ({'kv="6"': 'kv="3"'}, "damping kv [N m s/rad | N s/m]: right_hip_roll 6 -> 3, "),
        ({'forcerange="-400 400"': 'forcerange="-400 300"'}, "force limits [N m | N]: right_knee -400 400 -> -400 300, "),
        ({'range="-1.2 1.2"': 'range="-1.2 1.1"'}, "range [rad | m]: right_hip_pitch -1.2 1.2 -> -1.2 1.1, "),
        ({'armature="1"': 'armature="2"'}, "armature [kg m^2 | kg]: right_knee 1 -> 2, left_knee 1 -> 2"),
        ({'damping="5"': 'damping="6"'}, "passive damping [N m s/rad | N s/m]: right_knee 5 -> 6, left_knee 5 -> 6"),
        ({'kp="200"': 'timeconst="0.05" kp="200"'}, "time constant [s]: right_hip_roll 1 -> 0.05, "),
        (
            {'<body name="right_shank" pos="0 0 -0.67"': '<body name="right_shank" pos="0 0 -0.7"'},
            "place in its parent [m]: right",
        ),
        ({'"imu"': '"gyro_place"'}, "site: imu is gone, gyro_place is new"),
        ({'name="right_shank"': 'name="right_calf"'}, "body: right_shank is gone, right_calf is new"),
        ({"0 0 0.66  1 0 0 0": "0 0 0.65  1 0 0 0"}, "home height [m] and orientation: trunk 0.66 1 0 0 0 -> 0.65 1 0 0 0"),
        ({'cone="elliptic"': 'cone="pyramidal"'}, "cone: 1 -> 0"),
        ({'ls_iterations="20"': 'ls_iterations="21"'}, "fields of the compiled model: opt.ls_iterations"),
        ({'timestep="0.005"': 'timestep="0.004"'}, "physics step [s]: 0.005 -> 0.004"),
    ],
)
def test_every_difference_is_a_line(tmp_path: Path, edits: dict[str, str], line: str) -> None:
    own = record(edited(tmp_path, edits))
    found = differences(record(), own)
    assert len([one for one in found if one.startswith(line)]) == 1, found
    assert (own["digest"] == record()["digest"]) == ("is gone" in line)  # names of parts move nothing
    assert not any("\n" in one for one in found)


def test_what_is_looked_at_only_is_no_difference(tmp_path: Path) -> None:
    text = re.sub(r'rgba="[^"]*"', 'rgba="1 0 0 1"', MJCF.read_text())
    assert text != MJCF.read_text()
    (tmp_path / "red.xml").write_text(text.replace("<worldbody>", '<worldbody><light pos="0 0 9"/>'))
    assert differences(record(), record(tmp_path / "red.xml")) == []
    assert record()["digest"] == record(tmp_path / "red.xml")["digest"]


@pytest.mark.parametrize(
    ("path", "reason"),
    [
        ("rotary_knee", "its joint 'right_knee' slides, and turns here"),
        ("ten_joints", "it moves the joints right_hip_roll, "),
        ("four_joints", "it moves the joints right_hip_roll, "),
    ],
)
def test_other_joints_cannot_be_meant(path: str, reason: str) -> None:
    assert obstacles(record(), record(ROOT / "tests" / "robots" / f"{path}.xml"))[0].startswith(reason)


def test_an_axis_that_points_elsewhere_cannot_be_meant(tmp_path: Path) -> None:
    turned = edited(tmp_path, {'axis="1 0 0" range="-0.6 0.6"': 'axis="-1 0 0" range="-0.6 0.6"'})
    assert obstacles(record(), record(turned))[0] == "its joint 'right_hip_roll' has the axis 1 0 0, not -1 0 0"


def test_the_rate_is_that_of_the_policy(tmp_path: Path) -> None:
    fast = edited(tmp_path, {'timestep="0.005"': 'timestep="0.001"'})
    assert obstacles(record(), record(fast)) == ["its policy step is 0.02 s, not 0.004 s"]
    assert obstacles(record(), record(fast, 20)) == []  # the physics is finer, the policy as fast
    assert obstacles(record(), record(decimation=1)) == ["its policy step is 0.02 s, not 0.005 s"]
    old = {"joint_names": record()["joint_names"], "decimation": 4}  # as checkpoints of before
    assert differences(old, record(fast)) == []
    assert obstacles(old, record(decimation=1)) == ["its policy step has 4 physics steps, not 1"]


def test_another_mujoco_compiles_to_other_numbers(tmp_path: Path) -> None:
    old = {**record(), "mujoco": "3.9.9"}
    assert differences(old, record(edited(tmp_path, {'ls_iterations="20"': 'ls_iterations="21"'}))) == []
    assert differences(old, record(edited(tmp_path, {'kp="200"': 'kp="100"'}))) != []


@pytest.mark.parametrize("policy", sorted(folder.name for folder in (ROOT / "assets" / "policies").iterdir()))
def test_the_shipped_policies_know_the_shipped_robot(policy: str) -> None:
    checkpoint = load_checkpoint(policy)
    assert is_record(checkpoint.robot)
    assert differences(checkpoint.robot_record, record()) == []


def arguments(command: str, tmp_path: Path) -> list[str]:
    own = {
        "play": ["--duration", "0.1", "--device", "cpu"],
        "evaluate": [
            "--duration",
            "1",
            "--num-envs",
            "1",
            "--suite",
            "tracking",
            "--device",
            "cpu",
            "--out",
            str(tmp_path / "out"),
        ],
        "export": ["--out", str(tmp_path / "policy.onnx")],
    }
    return ["--checkpoint", "telebip_flat", *own[command]]


MAINS = {"play": play.main, "evaluate": evaluate.main, "export": export.main}


@pytest.mark.parametrize("command", MAINS)
def test_commands_say_what_differs_and_refuse_what_cannot_be_meant(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    soft = edited(tmp_path, {'kp="200"': 'kp="100"'})
    MAINS[command]([*arguments(command, tmp_path), f"sim.robot={soft}"])
    notes = [line for line in capsys.readouterr().out.splitlines() if line.startswith("note: ")]
    assert len(notes) == 1
    assert f"'{soft}' is not the robot of " in notes[0]
    assert "stiffness kp [N m/rad | N/m]: right_hip_roll 200 -> 100" in notes[0]

    fast = edited(tmp_path, {'timestep="0.005"': 'timestep="0.001"'})
    refused = (
        r"was trained on another robot than .*: its policy step is 0\.02 s, not 0\.004 s; go on with --allow-robot-change$"
    )
    with pytest.raises(UserError, match=refused):
        MAINS[command]([*arguments(command, tmp_path), f"sim.robot={fast}"])
    assert "physics step [s]: 0.005 -> 0.001" in capsys.readouterr().out
    MAINS[command]([*arguments(command, tmp_path), f"sim.robot={fast}", "--allow-robot-change"])

    other = "tests/robots/ten_joints.xml"
    with pytest.raises(UserError, match=r"it moves the joints .*left_knee, not .*left_ankle$"):  # no flag can help
        MAINS[command]([*arguments(command, tmp_path), f"sim.robot={ROOT / other}", "--allow-robot-change"])


def test_renamed_joints_go_on_if_told_to(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    swapped = re.sub("right|left", lambda side: SIDES[side[0]], MJCF.read_text())
    places = {'pos="0 -0.1 0"': 'pos="0 0.1 0"', 'pos="0 0.1 0"': 'pos="0 -0.1 0"'}  # legs stand on the side of their name
    swapped = re.sub("|".join(places), lambda place: places[place[0]], swapped)
    (tmp_path / "left_leg_first.xml").write_text(swapped)
    call = [*arguments("play", tmp_path), f"sim.robot={tmp_path / 'left_leg_first.xml'}"]
    with pytest.raises(UserError, match=r"it moves the joints .*; go on with --allow-robot-change$"):
        play.main(call)
    play.main([*call, "--allow-robot-change"])
    assert "mean speed" in capsys.readouterr().out


def test_an_exported_policy_knows_its_robot(tmp_path: Path) -> None:
    export.main(arguments("export", tmp_path))
    checkpoint = load_checkpoint(tmp_path / "policy.onnx")
    assert differences(checkpoint.robot_record, record()) == []
    soft = record(edited(tmp_path, {'kp="200"': 'kp="100"'}))
    assert len(differences(checkpoint.robot_record, soft)) == 1


def test_a_checkpoint_without_a_record_loads_and_that_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from telebip.rl.checkpoint import save_checkpoint

    for number, old in enumerate(({}, {"weight": [133.4]})):
        path = tmp_path / f"model_{number}.pt"
        save_checkpoint(replace(load_checkpoint("telebip_flat"), path=path, robot=old))
        play.main(["--checkpoint", str(path), "--duration", "0.1", "--device", "cpu"])
        assert f"note: '{path}' says nothing of its robot but its joints and decimation" in capsys.readouterr().out


def test_fingerprints_of_results_include_the_robot(tmp_path: Path) -> None:
    soft = edited(tmp_path, {'kp="200"': 'kp="100"'})
    for make in (
        lambda *more: checkpoint_candidate("telebip_flat", None, more),
        lambda *more: controller_candidate("alip", None, more),
    ):
        same = tmp_path / "copy.xml"
        same.write_text(MJCF.read_text())
        assert make().fingerprint == make(f"sim.robot={same}").fingerprint
        assert make().fingerprint != make(f"sim.robot={soft}").fingerprint
