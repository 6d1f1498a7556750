"""Who is seen: robots side by side, from any number of rollouts; and how long and in which colour arrows are drawn."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from telebip.rollout import Rollout

LANE = 0.9  # m between robots side by side

Color = tuple[int, int, int]
FORCE_SCALE, PUSH_SCALE, SPEED_SCALE = 0.001, 0.006, 0.5  # m of arrow per N, per N, and per m/s
GROUND_FORCE, PUSH, COMMAND, ACTUAL = (60, 230, 130), (230, 40, 40), (110, 110, 120), (250, 190, 50)


@dataclass(frozen=True)
class Actor:
    """One world of a rollout, on a lane of its own."""

    label: str
    rollout: Rollout
    world: int
    lane: float = 0.0  # how far it is moved along y [m]


def line_up(rollouts: Sequence[tuple[str, Rollout]], worlds: int = 1, lane: float = LANE) -> list[Actor]:
    """Place the first `worlds` worlds (at most) of every labelled rollout side by side, from left to right, centred.

    They are `lane` [m] apart; on a terrain, where each walks on its own tile, none.
    """
    actors = []
    for label, rollout in rollouts:
        count = min(worlds, rollout.qpos.shape[1])
        actors += [Actor(label if count == 1 else f"{label} {world + 1}", rollout, world) for world in range(count)]
    return [replace(actor, lane=lane * (0.5 * (len(actors) - 1) - i)) for i, actor in enumerate(actors)]
