"""The contour of a device: rows of nodes, the planes across the parent axis that hold them, and plane coordinates."""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.ndimage import gaussian_filter1d

from vstent.geometry.vessel import Centerline
from vstent.kernels import curves
from vstent.kernels.arrays import Floats, freeze

STEP_MM = 0.1
"""Distance between samples of the axis at which planes are computed, in mm."""
CROSSING_MARGIN = 0.8
"""Largest product of the planes' turn per length and the wall's radius, without unit.

Neighbouring planes then meet no nearer to the axis than the radius divided by this value.
"""
MAX_SMOOTHINGS = 12
"""Largest number of times that plane normals are smoothed."""


@dataclass(frozen=True, eq=False)
class Planes:
    """Planes across the parent axis that do not cross inside the lumen, with in-plane axes that do not twist."""

    abscissa_mm: Floats
    """(k,) arc lengths of the samples, in mm."""
    centers_mm: Floats
    """(k, 3) points of the axis, in mm."""
    frames: Floats
    """(k, 3, 3) right-handed unit vectors in rows: the plane normal and two axes in the plane."""

    def __post_init__(self) -> None:
        freeze(self, "abscissa_mm", np.float64, (-1,))
        freeze(self, "centers_mm", np.float64, (len(self.abscissa_mm), 3))
        freeze(self, "frames", np.float64, (len(self.abscissa_mm), 3, 3))

    @cached_property
    def curvature_per_mm(self) -> Floats:
        """(k,) angle by which the normals turn per length, in rad per mm."""
        return np.linalg.norm(np.gradient(self.frames[:, 0], self.abscissa_mm, axis=0), axis=1)

    def middle(self, abscissa_mm: Floats) -> Floats:
        """Return centers (n, 3), in mm, at arc lengths (n,), in mm."""
        return curves.interpolate(self.abscissa_mm, self.centers_mm, abscissa_mm)

    def at(self, abscissa_mm: Floats) -> tuple[Floats, Floats]:
        """Return centers (n, 3), in mm, and frames (n, 3, 3) at arc lengths (n,), in mm."""
        flat = np.concatenate([self.frames[:, 0], self.frames[:, 1]], axis=1)
        found = curves.interpolate(self.abscissa_mm, flat, abscissa_mm)
        normal = found[:, :3] / np.linalg.norm(found[:, :3], axis=1, keepdims=True)
        first = found[:, 3:] - np.einsum("ij,ij->i", found[:, 3:], normal)[:, None] * normal
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        return self.middle(abscissa_mm), np.stack([normal, first, np.cross(normal, first)], axis=1)

    def place(self, abscissa_mm: Floats, in_plane_mm: Floats) -> Floats:
        """Return points (n, m, 3), in mm, from plane coordinates (n, m, 2), in mm, at arc lengths (n,), in mm."""
        centers_mm, frames = self.at(abscissa_mm)
        return centers_mm[:, None] + in_plane_mm @ frames[:, 1:]

    def coordinates(self, abscissa_mm: Floats, points_mm: Floats) -> Floats:
        """Return plane coordinates (n, m, 2), in mm, of points (n, m, 3), in mm, at arc lengths (n,), in mm."""
        centers_mm, frames = self.at(abscissa_mm)
        return (points_mm - centers_mm[:, None]) @ frames[:, 1:].transpose(0, 2, 1)


@lru_cache(maxsize=8)
def planes(axis: Centerline) -> Planes:
    """Compute planes across an axis that do not cross inside the lumen.

    The plane normals are the tangents of the axis, smoothed along it just enough for neighbouring planes to meet
    outside the wall. In a bend sharper than the artery's radius, true cross-sections would intersect inside the lumen.
    """
    n = max(8, round(axis.length_mm / STEP_MM) + 1)
    abscissa_mm = np.linspace(0.0, axis.length_mm, n)
    centers_mm = axis.at(abscissa_mm)
    radius_mm = np.interp(abscissa_mm, axis.abscissa_mm, axis.inscribed_radius_mm)
    normals = curves.tangents(_smooth(centers_mm, 0.25 * radius_mm.mean() / STEP_MM))
    sigma_mm = 0.25 * float(radius_mm.mean())
    for _ in range(MAX_SMOOTHINGS):
        turn_per_mm = np.linalg.norm(np.gradient(normals, abscissa_mm, axis=0), axis=1)
        if np.all(turn_per_mm * radius_mm < CROSSING_MARGIN):
            break
        normals = _smooth(normals, sigma_mm / STEP_MM)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        sigma_mm *= 1.4
    return Planes(abscissa_mm, centers_mm, untwisted(normals, centers_mm.mean(axis=0) - centers_mm[0]))


