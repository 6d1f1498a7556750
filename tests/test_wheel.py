"""The built wheel: what is in it, and that it works from any folder of a fresh environment."""

import os
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

from telebip import ROOT, __version__

TINY = ("--num-envs", "8", "--device", "cpu", "--max-iterations", "2", "ppo.num_steps_per_env=5", "ppo.hidden_dims=[16,16]")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    subprocess.run([sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)], cwd=ROOT, check=True)
    (file,) = folder.iterdir()
    return file


def test_it_holds_the_code_and_what_the_code_reads(wheel: Path) -> None:
    assert wheel.name == f"telebip-{__version__}-py3-none-any.whl"
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        (metadata,) = (name for name in names if name.endswith("entry_points.txt"))
        assert b"telebip = telebip.cli.main:main" in archive.read(metadata)
    code = {str(path.relative_to(ROOT)) for path in ROOT.glob("telebip/**/*.py")} | {"telebip/py.typed"}
    data = {f"telebip/{path.relative_to(ROOT)}" for name in ("assets", "configs") for path in ROOT.glob(f"{name}/**/*.*")}
    assert len(data) > 8
    assert {name for name in names if ".dist-info/" not in name} == code | data


@pytest.mark.slow
def test_a_fresh_environment_trains_plays_records_and_exports(wheel: Path, tmp_path: Path) -> None:
    """Takes minutes and the network: it installs every dependency anew."""
    venv.create(tmp_path / "venv", with_pip=True)
    programs = tmp_path / "venv" / ("Scripts" if os.name == "nt" else "bin")
    folder = tmp_path / "anywhere"
    folder.mkdir()
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}

    def run(program: str, *arguments: str) -> str:
        done = subprocess.run(
            [programs / program, *arguments], cwd=folder, env=environment, capture_output=True, text=True, timeout=1200
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    run("python", "-m", "pip", "install", "-q", str(wheel))
    assert run("telebip", "--version") == f"telebip {__version__}\n"
    assert "train a policy" in run("telebip", "--help")
    assert "telebip train --task" in run("telebip", "train", "--help")
    trained = run("telebip", "train", "--task", "telebip_slow", *TINY)
    (run_dir,) = (folder / "runs" / "telebip_slow").iterdir()
    assert f"telebip play --checkpoint {run_dir} --viewer rerun" in trained
    played = run("telebip", "play", "--checkpoint", str(run_dir), "--duration", "1", "--record", "walk.rrd", "--device", "cpu")
    assert "recorded walk.rrd" in played
    assert (folder / "walk.rrd").stat().st_size > 10_000
    assert "0.7" in run("telebip", "play", "--checkpoint", "telebip_flat", "--command", "0.7", "0", "0", "--device", "cpu")

    refused = subprocess.run(
        [programs / "telebip", "export", "--checkpoint", "telebip_flat"],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert refused.returncode == 2
    assert "pip install 'telebip[export]'" in refused.stderr
    run("python", "-m", "pip", "install", "-q", f"{wheel}[export,gym]")
    assert "wrote policy.onnx" in run("telebip", "export", "--checkpoint", "telebip_flat")
    assert "mean speed" in run("telebip", "play", "--checkpoint", "policy.onnx", "--duration", "1", "--device", "cpu")
    make = "import gymnasium, telebip.gym; print(gymnasium.make_vec('telebip/Flat-v0', num_envs=2).reset(seed=0)[0].shape)"
    assert run("python", "-c", make) == "(2, 33)\n"
