"""Find a bulge of an artery in a volume of voxels: which of two vessels has an aneurysm, before either is traced."""

from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from vstent.geometry.surface import Surface
from vstent.kernels import voxels
from vstent.kernels.arrays import Bools, Floats

MOST_VOXELS: Final = 2_000_000
"""Larger volumes are coarsened: a bulge is many voxels wide."""
SHARES: Final = (0.8, 0.7, 0.6, 0.5)
"""Fractions of the radius of a sphere at which its surroundings are examined."""
COMPACT: Final = 2.4
"""Distance in radii of the sphere to which the surroundings of a bulge reach; those of an artery are longer."""
SHORTEST: Final = 6.0
"""Extent of the shortest vessel, in radii of its widest sphere; what is shorter is a sac alone."""
PEAKS: Final = 4
"""Number of widest places that are examined."""
VOXELS_ACROSS: Final = 10.0
"""Number of voxels across the mean diameter of a surface."""


COMPARABLE: Final = 0.25
"""Smallest size of a piece, as a fraction of the largest, that may be the vessel with the aneurysm."""
BULGING: Final = 1.4
"""Smallest prominence of an aneurysm; those of siphons and forks are below 1.3."""


MOST_PIECES: Final = 4
"""Largest number of pieces that are compared."""


def similar(sizes: NDArray[Any]) -> list[int]:
    """Return the numbers of the largest piece and of those of comparable size, the largest first."""
    largest = np.argsort(-sizes, kind="stable")[:MOST_PIECES]
    return [int(k) for k in largest if sizes[k] > COMPARABLE * sizes[largest[0]]]


def bulging(sizes: NDArray[Any], prominence_of: Callable[[int], float]) -> int:
    """Return the number of the piece to keep: the largest (n,) of those with a bulge, or the largest of all."""
    pieces = similar(sizes)
    with_bulge = (k for k in pieces if len(pieces) > 1 and prominence_of(k) >= BULGING)
    return next(with_bulge, pieces[0])


def prominence(inside: Bools, spacing_mm: Floats) -> float:
    """Measure how clearly the widest bulge of a vessel differs from the artery: 1 for none, 2 for a narrow neck.

    A bulge is an inscribed sphere around which the wall is near on all sides. Its prominence is the ratio of its radius
    to that of the narrowest passage that leads out of it. The sphere of an artery has others of similar radius before
    and behind it.
    """
    stride = max(1, int(np.ceil((inside.size / MOST_VOXELS) ** (1 / 3))))
    inside, spacing_mm = inside[::stride, ::stride, ::stride], spacing_mm * stride
    radius_mm = ndimage.distance_transform_edt(inside, sampling=spacing_mm)
    left, ratio = radius_mm.copy(), 1.0
    extent_mm = np.linalg.norm(np.ptp(np.argwhere(inside), axis=0) * spacing_mm)
    if extent_mm < SHORTEST * left.max():
        return 1.0
    for _ in range(PEAKS):
        peak = np.unravel_index(int(left.argmax()), left.shape)
        widest_mm = float(left[peak])
        for share in SHARES:
            label, _ = ndimage.label(radius_mm > share * widest_mm)
            around = label == label[peak]
            reach_mm = np.linalg.norm((np.argwhere(around) - peak) * spacing_mm, axis=1).max(initial=0.0)
            left[around & (share == SHARES[0])] = 0.0
            if reach_mm > COMPACT * widest_mm:
                break
            ratio = max(ratio, 1 / share)
    return ratio


def prominence_of_surface(surface: Surface) -> float:
    """Measure the `prominence` of the widest bulge inside a surface, whose loops are closed with flat caps."""
    corners_mm, volume_mm3 = surface.closed.corners_mm, surface.closed.volume_mm3
    extent_mm = np.ptp(corners_mm, axis=(0, 1))
    edge_mm = max(4 * abs(volume_mm3) / surface.area_mm2 / VOXELS_ACROSS, (extent_mm.prod() / MOST_VOXELS) ** (1 / 3))
    low = corners_mm.min(axis=(0, 1)) - edge_mm
    shape = np.ceil((corners_mm.max(axis=(0, 1)) + edge_mm - low) / edge_mm).astype(int) + 1
    corners = (corners_mm if volume_mm3 > 0 else corners_mm[:, ::-1]) - low
    inside = voxels.fill(corners / edge_mm, (int(shape[0]), int(shape[1]), int(shape[2])))
    return prominence(inside, np.full(3, edge_mm)) if inside.any() else 0.0
