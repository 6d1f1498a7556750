# pyright: reportGeneralTypeIssues=false, reportIndexIssue=false, reportOperatorIssue=false
"""MuJoCo Warp: the engine of NVIDIA GPUs, one CUDA graph per policy step. It runs on the CPU too, slowly, to be tested there.

The only file that imports `mujoco_warp`. Torch tensors and Warp arrays share memory in both directions.
"""

from collections.abc import Mapping, Sequence

import mujoco_warp as mjw
import torch
import warp as wp
from torch import Tensor

from telebip.robot import Robot
from telebip.sim.base import ENGINE_FAULTS, Backend, SimState

CAPACITY = int(mjw.OverflowType.ALL & ~(mjw.OverflowType.ITERATIONS | mjw.OverflowType.LS_ITERATIONS))
"""Overflows that truncate the physics; the MJCF's limits on solver iterations are meant."""


@wp.kernel
def _accumulate(
    actuator_force: wp.array2d[float],
    actuator_velocity: wp.array2d[float],
    sensordata: wp.array2d[float],
    right_adr: int,
    left_adr: int,
    scale: float,
    joint_force: wp.array2d[float],
    joint_power: wp.array2d[float],
    joint_net_power: wp.array2d[float],
    foot_force: wp.array2d[float],
):
    """Add one physics step's share, `scale` = 1 / decimation, to the means over a policy step."""
    world, i = wp.tid()  # type: ignore[misc]
    force = actuator_force[world, i]
    joint_force[world, i] += scale * force
    power = force * actuator_velocity[world, i]
    joint_power[world, i] += scale * wp.abs(power)
    joint_net_power[world, i] += scale * power
    if i == 0:
        foot_force[world, 0] += scale * sensordata[world, right_adr]
        foot_force[world, 1] += scale * sensordata[world, left_adr]


