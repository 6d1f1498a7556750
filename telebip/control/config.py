"""Parameters of the model-based walkers; values, units and sources stand in `configs/control/`."""

from collections.abc import Sequence
from dataclasses import dataclass

from telebip.config import load, quantity, section


@dataclass
class WalkerConfig:
    """Read `configs/control/walker.yaml` for values and explanations."""

    step_time: float = quantity("s", gt=0)
    start_phase: float = quantity(ge=0, lt=1)
    step_width: float = quantity("m", gt=0)
    error_kept: float = quantity(ge=0, lt=1)
    hip_height: float = quantity("m", gt=0)
    heading_filter: float = quantity("s", gt=0)
    acceleration: float = quantity("m/s^2", gt=0)
    speed_gain: float = quantity("per step", ge=0, le=1)
    speed_limit: float = quantity("m/s", ge=0)
    steering_gain: float = quantity("m/rad", ge=0)
    steering_limit: float = quantity("m", ge=0)
    reach: float = quantity("m", gt=0)
    feet_distance: tuple[float, float] = quantity("m", gt=0)
    swing_height: float = quantity("m", ge=0)
    swing_press: float = quantity("m", ge=0)
    swing_arrival: float = quantity(gt=0, le=1)
    height_stiffness: float = quantity("N/m", ge=0)
    height_damping: float = quantity("N s/m", ge=0)
    force_range: tuple[float, float] = quantity("body weights", ge=0)
    trunk_stiffness: float = quantity("N m/rad", ge=0)
    trunk_damping: float = quantity("N m s/rad", ge=0)
    friction_use: float = quantity(ge=0, le=1)


@dataclass
class ControllerConfig:
    """A file of `configs/control/`."""

    control: WalkerConfig = section(WalkerConfig)


def load_controller(name: str, overrides: Sequence[str] = ()) -> WalkerConfig:
    """Read `configs/control/<name>.yaml`, apply `control.key=value` overrides, and validate it.

    Raises:
        UserError: unknown or missing field, wrong type or a value out of bounds.
    """
    return load(ControllerConfig, f"control/{name}", overrides).control


def split_overrides(overrides: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return a command line's overrides of the task and, apart, those of the controller, `control.key=value`."""
    own = [override for override in overrides if override.startswith("control.")]
    return [override for override in overrides if override not in own], own
