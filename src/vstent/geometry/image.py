"""A scan on a regular, possibly oblique grid in the LPS frame."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vstent.errors import InputError
from vstent.kernels.arrays import Floats, freeze

FEWEST_ACROSS: Final = 8
"""Smallest number of voxels along each axis of a cropped scan."""


@dataclass(frozen=True, eq=False)
class Image:
    """A three-dimensional scan."""

    voxels: NDArray[Any]
    """(i, j, k) intensities of any real dtype."""
    affine_mm: Floats
    """(4, 4) transform from a voxel index to LPS mm."""
    modality: str = ""
    """DICOM modality; empty where the file does not state it."""
    notes: tuple[str, ...] = ()
    """Assumptions made while reading the scan, one sentence each."""
    is_oriented: bool = True
    """Whether the file states where left, right, front and back are; raw voxels do not."""

    def __post_init__(self) -> None:
        freeze(self, "voxels", np.asarray(self.voxels).dtype, (-1, -1, -1))
        freeze(self, "affine_mm", np.float64, (4, 4))

    @cached_property
    def spacing_mm(self) -> Floats:
        """(3,) distance between neighbouring voxels along i, j, k."""
        return np.linalg.norm(self.affine_mm[:3, :3], axis=0)

    def to_mm(self, index: Floats) -> Floats:
        """Return the positions (n, 3) in LPS mm of voxel indices (n, 3)."""
        return np.asarray(index, dtype=np.float64) @ self.affine_mm[:3, :3].T + self.affine_mm[:3, 3]

    def to_index(self, points_mm: Floats) -> Floats:
        """Return the fractional voxel indices (n, 3) of positions (n, 3) in LPS mm."""
        inverse = np.linalg.inv(self.affine_mm)
        return np.asarray(points_mm, dtype=np.float64) @ inverse[:3, :3].T + inverse[:3, 3]

    def cropped(self, corners_mm: Floats) -> "Image":
        """Return the voxels of a box along the image axes, given two opposite corners (2, 3) in LPS mm.

        An InputError is raised when it holds too few voxels.
        """
        index = np.rint(np.sort(self.to_index(corners_mm), axis=0))
        first, last = np.clip(index, 0, np.array(self.voxels.shape) - 1).astype(np.int32)
        if (last - first + 1 < FEWEST_ACROSS).any():
            raise InputError(
                f"The crop box holds fewer than {FEWEST_ACROSS} voxels along an axis of the scan. Choose a larger box."
            )
        affine_mm = self.affine_mm.copy()
        affine_mm[:3, 3] = self.to_mm(first[None])[0]
        voxels = self.voxels[tuple(slice(a, b + 1) for a, b in zip(first, last, strict=True))]
        of = " x ".join(map(str, self.voxels.shape))
        note = f"The scan is cropped to {' x '.join(map(str, voxels.shape))} of {of} voxels."
        return replace(self, voxels=voxels, affine_mm=affine_mm, notes=(*self.notes, note))
