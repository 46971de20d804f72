"""Move the points of a path to the centers of maximum inscribed spheres of a smooth wall sampled by a mesh.

A triangle is a chord of the wall. On a convex wall it lies inside by an amount that grows with the square of its edge
length, so a sphere that touches it is too small. Here the wall over every triangle is curved according to the normals
at its corners (a quadratic patch), and the center of a sphere is moved to that of the largest sphere in its section.
"""

from typing import Final

import numpy as np

from vstent.geometry.surface import Surface
from vstent.kernels import curves, triangles
from vstent.kernels.arrays import Floats
from vstent.kernels.medial import widest_in_section

N_RAYS: Final = 24
"""Number of directions in which the wall is sought around a center."""
NEAR: Final = 0.01
"""Scale of the movement of a center, in radii. A center moves a few of these at most, and longer movements are damped:
in the mouth of a sac the largest sphere is that of the sac."""
GAIN: Final = 0.5
"""Smallest growth of a sphere per distance that its center moves. In a flat section many spheres are nearly as large,
and the path is kept."""
OPEN: Final = 0.15
"""Mean excess of the wall's distance over the nearest distance, as a fraction, above which a section is that of a fork
and its center is less reliable."""
STRIDE: Final = 2
"""The movement is computed at every n-th point and interpolated between."""
SMOOTHED_DIAMETERS: Final = 0.25
"""Longest wavelength that is smoothed out of the movement, in local diameters."""


def centered(wall: Surface, path_mm: Floats, radius_mm: Floats) -> Floats:
    """Move the points (n, 3) of a smooth path to the centers of the largest spheres in its sections; its ends stay.

    The points are evenly spaced near the medial axis, and the radii (n,) of the inscribed spheres there approximate.
    """
    step_mm = curves.arc_length(path_mm)[-1] / (len(path_mm) - 1)
    waves = 2.0 * radius_mm * SMOOTHED_DIAMETERS / (2 * np.pi * step_mm)
    is_held = np.ones(len(path_mm))
    is_held[[0, -1]] = 1e6
    every = np.arange(float(len(path_mm)))
    place = np.union1d(every[::STRIDE], every[-1:])
    some = place.astype(np.int32)
    move_mm = curves.interpolate(place, _to_widest(wall, path_mm[some], radius_mm[some]), every)
    move_mm[[0, -1]] = 0.0
    return np.asarray(path_mm + curves.smooth(move_mm, is_held, waves**6, order=3))


def _to_widest(wall: Surface, path_mm: Floats, radius_mm: Floats) -> Floats:
    """Return the vectors (n, 3) from points of a path to the centers of the largest nearby spheres in its sections."""
    frames = curves.parallel_frames(path_mm)
    angle = 2 * np.pi * np.arange(N_RAYS) / N_RAYS
    rays = (np.stack([np.cos(angle), np.sin(angle)], axis=1) @ frames[:, 1:]).reshape(-1, 3)
    origins = np.repeat(path_mm, N_RAYS, axis=0)
    distance, face = wall.first_hits(origins, rays)
    along = np.where(np.isfinite(distance), distance, 0.0)
    # The wall is represented by its tangent planes where the rays of the section meet the smooth wall, at a height
    # above the mesh.
    corners, normals = wall.corners_mm[face], wall.smooth_normals[face]
    weight = triangles.barycentric(corners, origins + along[:, None] * rays)
    height = 0.5 * (weight * np.roll(weight, -1, axis=1) * triangles.edge_rises(corners, normals)).sum(axis=1)
    normal = np.einsum("fk,fkd->fd", weight, normals)
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    plane = np.where(np.isfinite(distance), along * np.einsum("ij,ij->i", normal, rays) + height, np.inf)
    ring = plane.reshape(-1, N_RAYS)
    slope = np.einsum("nrd,nkd->nrk", normal.reshape(-1, N_RAYS, 3), frames[:, 1:])
    shift = widest_in_section(ring, slope, GAIN, NEAR * radius_mm)
    size = np.linalg.norm(shift, axis=1) / (NEAR * radius_mm)
    # The center of a section is reliable where the section is round, not in a fork.
    nearest = np.nan_to_num(np.maximum(ring.min(axis=1, keepdims=True), 1e-300), posinf=1e-300)
    excess = np.clip(ring / nearest, 1.0, 3.0).mean(axis=1) - 1.0
    trust = 1.0 / (1.0 + (excess / OPEN) ** 4)
    shift *= (trust / (1.0 + size**2))[:, None]
    return np.asarray(np.einsum("nk,nkd->nd", shift, frames[:, 1:]))
