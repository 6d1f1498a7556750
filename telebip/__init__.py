"""telebip: reinforcement learning for a biped with telescopic legs, on MuJoCo Warp and on plain CPUs."""

from pathlib import Path

__version__ = "0.1.0"

ROOT = Path(__file__).resolve().parent.parent
"""Folder that holds `assets/` and `configs/`."""
