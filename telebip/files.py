"""Files that are complete or not there at all, and questions about files that always have an answer."""

import os
from pathlib import Path


def write_atomically(path: Path, content: bytes) -> None:
    """Replace `path` by `content`: whenever the process or the machine stops, the old file is there whole, or the new one.

    Raises:
        OSError: it cannot be written, for want of space or of permission; the old file stays.
    """
    partial = path.with_name(f".{path.name}.partial")
    try:
        with partial.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    except OSError:
        partial.unlink(missing_ok=True)
        raise
    if os.name == "posix":  # the new name outlasts a power cut once its folder is on the disk too
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def is_file(path: Path) -> bool:
    """Whether `path` is a file; not, too, where its name is too long, holds what no name can, or may not be looked up."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def is_folder(path: Path) -> bool:
    """Whether `path` is a folder; as `is_file`."""
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False
