"""What the commands share: one-line errors, devices, Ctrl-C."""

import argparse
import os
import re
import shlex
import shutil
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from telebip import ROOT
from telebip.errors import UserError, is_out_of_memory, nearest
from telebip.viz.opengl import check_opengl

if TYPE_CHECKING:
    import torch

    from telebip.config import TaskConfig
    from telebip.config.schema import SimConfig
    from telebip.control.policy import Policy
    from telebip.env import TelebipEnv
    from telebip.eval.standing import Finding
    from telebip.rl.checkpoint import Checkpoint
    from telebip.robot import Robot


CONTROLLERS = ("alip", "dcm")
"""Model-based walkers, as `telebip.control.factory.PLACEMENTS` names them; here, so that `--help` needs no torch."""


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line that names the nearest valid option."""

    def __init__(self, description: str, examples: str) -> None:
        """Create a parser; `examples`, one a line as in `play.py --agent zero`, close the `--help` text."""
        program = Path(sys.argv[0])
        super().__init__(
            prog=" ".join([program.name, *sys.argv[1:2]]) if program.stem == "telebip" or _is_own_script(program) else None,
            description=description,
            epilog="examples:\n" + re.sub(r"^  (\w+)\.py", lambda m: f"  {invocation(m[1])}", examples, flags=re.MULTILINE),
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )

    def add_engine(self) -> None:
        """Add `--device` and `--backend`."""
        self.add_device()
        names = ("auto", "native", "warp")
        self.add_argument("--backend", default="auto", choices=names, help="physics engine (default: auto)")

    def add_device(self) -> None:
        """Add `--device`."""
        self.add_argument("--device", default="auto", help="auto, cpu, cuda or cuda:N (default: auto, which prefers CUDA)")

    def add_allow_robot_change(self) -> None:
        """Add `--allow-robot-change`."""
        text = "go on with another robot than that of the checkpoint: other gains, joints of other names, another rate"
        self.add_argument("--allow-robot-change", action="store_true", help=text)

    def add_overrides(self, text: str = "override any field of the task") -> None:
        """Add the overrides, with `text` as their help."""
        self.add_argument("overrides", nargs="*", metavar="key.path=value", help=text)

    def parse(self, argv: Sequence[str] | None) -> argparse.Namespace:
        """Parse options and positional arguments in any order."""
        options, unknown = self.parse_known_intermixed_args(argv)
        if unknown:
            known = [option for action in self._actions for option in action.option_strings]
            self.error(f"unknown option '{unknown[0]}'; {nearest(unknown[0], known)}")
        return options

    def error(self, message: str) -> NoReturn:
        """Report wrong usage like every other mistake."""
        raise UserError(f"{message} (see {self.prog} --help)")


def invocation(command: str) -> str:
    """Return what to type for a command, as this one was started: `telebip play`, a script of the user's, or ours."""
    program = Path(sys.argv[0])
    if program.stem == "telebip":
        return f"telebip {command}"
    return f"python {program} {command}" if _is_own_script(program) else f"python scripts/{command}.py"


def hint(command: str, *arguments: object) -> str:
    """Return a line that can be pasted into a shell from any working directory; paths among the arguments become absolute."""
    program = Path(sys.argv[0])
    found = shutil.which("python")
    python = "python" if found and Path(found) == Path(sys.executable) else sys.executable
    if program.stem == "telebip":
        start = ["telebip" if shutil.which("telebip") else str(program.absolute()), command]
    elif _is_own_script(program):
        start = [python, str(program.absolute()), command]
    else:
        start = [python, str(ROOT / "scripts" / f"{command}.py")]
    return shlex.join([*start, *(str(part.absolute() if isinstance(part, Path) else part) for part in arguments)])


def _is_own_script(program: Path) -> bool:
    """Whether the program is a script of the user's that calls `telebip.cli.main.main`, with terms of their own."""
    ours = [ROOT / folder / program.name for folder in ("scripts", "telebip/cli")]
    return program.suffix == ".py" and program.stem != "__main__" and not any(file.is_file() for file in ours)


def run(command: Callable[[], None]) -> NoReturn:
    """Run a command: exit status 0, 2 after one line on standard error for a `UserError`, 130 when interrupted."""
    try:
        check_opengl()  # MuJoCo reads MUJOCO_GL when it is imported, and would fail with a traceback
        command()
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:  # the reader of our output has gone, as in `... | head`
        silence_stdout()
    except Exception as error:
        if not is_out_of_memory(error):
            raise
        print("error: out of memory; take fewer worlds (--num-envs)", file=sys.stderr)
        sys.exit(2)
    sys.exit(0)


