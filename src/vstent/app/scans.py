"""Slices of a scan and its surface at a threshold, for the first step of the page."""

from functools import cached_property
from typing import Any, Final

import numpy as np

from vstent.anatomy.segment import propose
from vstent.app.planes import Grid, is_oblique, oblique_deg, reformatted, upright
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
SAMPLE: Final = 3e5
"""Number of voxels, about, from which the quantiles of the intensity are computed."""
_LEVELS: Final = 65_535
"""Largest quantized intensity; it fits in two bytes."""


class Scan:
    """A scan as the page shows it.

    Parameters
    ----------
    image : the whole scan.
    crop_mm : (2, 3) opposite corners of the box in which the vessel is sought, LPS mm; None: the whole scan.
    """

    def __init__(self, image: Image, crop_mm: Floats | None = None) -> None:
        self.image = image
        self.part = image if crop_mm is None else image.cropped(crop_mm)

    @cached_property
    def _ends(self) -> tuple[float, float]:
        """Lowest and highest intensity."""
        return float(self.image.voxels.min()), float(self.image.voxels.max())

    @cached_property
    def _step(self) -> float:
        """Difference of two neighbouring quantized intensities: 1 where whole numbers fit without loss."""
        low, high = self._ends
        if self.image.voxels.dtype.kind in "iub" and high - low <= _LEVELS:
            return 1.0
        return (high - low) / _LEVELS or 1.0

    @cached_property
    def _quantiles(self) -> list[float]:
        """Quantiles of the intensity at 0.5, 5, 50, 95 and 99.9 %, of a sample of the voxels."""
        stride = max(1, round((self.image.voxels.size / SAMPLE) ** (1 / 3)))
        sample = self.image.voxels[::stride, ::stride, ::stride]
        return [float(value) for value in np.percentile(sample, [0.5, 5, 50, 95, 99.9])]

    @cached_property
    def proposed_threshold(self) -> float:
        """Threshold that a study would use."""
        return propose(self.part)[0].threshold

    @cached_property
    def upright(self) -> Grid | None:
        """Grid along the axes of the patient; None where the file's slices are anatomical or have no orientation."""
        return upright(self.image) if is_oblique(self.image) else None

    def grid(self, *, is_upright: bool) -> Image | Grid:
        """Return the grid of the slices: that of the file, or the one along the axes of the patient.

        Parameters
        ----------
        is_upright : whether the slices are anatomical planes.
        """
        return self.upright if is_upright and self.upright is not None else self.image

    def told(self) -> dict[str, Any]:
        """Return shape, spacing, affine, range and quantiles of the intensity; nothing that takes long."""
        turned = self.upright
        return {
            "oblique_deg": oblique_deg(self.image).tolist(),
            "upright": turned
            and {
                "shape": turned.shape,
                "spacing_mm": turned.spacing_mm.tolist(),
                "affine_mm": turned.affine_mm.ravel().tolist(),
                "oblique_deg": [0.0, 0.0, 0.0],
            },
            "shape": self.image.voxels.shape,
            "spacing_mm": self.image.spacing_mm.tolist(),
            "affine_mm": self.image.affine_mm.ravel().tolist(),
            "modality": self.image.modality,
            "is_oriented": self.image.is_oriented,
            "range": (self._quantiles[0], self._ends[1]),
            "ends": self._ends,
            "step": self._step,
            "quantiles": self._quantiles,
        }

    def slice(self, axis: int, index: int, slab: int = 0, *, is_upright: bool = False) -> bytes:
        """Return the quantized values of one slice, or the maximum of a slab, as a message for the page.

        Columns run fastest. All slices share the quantization that `told` states: intensity = low + step * integer.

        Parameters
        ----------
        axis : voxel axis across the slice: 0, 1 or 2.
        index : voxel index along that axis.
        slab : number of slices on each side that the maximum includes.
        is_upright : whether the slice is an anatomical plane of an oblique scan, interpolated between its voxels.

        Raises
        ------
        InputError
            There is no such slice.
        """
        grid = self.upright if is_upright else None
        count = (self.image.voxels.shape if grid is None else grid.shape)[axis]
        if not 0 <= index < count:
            raise InputError(f"The scan has no slice {index} in this direction; it has {count}.")
        first, last = max(index - slab, 0), min(index + slab + 1, count)
        if grid is None:
            plane = np.moveaxis(self.image.voxels, axis, 0)[first:last].max(axis=0).T
        else:
            plane = reformatted(self.image, grid, axis, first, last).T
        low, step = self._ends[0], self._step
        levels = np.rint((plane.astype(np.float64) - low) / step)
        is_narrow = self._ends[1] - low <= 255 * step
        packer = Packer()
        values = packer.add(levels.astype(np.uint8 if is_narrow else np.uint16))
        height, width = plane.shape
        return packer.framed({"width": width, "height": height, "values": {**values, "low": [low], "step": [step]}})

    def surface(self, threshold: float) -> bytes:
        """Return the surface at a threshold, coarse enough to follow a slider, as a message for the page."""
        stride = max(1, int(np.ceil((self.part.voxels.size / COARSE) ** (1 / 3))))
        field = self.part.voxels[::stride, ::stride, ::stride].astype(np.float32)
        index, faces = isosurface(field, threshold)
        layers, views = [], []
        if len(faces):
            index, faces = _without_specks(index, faces)
            surface = thin_surface(Surface(self.part.to_mm(stride * index), faces), LIVE_FACES)[0]
            layers = [MeshLayer("live", "", (0.80, 0.62, 0.55), surface)]
            views = [view_of("whole", FRONTAL, surface.vertices_mm)]
        return message(layers, views=views, threshold=threshold)


def _without_specks(index: Floats, faces: Any) -> tuple[Floats, Any]:
    """Return vertices and faces without small pieces."""
    label = topology.face_components(faces)
    count = np.bincount(label)
    return triangles.compact(index, faces[count[label] >= SPECK * count.max()])
