"""The `telebip` command: its table, its help, and one line for a command that is not there."""

import subprocess
import sys

import pytest

from telebip import ROOT, __version__
from telebip.cli.common import Parser, invocation, run
from telebip.cli.main import COMMANDS, dispatch
from telebip.errors import UserError


def test_every_command_is_a_script_and_every_script_a_command() -> None:
    """Except those that need a checkout: its own pictures, and the check of a GPU, which runs the tests."""
    assert {path.stem for path in ROOT.glob("scripts/*.py")} - {"gallery", "gpu_check"} == set(COMMANDS)
    for name, module in COMMANDS.items():
        assert module.__name__ == f"telebip.cli.{name}"
        assert f"from {module.__name__} import main" in (ROOT / "scripts" / f"{name}.py").read_text()


@pytest.mark.parametrize("arguments", [[], ["--help"], ["-h"]])
def test_help_lists_the_commands(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    dispatch(arguments)
    lines = capsys.readouterr().out.splitlines()
    for name in COMMANDS:
        (line,) = (line for line in lines if line.startswith(f"  {name} "))
        assert len(line.split()) >= 4  # with a description
    assert "  train       train a policy." in lines


def test_the_version(capsys: pytest.CaptureFixture[str]) -> None:
    dispatch(["--version"])
    assert capsys.readouterr().out == f"telebip {__version__}\n"


def test_a_command_that_is_not_there() -> None:
    with pytest.raises(UserError, match=r"unknown command 'trian'; did you mean 'train'"):
        dispatch(["trian"])


def test_help_says_how_it_was_started(monkeypatch: pytest.MonkeyPatch) -> None:
    examples = "  play.py --agent zero\n  python examples/deploy_mujoco.py policy.onnx\n"
    monkeypatch.setattr(sys, "argv", ["/usr/bin/telebip", "play", "--help"])
    text = Parser("Walk.", examples).format_help()
    assert "usage: telebip play" in text
    assert "  telebip play --agent zero\n  python examples/deploy_mujoco.py policy.onnx" in text
    assert invocation("train") == "telebip train"
    monkeypatch.setattr(sys, "argv", ["scripts/play.py", "--help"])
    text = Parser("Walk.", examples).format_help()
    assert "usage: play.py" in text
    assert "  python scripts/play.py --agent zero\n" in text


@pytest.mark.parametrize(
    ("program", "train"),
    [
        ("/usr/bin/telebip", "telebip train"),
        ("scripts/train.py", "python scripts/train.py"),
        ("scripts/reproduce.py", "python scripts/train.py"),
        ("mine/my_terms.py", "python mine/my_terms.py train"),
        ("-c", "python scripts/train.py"),
    ],
)
def test_a_run_goes_on_with_the_program_that_started_it(monkeypatch: pytest.MonkeyPatch, program: str, train: str) -> None:
    monkeypatch.setattr(sys, "argv", [program])
    assert invocation("train") == train


def test_the_command_passes_arguments_on_and_sets_the_exit_status() -> None:
    code = "import sys; sys.argv = ['telebip', *sys.argv[1:]]; from telebip.cli.main import main; main()"

    def telebip(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([sys.executable, "-c", code, *arguments], cwd=ROOT, capture_output=True, text=True, timeout=60)

    done = telebip("train", "--task", "telebip_slwo")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "error: unknown task 'telebip_slwo'; did you mean 'telebip_slow'?\n"
    assert telebip("train", "--num-env", "8").stderr.rstrip().endswith("(see telebip train --help)")
    assert telebip("--version").returncode == 0


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        ValueError("std::bad_alloc"),  # of the native engine
        RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 9 bytes"),
        RuntimeError("Failed to allocate 9 bytes on device 'cuda:0'"),  # of Warp
    ],
    ids=lambda error: type(error).__name__,
)
def test_too_many_worlds_are_one_line(error: Exception, capsys: pytest.CaptureFixture[str]) -> None:
    def command() -> None:
        raise error

    with pytest.raises(SystemExit) as end:
        run(command)
    assert end.value.code == 2
    assert capsys.readouterr().err == "error: out of memory; take fewer worlds (--num-envs)\n"


def test_other_errors_keep_their_traceback() -> None:
    def command() -> None:
        raise RuntimeError("a bug of ours")

    with pytest.raises(RuntimeError, match="a bug of ours"):
        run(command)
