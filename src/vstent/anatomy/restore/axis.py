"""Fit the axis of the parent artery: a smooth tube through the wall that is neither sac nor branch.

The centerline of the lumen bulges into a sac, but the wall opposite the neck does not. From a first guess of the axis,
rays in every section measure the distance to the wall, rho(s, theta). The center of a section is the center of the oval
fitted to the rays that hit neither sac nor branch. Where a neck leaves few such rays, smoothness along the artery
decides. Casting rays, weighting them and fitting alternate, with weights that become stricter.

The sections are ovals because circles fail in flattened arteries: with circles, the axis of an artery 1.4 times as wide
as high runs to one side, and its sac is lost.
"""

from collections.abc import Sequence
from itertools import product
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.sparse import bmat, csc_matrix, diags
from scipy.sparse.linalg import spsolve

from vstent.anatomy.trace import parent_radius_mm
from vstent.errors import VesselError
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Centerline
from vstent.kernels import curves
from vstent.kernels.arrays import Bools, Floats
from vstent.units import place

STEP_MM: Final = 0.25
"""Spacing of the axis points in mm."""
N_RAYS: Final = 48
"""Number of rays in a section."""
WAVELENGTH: Final = 1.5
"""Shortest wavelength of axis and radius along the artery, in diameters, where the wall is complete."""
FLARE_LENGTH: Final = 1.5
"""Largest length over which the artery flares into a neck, in artery radii."""
FAR_SIDE: Final = -0.2
"""A ray points to the wall opposite the neck if the cosine of its angle to the sac's direction is below this."""
INTO: Final = 0.5
"""Height above the middle of a neck's foot, in artery radii, of the point that gives the direction of the sac. The
middle of the foot may lie on the artery's axis and give none."""
SIDE_TRUST: Final = 0.1
"""Weight of the centerline across the direction into a neck, as a fraction of the weight of all rays of a section."""
NECK_TRUST: Final = 10.0
"""Weight of the interpolated oval under a neck, relative to all rays of a section."""
THROAT: Final = 0.85
"""An artery is stenosed beside a neck where it is narrower by this factor than farther away on both sides."""
THROAT_REACH: Final = 2.0
"""Length on each side of a neck, in diameters, over which the width without the stenosis is sought."""
THROAT_TRUST: Final = 1.0
"""Weight of the interpolated oval beside a stenosis, relative to all rays of a section. The artery regains its width
under the neck, so the opposite wall must decide."""
OVAL_WAVES: Final = 4.0
"""Shortest wavelength of the oval part, in multiples of `WAVELENGTH`: a fork widens a section in one direction too."""
OVAL_MOST: Final = 0.4
"""Largest deviation of a section's radius from its mean, as a fraction of the mean. At 0.4 it is 2.3 times as wide as
high."""
ROUND_TRUST: Final = 0.02
"""Weight of a circle, relative to all rays of a section: sections with few rays become round."""
TOLERANCE: Final = ((0.40, 1.00),) * 4 + ((0.20, 0.50),) * 4 + ((0.12, 0.35),) * 4
"""Per iteration, the relative excess of a ray over the oval up to which it counts fully and from which it is
ignored."""

ASTRAY: Final = 2.0
"""The fit is rejected where the axis is farther from the centerline than this many times the largest inscribed radius.
In real arteries this ratio stays below 0.3."""


class Tube(NamedTuple):
    """A tube with oval sections."""

    points_mm: Floats
    """(n, 3) points of the axis."""
    oval_mm: Floats
    """(n, 3) mean radius, and the amplitudes of the cosine and the sine of twice the angle."""

    @property
    def radius_mm(self) -> Floats:
        """(n,) mean radius in mm."""
        return self.oval_mm[:, 0]

    def rho_mm(self, n_rays: int) -> Floats:
        """Return the distance (n, n_rays) from axis to wall, in mm, at the angles of `section_directions`."""
        return self.oval_mm @ _waves(n_rays)[[0, 3, 4]]


class Mouth(NamedTuple):
    """Mouth of a sac on the artery."""

    foot_mm: Floats
    """(k, 3) points where the sac's wall rises from the artery."""
    inward: Floats
    """(3,) unit vector into the sac."""


def fit_axis(lumen: Surface, line: Centerline, mouths: Sequence[Mouth] = ()) -> Tube:
    """Fit axis and radius of the artery along a centerline, ignoring sacs and branches."""
    points = curves.resample(line.points_mm, STEP_MM)
    abscissa = curves.arc_length(points)
    parent = parent_radius_mm(line.abscissa_mm, line.inscribed_radius_mm)
    radius = np.interp(abscissa / abscissa[-1], line.abscissa_mm / line.length_mm, parent)
    tube = Tube(points, radius[:, None] * [1.0, 0.0, 0.0])
    for full, none in TOLERANCE:
        necks = _across_necks(tube, mouths)
        rho = section_rays(lumen, tube.points_mm, N_RAYS)
        excess = rho / necks.tube.rho_mm(N_RAYS) - 1.0
        weight = np.clip((none - excess) / (none - full), 0.0, 1.0)
        weight = np.where(necks.is_sacward, 0.0, weight)
        tube = _fit(np.where(weight > 0, rho, 0.0), weight, necks, line.points_mm)
        away_mm = np.linalg.norm(_toward(line.points_mm, tube.points_mm), axis=1)
        worst = int(np.argmax(away_mm))
        if away_mm[worst] > ASTRAY * line.inscribed_radius_mm.max():
            raise VesselError(
                f"no artery fits the wall: its axis would run {away_mm[worst]:.0f} mm from the centerline, to "
                f"{place(tube.points_mm[worst])}: give a longer piece of the vessel, or one with a complete wall"
            )
    return tube


