"""The mirror image at the plane y = 0: right and left change places, and so do the phase signals.

The image of x is sign * x[order]. A vector that points somewhere (polar) changes its y; an axis of rotation (axial) keeps it
and changes the others. What becomes of the joints is read from the MJCF, `telebip.robot.JointMirror`.
"""

from telebip.mdp.term import Image, Mirror
from telebip.robot import Robot

IMAGES: dict[Mirror, Image] = {
    "polar": ([0, 1, 2], [1.0, -1.0, 1.0]),
    "axial": ([0, 1, 2], [-1.0, 1.0, -1.0]),
    "quat": ([0, 1, 2, 3], [1.0, -1.0, 1.0, -1.0]),
    "command": ([0, 1, 2], [1.0, -1.0, -1.0]),
    "feet": ([1, 0], [1.0, 1.0]),
}


def image_of(mirror: Mirror | Image, size: int, robot: Robot) -> Image | str:
    """Return how `size` numbers of a kind are mirrored, or why they cannot be."""
    if isinstance(mirror, tuple):
        return mirror
    if mirror == "none":
        return "it declares no mirror image"
    if mirror == "same":
        return list(range(size)), [1.0] * size
    if mirror == "joints":
        joints = robot.mirror
        return joints if isinstance(joints, str) else (list(joints.order), list(joints.sign))
    image = IMAGES[mirror]
    return image if len(image[0]) == size else f"it has {size} numbers, and a '{mirror}' one {len(image[0])}"
