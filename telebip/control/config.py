"""Parameters of the model-based walkers; values, units and sources stand in `configs/control/`."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from telebip.config import load
from telebip.mdp.term import Quantity


@dataclass(frozen=True)
class WalkerConfig:
    """Read `configs/control/walker.yaml` for values and explanations."""

    step_time: Annotated[float, Quantity("s", gt=0)]
    start_phase: Annotated[float, Quantity(ge=0, lt=1)]
    step_width: Annotated[float, Quantity("m", gt=0)]
    error_kept: Annotated[float, Quantity(ge=0, lt=1)]
    hip_height: Annotated[float, Quantity("m", gt=0)]
    heading_filter: Annotated[float, Quantity("s", gt=0)]
    acceleration: Annotated[float, Quantity("m/s^2", gt=0)]
    speed_gain: Annotated[float, Quantity("per step", ge=0, le=1)]
    speed_limit: Annotated[float, Quantity("m/s", ge=0)]
    steering_gain: Annotated[float, Quantity("m/rad", ge=0)]
    steering_limit: Annotated[float, Quantity("m", ge=0)]
    reach: Annotated[float, Quantity("m", gt=0)]
    feet_distance: Annotated[tuple[float, float], Quantity("m", gt=0)]
    swing_height: Annotated[float, Quantity("m", ge=0)]
    swing_press: Annotated[float, Quantity("m", ge=0)]
    swing_arrival: Annotated[float, Quantity(gt=0, le=1)]
    height_stiffness: Annotated[float, Quantity("N/m", ge=0)]
    height_damping: Annotated[float, Quantity("N s/m", ge=0)]
    force_range: Annotated[tuple[float, float], Quantity("body weights", ge=0)]
    trunk_stiffness: Annotated[float, Quantity("N m/rad", ge=0)]
    trunk_damping: Annotated[float, Quantity("N m s/rad", ge=0)]
    friction_use: Annotated[float, Quantity(ge=0, le=1)]


@dataclass(frozen=True)
class ControllerConfig:
    """A file of `configs/control/`."""

    control: WalkerConfig


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
