"""One step as terms see it, of worlds whose state a test writes itself."""

from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from telebip.mdp.binding import Binder, Bound
from telebip.mdp.ground import Ground
from telebip.mdp.step import EnvState, Step, World
from telebip.mdp.term import Kind
from telebip.robot import Robot
from telebip.sim.base import SimState

CPU = torch.device("cpu")
SCALE = torch.tensor([0.25, 0.5, 0.1] * 2)


def standing(robot: Robot, num_envs: int) -> SimState:
    """Robots at rest in the home pose."""
    state = SimState.zeros(robot, num_envs, CPU)
    state.qpos[:] = torch.as_tensor(robot.home_qpos)
    return state


def make_world(robot: Robot, num_envs: int = 1, gait_period: float = 0.5, fields: tuple[str, ...] = ()) -> World:
    """Worlds with a state that nobody steps, and with these fields of the model of their own."""
    state = standing(robot, num_envs)
    nominal_fields = {name: torch.tensor(getattr(robot.model, name)) for name in fields}
    sim: Any = SimpleNamespace(
        state=state,
        model=robot.model,
        memory={"qvel": state.qvel.double()},
        model_fields={name: value.repeat(num_envs, *[1] * value.dim()) for name, value in nominal_fields.items()},
    )
    return World(
        robot=robot,
        sim=sim,
        num_envs=num_envs,
        device=CPU,
        step_dt=0.02,
        decimation=4,
        episode_length=10.0,
        gait_period=gait_period,
        home_qpos=torch.as_tensor(robot.home_qpos).float(),
        nominal=torch.as_tensor(robot.nominal).float(),
        force_range=torch.as_tensor(robot.force_range).float(),
        action_scale=SCALE,
        foot_lift=torch.as_tensor(robot.foot_lift).float(),
        ground=Ground(robot.terrain, CPU) if robot.terrain else None,
        nominal_fields=nominal_fields,
    )


def make_step(robot: Robot, num_envs: int = 1, **about: Any) -> Step:
    """The first step of worlds in the home pose; `about` are parameters of `make_world`."""
    world = make_world(robot, num_envs, **about)
    return Step(world, EnvState.zeros(world), torch.zeros(num_envs, world.num_joints))


def again(step: Step, age: int | Tensor | None = None) -> Step:
    """The same worlds, looked at anew; `age` steps after they began, where it is given."""
    if age is not None:
        step.env.episode_length[:] = age
        step.env.has_begun[:] = step.env.episode_length > 0
    return Step(step.world, step.env, step.action)


def everywhere(step: Step) -> Tensor:
    return torch.ones(step.world.num_envs, dtype=torch.bool)


def bind(step: Step, kind: Kind, name: str, seed: int = 0, **params: Any) -> Bound:
    """A term with its memory, and with random numbers that are drawn once."""
    binder = Binder(step)
    bound = binder.bind(kind, f"{kind}s", name, params)
    binder.allocate().draw(torch.Generator().manual_seed(seed))
    return bound


def fills(values: Tensor, low: float, high: float) -> None:
    """Assert that each column stays within [low, high] and comes within 1 % of both ends."""
    margin = 0.01 * (high - low)
    assert (values >= low - 1e-6).all()
    assert (values <= high + 1e-6).all()
    assert (values.amin(0) < low + margin).all()
    assert (values.amax(0) > high - margin).all()
