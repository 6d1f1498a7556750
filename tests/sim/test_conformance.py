# pyright: reportAttributeAccessIssue=false
"""Every physics backend gives the numbers of C MuJoCo's `mj_step`: `native` bit for bit, `warp` within float32's reach."""

import copy
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor
from worlds import write_stateful

from telebip import ROOT
from telebip.config import load_task
from telebip.errors import UserError
from telebip.robot import FEET, FLOOR, FOOT_SENSORS, Robot, load_robot
from telebip.sim import Backend, SimState, Simulator, make_simulator
from telebip.sim.base import state_fields
from telebip.sim.native import NativeSimulator
from telebip.sim.warp import WarpSimulator
from telebip.terrain import Terrain

Arrays = Mapping[str, NDArray[np.floating]]
Make = Callable[..., Simulator]

NUM_ENVS, DECIMATION, STEPS = 8, 4, 25
CAPACITY = (24, 96)
"""Room for two flat feet of two boxes each, on `warp`."""
FIELDS = ("qpos", "qvel", "foot_force", "joint_force", "joint_power", "joint_net_power")
TOLERANCE = {
    "qpos": 2e-5,
    "qvel": 2e-4,
    "foot_force": 2e-2,
    "joint_force": 2.5e-2,
    "joint_power": 1e-2,
    "joint_net_power": 1e-2,
}
"""Of `warp` [m, rad | m/s, rad/s | N | N, N m | W]: twenty times the largest difference seen over 25 policy steps."""

BACKENDS = [
    ("native", "cpu"),
    ("warp", "cpu"),
    pytest.param(
        ("warp", "cuda"),
        marks=[pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")],
    ),
]
ROBOTS = ("assets/telebip.xml", "tests/robots/ten_joints.xml", "tests/robots/four_joints.xml")


@pytest.fixture(scope="module", params=BACKENDS, ids=lambda param: "-".join(param))
def backend(request: pytest.FixtureRequest) -> tuple[Backend, str]:
    return request.param


def converging(path: Path, folder: Path) -> Robot:
    """Return a robot whose solver may take the iterations that it needs: what it leaves undone differs in float32."""
    text, edits = re.subn(r'iterations="\d+" ls_iterations="\d+"', 'iterations="50" ls_iterations="50"', path.read_text())
    assert edits == 1
    (folder / path.name).write_text(text)
    return load_robot(folder / path.name)


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    return converging(ROOT / "assets/telebip.xml", tmp_path_factory.mktemp("robot"))


@pytest.fixture(scope="module")
def make(backend: tuple[Backend, str], robot: Robot) -> Make:
    """Return a function that makes a simulator of the backend under test, in the home pose."""

    def make_one(
        num_envs: int = NUM_ENVS,
        model_fields: Sequence[str] = (),
        sensors: Sequence[str] = (),
        robot: Robot = robot,
    ) -> Simulator:
        name, device = backend
        return make_simulator(name, robot, num_envs, DECIMATION, torch.device(device), model_fields, sensors, CAPACITY)

    return make_one


def random_inputs(robot: Robot, num_envs: int, steps: int, seed: int = 0, each: int = 1) -> tuple[Tensor, Tensor]:
    """Joint targets about the nominal pose, (steps, num_envs, num_joints), and trunk wrenches, (steps, num_envs, 6).

    Targets differ by up to 0.15 rad and 0.04 m, wrenches are up to 30 N and 5 N m. With `each` above one there are as many
    targets in a step, (steps, num_envs, each, num_joints).
    """
    generator = torch.Generator().manual_seed(seed)
    sizes = [(each,) if each > 1 else (), ()]
    targets, wrenches = (
        2.0 * torch.rand(steps, num_envs, *more, size, generator=generator) - 1.0
        for more, size in zip(sizes, (len(robot.joint_names), 6), strict=True)
    )
    reach = torch.where(torch.as_tensor(robot.is_slide), 0.04, 0.15)
    return torch.as_tensor(robot.nominal).float() + reach * targets, torch.tensor([30.0] * 3 + [5.0] * 3) * wrenches


def home(robot: Robot, num_envs: int) -> Tensor:
    return torch.as_tensor(robot.home_qpos).float().repeat(num_envs, 1)


def rest(robot: Robot, num_envs: int) -> Tensor:
    return torch.zeros(num_envs, robot.model.nv)


def mj_rollout(
    models: list[mujoco.MjModel],
    robot: Robot,
    qpos: Tensor,
    qvel: Tensor,
    targets: Tensor,
    wrenches: Tensor,
    sensors: Sequence[str] = (),
) -> Arrays:
    """Step every world with C MuJoCo from `qpos`, `qvel`; FIELDS and sensors after each policy step, (steps, num_envs, ...)."""
    out: dict[str, list[list[NDArray[np.float64]]]] = {name: [] for name in (*FIELDS, *sensors)}
    worlds = [mujoco.MjData(model) for model in models]
    for model, data, position, velocity in zip(models, worlds, qpos, qvel, strict=True):
        mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
        data.qpos[:], data.qvel[:] = position, velocity
    for target, wrench in zip(targets, wrenches, strict=True):
        rows: dict[str, list[NDArray[np.float64]]] = {name: [] for name in out}
        for i, (model, data) in enumerate(zip(models, worlds, strict=True)):
            data.xfrc_applied[robot.trunk_id] = wrench[i]
            feet, forces, powers = [], [], []
            for controls in target[i].expand(DECIMATION, -1):
                data.ctrl[:] = controls
                mujoco.mj_step(model, data)
                feet.append(np.concatenate([data.sensor(name).data for name in FOOT_SENSORS]))
                forces.append(data.actuator_force.copy())
                powers.append(data.actuator_force * data.actuator_velocity)
            values = (data.qpos.copy(), data.qvel.copy(), *(np.mean(v, axis=0) for v in (feet, forces, np.abs(powers), powers)))
            seen = [data.sensor(name).data.copy() for name in sensors]
            for name, value in zip(out, (*values, *seen), strict=True):
                rows[name].append(value)
        for name, values in rows.items():
            out[name].append(values)
    return {name: np.array(values) for name, values in out.items()}


def run(sim: Simulator, targets: Tensor, wrenches: Tensor) -> Arrays:
    """Step a simulator and collect FIELDS and its sensors after each policy step, (steps, num_envs, ...)."""
    rows = [snapshot(sim.step(t.to(sim.device), w.to(sim.device))) for t, w in zip(targets, wrenches, strict=True)]
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}


