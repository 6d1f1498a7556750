"""Archives of data: written whole or not at all, checked when read, and never code.

An archive is a zip file, as `torch.save` writes it; the CRC-32 of each of its records tells whether it is as written.
"""

import io
import zipfile
from pathlib import Path
from typing import Any

import torch

from telebip.errors import UserError
from telebip.files import write_atomically


class DamagedArchiveError(UserError):
    """The bytes of an archive are not those that were written."""


def save_archive(path: Path, content: dict[str, Any]) -> None:
    """Write `content`, which says in "format" what it is, to `path`: complete, or not at all.

    Raises:
        OSError: it cannot be written.
    """
    archive = io.BytesIO()
    torch.save(content, archive)
    write_atomically(path, archive.getvalue())


def load_archive(path: Path, kind: str, form: str) -> dict[str, Any]:
    """Return what `save_archive` has written, with tensors on the CPU, if every record's checksum is right and all is data.

    Args:
        path: of the archive.
        kind: what it is called in messages.
        form: the "format" that it must have.

    Raises:
        DamagedArchiveError: it is not as it was written.
        UserError: it cannot be read, or holds something else.
    """
    try:
        archive = io.BytesIO(path.read_bytes())
    except OSError as error:
        raise UserError(f"{kind} '{path}' cannot be read: {error.strerror or error}") from error
    try:
        with zipfile.ZipFile(archive) as records:
            intact = records.testzip() is None
    except Exception as error:  # bytes that are no archive fail in as many ways as there are bytes
        raise DamagedArchiveError(f"{kind} '{path}' is not a telebip {kind}, or is damaged") from error
    if not intact:
        raise DamagedArchiveError(f"{kind} '{path}' is damaged: a checksum is wrong")
    archive.seek(0)
    try:
        content = torch.load(archive, map_location="cpu", weights_only=True)
    except Exception as error:
        raise UserError(f"{kind} '{path}' is not a telebip {kind}: it holds more than data") from error
    if not isinstance(content, dict) or "format" not in content:
        raise UserError(f"{kind} '{path}' is not a telebip {kind}")
    if content["format"] != form:
        raise UserError(f"{kind} '{path}' has format '{content['format']}', this version reads '{form}'")
    return content
