"""What grows, or falls, little by little in the course of a training."""

from typing import Annotated

import torch
from torch import Tensor

from telebip.mdp.term import Quantity

Ramp = Annotated[tuple[float, float], Quantity("samples", ge=0)]
"""A term's parameter: between which samples it grows from nothing to all of it."""


def progress(samples: Tensor, between: tuple[float, float]) -> Tensor | float:
    """Return how far a ramp has come, linear in `samples` (): 0 up to `between[0]` and 1 from `between[1]` on, ().

    Both in environment steps of all worlds together, the unit that does not depend on how many worlds there are.
    """
    start, end = between
    if end <= 0.0:
        return 1.0
    return torch.where(samples >= end, 1.0, (samples - start).clamp(min=0.0) / max(end - start, 1.0))