def snapshot(state: SimState) -> Arrays:
    values = {name: getattr(state, name) for name in FIELDS} | state.sensors
    return {name: value.cpu().numpy().copy() for name, value in values.items()}


def overwrite(sim: Simulator, worlds: list[int], qpos: Tensor, qvel: Tensor) -> None:
    """Reset the listed worlds to rows of `qpos` and `qvel`."""
    mask = torch.zeros(sim.num_envs, dtype=torch.bool)
    mask[worlds] = True
    sim.reset(mask.to(sim.device), qpos.to(sim.device), qvel.to(sim.device))


def assert_conform(actual: Arrays, expected: Arrays, exact: bool) -> None:
    for name, reference in expected.items():
        if exact:
            np.testing.assert_array_equal(actual[name], reference.astype(np.float32), err_msg=name)
        else:
            np.testing.assert_allclose(actual[name], reference, rtol=0.0, atol=TOLERANCE.get(name, 1e-3), err_msg=name)


@pytest.mark.parametrize("path", ROBOTS)
@pytest.mark.parametrize("each", [1, DECIMATION], ids=["held", "each_physics_step"])
def test_every_step_equals_mj_step(make: Make, backend: tuple[Backend, str], path: str, each: int, tmp_path: Path) -> None:
    robot = converging(ROOT / path, tmp_path)
    targets, wrenches = random_inputs(robot, NUM_ENVS, STEPS, each=each)
    models = [robot.model] * NUM_ENVS
    expected = mj_rollout(models, robot, home(robot, NUM_ENVS), rest(robot, NUM_ENVS), targets, wrenches)
    assert np.ptp(expected["qpos"][-1], axis=0).max() > 0.05  # the worlds differ
    assert expected["foot_force"].max() > 100.0  # and touch the ground
    sim = make(robot=robot)
    assert_conform(run(sim, targets, wrenches), expected, exact=backend[0] == "native")
    assert not sim.faults.any()
    joints = [robot.model.joint(name) for name in robot.joint_names]
    for state, columns in (("joint_pos", [j.qposadr[0] for j in joints]), ("joint_vel", [j.dofadr[0] for j in joints])):
        whole = sim.state.qpos if state == "joint_pos" else sim.state.qvel
        assert torch.equal(getattr(sim.state, state), whole[:, columns])


