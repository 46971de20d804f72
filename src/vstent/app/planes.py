"""Slices of an oblique scan along the axes of the patient: axial, coronal and sagittal."""

from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any, Final

import numpy as np

from vstent.geometry.image import Image
from vstent.kernels.arrays import Floats, freeze

STRAIGHT_DEG: Final = 0.5
"""Angle between the axes of a scan and those of the patient below which its slices count as anatomical."""


@dataclass(frozen=True, eq=False)
class Grid:
    """A grid of voxels along the axes of the patient, without intensities."""

    shape: tuple[int, int, int]
    """Number of voxels to the left, to the back and to the head."""
    affine_mm: Floats
    """(4, 4) transform from a voxel index to LPS mm."""

    def __post_init__(self) -> None:
        freeze(self, "affine_mm", np.float64, (4, 4))

    @cached_property
    def spacing_mm(self) -> Floats:
        """(3,) distance between neighbouring voxels."""
        return np.diag(self.affine_mm)[:3].copy()

    def to_index(self, points_mm: Floats) -> Floats:
        """Return the fractional voxel indices (n, 3) of positions (n, 3) in LPS mm."""
        return (np.asarray(points_mm, dtype=np.float64) - self.affine_mm[:3, 3]) / self.spacing_mm


def oblique_deg(image: Image) -> Floats:
    """Return the angles (3,) in degrees between the slices across each voxel axis and the nearest anatomical plane."""
    along = np.abs(image.affine_mm[:3, :3]) / image.spacing_mm
    return np.degrees(np.arccos(np.clip(along.max(axis=0), -1.0, 1.0)))


def is_oblique(image: Image) -> bool:
    """Return whether a scan with a stated orientation is turned against the axes of the patient."""
    return image.is_oriented and bool(oblique_deg(image).max() > STRAIGHT_DEG)


def upright(image: Image) -> Grid:
    """Return the grid along the axes of the patient that holds a scan; the spacing is that of the nearest axes."""
    ends = np.array(list(product(*((0.0, n - 1.0) for n in image.voxels.shape))))
    corners_mm = image.to_mm(ends)
    nearest = np.abs(image.affine_mm[:3, :3] / image.spacing_mm).argmax(axis=1)
    spacing_mm, low_mm = image.spacing_mm[nearest], corners_mm.min(axis=0)
    counts = np.ceil((corners_mm.max(axis=0) - low_mm) / spacing_mm - 1e-6).astype(int) + 1
    affine_mm = np.diag([*spacing_mm, 1.0])
    affine_mm[:3, 3] = low_mm
    i, j, k = (int(count) for count in counts)
    return Grid((i, j, k), affine_mm)


def reformatted(image: Image, grid: Grid, axis: int, first: int, last: int) -> Any:
    """Return the largest interpolated intensities of slices of a grid, columns first; the lowest outside the scan."""
    from scipy.ndimage import affine_transform

    shape = list(grid.shape)
    shape[axis] = last - first
    inverse = np.linalg.inv(image.affine_mm)
    matrix = inverse[:3, :3] @ grid.affine_mm[:3, :3]
    origin = np.zeros(3)
    origin[axis] = first
    start = inverse[:3, :3] @ grid.affine_mm[:3, 3] + inverse[:3, 3] + matrix @ origin
    voxels = image.voxels.view(np.uint8) if image.voxels.dtype == bool else image.voxels
    found = np.zeros(shape, dtype=np.float32)
    affine_transform(voxels, matrix, start, output=found, order=1, mode="constant", cval=float(voxels.min()))
    return found.max(axis=axis)
