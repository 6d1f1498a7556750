"""telebip: reinforcement learning for a biped with telescopic legs, on MuJoCo Warp and on plain CPUs."""

from pathlib import Path

__version__ = "0.1.0"

_PACKAGE = Path(__file__).resolve().parent

ROOT = _PACKAGE if (_PACKAGE / "configs").is_dir() else _PACKAGE.parent
"""Folder that holds `assets/` and `configs/`: the repository, or the package itself where a wheel was installed."""