@pytest.mark.parametrize("num_threads", [1, 2])
def test_native_is_bit_identical_inside_for_any_number_of_threads(num_threads: int) -> None:
    robot = load_robot("assets/telebip.xml")
    targets, wrenches = random_inputs(robot, NUM_ENVS, STEPS)
    models = [robot.model] * NUM_ENVS
    expected = mj_rollout(models, robot, home(robot, NUM_ENVS), rest(robot, NUM_ENVS), targets, wrenches)
    sim = NativeSimulator(robot, NUM_ENVS, DECIMATION, num_threads=num_threads)
    assert_conform(run(sim, targets, wrenches), expected, exact=True)
    np.testing.assert_array_equal(sim.memory["qpos"].numpy(), expected["qpos"][-1])
    np.testing.assert_array_equal(sim.memory["qvel"].numpy(), expected["qvel"][-1])


def ground_force(model: mujoco.MjModel, data: mujoco.MjData) -> list[float]:
    """Vertical force of the ground on the right and the left foot [N], contact by contact."""
    force, out = np.zeros(6), [0.0, 0.0]
    for i, contact in enumerate(data.contact[: data.ncon]):
        for k, foot in enumerate(FEET):
            if model.geom(foot).id in contact.geom and model.geom(FLOOR).id in contact.geom:
                mujoco.mj_contactForce(model, data, i, force)
                upward = 1.0 if contact.geom[0] == model.geom(FLOOR).id else -1.0
                out[k] += upward * float(contact.frame.reshape(3, 3).T[2] @ force[:3])
    return out


def test_on_rough_ground(make: Make, backend: tuple[Backend, str], robot: Robot) -> None:
    """`native` equals `mj_step`, bit for bit. `warp` finds other contacts: at most four a foot, and at edges elsewhere."""
    waves = {"waves": {"height": (0.1, 0.1), "length": 0.5}}
    terrain = replace(load_task("telebip_flat").terrain, types=waves, levels=1, start_level=(0, 0), size=2.0, platform=0.1)
    rough = robot.on(Terrain(terrain))
    steps, qpos = 10, home(rough, NUM_ENVS)
    qpos[:, :2] += torch.linspace(-0.5, 0.5, NUM_ENVS)[:, None]
    qpos[:, 2] += 0.05
    targets, wrenches = random_inputs(rough, NUM_ENVS, steps)
    sim = make(robot=rough)
    overwrite(sim, list(range(NUM_ENVS)), qpos, rest(rough, NUM_ENVS))
    actual = run(sim, targets, wrenches)
    ends, feet = np.zeros((steps, NUM_ENVS, rough.model.nq)), np.zeros((steps, NUM_ENVS, 2))
    for world in range(NUM_ENVS):
        data = mujoco.MjData(rough.model)
        data.qpos[:] = qpos[world]
        for step in range(steps):
            data.ctrl[:], data.xfrc_applied[rough.trunk_id] = targets[step, world], wrenches[step, world]
            for _ in range(DECIMATION):
                mujoco.mj_step(rough.model, data)
                feet[step, world] += np.array(ground_force(rough.model, data)) / DECIMATION
            ends[step, world] = data.qpos
    assert feet.max() > 100.0 and np.ptp(ends[-1, :, 2]) > 0.02
    assert not sim.faults.any()
    if backend[0] == "native":
        np.testing.assert_array_equal(actual["qpos"], ends.astype(np.float32))
        np.testing.assert_allclose(actual["foot_force"], feet, atol=1e-3)
    else:
        np.testing.assert_allclose(actual["qpos"][0], ends[0], atol=2e-5)  # in the air
        np.testing.assert_allclose(actual["qpos"], ends, atol=0.05)  # twice the largest difference seen
        assert actual["foot_force"].sum() == pytest.approx(feet.sum(), rel=0.02)  # the robots are carried all the same


