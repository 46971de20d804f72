"""Build the landing surface: the patient's own wall, closed across necks and the ostia of side branches.

In sections along the parent axis the wall is a function rho(s, theta). A smooth baseline of the wall is found by
asymmetric least squares (Eilers and Boelens 2005): wall outside the baseline, such as a sac or a branch, loses its
weight. Where the wall is outside the baseline, and in a margin around, it is replaced by the smoothest surface through
the surrounding wall (a thin plate on the (s, theta) grid). Elsewhere the wall is kept.
"""

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Final

import numpy as np
from scipy.linalg import solveh_banded
from scipy.ndimage import binary_dilation, binary_propagation, map_coordinates
from scipy.sparse import csc_matrix, diags, eye, kron, triu
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from vstent.anatomy.restore.axis import STEP_MM, Tube, section_directions, section_rays
from vstent.devices.stent import tube_faces
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Centerline
from vstent.kernels import curves
from vstent.kernels.arrays import Bools, Floats, Ints, freeze

N_RAYS: Final = 72
"""Vertices in a ring of the landing surface: one every 5 degrees."""
OUT: Final = 0.20
"""Wall that is outside the baseline by this fraction of the radius is sac or branch."""
FLARE: Final = 0.06
"""Connected wall that is outside the baseline by this fraction of the radius is the flare of a mouth, and is replaced
too."""
MARGIN_MM: Final = 0.3
"""Margin in mm around the replaced wall that is replaced too."""
PRIOR: Final = 0.02
"""Weight of the fitted tube relative to the wall's weight of 1; it decides where there is no wall."""
SAME_MM: Final = 1e-3
"""Two hits of a ray closer than this, in mm, are on the same wall."""
N_PASSES: Final = 12
"""Number of passes of asymmetric least squares; the weights converge within 10."""


@dataclass(frozen=True, eq=False)
class Landing:
    """Landing surface on a grid of sections and angles."""

    points_mm: Floats
    """(n, 3) axis of the parent artery."""
    rho_mm: Floats
    """(n, rays) distance from the axis to the landing surface."""
    is_restored: Bools
    """(n, rays) whether the surface closes a neck or an ostium there."""

    def __post_init__(self) -> None:
        freeze(self, "points_mm", np.float64, (-1, 3))
        freeze(self, "rho_mm", np.float64, (len(self.points_mm), -1))
        freeze(self, "is_restored", np.bool_, self.rho_mm.shape)

    @cached_property
    def surface(self) -> Surface:
        """Landing surface as an open tube, one ring of vertices per axis point."""
        rings = self.points_mm[:, None] + self.rho_mm[..., None] * section_directions(self.points_mm, self.n_rays)
        return Surface(rings.reshape(-1, 3), tube_faces(*self.rho_mm.shape))

    @property
    def n_rays(self) -> int:
        """Number of vertices in a ring."""
        return int(self.rho_mm.shape[1])

    @cached_property
    def section_radius_mm(self) -> Floats:
        """(n,) radius of the circle with the area of the section."""
        return np.sqrt((self.rho_mm**2).mean(axis=1))

    @cached_property
    def axis(self) -> Centerline:
        """Parent axis, with the distance to the landing surface as radius."""
        return Centerline(self.points_mm, self.surface.closest(self.points_mm)[1])

    @cached_property
    def frames(self) -> Floats:
        """(n, 3, 3) frames in which the angles are counted."""
        return curves.parallel_frames(self.points_mm)

    def grid_of(self, points_mm: Floats) -> Floats:
        """Return the fractional grid position (k, 2), section and ray, of points (k, 3) in mm."""
        abscissa = curves.arc_length(self.points_mm)
        s = curves.project(self.points_mm, points_mm)[0]
        section = np.interp(s, abscissa, np.arange(len(abscissa)))
        nearest = np.round(section).astype(int)
        offset = points_mm - curves.interpolate(abscissa, self.points_mm, s)
        local = np.einsum("kij,kj->ki", self.frames[nearest], offset)
        ray = np.mod(np.arctan2(local[:, 2], local[:, 1]), 2 * np.pi) * self.n_rays / (2 * np.pi)
        return np.stack([section, ray], axis=1)

    def nearest_sections(self, points_mm: Floats) -> Ints:
        """Return the index (k,) of the section nearest to each of the points (k, 3), in mm."""
        return np.asarray(cKDTree(self.points_mm).query(points_mm)[1])

    def at_grid(self, grid: Floats) -> Floats:
        """Return the points (k, 3) of the landing surface at fractional grid positions (k, 2), bilinear."""
        wrapped = np.concatenate([self.surface.vertices_mm.reshape(*self.rho_mm.shape, 3)] * 2, axis=1)
        place = [np.clip(grid[:, 0], 0, len(self.points_mm) - 1), np.mod(grid[:, 1], self.n_rays)]
        return np.stack([map_coordinates(wrapped[..., k], place, order=1) for k in range(3)], axis=1)


