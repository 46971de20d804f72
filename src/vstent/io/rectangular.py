"""Make image axes perpendicular: a small shear is removed from the frame, a large one by resampling."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from vstent.geometry.image import Image
from vstent.kernels.arrays import Floats

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
    nearest = _nearest_rotation(edges / spacing_mm)
    moved_mm = _largest_displacement_mm(edges - nearest * spacing_mm, image.voxels.shape)
    if moved_mm < NEGLIGIBLE_MM * min(1.0, float(spacing_mm.min())):
        return image
    angle_deg = _worst_angle_deg(edges / spacing_mm)
    if moved_mm <= SMALL_VOXELS * float(spacing_mm.min()):
        return _turned(image, nearest * spacing_mm, angle_deg, moved_mm)
    return _resampled(image, angle_deg)


def _nearest_rotation(directions: Floats) -> Floats:
    """Return the orthonormal matrix (3, 3) nearest to a matrix of unit columns, with the same handedness."""
    left, _, right = np.linalg.svd(directions)
    return np.asarray(left @ right)


def _largest_displacement_mm(change_mm: Floats, shape: tuple[int, ...]) -> float:
    """Return the displacement of the farthest corner where the voxel edges (3, 3) change and the center is fixed."""
    half = 0.5 * (np.array(shape, dtype=np.float64) - 1)
    corners = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1) * half[:, None]
    return float(np.linalg.norm(change_mm @ corners, axis=0).max())


def _worst_angle_deg(directions: Floats) -> float:
    """Return the largest deviation of two axes from a right angle, in degrees."""
    cosine = np.abs(np.triu(directions.T @ directions, k=1)).max()
    return float(np.degrees(np.arcsin(min(cosine, 1.0))))


def _centered(edges: Floats, image: Image) -> Floats:
    """Return the affine with other voxel edges (3, 3) that keeps the center of the volume."""
    half = 0.5 * (np.array(image.voxels.shape) - 1)
    affine = np.eye(4)
    affine[:3, :3] = edges
    affine[:3, 3] = image.affine_mm[:3, :3] @ half + image.affine_mm[:3, 3] - edges @ half
    return affine


def _turned(image: Image, edges: Floats, angle_deg: float, moved_mm: float) -> Image:
    """Return an image with a rectangular frame and a note on it."""
    note = (
        f"The image axes are not perpendicular (off by {angle_deg:.1f} degrees): the nearest rectangular frame is "
        f"used, which moves voxels by at most {moved_mm:.2f} mm."
    )
    return Image(image.voxels, _centered(edges, image), image.modality, (*image.notes, note))


def _resampled(image: Image, angle_deg: float) -> Image:
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
        f"The image axes are not perpendicular (off by {angle_deg:.1f} degrees, gantry tilt?): the voxels were "
        f"resampled on a rectangular grid of {' x '.join(f'{v:.3g}' for v in spacing_mm)} mm."
    )
    return Image(voxels, affine, image.modality, (*image.notes, note))