def test_sensors_are_those_of_the_last_physics_step(make: Make, backend: tuple[Backend, str], robot: Robot) -> None:
    names = ("orientation", "gyro", "accelerometer", "right_knee_pos")
    targets, wrenches = random_inputs(robot, NUM_ENVS, 5)
    models = [robot.model] * NUM_ENVS
    expected = mj_rollout(models, robot, home(robot, NUM_ENVS), rest(robot, NUM_ENVS), targets, wrenches, names)
    sim = make(sensors=names)
    kept = {sim.model.sensor(i).name for i in range(sim.model.nsensor)}
    assert kept == {*names, "right_foot_ground_force", "left_foot_ground_force"}
    assert_conform(run(sim, targets, wrenches), expected, exact=backend[0] == "native")
    overwrite(sim, [2], home(robot, NUM_ENVS), rest(robot, NUM_ENVS))
    assert not any(sim.state.sensors[name][2].any() for name in names)  # of the time before nothing is left
    assert all(sim.state.sensors[name][1].any() for name in names)


def test_a_single_world_works(make: Make, backend: tuple[Backend, str], robot: Robot) -> None:
    targets, wrenches = random_inputs(robot, 1, 3)
    expected = mj_rollout([robot.model], robot, home(robot, 1), rest(robot, 1), targets, wrenches)
    actual = run(make(num_envs=1), targets, wrenches)
    assert actual["qpos"].shape == (3, 1, robot.model.nq)
    assert_conform(actual, expected, exact=backend[0] == "native")


def test_worlds_start_at_home_and_at_rest(make: Make, robot: Robot) -> None:
    state = snapshot(make(num_envs=2).state)
    np.testing.assert_array_equal(state["qpos"], home(robot, 2))
    assert not any(state[name].any() for name in FIELDS if name != "qpos")


def test_the_memory_from_before_a_step_makes_the_step_again(make: Make, robot: Robot) -> None:
    sim = make()
    targets, wrenches = (values.to(sim.device) for values in random_inputs(robot, NUM_ENVS, 4))
    for target, wrench in zip(targets, wrenches, strict=True):
        live = {name: value.clone() for name, value in sim.memory.items()}
        after = snapshot(sim.step(target, wrench))
        assert sim.memory_before.keys() == live.keys()
        assert all(torch.equal(sim.memory_before[name], value) for name, value in live.items())
    sim.load({name: value.clone() for name, value in sim.memory_before.items()})
    assert_conform(snapshot(sim.step(targets[-1], wrenches[-1])), after, exact=sim.device.type == "cpu")


def test_reset_changes_masked_worlds_only(make: Make, robot: Robot) -> None:
    sim = make()
    run(sim, *random_inputs(robot, NUM_ENVS, 3))
    before = snapshot(sim.state)
    qpos, qvel = home(robot, NUM_ENVS) + 0.01, torch.full_like(rest(robot, NUM_ENVS), 0.5)
    overwrite(sim, [2, 5], qpos, qvel)
    after = snapshot(sim.state)
    kept = [0, 1, 3, 4, 6, 7]
    for name in FIELDS:
        np.testing.assert_array_equal(after[name][kept], before[name][kept])
    np.testing.assert_array_equal(after["qpos"][[2, 5]], qpos[[2, 5]])
    np.testing.assert_array_equal(after["qvel"][[2, 5]], qvel[[2, 5]])
    for name in ("foot_force", "joint_force", "joint_power", "joint_net_power"):
        assert not after[name][[2, 5]].any()


