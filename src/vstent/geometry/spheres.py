"""Maximum inscribed spheres against the smooth wall of which a mesh is a sample.

A triangle is a chord: it lies inside a convex wall by the square of its edge, and a sphere that touches it is narrower
than the artery by as much. Here a wall is curved over every triangle as its corners' normals tell, a quadratic, and the
centre of a sphere is moved to where the largest one in its section is.
"""

from typing import Final

import numpy as np

from vstent.geometry.surface import Surface
from vstent.kernels import curves, triangles
from vstent.kernels.arrays import Floats, Ints
from vstent.kernels.medial import widest_in_section

N_RAYS: Final = 24
"""Directions in which the wall is sought around a centre."""
NEAR: Final = 0.01
"""Centres are moved by a few of so many radii at most; in a sac's mouth, where the largest sphere is the sac's, not."""
GAIN: Final = 0.5
"""A sphere grows by at least this fraction of the way that its centre is moved: a flat section has many spheres
that are about as large, and the path is left where it is among them."""
OPEN: Final = 0.15
"""A section is a fork's, and says less of its middle, where its wall is further away than the nearest by more than this
fraction on average."""
STRIDE: Final = 2
"""The movement of every so manieth point is computed, and interpolated between them."""
SMOOTHED_DIAMETERS: Final = 0.25
"""Waves of the movement shorter than this many local diameters are left out."""


def centered(wall: Surface, path_mm: Floats, radius_mm: Floats) -> Floats:
    """Move the points of a smooth path (n, 3) to the centres of the largest spheres in its sections; its ends stay.

    Parameters
    ----------
    wall : the lumen's wall.
    path_mm : (n, 3) evenly spaced points near the medial axis.
    radius_mm : (n,) radii of the inscribed spheres there, about.
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
    """Way (n, 3) from the points of a path to the centres of the largest spheres in its sections, if it is short.

    The wall is taken as its tangent planes where rays of the section meet it.
    """
    frames = curves.parallel_frames(path_mm)
    angle = 2 * np.pi * np.arange(N_RAYS) / N_RAYS
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rays = (circle @ frames[:, 1:]).reshape(-1, 3)
    origins = np.repeat(path_mm, N_RAYS, axis=0)
    distance, face = wall.first_hits(origins, rays)
    along = np.where(np.isfinite(distance), distance, 0.0)
    height, normal = _bulge(wall, origins + along[:, None] * rays, face)
    plane = np.where(np.isfinite(distance), along * np.einsum("ij,ij->i", normal, rays) + height, np.inf)
    slope = np.einsum("nrd,nkd->nrk", normal.reshape(-1, N_RAYS, 3), frames[:, 1:])
    ring = plane.reshape(-1, N_RAYS)
    shift = widest_in_section(ring, slope, GAIN, NEAR * radius_mm)
    size = np.linalg.norm(shift, axis=1) / (NEAR * radius_mm)
    shift *= (_trust(ring) / (1.0 + size**2))[:, None]
    return np.asarray(np.einsum("nk,nkd->nd", shift, frames[:, 1:]))


def _trust(ring_mm: Floats) -> Floats:
    """Trust (n,) in the middle of a section whose wall is so far away (n, rays): 1 where it is round, 0 in a fork."""
    nearest = np.nan_to_num(np.maximum(ring_mm.min(axis=1, keepdims=True), 1e-300), posinf=1e-300)
    excess = np.clip(ring_mm / nearest, 1.0, 3.0).mean(axis=1) - 1.0
    return np.asarray(1.0 / (1.0 + (excess / OPEN) ** 4))


def _bulge(wall: Surface, points_mm: Floats, face: Ints) -> tuple[Floats, Floats]:
    """How far the smooth wall lies outside of points (n, 3) of its faces (n,), and its unit normals (n, 3) there."""
    corners, normal = wall.corners_mm[face], wall.smooth_normals[face]
    weight = triangles.barycentric(corners, points_mm)
    height = 0.5 * (weight * np.roll(weight, -1, axis=1) * triangles.edge_rises(corners, normal)).sum(axis=1)
    there = np.einsum("fk,fkd->fd", weight, normal)
    return height, there / np.maximum(np.linalg.norm(there, axis=1, keepdims=True), 1e-300)
