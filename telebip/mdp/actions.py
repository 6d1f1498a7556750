"""From actions to joint targets."""

from collections.abc import Mapping

import torch
from torch import Tensor

from telebip.errors import UserError, nearest
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
    """Joint targets that reach the actuators late, by a whole number of physics steps, drawn per world and episode.

        d = n delay + physics_delay,    target of physics step i of policy step t: q_target of step t - ceil((d - i) / n)

    with n physics steps per policy step; before the first action the nominal pose is held.
    """

    def __init__(self, delay: tuple[int, int], physics_delay: tuple[int, int], binder: Binder) -> None:
        """Keep room for the longest delay; `delay` [policy steps] and `physics_delay` [physics steps] are (least, most)."""
        world = binder.step.world
        self._decimation, self._in_physics_steps = world.decimation, physics_delay[1] > 0
        self._length = -(-(world.decimation * delay[1] + physics_delay[1]) // world.decimation)  # policy steps at most
        ranges = [(float(low), float(high + 1)) for low, high in (delay, physics_delay)]  # of numbers whose floor counts
        self._random = binder.random("actions", {"delay": ranges})
        earlier = {"targets": world.zeros(self._length, world.num_joints), "delay": world.zeros()}
        self._memory = binder.memory("actions", earlier)  # targets relative to the nominal pose, the newest first

    def __call__(self, step: Step) -> Tensor:
        """Take the step's `joint_target`, and return the targets that reach the actuators in it, see `Simulator.step`."""
        memory, world, n = self._memory, step.world, self._decimation
        steps, physics_steps = self._random["delay"].floor().unbind(1)
        torch.where(step.is_new, n * steps + physics_steps, memory["delay"], out=memory["delay"])
        known = torch.cat([(step.env.joint_target - world.nominal)[:, None], memory["targets"]], dim=1)
        substep = torch.arange(n if self._in_physics_steps else 1, device=known.device)
        late = ((memory["delay"][:, None] - substep) / n).ceil().clamp(min=0.0).long()
        targets = world.nominal + known.gather(1, late[:, :, None].expand(-1, -1, world.num_joints))
        memory["targets"].copy_(known[:, :-1])
        return targets if self._in_physics_steps else targets[:, 0]