def test_a_reset_world_steps_like_a_new_one(make: Make, backend: tuple[Backend, str], robot: Robot) -> None:
    history = random_inputs(robot, NUM_ENVS, 4)
    targets, wrenches = random_inputs(robot, NUM_ENVS, 5, seed=1)
    old, undisturbed, new = make(), make(), make()
    for sim in (old, undisturbed):
        run(sim, *history)
    # The state in which they already are: here a solver that starts from the last step's solution gets other last bits.
    qpos, qvel = old.state.qpos.cpu().clone(), old.state.qvel.cpu().clone()
    overwrite(old, [1, 6], qpos, qvel)
    overwrite(new, list(range(NUM_ENVS)), qpos, qvel)
    seen, others, fresh = (run(sim, targets, wrenches) for sim in (old, undisturbed, new))
    kept = [0, 2, 3, 4, 5, 7]
    # On a GPU the order in which contacts are found may differ from run to run, and with it the last bits.
    assert_conform({k: v[:, [1, 6]] for k, v in seen.items()}, {k: v[:, [1, 6]] for k, v in fresh.items()}, backend[1] == "cpu")
    assert_conform({k: v[:, kept] for k, v in seen.items()}, {k: v[:, kept] for k, v in others.items()}, backend[1] == "cpu")
    if isinstance(old, NativeSimulator) and isinstance(new, NativeSimulator):
        assert torch.equal(old.memory["qvel"][[1, 6]], new.memory["qvel"][[1, 6]])  # float64 shows what float32 rounds away


def test_a_fault_is_visible_stays_in_its_world_and_is_cured_by_reset(
    make: Make, backend: tuple[Backend, str], robot: Robot
) -> None:
    targets, wrenches = random_inputs(robot, NUM_ENVS, 6)
    faulty, healthy, new = make(), make(), make()
    qpos = home(robot, NUM_ENVS)
    broken = qpos.clone()
    broken[3, 9] = float("nan")
    overwrite(faulty, [3], broken, rest(robot, NUM_ENVS))
    exact = backend[1] == "cpu"

    seen, expected = run(faulty, targets[:3], wrenches[:3]), run(healthy, targets[:3], wrenches[:3])
    assert not np.isfinite(seen["qpos"][:, 3]).all(axis=1).any()
    others = [0, 1, 2, 4, 5, 6, 7]
    assert_conform({k: v[:, others] for k, v in seen.items()}, {k: v[:, others] for k, v in expected.items()}, exact)

    overwrite(faulty, [3], qpos, rest(robot, NUM_ENVS))
    cured, fresh = run(faulty, targets[3:], wrenches[3:]), run(new, targets[3:], wrenches[3:])
    assert np.isfinite(cured["qpos"]).all()
    assert_conform({k: v[:, [3]] for k, v in cured.items()}, {k: v[:, [3]] for k, v in fresh.items()}, exact)


