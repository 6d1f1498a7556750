"""Physics backends behind one interface; see `telebip.sim.base`."""

from collections.abc import Sequence

import torch

from telebip.errors import UserError
from telebip.robot import Robot
from telebip.sim.base import Backend, SimState, Simulator

__all__ = ["Backend", "SimState", "Simulator", "choose_backend", "indexed", "make_simulator"]


def indexed(device: torch.device) -> torch.device:
    """Return `device` with its number: `cuda` is torch's current CUDA device, which Warp does not know."""
    if device.type == "cuda" and device.index is None:
        return torch.device("cuda", torch.cuda.current_device())
    return device


def choose_backend(backend: Backend, device: torch.device) -> Backend:
    """Return the backend that `auto` stands for: `warp` on CUDA and `native` on the CPU."""
    if backend != "auto":
        return backend
    return "warp" if device.type == "cuda" else "native"


def make_simulator(
    backend: Backend,
    robot: Robot,
    num_envs: int,
    decimation: int,
    device: torch.device,
    model_fields: Sequence[str] = (),
    capacity: tuple[int, int] = (8, 64),
) -> Simulator:
    """Create the backend, see `choose_backend`. `capacity` is `warp`'s, see there.

    Raises:
        UserError: `native` was asked for on a CUDA device.
    """
    if choose_backend(backend, device) == "native":
        if device.type != "cpu":
            raise UserError(f"backend 'native' runs on the CPU, not on '{device}'; use --backend warp or --device cpu")
        from telebip.sim.native import NativeSimulator

        return NativeSimulator(robot, num_envs, decimation, model_fields)
    from telebip.sim.warp import WarpSimulator

    return WarpSimulator(robot, num_envs, decimation, indexed(device), model_fields, *capacity)
