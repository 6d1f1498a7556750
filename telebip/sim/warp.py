# pyright: reportGeneralTypeIssues=false, reportIndexIssue=false, reportOperatorIssue=false
"""MuJoCo Warp: the engine of NVIDIA GPUs, one CUDA graph per policy step. It runs on the CPU too, slowly, to be tested there.

The only file that imports `mujoco_warp`. Torch tensors and Warp arrays share memory in both directions.
"""

import os
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import mujoco_warp as mjw
import torch
import warp as wp
from torch import Tensor

from telebip.errors import UserError
from telebip.graph import no_garbage_collection
from telebip.math import over
from telebip.robot import FEET, Robot, ground_force_sensor
from telebip.sim.base import ENGINE_FAULTS, MEANS, Backend, SimState, derives, home_data, require_whole_state, state_fields
from telebip.sim.ordering import CanonicalOrder

CAPACITY = int(mjw.OverflowType.ALL & ~(mjw.OverflowType.ITERATIONS | mjw.OverflowType.LS_ITERATIONS))
"""Overflows that truncate the physics; the MJCF's limits on solver iterations are meant."""

DERIVED = (
    *("body_subtreemass", "body_invweight0", "dof_invweight0", "tendon_invweight0", "tendon_length0", "actuator_acc0"),
    *("geom_aabb", "geom_rbound", "eq_data", "cam_pos0", "cam_poscom0", "cam_mat0"),
)
"""Fields of the model that `mjw.set_const` computes."""


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
    """Add one physics step's share, `scale` = 1 / decimation, to the means over a policy step; the last four are `MEANS`."""
    world, i = wp.tid()  # type: ignore[misc]
    force = actuator_force[world, i]
    joint_force[world, i] += scale * force
    power = force * actuator_velocity[world, i]
    joint_power[world, i] += scale * wp.abs(power)
    joint_net_power[world, i] += scale * power
    if i == 0:
        foot_force[world, 0] -= scale * sensordata[world, right_adr]
        foot_force[world, 1] -= scale * sensordata[world, left_adr]


class EngineGraph:
    """Work of the engine recorded as a CUDA graph, which is replayed on torch's current stream."""

    def __init__(self, work: Callable[[], None], device: torch.device) -> None:
        """Do the work once, which compiles and loads its kernels, and record it; the device is idle before and after."""
        self._device, wp_device = device, wp.device_from_torch(device)
        self._streams: dict[int, wp.Stream] = {}
        torch.cuda.synchronize(device)  # the work below is on Warp's own stream
        with wp.ScopedDevice(wp_device):
            work()
            with no_garbage_collection(), wp.ScopedCapture() as capture:
                work()
        wp.synchronize_device(wp_device)
        self._graph: wp.Graph = capture.graph  # type: ignore[assignment]

    def __call__(self) -> None:
        """Do the work again, in order with torch's work before and after and without a synchronisation."""
        with torch.cuda.device(self._device):  # the default stream's handle means that of the current device
            stream = torch.cuda.current_stream(self._device)
            if stream.cuda_stream not in self._streams:
                self._streams[stream.cuda_stream] = wp.stream_from_torch(stream)
            wp.capture_launch(self._graph, stream=self._streams[stream.cuda_stream])


