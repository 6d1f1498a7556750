"""The ground: a grid of tiles, one type a column and one level a row, as one height field.

A terrain type is one function of the tile, and its entry in the YAML's `terrain.types` gives its parameters:

    @terrain
    def waves(tile: Tile, *, height: Annotated[tuple[float, float], Quantity("m", ge=0)], length: ...) -> Array: ...

A parameter that is a pair is the value on the first level and that on the last; `tile.at` returns that of the tile's level.
Robots start on the flat square in the middle of their tile (`platform`), and an episode ends where they leave it.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from telebip.errors import UserError
from telebip.mdp.term import Params, Quantity, find, terrain

Array = NDArray[np.floating]
Levels = tuple[float, float]
"""On the first level, and on the last."""

BORDER = 1.0
"""Flat ground around the tiles [m]: a robot that is about to leave the outermost ones sets its foot there."""


@dataclass(frozen=True)
class TerrainConfig:
    """The ground; without `types` it is the MJCF's floor."""

    types: dict[str, Params]
    levels: Annotated[int, Quantity(ge=1, le=100)]
    start_level: Annotated[tuple[int, int], Quantity(ge=0, le=99)]
    size: Annotated[float, Quantity("m", gt=0, le=100)]
    platform: Annotated[float, Quantity("m", gt=0, le=100)]
    resolution: Annotated[float, Quantity("m", ge=0.01, le=1)]
    seed: Annotated[int, Quantity(ge=0, le=2**32 - 1)]


@dataclass(frozen=True)
class Tile:
    """A tile as terrain types see it. They return the heights [m] of its nodes (x.shape); from which level counts nothing."""

    x: Array  # of the nodes, from the tile's middle [m], (n, n)
    y: Array
    platform: float  # side of the flat square in the middle [m]
    difficulty: float  # 0 on the first level, 1 on the last
    random: np.random.Generator

    @cached_property
    def distance(self) -> Array:
        """How far outside the platform, along x or y, whichever is more [m], (n, n); 0 on it."""
        return np.maximum(np.maximum(abs(self.x), abs(self.y)) - 0.5 * self.platform, 0.0)

    def at(self, levels: Levels) -> float:
        """Return the value of the tile's level, linear between those of the first and the last."""
        return levels[0] + self.difficulty * (levels[1] - levels[0])


@terrain
def slope_up(tile: Tile, *, angle: Annotated[Levels, Quantity("rad", ge=0, lt=1.5)]) -> Array:
    """Ground that rises on every side of the platform: `angle` [rad]."""
    return math.tan(tile.at(angle)) * tile.distance


@terrain
def slope_down(tile: Tile, *, angle: Annotated[Levels, Quantity("rad", ge=0, lt=1.5)]) -> Array:
    """Ground that falls on every side of the platform: `angle` [rad]."""
    return -math.tan(tile.at(angle)) * tile.distance


@terrain
def stairs_up(
    tile: Tile, *, rise: Annotated[Levels, Quantity("m", ge=0)], tread: Annotated[float, Quantity("m", gt=0)]
) -> Array:
    """Steps up on every side of the platform: `rise` [m] high and `tread` [m] deep."""
    return tile.at(rise) * np.ceil(np.round(tile.distance / tread, 6))


@terrain
def stairs_down(
    tile: Tile, *, rise: Annotated[Levels, Quantity("m", ge=0)], tread: Annotated[float, Quantity("m", gt=0)]
) -> Array:
    """Steps down on every side of the platform: `rise` [m] high and `tread` [m] deep."""
    return -tile.at(rise) * np.ceil(np.round(tile.distance / tread, 6))


@terrain
def boxes(tile: Tile, *, height: Annotated[Levels, Quantity("m", ge=0)], width: Annotated[float, Quantity("m", gt=0)]) -> Array:
    """Square boxes of `width` [m], their tops uniform within `height` [m], which is the highest step between two of them."""
    column, row = (np.floor(np.round((axis - axis.min()) / width, 6)).astype(int) for axis in (tile.x, tile.y))
    return tile.at(height) * tile.random.uniform(size=(row.max() + 1, column.max() + 1))[row, column]


@terrain
def noise(
    tile: Tile, *, height: Annotated[Levels, Quantity("m", ge=0)], spacing: Annotated[float, Quantity("m", gt=0)]
) -> Array:
    """Random heights, uniform within `height` [m], at points `spacing` [m] apart, and linear between them."""
    x, y = ((axis - axis.min()) / spacing for axis in (tile.x, tile.y))
    column, row = x.astype(int), y.astype(int)
    u, v = x - column, y - row
    drawn = tile.random.uniform(size=(row.max() + 2, column.max() + 2))
    near = (1.0 - u) * drawn[row, column] + u * drawn[row, column + 1]
    far = (1.0 - u) * drawn[row + 1, column] + u * drawn[row + 1, column + 1]
    return tile.at(height) * ((1.0 - v) * near + v * far)


