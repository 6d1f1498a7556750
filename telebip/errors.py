"""The one exception that a user is meant to see."""

import difflib
from collections.abc import Iterable


class UserError(Exception):
    """Something the user can mend: its message is one line that names the thing, the place and what would be valid.

    Every script prints it as `error: <message>` and exits with status 2; anything else that escapes is a bug of ours.
    """

    def __init__(self, message: str) -> None:
        """Keep to one printable line whatever the message quotes."""
        super().__init__(" ".join(message.split()).encode("utf-8", "backslashreplace").decode())


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an exception says so: Python's, torch's, Warp's or that of C++."""
    said = ("bad_alloc", "can't allocate memory", "Failed to allocate", "out of memory")
    return isinstance(error, MemoryError) or (
        isinstance(error, RuntimeError | ValueError) and any(text in str(error) for text in said)
    )


def nearest(name: str, valid: Iterable[str]) -> str:
    """Return the end of an error line: the closest valid name, or all of them: `nearest("slwo", ["slow", "fast"])`."""
    valid = sorted(valid)
    close = difflib.get_close_matches(name, valid, n=1, cutoff=0.5)
    return f"did you mean '{close[0]}'?" if close else f"valid: {', '.join(valid)}"
