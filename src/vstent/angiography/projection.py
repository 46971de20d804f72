"""Line integrals of a concentration on grid cells through a cone beam."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vstent.angiography.view import View
from vstent.kernels.footprints import footprints


@dataclass(frozen=True, eq=False)
class Projector:
    """Projection of any field on the same cells along the same view."""

    view: View
    """Direction, distances and detector."""
    matrix: Any
    """(rows * columns, n) sparse matrix: length in mm of the ray to a pixel within a cell."""

    def __call__(self, concentration_mg_mL: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
        """Return the line integrals (rows, columns), in mg/mL mm, of a concentration (n,) in mg/mL."""
        integrals = self.matrix @ np.asarray(concentration_mg_mL, dtype=np.float32)
        return np.asarray(integrals, dtype=np.float32).reshape(self.view.rows, self.view.columns)


def projector_of(view: View, points_mm: NDArray[np.floating[Any]], spacing_mm: NDArray[np.floating[Any]]) -> Projector:
    """Return the projector of grid cells: the footprints of cubes in a cone beam, as a sparse matrix.

    The sum over all pixels, times the area of a pixel, is the integral of the concentration over the volume, weighted
    with magnification squared over the cosine between the ray and the axis of the beam. The idea of footprints is that
    of Long, Fessler & Balter 2010 (IEEE Trans. Med. Imaging 29:1839).
    """
    from scipy.sparse import csc_array

    centers_mm = np.asarray(points_mm, dtype=np.float64)
    view.pixels_of(centers_mm)  # refuses cells beside or behind the source
    seen = np.ascontiguousarray((centers_mm - view.isocenter_mm) @ view.axes.T)
    middle = 0.5 * (view.rows - 1), 0.5 * (view.columns - 1)
    geometry = np.array([view.pixel_mm, view.source_detector_mm, view.source_isocenter_mm, *middle])
    shape = np.array([view.rows, view.columns])
    starts, pixels, weights = footprints(
        seen, np.asarray(spacing_mm, dtype=np.float64), np.ascontiguousarray(view.axes), geometry, shape
    )
    matrix = csc_array((weights, pixels, starts), shape=(view.rows * view.columns, len(seen)))
    return Projector(view, matrix)