def _smooth(values: Floats, sigma: float) -> Floats:
    """Return the Gaussian mean along the first axis; values are continued by point reflection, so lines stay lines."""
    pad = min(len(values) - 1, int(4 * sigma) + 1)
    before = 2 * values[0] - values[pad:0:-1]
    after = 2 * values[-1] - values[-2 : -pad - 2 : -1]
    return gaussian_filter1d(np.concatenate([before, values, after]), sigma, axis=0)[pad : pad + len(values)]


def untwisted(normals: Floats, start: Floats) -> Floats:
    """Return frames (n, 3, 3) that do not twist, their first in-plane axis starting along `start`."""
    # Starting along a direction of the artery makes the frames turn with it when the artery is rotated.
    frames = np.zeros((len(normals), 3, 3))
    first = start - (start @ normals[0]) * normals[0]
    if np.linalg.norm(first) < 1e-6 * np.linalg.norm(start):
        first = curves.any_perpendicular(normals[0])
    for i, normal in enumerate(normals):
        first = first - (first @ normal) * normal
        first = first / np.sqrt(first @ first)
        frames[i, 0], frames[i, 1] = normal, first
    frames[:, 2] = np.cross(frames[:, 0], frames[:, 1])
    return frames


def circles(radius_mm: Floats, columns: int) -> Floats:
    """Return plane coordinates (n, columns, 2), in mm, of nodes on circles of radii (n,), in mm, counter-clockwise."""
    angle = 2 * np.pi * np.arange(columns) / columns
    return radius_mm[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def perimeters(nodes: Floats) -> Floats:
    """Compute the lengths (n,) of closed rows of nodes (n, m, d) as smooth curves.

    An arc is longer than its chord by 8/3 h^2 / chord, with h its height. Four nodes in a row give h. A factor corrects
    the remaining error of this formula for a circle.
    """
    m = nodes.shape[1]
    length = curves.closed_lengths(nodes)
    half = np.pi / m
    circle = 2 * np.sin(half) + (np.cos(half) - np.cos(3 * half)) ** 2 / (48 * np.sin(half))
    return length * 2 * half / circle


def evenly_spaced(nodes: Floats) -> Floats:
    """Slide the nodes (n, m, d) of every closed row along it until their distances are equal.

    Each row is turned as little as possible and keeps its length.
    """
    n, m = nodes.shape[:2]
    closed = np.concatenate([nodes, nodes[:, :1]], axis=1)
    arc = np.zeros((n, m + 1))
    np.cumsum(curves.lengths(np.diff(closed, axis=1)), axis=1, out=arc[:, 1:])
    arc *= m / arc[:, -1:]
    wanted = (np.arange(m) + (arc[:, :m] - np.arange(m)).mean(axis=1, keepdims=True)) % m
    row = np.arange(n)[:, None]
    apart = (m + 1.0) * row  # all rows one after another on one line, so that one search finds all nodes
    left = np.searchsorted((arc + apart).ravel(), (wanted + apart).ravel(), side="right").reshape(n, m)
    left = np.clip(left - 1 - (m + 1) * row, 0, m - 1)
    share = ((wanted - arc[row, left]) / (arc[row, left + 1] - arc[row, left]))[..., None]
    result = (1 - share) * closed[row, left] + share * closed[row, left + 1]
    # Nodes slide along chords and cut corners, so the length of the row is restored.
    middle = result.mean(axis=1, keepdims=True)
    return middle + (perimeters(nodes) / perimeters(result))[:, None, None] * (result - middle)


def normals(nodes_mm: Floats) -> Floats:
    """Return outward unit normals (rows, columns, 3) of a contour (rows, columns, 3) by central differences."""
    along = np.gradient(nodes_mm, axis=0)
    around = np.roll(nodes_mm, -1, axis=1) - np.roll(nodes_mm, 1, axis=1)
    normal = np.cross(around, along)
    return normal / np.maximum(curves.lengths(normal), 1e-300)[..., None]


def bilinear(grid_values: Floats, row: Floats, column: Floats) -> Floats:
    """Return bilinear values (..., d) of a grid (n, m, d), periodic in columns, extrapolated linearly beyond rows."""
    n, m = grid_values.shape[:2]
    i = np.clip(np.floor(row).astype(int), 0, n - 2)
    j = np.floor(column).astype(int)
    down, right = (row - i)[..., None], (column - j)[..., None]
    j, beyond = j % m, (j + 1) % m
    above = (1 - right) * grid_values[i, j] + right * grid_values[i, beyond]
    below = (1 - right) * grid_values[i + 1, j] + right * grid_values[i + 1, beyond]
    return (1 - down) * above + down * below