def start_warp() -> None:
    """Start Warp; where its folder for compiled kernels cannot be written, as in a read-only home, with another one.

    Raises:
        UserError: that cannot be written either.
    """
    try:
        wp.init()
        tempfile.TemporaryFile(dir=wp.config.kernel_cache_dir).close()
    except OSError as error:
        folder = Path(tempfile.gettempdir()) / f"telebip-warp-{os.getuid() if hasattr(os, 'getuid') else ''}"
        print(f"note: kernels are kept in {folder}, as '{error.filename}' cannot be written: {error.strerror}", file=sys.stderr)
        try:
            folder.mkdir(mode=0o700, exist_ok=True)
            wp.config.kernel_cache_dir = str(folder)
            wp.init()
        except OSError as other:
            raise UserError(f"backend 'warp' needs a folder for its kernels: {other}; set WARP_CACHE_PATH to one") from other


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
        sensors: Sequence[str] = (),
        max_contacts: int = 8,
        max_constraints: int = 64,
        deterministic: bool = False,
    ) -> None:
        """Create the worlds in the home pose, as `telebip.sim.make_simulator` does, with room for so much in each of them.

        The first use on a machine compiles kernels for a minute or more. With `deterministic` no number depends on the order in
        which a GPU's threads come, see `telebip.sim.ordering`.

        Raises:
            UserError: the engine lacks something of the robot, or has one value of a field for all worlds, or cannot be
                deterministic with it.
        """
        self.num_envs, self.device = num_envs, device
        self.model = robot.engine_model(sensors)
        require_whole_state(self.model, robot.path)
        self._decimation = decimation
        self._derives = derives(model_fields)
        wp.config.log_level = wp.LOG_WARNING  # not a line for each of a hundred kernels
        start_warp()
        self._wp_device = wp.device_from_torch(device)
        per_world = (*model_fields, *(DERIVED if self._derives else ()))
        with wp.ScopedDevice(self._wp_device):
            try:
                self.mjw_model = mjw.put_model(self.model, batch_sizes=dict.fromkeys(per_world, num_envs))
            except (NotImplementedError, ValueError) as error:
                raise UserError(f"{robot.path}: backend 'warp': {error} (--backend native takes it)") from error
            self.mjw_model.opt.warn_overflow = 0  # `faults` has them
            self.mjw_data = mjw.make_data(self.model, nworld=num_envs, nconmax=max_contacts, njmax=max_constraints)
            if deterministic:
                self.mjw_model.opt.deterministic = True
                CanonicalOrder(self.mjw_model, self.mjw_data)
            self._schedule = [wp.zeros_like(self.mjw_data.ctrl) for _ in range(decimation)]  # controls of each physics step
        data = self.mjw_data
        self.model_fields = {name: wp.to_torch(getattr(self.mjw_model, name)) for name in model_fields}
        # Equality constraints read the velocities that bodies had in the step before.
        fields = (*state_fields(self.model), *(("cvel",) if self.model.neq else ()))
        self.memory = {name: wp.to_torch(getattr(data, name)) for name in fields}
        self._default = self._home()
        self._live = [getattr(data, name) for name in self.memory]
        self._copies = [wp.clone(array) for array in self._live]
        self.memory_before = {name: wp.to_torch(copy) for name, copy in zip(self.memory, self._copies, strict=True)}
        sensordata, places = wp.to_torch(data.sensordata), {name: self.model.sensor(name) for name in sensors}
        blank = SimState.zeros(robot, num_envs, device)
        self.state = replace(  # positions, velocities and sensors are the engine's own buffers
            blank,
            **{name: getattr(blank, name).contiguous() for name in MEANS},  # row by row, as the kernel's threads go
            qpos=self.memory["qpos"],
            qvel=self.memory["qvel"],
            sensors={name: sensordata[:, place.adr[0] : place.adr[0] + place.dim[0]] for name, place in places.items()},
        )
        self._means = [wp.from_torch(getattr(self.state, name)) for name in MEANS]
        self._ctrl, self._overflow = wp.to_torch(data.ctrl), wp.to_torch(data.overflow)
        self._targets = [wp.to_torch(controls) for controls in self._schedule]
        self._trunk_wrench = wp.to_torch(data.xfrc_applied)[:, self.model.jnt_bodyid[0]]
        self._foot_adr = [int(self.model.sensor(ground_force_sensor(foot)).adr[0]) + 2 for foot in FEET]
        self.advice = {
            "capacity": f"raise sim.max_contacts ({max_contacts}) or sim.max_constraints ({max_constraints}), both per world"
        }
        self.faults = torch.zeros(len(ENGINE_FAULTS), num_envs, dtype=torch.bool, device=device)  # warns of nothing else
        self._graphs: dict[Callable[[], None], EngineGraph] = {}
        if self._wp_device.is_cuda:
            self._graphs[self._hold] = self._record(self._hold)
        home = torch.as_tensor(robot.home_qpos, dtype=torch.float32, device=device).expand(num_envs, -1)
        everywhere = torch.ones(num_envs, dtype=torch.bool, device=device)
        self.reset(everywhere, home, torch.zeros(num_envs, self.model.nv, device=device))

    def _home(self) -> dict[str, Tensor]:
        """Return `memory` as it is in the keyframe `home`, at rest."""
        data, home = home_data(self.model), {}
        for name, live in self.memory.items():
            value = torch.as_tensor(getattr(data, name), dtype=live.dtype, device=live.device)
            home[name] = value.reshape(live.shape[1:]).expand_as(live).clone()
        return home

    def step(self, targets: Tensor, wrench_w: Tensor) -> SimState:
        """See `Simulator.step`."""
        self._trunk_wrench.copy_(wrench_w)
        if targets.dim() == 2:
            self._ctrl.copy_(targets)
            self._do(self._hold)
        else:
            for controls, target in zip(self._targets, targets.unbind(1), strict=True):
                controls.copy_(target)
            self._do(self._follow)
        torch.bitwise_and(self._overflow, CAPACITY, out=self._overflow)
        torch.ne(self._overflow, 0, out=self.faults[ENGINE_FAULTS.index("capacity")])
        self._overflow.zero_()
        return self.state

    def reset(self, mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        """See `Simulator.reset`."""
        new = self._default | {"qpos": qpos, "qvel": qvel}
        for name, live in self.memory.items():
            live.copy_(torch.where(over(mask, live), new[name], live))
        for value in self.state.step_values.values():
            value.masked_fill_(over(mask, value), 0.0)

    def load(self, memory: Mapping[str, Tensor]) -> None:
        """See `Simulator.load`."""
        for name, live in self.memory.items():
            live.copy_(memory[name])
        for value in self.state.step_values.values():
            value.zero_()

    def refresh_constants(self, mask: Tensor) -> None:
        """See `Simulator.refresh_constants`; it does so in all worlds."""
        if self._derives:
            self._do(self._set_const)

    def _hold(self) -> None:
        self._advance([])

    def _follow(self) -> None:
        self._advance(self._schedule)

    def _advance(self, schedule: list[wp.array]) -> None:
        """Do one policy step, with the present controls or those of each physics step; fill `memory_before` and the means."""
        data = self.mjw_data
        for copy, live in zip(self._copies, self._live, strict=True):
            wp.copy(copy, live)
        for mean in self._means:
            mean.zero_()
        for i in range(self._decimation):
            if schedule:
                wp.copy(data.ctrl, schedule[i])
            mjw.step(self.mjw_model, data)
            wp.launch(
                _accumulate,
                dim=(self.num_envs, self.model.nu),
                inputs=[data.actuator_force, data.actuator_velocity, data.sensordata, *self._foot_adr, 1.0 / self._decimation],
                outputs=self._means,
            )

    def _set_const(self) -> None:
        mjw.set_const(self.mjw_model, self.mjw_data, restore=False)

    def _do(self, work: Callable[[], None]) -> None:
        """Do `_hold`, `_follow` or `_set_const`: on CUDA as a graph, recorded at its first use."""
        if not self._wp_device.is_cuda:
            with wp.ScopedDevice(self._wp_device):
                work()
            return
        if work not in self._graphs:
            self._graphs[work] = self._record(work)
        self._graphs[work]()

    def _record(self, work: Callable[[], None]) -> EngineGraph:
        """Record a CUDA graph; the worlds stay where they are."""
        memory = {name: live.clone() for name, live in self.memory.items()}
        graph = EngineGraph(work, self.device)
        for name, live in self.memory.items():
            live.copy_(memory[name])
        self._overflow.zero_()  # that of a step that nobody asked for
        return graph
