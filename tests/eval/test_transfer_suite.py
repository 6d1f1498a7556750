"""The transfer suite: which factors there are, how wide they are drawn, and what is measured of the worlds."""

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from telebip.config import TaskConfig, check, load_task
from telebip.control.factory import with_estimate
from telebip.control.policy import Policy, Stateless
from telebip.env import TelebipEnv
from telebip.eval.conditions import as_evaluated
from telebip.eval.transfer import (
    QUANTILES,
    Factor,
    TransferProtocol,
    alone,
    factors_of,
    in_worlds,
    transfer_results,
    undisturbed,
    walk_worlds,
    widened,
)
from telebip.robot import Robot

REAL = load_task("telebip_real")


@pytest.fixture
def factors(robot: Robot) -> list[Factor]:
    return factors_of(REAL, robot)


def test_every_event_that_disturbs_has_a_factor_and_ranges_come_from_the_task(factors: list[Factor]) -> None:
    by_name = {factor.name: factor for factor in factors}
    assert len(by_name) == len(factors)
    disturbing = REAL.events.keys() - {"start_pose", "start_velocity"}
    assert {factor.entry for factor in factors} == disturbing | {"actions", "observations"}
    mass = by_name["mass.scale"]
    assert (mass.nominal, mass.low, mass.high) == (1.0, *REAL.events["mass"]["scale"])
    assert mass.values(7)[0] == mass.low and mass.values(7)[-1] == mass.high and len(mass.values(7)) == 7
    com = by_name["com.offset"]
    assert (com.nominal, com.low, com.high, com.is_amplitude) == (0.0, 0.0, 0.03, True)
    assert by_name["friction.range"].nominal == 0.8  # the MJCF's floor
    assert by_name["hip_damping.range"].nominal == 0.0  # added
    assert by_name["armature.range"].nominal == 1.0  # scaled
    assert by_name["actions.delay"].values(7) == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0]  # physics steps: to 40 ms


def test_one_factor_alone_leaves_the_others_nominal(factors: list[Factor]) -> None:
    by_name = {factor.name: factor for factor in factors}
    task = alone(REAL, by_name["mass.inertia"], 0.9, factors)
    assert task.events == {"mass": {**REAL.events["mass"], "scale": (1.0, 1.0), "inertia": (0.9, 0.9)}}
    task = alone(REAL, by_name["kick.ang_vel"], 0.3, factors)
    assert (task.events["kick"]["lin_vel"], task.events["kick"]["ang_vel"]) == (0.0, 0.3)
    task = alone(REAL, by_name["actions.delay"], 8.0, factors)
    assert task.actions == replace(undisturbed(REAL).actions, physics_delay=(8, 8)) and not task.events
    assert alone(REAL, by_name["actions.jitter"], 2.0, factors).actions.jitter == (0, 2)
    task = alone(REAL, by_name["observations.noise"], 0.5, factors)
    assert task.observations["policy"].terms["joint_vel"]["noise"] == 0.1
    assert task.observations["policy"].loss == 0.0
    assert alone(REAL, by_name["observations.loss"], 0.01, factors).observations["policy"].loss == 0.01
    for factor in factors:
        for value in factor.values(3):
            check(alone(REAL, factor, value, factors))


def test_ranges_are_widened_about_the_nominal_values(factors: list[Factor]) -> None:
    task = check(widened(REAL, 1.5, factors))
    events = task.events
    assert events["mass"]["scale"] == pytest.approx((1 - 0.225, 1 + 0.225))
    assert events["force_limit"]["range"] == pytest.approx((0.7, 1.15))
    assert events["friction"]["range"] == pytest.approx((0.2, 1.4))
    assert events["hip_damping"]["range"] == pytest.approx((0.0, 0.75))
    assert events["com"]["offset"] == pytest.approx(0.045)
    assert events["push"]["force"] == pytest.approx(90.0)
    assert events["push"]["interval"] == REAL.events["push"]["interval"]
    assert events["attitude_error"] == {"tilt": pytest.approx(0.03), "time": 1.0}
    assert (task.actions.physics_delay, task.actions.jitter) == ((0, 9), (0, 3))
    same = widened(REAL, 1.0, factors)
    assert same.actions == REAL.actions
    for entry, params in same.events.items():
        assert params == {key: pytest.approx(value) for key, value in REAL.events[entry].items()}


