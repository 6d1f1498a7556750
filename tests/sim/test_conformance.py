# pyright: reportAttributeAccessIssue=false
"""Every physics backend gives the numbers of C MuJoCo's `mj_step`: `native` bit for bit, `warp` within float32's reach."""

import copy
from collections.abc import Callable, Mapping

import mujoco
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from telebip.errors import UserError
from telebip.robot import Robot
from telebip.sim import Backend, SimState, Simulator, make_simulator
from telebip.sim.native import NativeSimulator

Arrays = Mapping[str, NDArray[np.floating]]
Make = Callable[..., Simulator]

NUM_ENVS, DECIMATION, STEPS = 8, 4, 25
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


@pytest.fixture(scope="module", params=BACKENDS, ids=lambda param: "-".join(param))
def backend(request: pytest.FixtureRequest) -> tuple[Backend, str]:
    return request.param


@pytest.fixture(scope="module")
def make(backend: tuple[Backend, str], robot: Robot) -> Make:
    """Return a function that makes a simulator of the backend under test, in the home pose."""

    def make_one(num_envs: int = NUM_ENVS, model_fields: tuple[str, ...] = ()) -> Simulator:
        name, device = backend
        return make_simulator(name, robot, num_envs, DECIMATION, torch.device(device), model_fields)

    return make_one


