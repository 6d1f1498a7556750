# pyright: reportAttributeAccessIssue=false
"""C MuJoCo on a thread pool: the engine of machines without a GPU, bit-identical to a loop of `mj_step`."""

import copy
from collections.abc import Sequence

import mujoco
import torch
from mujoco.batch import Batch
from torch import Tensor

from telebip.robot import Robot
from telebip.sim.base import SimState


class NativeSimulator:
    """`Simulator` on `mujoco.batch.Batch`: float64 inside, float32 in `state`; results do not depend on threads."""

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
        self._rows = torch.from_numpy(self._batch.state)
        self._qpos, self._qvel, self._warmstart, self._ctrl, self._time = (
            torch.from_numpy(self._batch.bind(name)) for name in ("qpos", "qvel", "qacc_warmstart", "ctrl", "time")
        )
        self._trunk_wrench = torch.from_numpy(self._batch.bind("xfrc_applied"))[:, robot.trunk_id]
        self.model_fields = {name: torch.from_numpy(self._batch.expand(name)) for name in model_fields}
        # Every physics step's values, (num_envs, decimation, ...), written by the engine's threads.
        self._record = self._batch.rollout(1, record=("actuator_force", "actuator_velocity", "sensordata"))
        self._record = {k: v.repeat(decimation, axis=1) for k, v in self._record.items()}
        self._force, self._velocity, self._sensors = (torch.from_numpy(v) for v in self._record.values())
        home = torch.from_numpy(robot.home_qpos).float().expand(num_envs, -1)
        self.reset(torch.ones(num_envs, dtype=torch.bool), home, torch.zeros(num_envs, 12))

    def step(self, targets: Tensor, wrench_w: Tensor) -> SimState:
        """See `Simulator.step`."""
        self.write(targets, wrench_w)
        self._batch.rollout(self._decimation, record=tuple(self._record), out=self._record)
        self.state.qpos.copy_(self._qpos)
        self.state.qvel.copy_(self._qvel)
        self.state.foot_force.copy_(_mean(self._sensors)[:, self._foot_adr])
        self.state.joint_force.copy_(_mean(self._force))
        power = self._force * self._velocity
        self.state.joint_net_power.copy_(_mean(power))
        self.state.joint_power.copy_(_mean(power.abs_()))
        return self.state

    @property
    def buffers(self) -> tuple[Tensor, ...]:
        """See `Simulator.buffers`."""
        return self._rows, self.state.qpos, self.state.qvel, *self.state.step_means, *self.model_fields.values()

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


def _mean(record: Tensor) -> Tensor:
    """Return the mean over the physics steps of a record (num_envs, steps, ...); `record.mean(1)` takes three times as long."""
    first, *others = record.unbind(1)
    return sum(others, first) / record.shape[1]