def test_worlds_have_the_other_task_s_disturbances_and_the_policy_its_own_observations(robot: Robot) -> None:
    own = as_evaluated(load_task("telebip_efficient"), 4, 1.0)
    task = in_worlds(own, REAL)
    assert set(task.events) == set(REAL.events)
    assert task.events["start_pose"]["heading"] == 0.0  # as they are evaluated
    policy = task.observations["policy"]
    assert list(policy.terms) == list(own.observations["policy"].terms)
    assert policy.noise and policy.loss == 0.02 and policy.history == 1
    assert policy.terms["joint_vel"]["noise"] == 0.2  # the other's
    assert policy.terms["base_lin_vel"]["noise"] == 0.05  # its own
    assert task.rewards == own.rewards
    quiet = in_worlds(own, undisturbed(REAL))
    assert not any(params["noise"] for params in quiet.observations["policy"].terms.values())
    estimate = with_estimate(task).observations["estimate"]
    assert estimate.noise and estimate.loss == 0.02 and estimate.terms["joint_vel"]["noise"] == 0.2


def gliding(env: TelebipEnv, speeds: Tensor) -> Policy:
    """Robots that are moved along x with these speeds [m/s], the last one of which falls."""

    def act(obs: TensorDict) -> Tensor:
        qpos, qvel = env.sim.state.qpos.clone(), torch.zeros_like(env.sim.state.qvel)
        qpos[:, 3:7] = torch.tensor([1.0, 0.0, 0.0, 0.0])
        qpos[:, 2] = 0.8
        qpos[-1, 2] = 0.3 if env.state.num_steps > 20 else 0.8
        qvel[:, 0] = speeds
        env.sim.reset(torch.ones(env.num_envs, dtype=torch.bool), qpos, qvel)
        return torch.full((env.num_envs, 6), 0.2 if env.state.num_steps % 2 else -0.2)  # so that the joints move

    return Stateless(act)


def test_what_is_measured_of_worlds_that_glide(robot: Robot) -> None:
    env = TelebipEnv(as_evaluated(load_task("telebip_flat"), 5, 2.0), robot, "cpu", "native")
    speeds = torch.tensor([0.40, 0.45, 0.55, 0.60, 0.50])
    protocol = TransferProtocol(command=0.5, duration=1.0, skip=0.2)
    row = walk_worlds(env, gliding(env, speeds), protocol)
    assert (row["worlds"], row["falls"], row["success"]) == (5, 1, 0.8)
    # A robot that hangs in the air keeps its momentum: it glides as fast as it was told, but for what its legs take.
    assert row["speed_mps"] == pytest.approx(0.5, abs=0.02)
    assert row["speed_error"] == pytest.approx(0.15, abs=0.03)  # of 0.2, 0.1, 0.1, 0.2
    assert list(row["speed_error_quantiles"]) == [f"{q:g}" for q in QUANTILES]
    assert row["speed_error_quantiles"]["0.95"] == pytest.approx(0.2, abs=0.03)
    assert row["cot"] > 0.0


def test_the_results_of_a_policy_that_stands_still(robot: Robot, factors: list[Factor]) -> None:
    made: list[TaskConfig] = []

    def make(task: TaskConfig) -> tuple[TelebipEnv, Policy]:
        made.append(task)
        env = TelebipEnv(task, robot, "cpu", "native")
        return env, Stateless(lambda obs: torch.zeros(env.num_envs, 6))

    ranges = replace(
        undisturbed(REAL),
        events={"mass": REAL.events["mass"]},
        actions=replace(undisturbed(REAL).actions, loss=0.1),
    )
    protocol = TransferProtocol(worlds=3, sweep_worlds=2, points=3, duration=0.2, skip=0.1)
    config = as_evaluated(load_task("telebip_flat"), 1, 1.0)
    results = transfer_results(make, config, ranges, robot, protocol)
    assert [row["width"] for row in results["worlds"]] == [1.0, 1.5]
    assert [row["worlds"] for row in results["worlds"]] == [3, 3]
    factor = {factor["name"]: factor for factor in results["factors"]}
    assert list(factor) == ["mass.scale", "mass.inertia", "actions.loss", "observations.noise"]
    assert [row["value"] for row in factor["mass.scale"]["points"]] == [0.85, 1.0, 1.15]
    assert all(row["worlds"] == 2 for row in factor["mass.scale"]["points"])
    # Two widths, the nominal worlds once, two more masses, two inertias, two losses, two of noise.
    assert [task.num_envs for task in made] == [3, 3] + [2] * 9
    assert made[3].events["mass"]["scale"] == (0.85, 0.85)
