"""Which OpenGL there is. Imports no engine: MuJoCo reads `MUJOCO_GL` once, when it is imported."""

import ctypes
import os
import sys

from telebip.errors import UserError, nearest

PACKAGES = {"egl": ("libEGL.so.1", "libegl1"), "osmesa": ("libOSMesa.so.8", "libosmesa6")}
"""Library of each way to render without a display, and its Debian package."""
NAMES = ("egl", "osmesa", "glfw", "glx", "disable")  # what to choose from in `MUJOCO_GL`
MORE_NAMES = ("wgl", "cgl", "disabled", "off", "false", "0", "enable", "enabled", "on", "true", "1")  # taken too, somewhere


def has_display() -> bool:
    """Whether a window can be opened, as far as the environment says."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def check_opengl() -> None:
    """Refuse a `MUJOCO_GL` with which MuJoCo could not be imported.

    Raises:
        UserError: the user chose an unknown way to render, or one whose library is not there.
    """
    chosen = os.environ.get("MUJOCO_GL", "").lower().strip()
    if chosen in PACKAGES and not _loads(PACKAGES[chosen][0]):
        library, package = PACKAGES[chosen]
        raise UserError(f"MUJOCO_GL={chosen}, but {library} is not there; on Debian, apt-get install {package}")
    if chosen and chosen not in NAMES + MORE_NAMES:
        raise UserError(f"MUJOCO_GL={chosen} names no way to render; {nearest(chosen, NAMES)}")


def choose_opengl() -> None:
    """Where there is no display and the user has not chosen, let MuJoCo render through EGL, else OSMesa, else not at all.

    Call it before MuJoCo is imported: with `MUJOCO_GL=egl` and no libEGL, that would fail with a traceback.

    Raises:
        UserError: see `check_opengl`.
    """
    check_opengl()
    if not has_display():
        found = [name for name, (library, _) in PACKAGES.items() if _loads(library)]
        os.environ.setdefault("MUJOCO_GL", found[0] if found else "disable")


def how_to_get_opengl() -> str:
    """Return the end of an error line: what to set, and what to install."""
    there = [f"MUJOCO_GL={name}" for name, (library, _) in PACKAGES.items() if _loads(library)]
    missing = [package for library, package in PACKAGES.values() if not _loads(library)]
    advice = [f"try {' or '.join(there)}"] if there else []
    advice += [f"on Debian, apt-get install {' or '.join(missing)}"] if missing else []
    return "; ".join(advice)


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True
