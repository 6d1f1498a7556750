"""From actions to joint targets."""

from collections.abc import Mapping

import torch
from torch import Tensor

from telebip.errors import UserError, nearest
from telebip.math import columns
from telebip.mdp.binding import Binder
from telebip.mdp.step import Step


def scales(scale: Mapping[str, float], joint_names: tuple[str, ...]) -> list[float]:
    """Return the displacement of each joint's target per unit of action [rad | m].

    Args:
        scale: by the joint's name or, for the joints of both sides, its name without the side (`right_`, `_left`, ...).
        joint_names: the joints.

    Raises:
        UserError: a joint has no scale, or a scale no joint.
    """
    found = {name: next((key for key in (name, _without_side(name)) if key in scale), None) for name in joint_names}
    for name, key in found.items():
        if key is None:
            raise UserError(f"actions.scale: joint '{name}' has none; {nearest(_without_side(name), scale)}")
    for key in scale.keys() - {*found.values()}:
        raise UserError(f"actions.scale.{key}: the robot has no such joint; {nearest(key, map(_without_side, joint_names))}")
    return [scale[key] for key in found.values() if key is not None]


def _without_side(name: str) -> str:
    return name.removeprefix("right_").removeprefix("left_").removesuffix("_right").removesuffix("_left")


def joint_targets(action: Tensor, nominal: Tensor, scale: Tensor) -> Tensor:
    r"""Setpoints of the position actuators.

        q_target = q_nominal + action_scale * action

    The engine evaluates tau = kp (q_target - q) - kv qd at every physics step and clips it to the actuator's force limit.

    Args:
        action: the policy's output [-], (num_envs, num_joints).
        nominal: joint positions of the home pose [rad | m], (num_joints,).
        scale: displacement per unit of action [rad | m], (num_joints,).

    Returns:
        Joint targets [rad | m], (num_envs, num_joints).
    """
    return nominal + scale * action


class DelayLine:
    """Joint targets that reach the actuators late, now and then not at all.

    The target of policy step t arrives d physics steps after it was wanted, and the newest that has arrived is held:

        d = n delay + physics_delay + jitter

    with n physics steps per policy step. `delay` and `physics_delay` are drawn per world and episode, `jitter` anew in every
    policy step; a share `loss` of the targets never arrives. Before the first one the nominal pose is held.
    """

    def __init__(
        self,
        binder: Binder,
        delay: tuple[int, int] = (0, 0),
        physics_delay: tuple[int, int] = (0, 0),
        jitter: tuple[int, int] = (0, 0),
        loss: float = 0.0,
    ) -> None:
        """Keep room for the longest delay.

        Args:
            binder: of the worlds.
            delay: least and most [policy steps].
            physics_delay: on top of that [physics steps].
            jitter: on top of that [physics steps].
            loss: share of the targets that never arrive [-].
        """
        world = binder.step.world
        self._decimation, self._has_jitter, self._loss = world.decimation, jitter[1] > 0, loss
        self._in_physics_steps = physics_delay[1] > 0 or jitter[1] > 0
        longest = world.decimation * delay[1] + physics_delay[1] + jitter[1]
        length = max(1, -(-longest // world.decimation))  # policy steps
        ranges = {"delay": [delay, physics_delay], "jitter": [jitter] if self._has_jitter else []}
        floors = {name: [(float(low), float(high + 1)) for low, high in each] for name, each in ranges.items()}
        self._random = binder.random("actions", {**floors, "loss": [(0.0, 1.0)] if loss else []})
        self._memory = binder.memory(
            "actions",
            {
                "targets": world.zeros(length, world.num_joints),  # relative to the nominal pose, the newest first
                "due": world.zeros(length),  # physics steps from now on in which each arrives; negative: it has
                "delay": world.zeros(),
            },
        )

    def __call__(self, step: Step) -> Tensor:
        """Take the step's `joint_target`, and return the targets that reach the actuators in it, see `Simulator.step`."""
        memory, world, n = self._memory, step.world, self._decimation
        steps, physics_steps = self._random["delay"].floor().unbind(1)
        torch.where(step.is_new, n * steps + physics_steps, memory["delay"], out=memory["delay"])
        due = memory["delay"] + self._random["jitter"][:, 0].floor() if self._has_jitter else memory["delay"]
        wanted, before = step.env.joint_target - world.nominal, memory["due"] - n
        if self._loss:  # what is lost is the target before once more, which arrives when that does
            is_lost = self._random["loss"][:, 0] < self._loss
            wanted = torch.where(is_lost[:, None], memory["targets"][:, 0], wanted)
            due = torch.where(is_lost, before[:, 0], due)
        targets, due = torch.cat([wanted[:, None], memory["targets"]], dim=1), columns(due, before)
        substep = torch.arange(n if self._in_physics_steps else 1, device=due.device)
        newest = (due[:, None] <= substep[:, None]).int().argmax(2)  # the first that has arrived, (num_envs, physics steps)
        held = world.nominal + targets.gather(1, newest[:, :, None].expand(-1, -1, world.num_joints))
        memory["targets"].copy_(targets[:, :-1])
        memory["due"].copy_(due[:, :-1])
        return held if self._in_physics_steps else held[:, 0]
