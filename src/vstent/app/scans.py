"""Slices of a scan, as stored or along the axes of the patient, and its surface at a threshold, for the page."""

import threading
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any, Final

import numpy as np

from vstent.anatomy.segment import propose
from vstent.errors import InputError
from vstent.geometry.image import Image
from vstent.geometry.surface import Surface
from vstent.kernels import topology, triangles
from vstent.kernels.arrays import Floats, freeze
from vstent.kernels.voxels import isosurface
from vstent.reporting.packing import LEVELS, Packer, message
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


LOCK: Final = threading.RLock()
"""Lock for one computation at a time, because parallel compiled loops must not run concurrently."""


class Scan:
    """A scan as the page shows it, and the box in it, by opposite corners (2, 3), in which the vessel is sought."""

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
        if self.image.voxels.dtype.kind in "iub" and high - low <= LEVELS:
            return 1.0
        return (high - low) / LEVELS or 1.0

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
    def oblique_deg(self) -> Floats:
        """Angles (3,) between the slices across each voxel axis and the nearest anatomical plane."""
        along = np.abs(self.image.affine_mm[:3, :3]) / self.image.spacing_mm
        return np.degrees(np.arccos(np.clip(along.max(axis=0), -1.0, 1.0)))

    @cached_property
    def upright(self) -> Grid | None:
        """Grid along the axes of the patient that holds the scan, with the spacing of the nearest axes.

        None where the file's slices are anatomical or have no orientation.
        """
        image = self.image
        if not image.is_oriented or self.oblique_deg.max() <= STRAIGHT_DEG:
            return None
        corners_mm = image.to_mm(np.array(list(product(*((0.0, n - 1.0) for n in image.voxels.shape)))))
        nearest = np.abs(image.affine_mm[:3, :3] / image.spacing_mm).argmax(axis=1)
        spacing_mm, low_mm = image.spacing_mm[nearest], corners_mm.min(axis=0)
        counts = np.ceil((corners_mm.max(axis=0) - low_mm) / spacing_mm - 1e-6).astype(int) + 1
        affine_mm = np.diag([*spacing_mm, 1.0])
        affine_mm[:3, 3] = low_mm
        i, j, k = (int(count) for count in counts)
        return Grid((i, j, k), affine_mm)

    def grid(self, *, is_upright: bool) -> Image | Grid:
        """Return the grid of the slices: that of the file, or the one along the axes of the patient."""
        return self.upright if is_upright and self.upright is not None else self.image

    def told(self) -> dict[str, Any]:
        """Return shape, spacing, affine, range and quantiles of the intensity; nothing that takes long."""
        turned = self.upright
        return {
            "oblique_deg": self.oblique_deg.tolist(),
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
        The slice lies across a voxel axis; a slab includes so many slices on each side of it. An upright slice is an
        anatomical plane of an oblique scan, interpolated between its voxels.

        Raises InputError: there is no such slice.
        """
        grid = self.upright if is_upright else None
        count = (self.image.voxels.shape if grid is None else grid.shape)[axis]
        if not 0 <= index < count:
            raise InputError(f"The scan has no slice {index} in this direction; it has {count}.")
        first, last = max(index - slab, 0), min(index + slab + 1, count)
        if grid is None:
            plane = np.moveaxis(self.image.voxels, axis, 0)[first:last].max(axis=0).T
        else:
            plane = _reformatted(self.image, grid, axis, first, last).T
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
        layers, views = [], []
        with LOCK:
            index, faces = isosurface(field, threshold)
            if len(faces):
                label = topology.face_components(faces)
                count = np.bincount(label)
                index, faces = triangles.compact(index, faces[count[label] >= SPECK * count.max()])
                surface = thin_surface(Surface(self.part.to_mm(stride * index), faces), LIVE_FACES)[0]
                layers = [MeshLayer("live", "", (0.80, 0.62, 0.55), surface)]
                views = [view_of("whole", FRONTAL, surface.vertices_mm)]
        return message(layers, views=views, threshold=threshold)


def _reformatted(image: Image, grid: Grid, axis: int, first: int, last: int) -> Any:
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
