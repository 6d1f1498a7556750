"""What an engine cannot do is refused in one line that names the robot's file, or the backend that can."""

import re
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch

from telebip import ROOT
from telebip.errors import UserError
from telebip.robot import Robot, load_robot
from telebip.sim import Backend, make_simulator

DECIMATION = 4


def test_native_refuses_a_gpu_in_one_line(robot: Robot) -> None:
    with pytest.raises(UserError, match=r"^backend 'native' runs on the CPU, not on 'cuda:0'; .*--backend warp.*$"):
        make_simulator("native", robot, 4, DECIMATION, torch.device("cuda:0"))


def refusal(path: Path, backend: Backend, sensors: Sequence[str] = ()) -> str:
    """Return the one line that names the robot's file."""
    with pytest.raises(UserError) as caught:
        make_simulator(backend, load_robot(path), 2, DECIMATION, torch.device("cpu"), sensors=sensors)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert len(message.splitlines()) == 1
    return message


@pytest.mark.parametrize(
    ("option", "line"),
    [
        ('><flag sleep="enable"/></option>', 'take out <flag sleep="enable"/>: what it remembers is no part of'),
        (
            ' integrator="discrete"><flag ipc="enable"/></option>',
            'take out <flag ipc="enable"/>: what it remembers is no part of',
        ),
    ],
)
@pytest.mark.parametrize("backend", ["native", "warp"])
def test_what_remembers_more_than_its_state_is_refused(backend: Backend, tmp_path: Path, option: str, line: str) -> None:
    """Sleep and IPC keep what mjSTATE_INTEGRATION does not have; on `warp`, sleep ended the process."""
    text = (ROOT / "assets/telebip.xml").read_text()
    changed, edits = re.subn(r'(<option [^>]*?) integrator="implicitfast"([^>]*?)/>', rf"\1\2{option}", text)
    assert edits == 1
    (tmp_path / "robot.xml").write_text(changed)
    assert line in refusal(tmp_path / "robot.xml", backend)


def test_a_plugin_that_warp_lacks_is_one_line(robot: Robot, tmp_path: Path) -> None:
    """A touch grid is a sensor that native has; nobody reads it, and warp goes on without, or refuses it."""
    plugin, settings = "mujoco.sensor.touch_grid", {"size": "3 3", "fov": "20 20", "gamma": "0", "nchannel": "1"}
    configured = "".join(f'<config key="{key}" value="{value}"/>' for key, value in settings.items())
    grid = f'<plugin name="grid" plugin="{plugin}" objtype="site" objname="right_foot">{configured}</plugin>'
    text = robot.path.read_text().replace("<sensor>", f"<sensor>{grid}")
    path = tmp_path / "grid.xml"
    path.write_text(text.replace("<worldbody>", f'<extension><plugin plugin="{plugin}"/></extension><worldbody>', 1))
    sim = make_simulator("native", load_robot(path), 2, DECIMATION, torch.device("cpu"), sensors=("grid",))
    assert sim.step(torch.as_tensor(robot.nominal).float().repeat(2, 1), torch.zeros(2, 6)).sensors["grid"].shape == (2, 9)
    make_simulator("warp", load_robot(path), 2, DECIMATION, torch.device("cpu"))
    assert "backend 'warp': ['mjSENS_PLUGIN'] not supported." in refusal(path, "warp", ("grid",))


def test_a_solver_that_warp_lacks_is_one_line(robot: Robot, tmp_path: Path) -> None:
    text = robot.path.read_text()
    (tmp_path / "robot.xml").write_text(text.replace("<option ", '<option solver="PGS" ', 1))
    assert "backend 'warp': " in refusal(tmp_path / "robot.xml", "warp")


def test_what_warp_cannot_do_is_one_line(robot: Robot) -> None:
    with pytest.raises(UserError, match=r"telebip\.xml: backend 'warp': Model field 'geom_contype' is not a batched .*$"):
        make_simulator("warp", robot, 2, DECIMATION, torch.device("cpu"), ("geom_contype",))