class _Necks(NamedTuple):
    """All necks on an artery, as they enter the fit."""

    tube: Tube
    """The artery with its ovals interpolated across necks."""
    trust: Floats
    """(n,) weight of these ovals, in rays."""
    is_sacward: Bools
    """(n, rays) whether a ray points into a neck; such rays are ignored."""
    across: Floats
    """(n, 2) unit vector in the section, along its two normals, perpendicular to the sac's direction; zero off
    necks."""


def _across_necks(tube: Tube, mouths: Sequence[Mouth]) -> _Necks:
    """Return the necks of all mouths, with the artery interpolated across them from its healthy sections."""
    n = len(tube.points_mm)
    healthy, sacward, across = np.ones(n, dtype=bool), np.zeros((n, N_RAYS), dtype=bool), np.zeros((n, 2))
    necks = []
    for mouth in mouths:
        if neck := _neck(tube, mouth):
            is_under, diameter_mm, is_sacward, square = neck
            necks.append((is_under, diameter_mm))
            healthy &= ~is_under
            sacward |= is_sacward
            across = np.where(square.any(axis=1, keepdims=True), square, across)
    if not healthy.any():
        return _Necks(tube, np.zeros(n), sacward, across)
    trust, telling = np.where(healthy, 0.0, NECK_TRUST * N_RAYS), healthy
    for is_under, diameter_mm in necks:
        throat = _throat_beside(tube, is_under, diameter_mm, healthy)
        telling = telling & ~throat
        trust = np.where(is_under & throat.any(), THROAT_TRUST * N_RAYS, trust)
    abscissa = curves.arc_length(tube.points_mm)
    between = curves.interpolate(abscissa[telling], tube.oval_mm[telling], abscissa)
    oval = np.where(healthy[:, None], tube.oval_mm, between)
    return _Necks(Tube(tube.points_mm, oval), trust, sacward, across)


def _neck(tube: Tube, mouth: Mouth) -> tuple[Bools, float, Bools, Floats] | None:
    """Return sections (n,) under a mouth, their diameter, rays into it and directions across it; None off the tube."""
    (points, radius), (foot_mm, inward) = (tube.points_mm, tube.radius_mm), mouth
    abscissa = curves.arc_length(points)
    place, distance = curves.project(points, foot_mm)
    at_foot = place[distance < 3.0 * np.interp(place, abscissa, radius)]
    if not len(at_foot):
        return None
    typical = float(np.median(np.interp(at_foot, abscissa, radius)))
    flare = FLARE_LENGTH * typical
    under = (abscissa > at_foot.min() - flare) & (abscissa < at_foot.max() + flare)
    into = foot_mm.mean(axis=0) + INTO * typical * inward - points
    to_sac = np.einsum("nrd,nd->nr", section_directions(points, N_RAYS), into)
    reach = to_sac.max(axis=1, keepdims=True)
    beside = under[:, None] & (reach > 0.5 * typical)
    square = np.einsum("nkd,nd->nk", curves.parallel_frames(points)[:, :0:-1], into) * [-1.0, 1.0]
    across = np.where(beside, square / np.maximum(np.linalg.norm(square, axis=1, keepdims=True), 1e-12), 0.0)
    return under, 2.0 * typical, beside & (to_sac > FAR_SIDE * reach), across


def _throat_beside(tube: Tube, is_under: Bools, diameter_mm: float, healthy: Bools) -> Bools:
    """Return whether each section (n,) is in a stenosis beside a neck, and so not healthy."""
    # A tapering artery, or one that is thinner beyond a fork, is not narrower there than on both sides.
    abscissa, (first, last) = curves.arc_length(tube.points_mm), np.flatnonzero(is_under)[[0, -1]]
    reach_mm = THROAT_REACH * diameter_mm
    upstream = healthy & (abscissa < abscissa[first]) & (abscissa > abscissa[first] - reach_mm)
    downstream = healthy & (abscissa > abscissa[last]) & (abscissa < abscissa[last] + reach_mm)
    throat = np.zeros(len(abscissa), dtype=bool)
    if not (upstream.any() and downstream.any()):
        return throat
    width_mm = min(float(tube.radius_mm[upstream].max()), float(tube.radius_mm[downstream].max()))
    for side, edge in ((upstream, -1), (downstream, 0)):
        is_narrow = tube.radius_mm[side] < THROAT * width_mm
        throat[side] = is_narrow & is_narrow[edge]
    return throat