def silence_stdout() -> None:
    """Send nowhere what is yet to be printed, by Python too when it ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def open_checkpoint(path: str | Path) -> "Checkpoint":
    """Load a checkpoint as `telebip.rl.checkpoint.load_checkpoint` does, and say which newer ones are damaged."""
    from telebip.rl.checkpoint import load_checkpoint

    checkpoint = load_checkpoint(path)
    for line in checkpoint.damaged:
        print(f"note: {line}; using {checkpoint.path.name} instead", file=sys.stderr)
    return checkpoint


def open_policy(path: str | Path) -> "Checkpoint":
    """Do what `open_checkpoint` does for a policy that is to walk, and say which terms of its task are unknown here."""
    checkpoint = open_checkpoint(path)
    if unknown := [name for name in checkpoint.missing if not name.startswith("rewards.")]:  # walking needs no rewards
        print(f"note: '{checkpoint.path}' is walked without {', '.join(unknown)}, unknown here", file=sys.stderr)
    return checkpoint


def match_robot(checkpoint: "Checkpoint", sim: "SimConfig", robot: "Robot", allow_robot_change: bool) -> None:
    """Print in what a robot differs from that of a checkpoint.

    Raises:
        UserError: the checkpoint's policy cannot mean it; see `telebip.rl.policy.require_robot`.
    """
    from telebip.rl.policy import require_robot

    compare_robot(checkpoint, sim, robot)
    require_robot(checkpoint, sim, robot, allow_robot_change)


def compare_robot(checkpoint: "Checkpoint", sim: "SimConfig", robot: "Robot") -> None:
    """Print in what a robot differs from that of a checkpoint, a line each."""
    from telebip.robot_record import describe_robot, differences, is_record

    if not is_record(checkpoint.robot):
        print(f"note: '{checkpoint.path}' says nothing of its robot but its joints and decimation")
    for line in differences(checkpoint.robot_record, describe_robot(robot, sim.decimation)):
        print(f"note: '{sim.robot}' is not the robot of '{checkpoint.path}': {line}")


def policy_of(checkpoint: "Checkpoint", env: "TelebipEnv", allow_robot_change: bool = False) -> "Policy":
    """Return a checkpoint's policy, to walk in `env`; a `UserError` if it was trained on other joints or observations."""
    from telebip.rl.policy import load_policy, require_fit

    require_fit(checkpoint, env, allow_robot_change=allow_robot_change)
    return load_policy(checkpoint, env.device)


def checked_robot(
    config: "TaskConfig", checkpoint: "Checkpoint | None" = None, allow_robot_change: bool = False, is_quiet: bool = False
) -> "Robot":
    """Load a task's robot, compare it with that of a checkpoint, and let it stand for a second.

    What is doubtful is said on standard error, a line each.

    Raises:
        UserError: the robot is no robot that the task can be done with, or as `match_robot`.
    """
    from telebip.eval.standing import standing_test
    from telebip.robot import load_robot

    robot = load_robot(config.sim.robot)
    if checkpoint:
        match_robot(checkpoint, config.sim, robot, allow_robot_change)
    findings = standing_test(config, robot)
    refuse_wrong(findings, robot)
    for finding in findings:
        if finding.verdict == "warning" and not is_quiet:
            print(f"warning: {robot.path}: {finding}", file=sys.stderr)
    return robot


def refuse_wrong(findings: "Sequence[Finding]", robot: "Robot") -> None:
    """Raise a `UserError` for the first of a standing test's findings that is an error."""
    for finding in findings:
        if finding.verdict == "error":
            raise UserError(f"{robot.path}: {finding}")


def check_connect(options: argparse.Namespace) -> None:
    """Refuse a `--connect` without a `--viewer rerun`."""
    if options.connect and options.viewer != "rerun":
        raise UserError("--connect names a rerun viewer; it goes with --viewer rerun")


def check_listen(options: argparse.Namespace) -> None:
    """Read `--listen`, and refuse it without a `--viewer browser`."""
    if options.viewer == "browser":
        from telebip.viz.browser.server import read_address

        options.listen = read_address(options.listen)
    elif options.listen:
        raise UserError("--listen says where --viewer browser is served; add that, or leave it out")


def check_outputs(json: str | None, plot: str | None) -> None:
    """Refuse files that cannot be written, and plots of unknown endings, now and not after minutes of measuring."""
    if plot and Path(plot).suffix not in (".png", ".svg", ".pdf"):
        raise UserError(f"--plot writes FILE.png, FILE.svg or FILE.pdf, got '{plot}'")
    for file in map(Path, filter(None, (json, plot))):
        is_new = not file.exists()
        try:
            file.touch()
            if is_new:
                file.unlink()
        except OSError as error:
            raise UserError(f"cannot write to '{file}': {error.strerror or error}") from error


def resolve_device(name: str) -> "torch.device":
    """Return the torch device that `auto`, `cpu`, `cuda` or `cuda:N` means on this machine; `auto` prefers CUDA.

    A CUDA device becomes torch's current one.

    Raises:
        UserError: the name is none of these, or the device is not there.
    """
    import torch

    available = ["cpu", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
    name = {"auto": available[:2][-1], "cuda": "cuda:0"}.get(name, name)
    if not re.fullmatch(r"cpu|cuda:\d+", name):
        raise UserError(f"unknown device '{name}'; valid: auto, cpu, cuda, cuda:N")
    if name not in available:
        raise UserError(f"device '{name}' is not there; this machine has: {', '.join(available)}")
    device = torch.device(name)
    if device.type == "cuda":
        torch.cuda.set_device(device)
    return device


@contextmanager
def stop_on_signal(console):
    """Yield a function that tells whether to stop: one Ctrl-C ends the run after its iteration, a second one at once.

    So do SIGTERM and, as a terminal that is closed sends it, SIGHUP; not where `nohup` has said to ignore that.
    """
    asked = False

    def handle(signum: int, frame: object) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True
        console.print("stopping after this iteration with a checkpoint (press Ctrl-C again to leave at once)")

    numbers = [signal.SIGINT, signal.SIGTERM]
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    previous = {number: signal.signal(number, handle) for number in numbers}
    try:
        yield lambda: asked
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