@terrain
def waves(
    tile: Tile, *, height: Annotated[Levels, Quantity("m", ge=0)], length: Annotated[float, Quantity("m", gt=0)]
) -> Array:
    """Hills and hollows, h/2 sin(2 pi x / length) sin(2 pi y / length): `height` h [m] from the lowest to the highest point."""
    k = 2.0 * math.pi / length
    return 0.5 * tile.at(height) * np.sin(k * tile.x) * np.sin(k * tile.y)


@terrain
def gaps(
    tile: Tile,
    *,
    width: Annotated[Levels, Quantity("m", ge=0)],
    spacing: Annotated[float, Quantity("m", gt=0)],
    depth: Annotated[float, Quantity("m", ge=0)],
) -> Array:
    """Ditches around the platform, `width` [m] wide, their near edges `spacing` [m] apart, and `depth` [m] deep."""
    across = np.round((tile.distance - 0.5 * spacing) % spacing, 6)
    return np.where((tile.distance > 0.5 * spacing) & (across < tile.at(width)), -depth, 0.0)


def make_terrain(cfg: TerrainConfig) -> "Terrain | None":
    """Return a task's terrain, or None if it is the floor of the MJCF."""
    return Terrain(cfg) if cfg.types else None


class Terrain:
    """The height field. Its middle is at the world's origin; rows of levels lie along x and columns of types along y."""

    def __init__(self, cfg: TerrainConfig) -> None:
        """Make the tiles; they are the same for the same configuration.

        Raises:
            UserError: sizes do not fit together.
        """
        n = round(cfg.size / cfg.resolution)
        if abs(n * cfg.resolution - cfg.size) > 1e-6 or cfg.platform >= cfg.size:
            raise UserError(
                f"terrain: a tile of {cfg.size} m must be a multiple of the resolution {cfg.resolution} m, and larger than its "
                f"platform of {cfg.platform} m"
            )
        if cfg.start_level[1] >= cfg.levels:
            raise UserError(f"terrain.start_level must be below terrain.levels, {cfg.levels}, got {list(cfg.start_level)}")
        self.types, self.levels, self.size, self.resolution = tuple(cfg.types), cfg.levels, cfg.size, cfg.resolution
        edge, margin = [(i + 0.5) * cfg.resolution - 0.5 * cfg.size for i in range(n)], round(BORDER / cfg.resolution)
        x, y = np.meshgrid(edge, edge)
        tiles = np.zeros((len(self.types), self.levels, n, n))
        for column, (entry, params) in enumerate(cfg.types.items()):
            term = find("terrain", params.get("term", entry))
            own = {name: params[name] for name in term.own_parameters}
            for level in range(self.levels):
                random = np.random.default_rng([cfg.seed, column, level])
                tile = Tile(x, y, cfg.platform, level / max(1, self.levels - 1), random)
                tiles[column, level] = _joined(term.function(tile, **own), tile)
        self.heights = np.pad(tiles.transpose(0, 2, 1, 3).reshape(len(self.types) * n, -1), margin)
        """Heights of the nodes [m], (rows along y, columns along x); the outermost ones are half a `resolution` inside."""
        centre = np.arange(len(self.types)), np.arange(self.levels)
        row, column = np.meshgrid(*(cfg.size * (i - 0.5 * i.max()) for i in centre), indexing="ij")
        self.origins = np.stack([column, row, tiles[:, :, n // 2, n // 2]], axis=-1)
        """Middles of the tiles [m], (types, levels, 3)."""

    @property
    def half_extent(self) -> tuple[float, float]:
        """Half the distance between the outermost nodes, along x and along y [m]."""
        rows, columns = self.heights.shape
        return 0.5 * (columns - 1) * self.resolution, 0.5 * (rows - 1) * self.resolution


def _joined(heights: Array, tile: Tile) -> Array:
    """Return a tile's heights with its platform flat, and with its edge about as high as that of its neighbours, at zero."""
    heights = heights.copy()
    on_platform = tile.distance == 0.0
    heights[on_platform] = heights[on_platform].mean()
    return heights - np.concatenate([heights[0], heights[-1], heights[:, 0], heights[:, -1]]).mean()