def momentum(robot: Robot, state: SimState, world: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Linear momentum [N s] and angular momentum about the centre of mass [N m s] of one world."""
    data = mujoco.MjData(robot.model)
    data.qpos[:], data.qvel[:] = state.qpos[world].cpu(), state.qvel[world].cpu()
    mujoco.mj_forward(robot.model, data)
    mujoco.mj_subtreeVel(robot.model, data)
    mass = robot.model.body_subtreemass[robot.trunk_id]
    return mass * data.subtree_linvel[robot.trunk_id], data.subtree_angmom[robot.trunk_id].copy()


def test_the_wrench_is_a_momentum_rate_in_the_world_frame(make: Make, robot: Robot) -> None:
    sim = make(num_envs=3)
    qpos = home(robot, 3)
    qpos[:, 2] = 3.0
    qpos[:, 3:7] = torch.tensor([np.cos(0.5), 0.0, 0.0, np.sin(0.5)])  # facing 1 rad to the left: world and body frame differ
    overwrite(sim, [0, 1, 2], qpos, rest(robot, 3))
    wrench = torch.zeros(3, 6)
    wrench[0, 0], wrench[1, 1], wrench[2, 5] = 20.0, -30.0, 4.0  # N, N, N m
    sim.step(torch.as_tensor(robot.nominal).float().repeat(3, 1).to(sim.device), wrench.to(sim.device))
    duration = 0.005 * 4  # s
    np.testing.assert_allclose(momentum(robot, sim.state, 0)[0][:2], [20.0 * duration, 0.0], atol=20.0 * duration * 1e-3)
    np.testing.assert_allclose(momentum(robot, sim.state, 1)[0][:2], [0.0, -30.0 * duration], atol=30.0 * duration * 1e-3)
    np.testing.assert_allclose(momentum(robot, sim.state, 2)[1][2], 4.0 * duration, rtol=1e-3)
    np.testing.assert_allclose(momentum(robot, sim.state, 2)[0][2], -robot.weight * duration, rtol=1e-3)


def foot_displacement(robot: Robot, qpos: NDArray[np.floating]) -> NDArray[np.float64]:
    """Displacement of the right foot from its place in the home pose [m], (3,)."""
    data, places = mujoco.MjData(robot.model), []
    for pose in (robot.home_qpos, qpos):
        data.qpos[:] = pose
        mujoco.mj_kinematics(robot.model, data)
        places.append(data.site("right_foot").xpos.copy())
    return places[1] - places[0]


def test_friction_is_per_world_and_acts(make: Make, backend: tuple[Backend, str], robot: Robot) -> None:
    friction = (0.1, 1.0, 0.8)
    sim = make(num_envs=3, model_fields=("geom_friction",))
    field = sim.model_fields["geom_friction"]
    for world in field.cpu():
        torch.testing.assert_close(world, torch.as_tensor(sim.model.geom_friction).to(world), rtol=0.0, atol=0.0)
    field[:, sim.model.geom("floor").id, 0] = torch.tensor(friction, dtype=field.dtype, device=field.device)
    models = []
    for value in friction:
        model = copy.copy(robot.model)
        model.geom_friction[robot.floor_id, 0] = torch.tensor(value, dtype=field.dtype).item()
        models.append(model)

    qpos, qvel = home(robot, 3), rest(robot, 3)
    qvel[:, 1] = 1.0  # m/s to the left
    overwrite(sim, [0, 1, 2], qpos, qvel)
    targets = torch.as_tensor(robot.nominal).float().repeat(10, 3, 1)
    push = torch.zeros(10, 3, 6)
    push[:, :, 1] = 20.0  # N to the left
    actual = run(sim, targets, push)
    assert_conform(actual, mj_rollout(models, robot, qpos, qvel, targets, push), exact=backend[0] == "native")
    slippery, rough, _ = (foot_displacement(robot, row)[1] for row in actual["qpos"][-1])
    assert slippery > rough + 0.02  # m

    plain = make(num_envs=1)
    overwrite(plain, [0], qpos[:1], qvel[:1])
    assert_conform({k: v[:, [2]] for k, v in actual.items()}, run(plain, targets[:, :1], push[:, :1]), backend[0] == "native")


CHANGES: dict[str, tuple[list[float], list[float]]] = {
    "body_mass": ([1.0, 0.6, 1.5], [0.0] * 3),
    "body_inertia": ([1.0, 0.3, 3.0], [0.0] * 3),
    "body_ipos": ([1.0] * 3, [0.0, -0.03, 0.03]),  # m
    "dof_damping": ([1.0] * 3, [0.0, 2.0, 10.0]),  # N m s/rad, N s/m
    "dof_armature": ([1.0, 0.5, 4.0], [0.0] * 3),
    "actuator_gainprm": ([1.0, 0.8, 1.2], [0.0] * 3),
    "actuator_biasprm": ([1.0, 0.8, 1.2], [0.0] * 3),
    "geom_friction": ([1.0, 0.1, 0.5], [0.0] * 3),
    "actuator_forcerange": ([1.0, 0.1, 0.05], [0.0] * 3),
}
"""What a field is multiplied by, and what is added to it, in each of three worlds."""


def changed(values: NDArray[np.float64], field: str, world: int) -> NDArray[np.float64]:
    """Return a field's values as in a world of `CHANGES`; what is not the robot's own stays."""
    factor, term = CHANGES[field][0][world], CHANGES[field][1][world]
    result = factor * values + term
    if field == "dof_damping":
        result[:6] = values[:6]  # the trunk's freedom
    return result


def precise(values: NDArray[np.float64], backend: tuple[Backend, str]) -> NDArray[np.float64]:
    """Return values as the engine can hold them."""
    return values if backend[0] == "native" else values.astype(np.float32).astype(np.float64)


def vary(sim: Simulator, field: str) -> None:
    """Write to a field what `CHANGES` says, and let MuJoCo's constants follow."""
    live = sim.model_fields[field]
    nominal = np.array(getattr(sim.model, field), dtype=np.float64).reshape(live.shape[1:])
    for world in range(3):
        live[world] = torch.as_tensor(changed(nominal, field, world)).to(live)
    sim.refresh_constants(torch.ones(3, dtype=torch.bool, device=sim.device))


def edited(robot: Robot, field: str, backend: tuple[Backend, str]) -> list[mujoco.MjModel]:
    """Return models of the whole robot, edited in the same way."""
    models = [copy.copy(robot.model) for _ in range(3)]
    for world, model in enumerate(models):
        getattr(model, field)[:] = precise(changed(getattr(model, field).copy(), field, world), backend)
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return models


@pytest.mark.parametrize("field", CHANGES)
def test_a_changed_field_of_the_model_moves_its_world_as_mj_step(
    make: Make, backend: tuple[Backend, str], robot: Robot, field: str
) -> None:
    sim = make(num_envs=3, model_fields=(field,))
    vary(sim, field)
    qpos, qvel = home(robot, 3), rest(robot, 3)
    qvel[:, 1] = 0.5  # m/s to the left: the feet slide
    overwrite(sim, [0, 1, 2], qpos, qvel)
    targets, wrenches = (values[:, :1].repeat(1, 3, 1) for values in random_inputs(robot, 1, 10))
    expected = mj_rollout(edited(robot, field, backend), robot, qpos, qvel, targets, wrenches)
    assert_conform(run(sim, targets, wrenches), expected, exact=backend[0] == "native")
    end = expected["qvel"][-1]
    assert all(np.abs(end[a] - end[b]).max() > 1e-3 for a, b in ((0, 1), (0, 2), (1, 2)))


def test_what_mujoco_derives_follows_the_mass_of_each_world(make: Make, backend: tuple[Backend, str], robot: Robot) -> None:
    sim = make(num_envs=3, model_fields=("body_mass",))
    vary(sim, "body_mass")
    models = edited(robot, "body_mass", backend)
    for name in ("dof_invweight0", "body_invweight0", "body_subtreemass"):
        if isinstance(sim, NativeSimulator):
            actual = np.array([getattr(sim.batch.get_model(world), name) for world in range(3)])
        else:
            assert isinstance(sim, WarpSimulator)
            actual = getattr(sim.mjw_model, name).numpy()
        np.testing.assert_allclose(actual, [getattr(model, name) for model in models], rtol=1e-4, atol=1e-7, err_msg=name)


@pytest.fixture
def stateful(robot: Robot, tmp_path: Path) -> Robot:
    return load_robot(write_stateful(robot.path, tmp_path))


def test_memory_is_the_engine_s_whole_state(make: Make, backend: tuple[Backend, str], stateful: Robot) -> None:
    """Whatever MuJoCo calls state is reset to that of the keyframe, kept and gone on from."""
    robot = stateful
    size = mujoco.mj_stateSize(stateful.model, mujoco.mjtState.mjSTATE_INTEGRATION)
    sim, new = make(robot=robot), make(robot=robot)
    assert {"act", "history", "plastic", "eq_active", "mocap_pos", "mocap_quat", "userdata"} < sim.memory.keys()
    numbers = sum(value[0].numel() for name, value in sim.memory.items() if name != "cvel")
    assert numbers == size - robot.model.nu - 6 * robot.model.nbody  # of controls and external forces
    default = {name: value.clone() for name, value in sim.memory.items()}
    np.testing.assert_allclose(default["mocap_pos"][0].cpu().reshape(-1), [0.2, 0.0, 0.7], rtol=1e-6)
    np.testing.assert_allclose(default["act"][0].cpu(), [0.02, 0.04], rtol=1e-6)

    sim.memory["eq_active"].fill_(1)
    sim.memory["mocap_pos"] += 0.1
    sim.memory["userdata"] += 5.0
    targets, wrenches = random_inputs(robot, NUM_ENVS, 4)
    run(sim, targets, wrenches)
    assert all(
        (value != default[name]).any() for name, value in sim.memory.items() if name not in ("qfrc_applied", "mocap_quat")
    )
    overwrite(sim, [1, 6], home(robot, NUM_ENVS), rest(robot, NUM_ENVS))
    for name, value in sim.memory.items():
        assert torch.equal(value[[1, 6]], default[name][[1, 6]]), name
    assert sim.memory["eq_active"][[0, 2, 7]].all()

    kept = {name: value.clone() for name, value in sim.memory.items()}
    fresh = run(new, targets, wrenches)
    after = run(sim, targets, wrenches)
    exact = backend[1] == "cpu"
    assert_conform({k: v[:, [1, 6]] for k, v in after.items()}, {k: v[:, [1, 6]] for k, v in fresh.items()}, exact)
    assert np.abs(after["qpos"][-1, 0] - after["qpos"][-1, 1]).max() > 0.01  # the weld holds the other worlds
    new.load(kept)
    assert_conform(run(new, targets, wrenches), after, exact)


def test_activations_move_as_with_mj_step(make: Make, backend: tuple[Backend, str], stateful: Robot) -> None:
    targets, wrenches = random_inputs(stateful, NUM_ENVS, 10)
    models = [stateful.model] * NUM_ENVS
    expected = mj_rollout(models, stateful, home(stateful, NUM_ENVS), rest(stateful, NUM_ENVS), targets, wrenches)
    assert_conform(run(make(robot=stateful), targets, wrenches), expected, exact=backend[0] == "native")


def test_names_are_looked_up_in_the_engine_s_own_model(
    make: Make, backend: tuple[Backend, str], robot: Robot, tmp_path: Path
) -> None:
    """A sensor keeps a fixed body apart in the full model; without it, `fusestatic` makes the body a part of the world."""
    text = robot.path.read_text()
    for before, after in {
        'autolimits="true"': 'autolimits="true" fusestatic="true"',
        '<body name="trunk"': '<body name="post" pos="3 0 0"><geom size="0.1"/></body><body name="trunk"',
        "</sensor>": '<framepos name="post" objtype="xbody" objname="post"/></sensor>',
    }.items():
        assert before in text
        text = text.replace(before, after)
    (tmp_path / "fused.xml").write_text(text)
    robot = load_robot(tmp_path / "fused.xml")
    sim = make(robot=robot)
    assert (robot.trunk_id, sim.model.body("trunk").id) == (2, 1)
    targets, wrenches = random_inputs(robot, NUM_ENVS, 5)
    models = [robot.model] * NUM_ENVS
    expected = mj_rollout(models, robot, home(robot, NUM_ENVS), rest(robot, NUM_ENVS), targets, wrenches)
    assert_conform(run(sim, targets, wrenches), expected, exact=backend[0] == "native")


def test_an_unknown_field_or_sensor_is_one_line(make: Make) -> None:
    with pytest.raises(UserError, match=r"^no field 'body_mas' in MuJoCo's model; did you mean 'body_mass'\?$"):
        make(model_fields=("body_mas",))
    with pytest.raises(UserError, match=r"telebip\.xml: no sensor named 'gyr'; did you mean 'gyro'\?$"):
        make(sensors=("gyr",))


def test_the_parts_of_the_state_are_mujoco_s(robot: Robot) -> None:
    assert state_fields(robot.model) == ("time", "qpos", "qvel", "qacc_warmstart", "qfrc_applied")


def test_every_part_of_mujoco_s_state_is_a_field_of_its_data(monkeypatch: pytest.MonkeyPatch, robot: Robot) -> None:
    """As if the robot had all of them; the names are MuJoCo's own, which may get more."""
    monkeypatch.setattr("mujoco.mj_stateSize", lambda *_: 1)
    fields = state_fields(robot.model)
    assert {"act", "history", "plastic", "plugin_state", "userdata", "eq_active", "mocap_pos", "mocap_quat"} < set(fields)
    assert all(hasattr(mujoco.MjData(robot.model), name) for name in fields)
