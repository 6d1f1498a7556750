"""The ground under the robots: its height, and the tile on which each of them walks."""

import torch
from torch import Tensor

from telebip.math import columns
from telebip.terrain import Terrain


class Ground:
    """A `Terrain` as the terms see it, on the worlds' device."""

    def __init__(self, terrain: Terrain, device: torch.device) -> None:
        """Copy the heights to `device`."""

        def constant(values) -> Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=device)

        self.types, self.levels, self.size = terrain.types, terrain.levels, terrain.size
        self._heights, self._columns = constant(terrain.heights).flatten(), terrain.heights.shape[1]
        self._rows = len(terrain.heights)
        self._origins, self._resolution = constant(terrain.origins).flatten(0, 1), terrain.resolution
        self._half_x, self._half_y = terrain.half_extent

    def height(self, x: Tensor, y: Tensor) -> Tensor:
        """Return the height of the ground at points of the world [m], (...) each; beyond the edge, that of the edge.

        It is the engines' surface: each square of nodes is two triangles, which meet in its diagonal from the lowest x and y
        to the highest.
        """
        x = ((x + self._half_x) / self._resolution).clamp(0.0, self._columns - 1.001)
        y = ((y + self._half_y) / self._resolution).clamp(0.0, self._rows - 1.001)
        column, row = x.long(), y.long()
        u, v, near = x - column, y - row, row * self._columns + column
        far = near + self._columns
        h = self._heights
        corner, opposite = h[near], h[far + 1]
        is_left = v >= u
        beside = torch.where(is_left, h[far], h[near + 1])
        # corner + (along the side) (beside - corner) + (across it) (opposite - beside)
        return corner + torch.maximum(u, v) * (beside - corner) + torch.minimum(u, v) * (opposite - beside)

    def origin(self, tile: Tensor) -> Tensor:
        """Return the middles (num_envs, 3) [m] of tiles (type, level), (num_envs, 2) long."""
        return self._origins[tile[:, 0] * self.levels + tile[:, 1]]

    def distance(self, base_pos: Tensor, tile: Tensor) -> Tensor:
        """Return how far robots are from the middle of their tile, along x or y, whichever is more [m], (num_envs,)."""
        return (base_pos - self.origin(tile))[:, :2].abs().amax(1)

    def tiles(self, num_envs: int, start_level: tuple[int, int]) -> Tensor:
        """Return a tile (type, level) for each world, (num_envs, 2) long: types in turn, then levels from first to last."""
        world = torch.arange(num_envs, device=self._heights.device)
        low, high = start_level
        return columns(world % len(self.types), low + world // len(self.types) % (high + 1 - low))