def close_landing(lumen: Surface, tube: Tube, own: Surface | None = None) -> Landing:
    """Close the necks and ostia of the lumen's wall along a tube."""
    rho = section_rays(lumen, tube.points_mm, N_RAYS)
    radius = np.repeat(tube.radius_mm[:, None], N_RAYS, axis=1)
    # The plate is as stiff against an oval as against other waves around the section, so the oval is subtracted first.
    oval = tube.rho_mm(N_RAYS) - radius
    has_wall = np.isfinite(rho) & (rho < 4.0 * radius)
    if own is not None:
        has_wall &= section_rays(own, tube.points_mm, N_RAYS) < rho + SAME_MM
    wall = np.where(has_wall, rho - oval, radius)
    scale = float(np.median(tube.radius_mm))
    baseline = _baseline(wall, has_wall, radius, scale)
    out = (wall - baseline) / radius
    # Three copies side by side connect patches across the seam of the ring.
    thrice = partial(np.tile, reps=(1, 3))
    is_out = binary_propagation(thrice(out > OUT), mask=thrice(~has_wall | (out > FLARE))) | thrice(~has_wall)
    along, around = (max(1, round(MARGIN_MM / step_mm)) for step_mm in (STEP_MM, 2 * np.pi * scale / N_RAYS))
    margin = np.ones((2 * along + 1, 2 * around + 1), dtype=bool)
    restored = np.asarray(binary_dilation(is_out, margin)[:, N_RAYS : 2 * N_RAYS])
    return Landing(tube.points_mm, oval + _closed(wall, restored, baseline, scale), restored)


def _baseline(wall: Floats, has_wall: Bools, radius: Floats, scale_mm: float) -> Floats:
    """Return a smooth surface (n, rays) under the wall, by asymmetric least squares."""
    # The baseline has no waves shorter than three radii, so half the grid resolves it at an eighth of the run time.
    fine, wall, has_wall, radius = wall, wall[::2, ::2], has_wall[::2, ::2], radius[::2, ::2]
    stiffness = _thin_plate(wall.shape[0], wall.shape[1], scale_mm / (2 * STEP_MM))
    baseline, bandwidth = radius, 2 * wall.shape[1]
    for _ in range(N_PASSES):
        out = (wall - baseline) / radius
        weight = np.where(has_wall, 1.0 / (1.0 + np.maximum(out / FLARE, 0.0) ** 4), 0.0)
        system = diags((weight + PRIOR).ravel()) + stiffness
        upper = triu(system)
        band = np.zeros((bandwidth + 1, wall.size))
        band[bandwidth + upper.row - upper.col, upper.col] = upper.data
        right = (weight * wall + PRIOR * radius).ravel()
        baseline = solveh_banded(band, right, check_finite=False).reshape(wall.shape)
    grid = np.meshgrid(np.arange(fine.shape[0]) / 2, np.arange(fine.shape[1]) / 2, indexing="ij")
    wrapped = np.concatenate([baseline, baseline[:, :1]], axis=1)
    return np.asarray(map_coordinates(wrapped, grid, order=1, mode="nearest"))


def _closed(wall: Floats, restored: Bools, baseline: Floats, scale_mm: float) -> Floats:
    """Return the wall with its restored part replaced by the smoothest surface near the baseline."""
    unknown = np.flatnonzero(restored)
    if not len(unknown):
        return wall
    system = csc_matrix(PRIOR * eye(wall.size) + _thin_plate(wall.shape[0], wall.shape[1], scale_mm / STEP_MM))[unknown]
    known = np.where(restored, 0.0, wall).ravel()
    right = PRIOR * baseline.ravel()[unknown] - system @ known
    closed = wall.copy()
    closed[restored] = spsolve(csc_matrix(system[:, unknown]), right)
    return closed


def _thin_plate(n: int, n_rays: int, radius_steps: float) -> csc_matrix:
    """Return the stiffness of a thin plate against waves below 3 radii along and a third of a turn around."""
    ring = eye(n_rays, format="csc")
    turn = 2.0 * ring - csc_matrix(np.roll(np.eye(n_rays), 1, axis=0) + np.roll(np.eye(n_rays), -1, axis=0))
    along = (3.0 * radius_steps / (2 * np.pi)) ** 2
    round_ = (n_rays / (2 * np.pi * 3.0)) ** 2
    plate = along**2 * kron(curves.roughness(n, 2), ring) + round_**2 * kron(eye(n), turn @ turn)
    return csc_matrix(plate + 2.0 * along * round_ * kron(curves.roughness(n, 1), turn))
