"""How far a training has come, as a share from 0 to 1: what is switched on, or off, little by little."""


def ramp(samples: float, between: tuple[float, float]) -> float:
    """Return the share, linear in `samples`: 0 up to `between[0]` and 1 from `between[1]` on.

    Both in environment steps of all worlds together, the unit that does not depend on how many worlds there are.
    """
    start, end = between
    if samples >= end:
        return 1.0
    return 0.0 if samples <= start else (samples - start) / (end - start)
