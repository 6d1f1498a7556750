"""Fields of MuJoCo's model that differ from world to world: which rows, their nominal values, and how they are written."""

import functools
from typing import Any

import torch
from torch import Tensor

from telebip.errors import UserError
from telebip.math import over
from telebip.mdp.step import World
from telebip.robot import part

KINDS = {"body": "body", "geom": "geom", "jnt": "joint", "dof": "joint", "actuator": "actuator", "site": "site"}
"""What the first part of a field's name says that its rows are."""

Index = slice | Tensor | tuple[slice | Tensor, int]
"""Rows of a field, and a column of them."""


def rows_of(world: World, field: str, names: list[str] | None) -> slice | Tensor:
    """Return the rows of a field that belong to parts of these names; all rows if `names` is None.

    Raises:
        UserError: the engine's model has no such part.
    """
    if names is None:
        return slice(None)
    kind = KINDS.get(field.partition("_")[0])
    if kind is None:
        raise UserError(f"rows of field '{field}' have no names; leave out `names`")
    found = []
    for name in names:
        named = part(world.sim.model, kind, name, world.robot.path, " moves or collides")
        found.append(int(named.dofadr[0]) if field.startswith("dof_") else named.id)
    return _on(world.device, tuple(found))


@functools.cache
def _on(device: torch.device, rows: tuple[int, ...]) -> Tensor:
    """Return the numbers of rows on a device, made once: a recorded CUDA graph cannot bring them there."""
    return torch.tensor(rows, device=device)


def nominal(world: World, field: str, index: Index) -> Tensor:
    """Return the MJCF's values of a field, without a dimension for the worlds."""
    return world.nominal_fields[field][index]


def write(world: World, field: str, index: Index, value: Tensor, mask: Tensor) -> None:
    """Write `value` (num_envs, ...) to a field's rows, in the worlds where `mask` holds."""
    live: Any = world.sim.model_fields[field]
    at = (slice(None), *index) if isinstance(index, tuple) else (slice(None), index)
    kept = live[at]
    live[at] = torch.where(over(mask, kept), value.to(kept.dtype), kept)
