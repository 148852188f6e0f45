"""A map's cells at several sizes, each with the numbers of refinement for the things that it shows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from detect.refinement.options import DEFAULTS, RefinementOptions
from detect.refinement.surroundings.map_cells import MapCells
from mapping.grid import OccupancyGrid
from mapping.pyramid import PyramidLevel, coarser, levels_for
from prim.arrays import FloatArray
from prim.shapes import Primitive


@dataclass(frozen=True)
class MapLevel:
    """A map at one size of its cells.

    Attributes:
        level: The cells' size, and which things are searched for in them.
        grid: The map.
        options: Numbers for these things.
    """

    level: PyramidLevel
    grid: OccupancyGrid
    options: RefinementOptions

    @cached_property
    def cells(self) -> MapCells:
        """The map's cells; they are classified when they are first asked for."""
        return MapCells.of(self.grid, self.options.map, self.options.lines)


@dataclass(frozen=True)
class MapLevels:
    """A map at all sizes of its cells that things of the wanted sizes need.

    Attributes:
        levels: The sizes, the finest first.
        options: Numbers at a scale of 1.
    """

    levels: tuple[MapLevel, ...]
    options: RefinementOptions

    @classmethod
    def of(cls, grid: OccupancyGrid, options: RefinementOptions = DEFAULTS) -> MapLevels:
        """Make the coarser maps.

        Args:
            grid: The map.
            options: The wanted sizes (``options.evidence.sizes``), and the numbers at a scale of 1.

        Returns:
            The levels.
        """
        made, factor = [], 1
        for level in levels_for(grid.frame.resolution, options.evidence.sizes):
            grid, factor = coarser(grid, level.factor // factor), level.factor
            made.append(MapLevel(level, grid, options.at_scale(level.resolution / options.map.reference)))
        return cls(tuple(made), options)

    def __iter__(self) -> Iterator[MapLevel]:
        return iter(self.levels)

    def is_room(self, outline: FloatArray) -> bool:
        """Tell whether an outline (N, 2) in m, too large for the finest cells, is a room's: its inside is free."""
        level = self._at_extent(2 * float(np.hypot(*(outline - outline.mean(axis=0)).T).max()))
        return level is not self.levels[0] and level.cells.is_hollow(outline)

    def showing(self, primitive: Primitive) -> MapLevel:
        """Return the finest level at which the numbers hold for a thing of a primitive's extent."""
        return self._at_extent(2 * primitive.bounding_radius)

    def _at_extent(self, extent: float) -> MapLevel:
        """Return the finest level at which the numbers hold for a thing of some extent (m)."""
        shown = (one for one in self.levels if extent <= self.options.map.shown_cells * one.level.resolution)
        return next(shown, self.levels[-1])
