"""Programs in processes of their own, as a user starts them."""

import multiprocessing
import os
import runpy
import subprocess
import sys
import tempfile
from pathlib import Path

from telebip import ROOT

FORKS = multiprocessing.get_context("forkserver")
"""Processes of their own, which need not import torch anew."""
FORKS.set_forkserver_preload(
    [f"telebip.{name}" for name in ("cli.main", "eval.report", "eval.suites", "rl.train", "sim.native")] + ["rich.progress"]
)

Done = subprocess.CompletedProcess[str]


def fresh(script: str, *arguments: str, timeout: float = 120.0) -> Done:
    """Run a script with an interpreter of its own, which takes seconds to import torch."""
    return subprocess.run([sys.executable, script, *arguments], cwd=ROOT, capture_output=True, text=True, timeout=timeout)


def forked(script: str, *arguments: str, cwd: Path = ROOT) -> Done:
    """Run a script in a process that has imported torch and telebip already."""
    with tempfile.TemporaryDirectory() as folder:
        outputs = Path(folder, "stdout"), Path(folder, "stderr")
        process = FORKS.Process(target=_run, args=(script, arguments, cwd, outputs))
        process.start()
        process.join(timeout=120)
        if process.exitcode is None:
            process.kill()
            raise subprocess.TimeoutExpired(script, 120)
        return subprocess.CompletedProcess([script, *arguments], process.exitcode, *(file.read_text() for file in outputs))


def _run(script: str, arguments: tuple[str, ...], cwd: Path, outputs: tuple[Path, Path]) -> None:
    for descriptor, file in enumerate(outputs, start=1):
        os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT), descriptor)
    os.chdir(cwd)
    sys.argv = [script, *arguments]
    runpy.run_path(script, run_name="__main__")