def section_rays(lumen: Surface, points_mm: Floats, n_rays: int) -> Floats:
    """Return the distance (n, rays) from axis points (n, 3) to the wall along the rays of their sections."""
    directions = section_directions(points_mm, n_rays)
    origins = np.repeat(points_mm, n_rays, axis=0)
    return lumen.first_hit(origins, directions.reshape(-1, 3)).reshape(len(points_mm), n_rays)


def section_directions(points_mm: Floats, n_rays: int) -> Floats:
    """Return the unit vectors (n, rays, 3) of the rays around axis points (n, 3)."""
    frames = curves.parallel_frames(points_mm)
    angle = 2 * np.pi * np.arange(n_rays) / n_rays
    return np.cos(angle)[None, :, None] * frames[:, None, 1] + np.sin(angle)[None, :, None] * frames[:, None, 2]


def _toward(line_mm: Floats, points: Floats) -> Floats:
    """Return the vectors (n, 3) from points to their nearest points on a polyline (k, 3)."""
    return curves.interpolate(curves.arc_length(line_mm), line_mm, curves.project(line_mm, points)[0]) - points


def _waves(n_rays: int) -> Floats:
    """Return 1, cos a, sin a, cos 2a and sin 2a (5, n_rays) at the angles a of a section's rays."""
    angle = 2 * np.pi * np.arange(n_rays) / n_rays
    return np.stack([np.ones(n_rays), np.cos(angle), np.sin(angle), np.cos(2 * angle), np.sin(2 * angle)])


def _fit(rho: Floats, weight: Floats, necks: _Necks, medial_mm: Floats) -> Tube:
    """Return the tube after one least-squares fit of rho = r + a cos t + b sin t + c cos 2t + d sin 2t to the rays."""
    # The oval (r, c, d) and the axis, points + a n1 + b n2, are smooth along the artery. Across the direction into a
    # neck it is pulled to the centerline (k, 3): a wide neck leaves a wall along which a circle can roll sideways. The
    # centerline bulges into the sac, but not sideways.
    points, (n, n_rays) = necks.tube.points_mm, rho.shape
    frames = curves.parallel_frames(points)
    basis = _waves(n_rays)
    normal = np.einsum("ik,nk,jk->ijn", basis, weight, basis)
    right = np.einsum("ik,nk,nk->in", basis, weight, rho)
    for i, value in zip((0, 3, 4), necks.tube.oval_mm.T, strict=True):
        normal[i, i] += necks.trust + (ROUND_TRUST * n_rays if i else 0.0)
        right[i] += necks.trust * value
    aside = SIDE_TRUST * n_rays * np.einsum("nk,nkd,nd->n", necks.across, frames[:, 1:], _toward(medial_mm, points))
    right[1:3] += aside * necks.across.T
    normal[1:3, 1:3] += SIDE_TRUST * n_rays * np.einsum("ni,nj->ijn", necks.across, necks.across)
    blocks, bent = _stiffness(necks.tube, frames, n_rays)
    for i, j in product(range(5), repeat=2):
        blocks[i][j] = blocks[i][j] + diags(normal[i, j])
    ridge = 1e-6 * n_rays * diags(np.ones(5 * n))
    solution = spsolve(csc_matrix(bmat(blocks) + ridge), (right - bent).ravel()).reshape(5, n)
    moved = points + solution[1][:, None] * frames[:, 1] + solution[2][:, None] * frames[:, 2]
    evenly = curves.resample_evenly(moved, n)
    radius = np.maximum(solution[0], 0.1)
    most = OVAL_MOST * radius / np.maximum(np.hypot(solution[3], solution[4]), 1e-12)
    # The ovals in the frames of the moved axis.
    first = curves.parallel_frames(evenly)[:, 1]
    along, across = (np.einsum("nd,nd->n", first, frames[:, k]) for k in (1, 2))
    oval = np.minimum(most, 1.0) * solution[3:]
    turned = (oval[0] + 1j * oval[1]) * np.exp(-2j * np.arctan2(across, along))
    return Tube(evenly, np.stack([radius, turned.real, turned.imag], axis=1))


def _stiffness(tube: Tube, frames: Floats, n_rays: int) -> tuple[list[list[Any]], Floats]:
    """Return the stiffness of oval and axis against short waves (5 x 5 sparse blocks), and its present force (5, n)."""
    n = len(tube.points_mm)
    wave = WAVELENGTH * 2.0 * float(np.median(tube.radius_mm)) / (2 * np.pi * STEP_MM)
    radius, axis = n_rays * wave**4 * curves.roughness(n, 2), n_rays / 2 * wave**6 * curves.roughness(n, 3)
    blocks: list[list[Any]] = [[csc_matrix((n, n)) for _ in range(5)] for _ in range(5)]
    bent = np.zeros((5, n))
    for i, times in ((0, 1.0), (3, OVAL_WAVES**4), (4, OVAL_WAVES**4)):
        blocks[i][i] = times * radius
    for i, side in product((1, 2), range(3)):
        across = diags(frames[:, i, side])
        bent[i] += across @ (axis @ tube.points_mm[:, side])
        for j in (1, 2):
            blocks[i][j] = blocks[i][j] + across @ axis @ diags(frames[:, j, side])
    return blocks, bent
