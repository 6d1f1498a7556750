# pyright: reportAttributeAccessIssue=false
"""C MuJoCo on a thread pool: the engine of machines without a GPU, bit-identical to a loop of `mj_step`."""

import contextlib
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch, SimulationError
from torch import Tensor

from telebip.robot import FEET, Robot, ground_force_sensor, silent_engine
from telebip.sim.base import ENGINE_FAULTS, Backend, SimState, derives, home_data, require_whole_state, state_fields

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
        sensors: Sequence[str] = (),
        num_threads: int = 0,
    ) -> None:
        """Create the worlds in the home pose, as `telebip.sim.make_simulator` does; 0 `num_threads` are one per processor."""
        self.num_envs = num_envs
        self.device = torch.device("cpu")
        self.model = robot.engine_model(sensors)
        require_whole_state(self.model, robot.path)
        # A non-finite state stays, to be seen and counted by the environment; the engine would silently reset it.
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.state = SimState.zeros(robot, num_envs, self.device, sensors)
        self.batch = Batch(self.model, num_envs, num_threads)  # the engine itself
        self.memory = {name: torch.from_numpy(self.batch.bind(name)) for name in state_fields(self.model)}
        self.memory_before = {name: live.clone() for name, live in self.memory.items()}
        self.model_fields = {name: torch.from_numpy(self.batch.expand(name)) for name in model_fields}
        self.faults = torch.zeros(len(ENGINE_FAULTS), num_envs, dtype=torch.bool)
        self.advice = {"capacity": 'raise <size memory="..."/> in the MJCF'}
        self._derives = derives(model_fields)
        self._decimation = decimation
        self._default = np.empty(self.batch.nstate)  # the engine's whole state in the keyframe `home`
        mujoco.mj_getState(self.model, home_data(self.model), self._default, mujoco.mjtState.mjSTATE_INTEGRATION)
        self._ctrl = torch.from_numpy(self.batch.bind("ctrl"))
        self._trunk_wrench = torch.from_numpy(self.batch.bind("xfrc_applied"))[:, self.model.jnt_bodyid[0]]
        # Every physics step's values, (num_envs, decimation, ...), written by the engine's threads.
        sizes = {"actuator_force": self.model.nu, "actuator_velocity": self.model.nu, "sensordata": self.model.nsensordata}
        self._record = {name: np.zeros((num_envs, decimation, size)) for name, size in sizes.items()}
        self._force, self._velocity, data = (torch.from_numpy(values) for values in self._record.values())
        self._feet = [data[:, :, self.model.sensor(ground_force_sensor(foot)).adr[0] + 2] for foot in FEET]
        places = {name: self.model.sensor(name) for name in sensors}
        self._sensors = {name: data[:, -1, place.adr[0] : place.adr[0] + place.dim[0]] for name, place in places.items()}
        home = torch.from_numpy(robot.home_qpos).float().expand(num_envs, -1)
        self.reset(torch.ones(num_envs, dtype=torch.bool), home, torch.zeros(num_envs, self.model.nv))

    def step(self, targets: Tensor, wrench_w: Tensor) -> SimState:
        """See `Simulator.step`."""
        state, memory = self.state, self.memory
        self._trunk_wrench.copy_(wrench_w)
        schedule = targets.numpy() if targets.dim() == 3 else None  # (num_envs, decimation, num_joints)
        if schedule is None:
            self._ctrl.copy_(targets)
        for before, live in zip(self.memory_before.values(), memory.values(), strict=True):
            before.copy_(live)
        with silent_engine(), contextlib.suppress(SimulationError):  # those worlds keep the state that they had
            self.batch.rollout(self._decimation, control=schedule, record=tuple(self._record), out=self._record)
        self._read_faults()
        state.qpos.copy_(memory["qpos"])
        state.qvel.copy_(memory["qvel"])
        for column, foot in zip(state.foot_force.T, self._feet, strict=True):
            column.copy_(-_mean(foot))
        state.joint_force.copy_(_mean(self._force))
        power = self._force * self._velocity
        state.joint_net_power.copy_(_mean(power))
        state.joint_power.copy_(_mean(power.abs_()))
        for name, values in self._sensors.items():
            state.sensors[name].copy_(values)
        return state

    def reset(self, mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        """See `Simulator.reset`."""
        worlds = mask.numpy().nonzero()[0]  # in numpy's hands: a look at the mask costs nothing here, and most worlds go on
        self.batch.state[worlds] = self._default
        for name, values in (("qpos", qpos), ("qvel", qvel)):
            rows = values.numpy()[worlds]
            self.memory[name].numpy()[worlds] = rows
            getattr(self.state, name).numpy()[worlds] = rows
        for value in self.state.step_values.values():
            value.numpy()[worlds] = 0.0

    def load(self, memory: Mapping[str, Tensor]) -> None:
        """See `Simulator.load`."""
        for name, live in self.memory.items():
            live.copy_(memory[name])
        self.state.qpos.copy_(self.memory["qpos"])
        self.state.qvel.copy_(self.memory["qvel"])
        for value in self.state.step_values.values():
            value.zero_()

    def refresh_constants(self, mask: Tensor) -> None:
        """See `Simulator.refresh_constants`."""
        worlds = mask.numpy().nonzero()[0]
        if self._derives and len(worlds):
            self.batch.set_const(worlds)

    def _read_faults(self) -> None:
        """Bring `faults` up to date. A world with a warning has skipped the rest of its physics steps."""
        warnings, failed = self.batch.warning[:, :, 1], self.batch.status != 0  # numbers of warnings, (num_envs, kinds)
        faults = self.faults.numpy()
        if warnings.any() or failed.any() or faults.any():
            full = warnings[:, CAPACITY].any(1)
            faults[:] = warnings.any(1) & ~full, failed, full
            if failed.any():
                self.advice["engine_error"] = self.batch.error(int(failed.argmax()))
            self.batch.warning[:] = 0


def _mean(record: Tensor) -> Tensor:
    """Return the mean over the physics steps of a record (num_envs, steps, ...); `record.mean(1)` takes three times as long."""
    first, *others = record.unbind(1)
    return sum(others, first) / record.shape[1]
