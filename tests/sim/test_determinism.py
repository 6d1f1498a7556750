# pyright: reportAttributeAccessIssue=false
"""Same inputs, same bits: on a CPU always, and on a GPU with `sim.deterministic`, whatever thread comes first."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from telebip import ROOT
from telebip.errors import UserError
from telebip.robot import Robot, load_robot
from telebip.sim.native import NativeSimulator
from telebip.sim.warp import WarpSimulator

NUM_ENVS, STEPS = 6, 12
CPU = torch.device("cpu")


def inputs(robot: Robot) -> Iterator[tuple[Tensor, Tensor]]:
    """Targets that throw the robot off its feet and its joints against their limits, and pushes."""
    generator = torch.Generator().manual_seed(3)
    for _ in range(STEPS):
        reach = 2.0 * torch.rand(NUM_ENVS, len(robot.joint_names), generator=generator) - 1.0
        yield torch.as_tensor(robot.nominal).float() + 0.8 * reach, 80.0 * torch.randn(NUM_ENVS, 6, generator=generator)


def trajectory(sim: Any, robot: Robot) -> Tensor:
    """Positions, velocities and foot forces after each step, from one in which the robot lies almost on the floor."""
    qpos = torch.as_tensor(robot.home_qpos).float().repeat(NUM_ENVS, 1)
    qpos[:, 2] -= torch.linspace(0.0, 0.3, NUM_ENVS)
    device = sim.device
    everywhere = torch.ones(NUM_ENVS, dtype=torch.bool, device=device)
    sim.reset(everywhere, qpos.to(device), torch.zeros(NUM_ENVS, robot.model.nv, device=device))
    rows = []
    for targets, wrench in inputs(robot):
        state = sim.step(targets.to(device), wrench.to(device))
        rows.append(torch.cat([state.qpos, state.qvel, state.foot_force], dim=1).cpu())
    return torch.stack(rows)


class Race:
    """Brings contacts and constraint rows into another order each time, as the threads of a GPU may."""

    def __init__(self, sim: WarpSimulator, seed: int) -> None:
        self.random, self.most_rows = np.random.default_rng(seed), 0
        callback = sim.mjw_model.callback
        self._sort_contacts, self._sort_rows = callback.contactfilter, callback.control
        callback.contactfilter, callback.control = self.contacts, self.rows

    def contacts(self, model: Any, data: Any) -> None:
        number = int(data.nacon.numpy()[0])
        order = self.random.permutation(number)
        for array in vars(data.contact).values():
            if array.size:
                values = array.numpy()
                values[:number] = values[order]
        if self._sort_contacts:
            self._sort_contacts(model, data)

    def rows(self, model: Any, data: Any) -> None:
        for world in range(data.nworld):
            self._shuffle_rows(data, world)
        if self._sort_rows:
            self._sort_rows(model, data)

    def _shuffle_rows(self, data: Any, world: int) -> None:
        efc, contact = data.efc, data.contact
        number = int(data.nefc.numpy()[world])
        kind, index = efc.type.numpy()[world, :number], efc.id.numpy()[world, :number]
        order: list[int] = []
        for each in sorted(set(kind.tolist())):  # joint limits and contacts take turns, and a contact's rows stay together
            ids = np.unique(index[kind == each])
            for chosen in self.random.permutation(ids):
                order += np.flatnonzero((kind == each) & (index == chosen)).tolist()
        self.most_rows = max(self.most_rows, len(order))
        place = np.argsort(np.array(order, dtype=int))
        for name in ("type", "id", "J", "pos", "margin", "D", "vel", "aref", "frictionloss", "Jqvel"):
            values = getattr(efc, name).numpy()[world]
            values[:number] = values[order]
        addresses: NDArray[np.int32] = contact.efc_address.numpy()
        mine = (contact.worldid.numpy() == world)[:, None] & (addresses >= 0)
        mine[int(data.nacon.numpy()[0]) :] = False
        addresses[mine] = place[addresses[mine]]


def simulator(robot: Robot, deterministic: bool) -> WarpSimulator:
    return WarpSimulator(robot, NUM_ENVS, 4, CPU, max_contacts=40, max_constraints=240, deterministic=deterministic)


@pytest.mark.parametrize("path", ["assets/telebip.xml", "tests/robots/ten_joints.xml"])
def test_the_order_of_contacts_and_rows_makes_no_difference(path: str) -> None:
    robot = load_robot(path)
    expected = trajectory(simulator(robot, True), robot)
    for seed in (1, 2):
        sim = simulator(robot, True)
        race = Race(sim, seed)
        assert torch.equal(trajectory(sim, robot), expected)
        assert race.most_rows >= 8  # of two contacts at least, and joint limits

    plain, raced = simulator(robot, False), simulator(robot, False)
    Race(raced, 1)
    assert not torch.equal(trajectory(plain, robot), trajectory(raced, robot))  # without it, the order does


def test_determinism_leaves_the_motion_as_it_is(robot: Robot) -> None:
    """Contacts that a CPU finds are in order already, up to that of the geoms: other roundings, which contacts let grow."""
    ordered, plain = (trajectory(simulator(robot, deterministic), robot) for deterministic in (True, False))
    torch.testing.assert_close(ordered[:3], plain[:3], atol=1e-3, rtol=1e-3)


def test_native_gives_the_same_bits_on_any_number_of_threads(robot: Robot) -> None:
    one, three = (trajectory(NativeSimulator(robot, NUM_ENVS, 4, num_threads=threads), robot) for threads in (1, 3))
    assert torch.equal(one, three)


def test_what_cannot_be_ordered_is_refused(tmp_path: Any) -> None:
    text = (ROOT / "assets/telebip.xml").read_text()
    tie = '<equality><joint joint1="right_hip_pitch" joint2="left_hip_pitch"/></equality>'
    assert "</mujoco>" in text
    (tmp_path / "tied.xml").write_text(text.replace("</mujoco>", f"{tie}</mujoco>"))
    robot = load_robot(tmp_path / "tied.xml")
    with pytest.raises(UserError, match="cannot order the rows of a robot with equality constraints"):
        simulator(robot, True)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_on_cuda_the_engine_repeats_itself_bit_for_bit(robot: Robot) -> None:
    device = torch.device("cuda", torch.cuda.current_device())
    runs = [
        trajectory(WarpSimulator(robot, NUM_ENVS, 4, device, max_contacts=40, max_constraints=240, deterministic=True), robot)
        for _ in range(3)
    ]
    assert torch.equal(runs[0], runs[1])
    assert torch.equal(runs[0], runs[2])
