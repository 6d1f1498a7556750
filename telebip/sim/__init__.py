"""Physics backends behind one interface; see `telebip.sim.base`."""

from collections.abc import Sequence

import torch
from mujoco.batch import MODEL_FIELDS

from telebip.errors import UserError, nearest
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
    return backend if backend != "auto" else "warp" if device.type == "cuda" else "native"


def make_simulator(
    backend: Backend,
    robot: Robot,
    num_envs: int,
    decimation: int,
    device: torch.device,
    model_fields: Sequence[str] = (),
    sensors: Sequence[str] = (),
    capacity: tuple[int, int] = (8, 64),
    deterministic: bool = False,
) -> Simulator:
    """Create the backend.

    Args:
        backend: which, see `choose_backend`.
        robot: the model.
        num_envs: number of worlds.
        decimation: physics steps per `Simulator.step`.
        device: where tensors live.
        model_fields: names of `mujoco.MjModel` fields that get one value per world.
        sensors: names of the sensors to keep in `SimState.sensors`.
        capacity: room for contacts and for constraints per world, on `warp`.
        deterministic: whether `warp` gives the same bits in every run on a GPU; on a CPU both engines always do.

    Raises:
        UserError: `native` was asked for on a CUDA device; there is no such field or sensor, or the engine lacks what the
            robot needs.
    """
    for name in model_fields:
        if name not in MODEL_FIELDS:
            raise UserError(f"no field '{name}' in MuJoCo's model; {nearest(name, MODEL_FIELDS)}")
    if choose_backend(backend, device) == "native":
        if device.type != "cpu":
            raise UserError(f"backend 'native' runs on the CPU, not on '{device}'; use --backend warp or --device cpu")
        from telebip.sim.native import NativeSimulator

        return NativeSimulator(robot, num_envs, decimation, model_fields, sensors)
    from telebip.sim.warp import WarpSimulator

    return WarpSimulator(robot, num_envs, decimation, indexed(device), model_fields, sensors, *capacity, deterministic)