class WarpSimulator:
    """`Simulator` on `mujoco_warp`, float32 throughout."""

    backend: Backend = "warp"

    def __init__(
        self,
        robot: Robot,
        num_envs: int,
        decimation: int,
        device: torch.device,
        model_fields: Sequence[str] = (),
        max_contacts: int = 8,
        max_constraints: int = 64,
    ) -> None:
        """Create the worlds in the home pose; the first use on a machine compiles kernels for a minute or more.

        Args:
            robot: the model.
            num_envs: number of worlds.
            decimation: physics steps per `step`.
            device: where to simulate.
            model_fields: names of model fields that get one value per world.
            max_contacts: room for contacts, per world.
            max_constraints: room for rows of the constraint solver, per world.
        """
        self.num_envs = num_envs
        self.device = device
        self._decimation = decimation
        self._foot_adr = robot.engine_foot_sensor_adr
        wp.config.log_level = wp.LOG_WARNING  # not a line for each of a hundred kernels
        wp.init()
        self._wp_device = wp.device_from_torch(device)
        with wp.ScopedDevice(self._wp_device):
            self._model = mjw.put_model(robot.engine_model, batch_sizes=dict.fromkeys(model_fields, num_envs))
            self._model.opt.warn_overflow = 0  # `faults` has them
            self._data = mjw.make_data(robot.engine_model, nworld=num_envs, nconmax=max_contacts, njmax=max_constraints)
        self.model_fields = {name: wp.to_torch(getattr(self._model, name)) for name in model_fields}
        for name, field in self.model_fields.items():
            field.copy_(
                torch.as_tensor(getattr(robot.engine_model, name), dtype=field.dtype).reshape(field.shape[1:]).expand_as(field)
            )
        self.state = SimState(
            qpos=wp.to_torch(self._data.qpos),
            qvel=wp.to_torch(self._data.qvel),
            foot_force=torch.zeros(num_envs, 2, device=device),
            joint_force=torch.zeros(num_envs, 6, device=device),
            joint_power=torch.zeros(num_envs, 6, device=device),
            joint_net_power=torch.zeros(num_envs, 6, device=device),
        )
        state = self.state
        self._means = [
            wp.from_torch(mean) for mean in (state.joint_force, state.joint_power, state.joint_net_power, state.foot_force)
        ]
        self._ctrl, self._warmstart, self._time = (
            wp.to_torch(a) for a in (self._data.ctrl, self._data.qacc_warmstart, self._data.time)
        )
        self.memory = {"qpos": state.qpos, "qvel": state.qvel, "qacc_warmstart": self._warmstart, "time": self._time}
        self._live = [wp.from_torch(memory) for memory in self.memory.values()]
        self._copies = [wp.clone(array) for array in self._live]
        self.memory_before = {name: wp.to_torch(copy) for name, copy in zip(self.memory, self._copies, strict=True)}
        self._trunk_wrench = wp.to_torch(self._data.xfrc_applied)[:, robot.trunk_id]
        self.advice = {
            "capacity": f"raise sim.max_contacts ({max_contacts}) or sim.max_constraints ({max_constraints}), both per world"
        }
        self._overflow = wp.to_torch(self._data.overflow)
        self.faults = torch.zeros(len(ENGINE_FAULTS), num_envs, dtype=torch.bool, device=device)  # warns of nothing else
        self._graphs = {True: self._capture(complete=True)} if self._wp_device.is_cuda else {}
        home = torch.as_tensor(robot.home_qpos, dtype=torch.float32, device=device).expand(num_envs, -1)
        self.reset(torch.ones(num_envs, dtype=torch.bool, device=device), home, torch.zeros(num_envs, 12, device=device))

    def step(self, targets: Tensor, wrench_w: Tensor) -> SimState:
        """See `Simulator.step`."""
        self.write(targets, wrench_w)
        self._run(complete=True)
        torch.bitwise_and(self._overflow, CAPACITY, out=self._overflow)
        torch.ne(self._overflow, 0, out=self.faults[ENGINE_FAULTS.index("capacity")])
        self._overflow.zero_()
        return self.state

    def write(self, targets: Tensor, wrench_w: Tensor) -> None:
        """See `Simulator.write`."""
        self._ctrl.copy_(targets)
        self._trunk_wrench.copy_(wrench_w)

    def advance(self) -> None:
        """See `Simulator.advance`; on CUDA the first call records a graph, and leaves the worlds some steps further on."""
        self._run(complete=False)
        self._overflow.zero_()

    def reset(self, mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        """See `Simulator.reset`."""
        rows = mask[:, None]
        self.state.qpos.copy_(torch.where(rows, qpos, self.state.qpos))
        self.state.qvel.copy_(torch.where(rows, qvel, self.state.qvel))
        for target in (self._warmstart, self._time, *self.state.step_means):
            target.masked_fill_(rows if target.dim() == 2 else mask, 0.0)

    def load(self, memory: Mapping[str, Tensor]) -> None:
        """See `Simulator.load`."""
        for name, live in self.memory.items():
            live.copy_(memory[name])
        for mean in self.state.step_means:
            mean.zero_()

    def _run(self, complete: bool) -> None:
        """Run the physics steps of one policy step: on CUDA as a graph, recorded at its first use."""
        if not self._wp_device.is_cuda:
            self._launch(complete)
            return
        if complete not in self._graphs:
            self._graphs[complete] = self._capture(complete)
        # On torch's stream, so that torch's work before and after is ordered with it without a synchronisation.
        with torch.cuda.device(self.device):  # the default stream's handle means that of the current device
            wp.capture_launch(self._graphs[complete], stream=wp.stream_from_torch(torch.cuda.current_stream(self.device)))

    def _launch(self, complete: bool) -> None:
        """Run the physics steps of one policy step, and if `complete` all else of `step`: `memory_before` and the means."""
        with wp.ScopedDevice(self._wp_device):
            if complete:
                for copy, live in zip(self._copies, self._live, strict=True):
                    wp.copy(copy, live)
                for mean in self._means:
                    mean.zero_()
            for _ in range(self._decimation):
                mjw.step(self._model, self._data)
                if not complete:
                    continue
                wp.launch(
                    _accumulate,
                    dim=(self.num_envs, 6),
                    inputs=[
                        self._data.actuator_force,
                        self._data.actuator_velocity,
                        self._data.sensordata,
                        *self._foot_adr,
                        1.0 / self._decimation,
                    ],
                    outputs=self._means,
                )

    def _capture(self, complete: bool) -> wp.Graph:
        """Compile and warm up, then record `_launch` as a CUDA graph."""
        wp.synchronize_device(self._wp_device)
        self._launch(complete)
        with wp.ScopedCapture(device=self._wp_device) as capture:
            self._launch(complete)
        wp.synchronize_device(self._wp_device)  # from here on everything runs on torch's stream
        self._overflow.zero_()  # that of a pose that nobody asked for
        return capture.graph  # type: ignore[return-value]
