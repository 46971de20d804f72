"""Make image axes perpendicular: a small shear is removed from the frame, a large one by resampling."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from vstent.geometry.image import Image

NEGLIGIBLE_MM: Final = 0.01
"""Displacement in mm below which a shear is a rounding error of the header and is not reported."""
SMALL_VOXELS: Final = 0.5
"""Largest displacement, in voxel edges, for which the nearest rectangular frame replaces a sheared one."""


def rectangular(image: Image) -> Image:
    """Return an image with perpendicular axes.

    A shear that moves no voxel by more than half a voxel edge is removed from the frame: it is replaced by the nearest
    rectangular frame around the center of the volume (polar decomposition). A larger one, as from a tilted gantry, is
    removed by resampling the voxels on a rectangular grid with the same first axis. A note reports either.
    """
    edges = np.array(image.affine_mm[:3, :3])
    spacing_mm = np.linalg.norm(edges, axis=0)
    directions = edges / spacing_mm
    left, _, right = np.linalg.svd(directions)
    nearest = left @ right * spacing_mm  # the same handedness
    half = 0.5 * (np.array(image.voxels.shape) - 1)
    corners = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1) * half[:, None]
    moved_mm = float(np.linalg.norm((edges - nearest) @ corners, axis=0).max())
    if moved_mm < NEGLIGIBLE_MM * min(1.0, float(spacing_mm.min())):
        return image
    cosine = np.abs(np.triu(directions.T @ directions, k=1)).max()
    skew = f"The image axes are not perpendicular (off by {np.degrees(np.arcsin(min(cosine, 1.0))):.1f} degrees"
    if moved_mm > SMALL_VOXELS * float(spacing_mm.min()):
        return _resampled(image, skew)
    affine = np.eye(4)
    affine[:3, :3] = nearest
    affine[:3, 3] = image.affine_mm[:3, :3] @ half + image.affine_mm[:3, 3] - nearest @ half
    note = f"{skew}): the nearest rectangular frame is used, which moves voxels by at most {moved_mm:.2f} mm."
    return Image(image.voxels, affine, image.modality, (*image.notes, note))


def _resampled(image: Image, skew: str) -> Image:
    """Return the image on a rectangular grid that spans the sheared volume; voxels outside it get the lowest value."""
    from scipy.ndimage import affine_transform

    rotation, upper = np.linalg.qr(image.affine_mm[:3, :3])
    sign = np.where(np.diag(upper) < 0, -1.0, 1.0)
    spacing_mm = np.abs(np.diag(upper))
    edges = rotation * sign * spacing_mm
    last = np.array(image.voxels.shape) - 1
    corners = np.array(np.meshgrid(*[[0, n] for n in last], indexing="ij")).reshape(3, -1)
    places = np.linalg.solve(edges, image.affine_mm[:3, :3] @ corners)  # corners in voxels of the new grid
    low = np.floor(np.round(places.min(axis=1), 6))
    shape = tuple((np.ceil(np.round(places.max(axis=1), 6)) - low).astype(int) + 1)
    to_old = np.linalg.solve(image.affine_mm[:3, :3], edges)
    voxels: NDArray[np.float32] = affine_transform(
        image.voxels.astype(np.float32), to_old, to_old @ low, shape, order=3, cval=float(image.voxels.min())
    )
    affine = np.eye(4)
    affine[:3, :3] = edges
    affine[:3, 3] = image.affine_mm[:3, 3] + edges @ low
    note = (
        f"{skew}, gantry tilt?): the voxels were resampled on a rectangular grid of "
        f"{' x '.join(f'{v:.3g}' for v in spacing_mm)} mm."
    )
    return Image(voxels, affine, image.modality, (*image.notes, note))
