"""The mirror image of observations and actions."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, get_args

import pytest
import torch
from torch import Tensor
from worlds import PHASE, MakeEnv, quat_mul

from telebip.math import rotate_inverse
from telebip.mdp.mirror import image_of
from telebip.mdp.term import Mirror
from telebip.robot import Robot

SIZES: dict[Any, int] = {"joints": 6, "polar": 3, "axial": 3, "quat": 4, "command": 3, "feet": 2, "same": 5}


def mirrored(x: Tensor, image: Any) -> Tensor:
    order, sign = image
    return x[:, order] * torch.tensor(sign)


def policy(make_env: MakeEnv) -> list[Any]:
    return make_env(num_envs=1).groups["policy"].parts


def joined(images: Iterable[Any]) -> tuple[list[int], list[float]]:
    """The image of vectors side by side."""
    order: list[int] = []
    sign: list[float] = []
    for part_order, part_sign in images:
        order += [len(sign) + i for i in part_order]
        sign += part_sign
    return order, sign


def test_every_kind_is_known() -> None:
    assert {*SIZES, "none"} == set(get_args(Mirror))


@pytest.mark.parametrize("mirror", list(SIZES))
def test_mirroring_twice_changes_nothing(robot: Robot, mirror: Mirror) -> None:
    x = torch.randn(5, SIZES[mirror], generator=torch.Generator().manual_seed(0))
    image = image_of(mirror, SIZES[mirror], robot)
    once = mirrored(x, image)
    assert torch.equal(once, x) == (mirror == "same")
    assert torch.equal(mirrored(once, image), x)


def test_the_mirror_of_a_whole_observation_is_its_own_inverse(make_env: MakeEnv) -> None:
    image = joined(part.image for part in policy(make_env))
    x = torch.randn(5, 33, generator=torch.Generator().manual_seed(0))
    assert not torch.equal(mirrored(x, image), x)
    assert torch.equal(mirrored(mirrored(x, image), image), x)


def test_every_part_of_the_observation_has_its_mirror(make_env: MakeEnv) -> None:
    for part in policy(make_env):
        assert sorted(part.image[0]) == list(range(part.size)), part.name
        assert len(part.image[1]) == part.size
    assert sum(part.size for part in policy(make_env)) == 33


def test_the_right_leg_becomes_the_left_and_rolls_the_other_way(robot: Robot) -> None:
    action = torch.tensor([[0.1, 0.2, 0.3, 0.4, 0.5, 0.6]])
    image = mirrored(action, image_of("joints", 6, robot))
    torch.testing.assert_close(image, torch.tensor([[-0.4, 0.5, 0.6, -0.1, 0.2, 0.3]]))


def test_the_phase_signals_are_where_they_are_looked_for(make_env: MakeEnv) -> None:
    names = [part.name for part in policy(make_env) for _ in range(part.size)]
    assert [i for i, name in enumerate(names) if name == "phase"] == [*range(PHASE.start, PHASE.stop)] == [31, 32]


def test_frames_mirror_with_what_is_seen_from_them(robot: Robot) -> None:
    """Of a vector v and a rotation by w in the frame q, M turns v into M v and w, an axial vector, into -M w."""
    generator = torch.Generator().manual_seed(0)
    quat, vec = torch.randn(8, 4, generator=generator), torch.randn(8, 3, generator=generator)
    quat = quat / torch.linalg.vector_norm(quat, dim=1, keepdim=True)
    images = {mirror: image_of(mirror, SIZES[mirror], robot) for mirror in ("polar", "axial", "quat")}
    seen = rotate_inverse(mirrored(quat, images["quat"]), mirrored(vec, images["polar"]))
    torch.testing.assert_close(seen, mirrored(rotate_inverse(quat, vec), images["polar"]))
    spun = rotate_inverse(mirrored(quat, images["quat"]), mirrored(vec, images["axial"]))
    torch.testing.assert_close(spun, mirrored(rotate_inverse(quat, vec), images["axial"]))
    product = quat_mul(mirrored(quat, images["quat"]), mirrored(quat.flip(0), images["quat"]))
    torch.testing.assert_close(product, mirrored(quat_mul(quat, quat.flip(0)), images["quat"]))


def test_what_has_no_mirror_image_says_why(robot: Robot) -> None:
    assert image_of("none", 3, robot) == "it declares no mirror image"
    assert image_of("polar", 4, robot) == "it has 4 numbers, and a 'polar' one 3"
    assert image_of("joints", 6, replace(robot, mirror="axes of joint 'waist'")) == "axes of joint 'waist'"
