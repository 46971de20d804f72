"""Blood cells of a regular grid: the base of a `Domain`, which is computed on, and of a `Level`, which holds a flow."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from vstent.kernels import voxels
from vstent.kernels.arrays import Floats, Ints, freeze
from vstent.kernels.directions import VELOCITIES


@dataclass(frozen=True, eq=False)
class Cells:
    """Blood cells of a regular grid."""

    cells: Ints
    """(n, 3) integer coordinates, sorted; the outermost layer of the grid contains no blood."""
    origin_mm: Floats
    """(3,) centre of the cell (0, 0, 0)."""
    cell_size_mm: float
    """Grid spacing."""

    def __post_init__(self) -> None:
        freeze(self, "cells", np.int32, (-1, 3))
        freeze(self, "origin_mm", np.float64, (3,))

    @cached_property
    def centers_mm(self) -> Floats:
        """Cell centres (n, 3)."""
        return self.origin_mm + self.cells * self.cell_size_mm

    @cached_property
    def index(self) -> Ints:
        """Index of the cell at every grid point (i, j, k), -1 outside the blood."""
        return voxels.index_of(self.cells)

    def neighbours(self) -> Ints:
        """Return the cell indices (n, 19) of every cell's neighbours, -1 where they are not blood."""
        return np.stack([self.index[tuple((self.cells + c).T)] for c in VELOCITIES], axis=1)

    def places(self, points_mm: Floats) -> Floats:
        """Return the grid coordinates (m, 3) of points (m, 3)."""
        return (points_mm - self.origin_mm) / self.cell_size_mm

    def cells_at(self, points_mm: Floats) -> Ints:
        """Return the cell (m,) in which each point (m, 3) lies, -1 outside the blood."""
        place = np.rint(self.places(points_mm)).astype(int)
        is_near = ((place >= 0) & (place < self.index.shape)).all(axis=1)
        found = np.full(len(points_mm), -1, dtype=np.int32)
        found[is_near] = self.index[tuple(place[is_near].T)]
        return found