def random_inputs(robot: Robot, num_envs: int, steps: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Joint targets about the nominal pose and trunk wrenches up to 30 N and 5 N m, each (steps, num_envs, 6)."""
    generator = torch.Generator().manual_seed(seed)
    draws = 2.0 * torch.rand(2, steps, num_envs, 6, generator=generator) - 1.0
    targets = torch.as_tensor(robot.nominal).float() + torch.tensor([0.1, 0.2, 0.04] * 2) * draws[0]
    return targets, torch.tensor([30.0, 30.0, 30.0, 5.0, 5.0, 5.0]) * draws[1]


def home(robot: Robot, num_envs: int) -> Tensor:
    return torch.as_tensor(robot.home_qpos).float().repeat(num_envs, 1)


def mj_rollout(
    models: list[mujoco.MjModel], robot: Robot, qpos: Tensor, qvel: Tensor, targets: Tensor, wrenches: Tensor
) -> Arrays:
    """Step every world with C MuJoCo from `qpos`, `qvel`; FIELDS after each policy step, (steps, num_envs, ...)."""
    out: dict[str, list[list[NDArray[np.float64]]]] = {name: [] for name in FIELDS}
    worlds = [mujoco.MjData(model) for model in models]
    for data, position, velocity in zip(worlds, qpos, qvel, strict=True):
        data.qpos[:], data.qvel[:] = position, velocity
    for target, wrench in zip(targets, wrenches, strict=True):
        rows: dict[str, list[NDArray[np.float64]]] = {name: [] for name in FIELDS}
        for i, (model, data) in enumerate(zip(models, worlds, strict=True)):
            data.ctrl[:], data.xfrc_applied[robot.trunk_id] = target[i], wrench[i]
            feet, forces, powers = [], [], []
            for _ in range(DECIMATION):
                mujoco.mj_step(model, data)
                feet.append(data.sensordata[list(robot.foot_sensor_adr)])
                forces.append(data.actuator_force.copy())
                powers.append(data.actuator_force * data.actuator_velocity)
            values = (data.qpos.copy(), data.qvel.copy(), *(np.mean(v, axis=0) for v in (feet, forces, np.abs(powers), powers)))
            for name, value in zip(FIELDS, values, strict=True):
                rows[name].append(value)
        for name in FIELDS:
            out[name].append(rows[name])
    return {name: np.array(values) for name, values in out.items()}


def run(sim: Simulator, targets: Tensor, wrenches: Tensor) -> Arrays:
    """Step a simulator and collect FIELDS after each policy step, (steps, num_envs, ...)."""
    rows = [snapshot(sim.step(t.to(sim.device), w.to(sim.device))) for t, w in zip(targets, wrenches, strict=True)]
    return {name: np.stack([row[name] for row in rows]) for name in FIELDS}


def snapshot(state: SimState) -> Arrays:
    return {name: getattr(state, name).cpu().numpy().copy() for name in FIELDS}


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
            np.testing.assert_allclose(actual[name], reference, rtol=0.0, atol=TOLERANCE[name], err_msg=name)


def test_every_step_equals_mj_step(make: Make, backend: tuple[Backend, str], robot: Robot) -> None:
    targets, wrenches = random_inputs(robot, NUM_ENVS, STEPS)
    expected = mj_rollout([robot.model] * NUM_ENVS, robot, home(robot, NUM_ENVS), torch.zeros(NUM_ENVS, 12), targets, wrenches)
    assert np.ptp(expected["qpos"][-1], axis=0).max() > 0.05  # the worlds differ
    assert expected["foot_force"].max() > 100.0  # and touch the ground
    assert_conform(run(make(), targets, wrenches), expected, exact=backend[0] == "native")


@pytest.mark.parametrize("num_threads", [1, 2])
def test_native_is_bit_identical_inside_for_any_number_of_threads(robot: Robot, num_threads: int) -> None:
    targets, wrenches = random_inputs(robot, NUM_ENVS, STEPS)
    expected = mj_rollout([robot.model] * NUM_ENVS, robot, home(robot, NUM_ENVS), torch.zeros(NUM_ENVS, 12), targets, wrenches)
    sim = NativeSimulator(robot, NUM_ENVS, DECIMATION, num_threads=num_threads)
    assert_conform(run(sim, targets, wrenches), expected, exact=True)
    np.testing.assert_array_equal(sim._qpos.numpy(), expected["qpos"][-1])
    np.testing.assert_array_equal(sim._qvel.numpy(), expected["qvel"][-1])


def test_a_single_world_works(make: Make, backend: tuple[Backend, str], robot: Robot) -> None:
    targets, wrenches = random_inputs(robot, 1, 3)
    expected = mj_rollout([robot.model], robot, home(robot, 1), torch.zeros(1, 12), targets, wrenches)
    actual = run(make(num_envs=1), targets, wrenches)
    assert actual["qpos"].shape == (3, 1, 13)
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
    qpos, qvel = home(robot, NUM_ENVS) + 0.01, torch.full((NUM_ENVS, 12), 0.5)
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
        assert torch.equal(old._qvel[[1, 6]], new._qvel[[1, 6]])  # float64 shows what float32 rounds away


def test_a_fault_is_visible_stays_in_its_world_and_is_cured_by_reset(
    make: Make, backend: tuple[Backend, str], robot: Robot
) -> None:
    targets, wrenches = random_inputs(robot, NUM_ENVS, 6)
    faulty, healthy, new = make(), make(), make()
    qpos = home(robot, NUM_ENVS)
    broken = qpos.clone()
    broken[3, 9] = float("nan")
    overwrite(faulty, [3], broken, torch.zeros(NUM_ENVS, 12))
    exact = backend[1] == "cpu"

    seen, expected = run(faulty, targets[:3], wrenches[:3]), run(healthy, targets[:3], wrenches[:3])
    assert not np.isfinite(seen["qpos"][:, 3]).all(axis=1).any()
    others = [0, 1, 2, 4, 5, 6, 7]
    assert_conform({k: v[:, others] for k, v in seen.items()}, {k: v[:, others] for k, v in expected.items()}, exact)

    overwrite(faulty, [3], qpos, torch.zeros(NUM_ENVS, 12))
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
    overwrite(sim, [0, 1, 2], qpos, torch.zeros(3, 12))
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
        torch.testing.assert_close(world, torch.as_tensor(robot.engine_model.geom_friction).to(world), rtol=0.0, atol=0.0)
    field[:, robot.engine_floor_id, 0] = torch.tensor(friction, dtype=field.dtype, device=field.device)
    models = []
    for value in friction:
        model = copy.copy(robot.model)
        model.geom_friction[robot.floor_id, 0] = torch.tensor(value, dtype=field.dtype).item()
        models.append(model)

    qpos, qvel = home(robot, 3), torch.zeros(3, 12)
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


def test_native_refuses_a_gpu_in_one_line(robot: Robot) -> None:
    with pytest.raises(UserError, match=r"^backend 'native' runs on the CPU, not on 'cuda:0'; .*--backend warp.*$"):
        make_simulator("native", robot, 4, DECIMATION, torch.device("cuda:0"))
