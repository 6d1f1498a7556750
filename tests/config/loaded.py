"""What the tests of configurations share."""

import pytest

from telebip.config import TaskConfig, load_task
from telebip.errors import UserError

FLAT = load_task("telebip_flat")
EXACT = {"noise": 0.0, "delay": (0, 0)}
"""What an observation is if nothing is said of it."""


def error_of(task: str | TaskConfig, *overrides: str) -> str:
    with pytest.raises(UserError) as caught:
        load_task(task, overrides)
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    return message
