# pyright: reportAttributeAccessIssue=false
"""C MuJoCo on a thread pool: the engine of machines without a GPU, bit-identical to a loop of `mj_step`."""

import contextlib
import copy
from collections.abc import Iterator, Mapping, Sequence

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch, SimulationError
from torch import Tensor

from telebip.robot import Robot
from telebip.sim.base import ENGINE_FAULTS, Backend, SimState

CAPACITY = [mujoco.mjtWarning.mjWARN_CONTACTFULL.value, mujoco.mjtWarning.mjWARN_CNSTRFULL.value]
"""Warnings of an arena that is too small: the MJCF's `<size memory="..."/>`."""


class NativeSimulator:
    """`Simulator` on `mujoco.batch.Batch`: float64 inside, float32 in `state`; results do not depend on threads."""

    backend: Backend = "native"

    def __init__(
        self,
        robot: Robot,
        num_envs: int,
        decimation: int,
        model_fields: Sequence[str] = (),
        num_threads: int = 0,
    ) -> None:
        """Create the worlds in the home pose.

        Args:
            robot: the model.
            num_envs: number of worlds.
            decimation: physics steps per `step`.
            model_fields: names of `mujoco.MjModel` fields that get one value per world.
            num_threads: physics threads; 0 is one per processor.
        """
        self.num_envs = num_envs
        self.device = torch.device("cpu")
        self.state = SimState.zeros(num_envs, self.device)
        self._decimation = decimation
        self._foot_adr = list(robot.engine_foot_sensor_adr)
        model = copy.copy(robot.engine_model)
        # A non-finite state stays, to be seen and counted by the environment; the engine would silently reset it.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self._batch = Batch(model, num_envs, num_threads)
        self.memory = {name: torch.from_numpy(self._batch.bind(name)) for name in ("time", "qpos", "qvel", "qacc_warmstart")}
        self._time, self._qpos, self._qvel, self._warmstart = self.memory.values()
        widths = (1, model.nq, model.nv, model.nv)
        self._memory = torch.from_numpy(self._batch.state)[:, : sum(widths)]  # the same, in one piece: copied at once
        self._memory_before = self._memory.clone()
        self.memory_before = dict(zip(self.memory, self._memory_before.split(widths, dim=1), strict=True))
        self.memory_before["time"] = self.memory_before["time"][:, 0]
        self._ctrl = torch.from_numpy(self._batch.bind("ctrl"))
        self.advice = {"capacity": 'raise <size memory="..."/> in the MJCF'}
        self._faults = np.zeros((len(ENGINE_FAULTS), num_envs), dtype=bool)
        self.faults = torch.from_numpy(self._faults)
        self._trunk_wrench = torch.from_numpy(self._batch.bind("xfrc_applied"))[:, robot.trunk_id]
        self.model_fields = {name: torch.from_numpy(self._batch.expand(name)) for name in model_fields}
        # Every physics step's values, (num_envs, decimation, ...), written by the engine's threads.
        sizes = {"actuator_force": model.nu, "actuator_velocity": model.nu, "sensordata": model.nsensordata}
        self._record = {name: np.zeros((num_envs, decimation, size)) for name, size in sizes.items()}
        self._force, self._velocity, self._sensors = (torch.from_numpy(v) for v in self._record.values())
        home = torch.from_numpy(robot.home_qpos).float().expand(num_envs, -1)
        self.reset(torch.ones(num_envs, dtype=torch.bool), home, torch.zeros(num_envs, 12))

    def step(self, targets: Tensor, wrench_w: Tensor) -> SimState:
        """See `Simulator.step`."""
        self.write(targets, wrench_w)
        self._memory_before.copy_(self._memory)
        with _silence(), contextlib.suppress(SimulationError):  # those worlds keep the state that they had
            self._batch.rollout(self._decimation, record=tuple(self._record), out=self._record)
        self._read_faults()
        self.state.qpos.copy_(self._qpos)
        self.state.qvel.copy_(self._qvel)
        self.state.foot_force.copy_(_mean(self._sensors)[:, self._foot_adr])
        self.state.joint_force.copy_(_mean(self._force))
        power = self._force * self._velocity
        self.state.joint_net_power.copy_(_mean(power))
        self.state.joint_power.copy_(_mean(power.abs_()))
        return self.state

    def write(self, targets: Tensor, wrench_w: Tensor) -> None:
        """See `Simulator.write`."""
        self._ctrl.copy_(targets)
        self._trunk_wrench.copy_(wrench_w)

    def advance(self) -> None:
        """See `Simulator.advance`."""
        self._batch.step(nstep=self._decimation)

    def reset(self, mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        """See `Simulator.reset`."""
        worlds = mask.numpy().nonzero()[0]  # in numpy's hands: a look at the mask costs nothing here, and most worlds go on
        for target, value in ((self._qpos, qpos), (self._qvel, qvel), (self.state.qpos, qpos), (self.state.qvel, qvel)):
            target.numpy()[worlds] = value.numpy()[worlds]
        for target in (self._warmstart, self._time, *self.state.step_means):
            target.numpy()[worlds] = 0.0

    def _read_faults(self) -> None:
        """Bring `faults` up to date. A world with a warning has skipped the rest of its physics steps."""
        warnings, failed = self._batch.warning[:, :, 1], self._batch.status != 0  # numbers of warnings, (num_envs, kinds)
        if self._batch.warning.any() or failed.any() or self._faults.any():
            full = warnings[:, CAPACITY].any(1)
            self._faults[:] = warnings.any(1) & ~full, failed, full
            if failed.any():
                self.advice["engine_error"] = self._batch.error(int(failed.argmax()))
            self._batch.warning[:] = 0

    def load(self, memory: Mapping[str, Tensor]) -> None:
        """See `Simulator.load`."""
        for name, live in self.memory.items():
            live.copy_(memory[name])
        self.state.qpos.copy_(self._qpos)
        self.state.qvel.copy_(self._qvel)
        for mean in self.state.step_means:
            mean.zero_()


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Keep the engine from writing each warning to the console and to a file in the working directory; `faults` has them."""
    before, quiet = mujoco.MjLogConfig.get(), mujoco.MjLogConfig.get()
    quiet.logto_console = quiet.logto_file = False
    quiet.set()
    try:
        yield
    finally:
        before.set()


def _mean(record: Tensor) -> Tensor:
    """Return the mean over the physics steps of a record (num_envs, steps, ...); `record.mean(1)` takes three times as long."""
    first, *others = record.unbind(1)
    return sum(others, first) / record.shape[1]
