"""Slices of a scan and its surface at a threshold, for the first step of the page."""

from functools import cached_property
from typing import Any, Final

import numpy as np

from vstent.anatomy.segment import propose
from vstent.errors import InputError
from vstent.geometry.image import Image
from vstent.geometry.surface import Surface
from vstent.kernels import topology, triangles
from vstent.kernels.arrays import Floats
from vstent.kernels.isosurface import isosurface
from vstent.reporting.packing import Packer, message
from vstent.reporting.scene import FRONTAL, MeshLayer, view_of
from vstent.reporting.thinning import thin_surface

COARSE: Final = 2.5e6
"""Largest number of voxels from which the live surface is computed."""
LIVE_FACES: Final = 40_000
"""Number of triangles above which the live surface is decimated."""
SPECK: Final = 0.01
"""Size of a piece, as a fraction of the triangles of the largest piece, below which it is not drawn."""


class Scan:
    """A scan as the page shows it."""

    def __init__(self, image: Image) -> None:
        self.image = image

    @cached_property
    def _range(self) -> tuple[float, float]:
        """Lowest shown and highest intensity: the 0.5 % quantile of a sample, and the maximum."""
        sample = self.image.voxels[::3, ::3, ::3]
        return float(np.percentile(sample, 0.5)), float(self.image.voxels.max())

    @cached_property
    def proposed_threshold(self) -> float:
        """Threshold that a study would use."""
        return propose(self.image)[0].threshold

    def told(self) -> dict[str, Any]:
        """Return shape, spacing, affine, range and proposed threshold."""
        return {
            "shape": self.image.voxels.shape,
            "spacing_mm": self.image.spacing_mm.tolist(),
            "affine_mm": self.image.affine_mm.ravel().tolist(),
            "modality": self.image.modality,
            "is_oriented": self.image.is_oriented,
            "range": self._range,
            "proposed_threshold": self.proposed_threshold,
        }

    def slice(self, axis: int, index: int) -> bytes:
        """Return the quantized values of one slice, as a message for the page; columns run fastest.

        Parameters
        ----------
        axis : voxel axis across the slice: 0, 1 or 2.
        index : voxel index along that axis.

        Raises
        ------
        InputError
            There is no such slice.
        """
        if not 0 <= index < self.image.voxels.shape[axis]:
            raise InputError(
                f"The scan has no slice {index} in this direction; it has {self.image.voxels.shape[axis]}."
            )
        plane = np.take(self.image.voxels, index, axis=axis).astype(np.float64)
        packer = Packer()
        values = packer.add_numbers(plane.T[..., None])
        return packer.framed({"width": plane.shape[0], "height": plane.shape[1], "values": values})

    def surface(self, threshold: float) -> bytes:
        """Return the surface at a threshold, coarse enough to follow a slider, as a message for the page."""
        stride = max(1, int(np.ceil((self.image.voxels.size / COARSE) ** (1 / 3))))
        field = self.image.voxels[::stride, ::stride, ::stride].astype(np.float32)
        index, faces = isosurface(field, threshold)
        layers, views = [], []
        if len(faces):
            index, faces = _without_specks(index, faces)
            surface = thin_surface(Surface(self.image.to_mm(stride * index), faces), LIVE_FACES)[0]
            layers = [MeshLayer("live", "", (0.80, 0.62, 0.55), "", np.zeros(0), surface)]
            views = [view_of("whole", FRONTAL, surface.vertices_mm)]
        return message(layers, views=views, threshold=threshold)


def _without_specks(index: Floats, faces: Any) -> tuple[Floats, Any]:
    """Return vertices and faces without small pieces."""
    label = topology.face_components(faces)
    count = np.bincount(label)
    return triangles.compact(index, faces[count[label] >= SPECK * count.max()])
