"""The parent artery's own axis: a smooth tube fitted to the wall that is not sac or branch.

The medial line bulges into a sac. The wall opposite the neck does not: from a first guess of the axis, rays to the
wall in every section give distances rho(s, theta); the centre of a section is that of the oval through those that are
neither sac nor branch, and where a neck leaves few of them, smoothness along the artery decides. Rays, weights and
fit alternate, the weights tightening. (With circles for ovals the axis of an artery 1.4 times as wide as high runs to
one side of it, and its sac is lost.)
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
"""Spacing of axis points."""
N_RAYS: Final = 48
"""Rays in a section."""
WAVELENGTH: Final = 1.5
"""The axis and its radius follow waves along the artery longer than this many diameters where the wall is whole."""
FLARE_LENGTH: Final = 1.5
"""The artery flares into a neck over at most this many of its radii."""
FAR_SIDE: Final = -0.2
"""A ray looks at the far side of the neck if the cosine of its angle with the sac's direction is below this."""
INTO: Final = 0.5
"""A neck is looked for this many radii above the middle of its foot, which may lie on the artery's axis."""
SIDE_TRUST: Final = 0.1
"""Across the way into a neck the medial line counts as this fraction of all rays of a section."""
NECK_TRUST: Final = 10.0
"""Weight of the interpolated oval across a neck against all rays of a section."""
THROAT: Final = 0.85
"""An artery narrower by this factor beside a neck than further off on both its sides is stenosed there..."""
THROAT_REACH: Final = 2.0
"""... and how wide it is without that is sought over this many diameters."""
THROAT_TRUST: Final = 1.0
"""Weight of the interpolated oval there: the artery regains its width within the neck, the far wall says where."""
OVAL_WAVES: Final = 4.0
"""Ovals follow waves this many times as long: a fork widens a section in one direction too."""
OVAL_MOST: Final = 0.4
"""A section's radius departs from its mean by at most this fraction: it is then 2.3 times as wide as high."""
ROUND_TRUST: Final = 0.02
"""Weight of a circle beside all rays of a section: what few rays leave open is round."""
TOLERANCE: Final = ((0.40, 1.00),) * 4 + ((0.20, 0.50),) * 4 + ((0.12, 0.35),) * 4
"""Per iteration: relative excess of a ray over the oval up to which it counts fully, and from which not at all."""

ASTRAY: Final = 2.0
"""An axis further from the centerline than this many of its widest radii is no artery's: real ones stay within 0.3."""


class Tube(NamedTuple):
    """A tube of oval sections."""

    points_mm: Floats
    """(n, 3) axis."""
    oval_mm: Floats
    """(n, 3) mean radius, and the parts of the radius that go with the cosine and the sine of twice the angle."""

    @property
    def radius_mm(self) -> Floats:
        """(n,) mean radius."""
        return self.oval_mm[:, 0]

    def rho_mm(self, n_rays: int) -> Floats:
        """Distance (n, n_rays) from the axis to the wall, at the angles of `section_rays`."""
        return self.oval_mm @ _waves(n_rays)[[0, 3, 4]]


class Mouth(NamedTuple):
    """Where a sac opens into the artery."""

    foot_mm: Floats
    """(k, 3) where its wall rises from the artery."""
    inward: Floats
    """(3,) unit vector into the sac."""


def fit_axis(lumen: Surface, line: Centerline, mouths: Sequence[Mouth] = ()) -> Tube:
    """Fit the axis and radius of the artery along a centerline, blind to sacs and branches.

    Parameters
    ----------
    lumen : the wall.
    line : where to begin from.
    mouths : of each sac: there the radius is interpolated between the healthy stations on both sides, because the wall
        that is left flares into the neck.

    Raises
    ------
    VesselError
        When the wall is no tube's.
    """
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
        _refuse_astray(tube, line)
    return tube


def _refuse_astray(tube: Tube, line: Centerline) -> None:
    """Refuse a wall through which the axis of a tube runs away from the centerline that it was to follow."""
    away_mm = np.linalg.norm(_toward(line.points_mm, tube.points_mm), axis=1)
    worst = int(np.argmax(away_mm))
    if away_mm[worst] > ASTRAY * line.inscribed_radius_mm.max():
        raise VesselError(
            f"no artery fits the wall: its axis would run {away_mm[worst]:.0f} mm from the centerline, to "
            f"{place(tube.points_mm[worst])}: give a longer piece of the vessel, or one with a complete wall"
        )


class _Necks(NamedTuple):
    tube: Tube
    """The artery, its ovals interpolated across necks."""
    trust: Floats
    """(n,) weight of those ovals, in rays."""
    is_sacward: Bools
    """(n, rays) rays into a neck: only the wall on the far side says where the artery is."""
    across: Floats
    """(n, 2) unit vector in the section, along its two normals, square to the way into the neck; zero off necks."""


class _Neck(NamedTuple):
    is_under: Bools
    """(n,) sections under a neck and its flares."""
    diameter_mm: float
    """The artery's there."""
    is_sacward: Bools
    """(n, rays) rays into it."""
    across: Floats
    """(n, 2) unit vector in the section square to the way into it; zero elsewhere."""


def _across_necks(tube: Tube, mouths: Sequence[Mouth]) -> _Necks:
    """Where the necks are, and what the healthy stations on both sides of them say."""
    n = len(tube.points_mm)
    healthy, sacward, across = np.ones(n, dtype=bool), np.zeros((n, N_RAYS), dtype=bool), np.zeros((n, 2))
    necks = [neck for mouth in mouths if (neck := _neck(tube, mouth))]
    for neck in necks:
        healthy &= ~neck.is_under
        sacward |= neck.is_sacward
        across = np.where(neck.across.any(axis=1, keepdims=True), neck.across, across)
    if not healthy.any():
        return _Necks(tube, np.zeros(n), sacward, across)
    trust, telling = np.where(healthy, 0.0, NECK_TRUST * N_RAYS), healthy
    for neck in necks:
        throat = _throat_beside(tube, neck, healthy)
        telling = telling & ~throat
        trust = np.where(neck.is_under & throat.any(), THROAT_TRUST * N_RAYS, trust)
    abscissa = curves.arc_length(tube.points_mm)
    between = curves.interpolate(abscissa[telling], tube.oval_mm[telling], abscissa)
    oval = np.where(healthy[:, None], tube.oval_mm, between)
    return _Necks(Tube(tube.points_mm, oval), trust, sacward, across)


def _neck(tube: Tube, mouth: Mouth) -> _Neck | None:
    """The neck of a sac on a tube; None where its mouth is not on it."""
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
    return _Neck(under, 2.0 * typical, beside & (to_sac > FAR_SIDE * reach), across)


def _throat_beside(tube: Tube, neck: _Neck, healthy: Bools) -> Bools:
    """Tell the healthy stations (n,) of a stenosis that a neck begins in: no measure of the artery across that neck.

    An artery that tapers, or is thinner behind a fork, is no narrower there than on both sides.
    """
    abscissa, (first, last) = curves.arc_length(tube.points_mm), np.flatnonzero(neck.is_under)[[0, -1]]
    reach_mm = THROAT_REACH * neck.diameter_mm
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
    """Distance (n, n_rays) from axis points (n, 3) to the wall around them; inf where a ray leaves an opening."""
    directions = section_directions(points_mm, n_rays)
    origins = np.repeat(points_mm, n_rays, axis=0)
    return lumen.first_hit(origins, directions.reshape(-1, 3)).reshape(len(points_mm), n_rays)


def section_directions(points_mm: Floats, n_rays: int) -> Floats:
    """Unit vectors (n, n_rays, 3) around each axis point, counter-clockwise about the direction of travel."""
    frames = curves.parallel_frames(points_mm)
    angle = 2 * np.pi * np.arange(n_rays) / n_rays
    return np.cos(angle)[None, :, None] * frames[:, None, 1] + np.sin(angle)[None, :, None] * frames[:, None, 2]


def _toward(line_mm: Floats, points: Floats) -> Floats:
    """Way (n, 3) from points to the nearest ones of a polyline (k, 3)."""
    return curves.interpolate(curves.arc_length(line_mm), line_mm, curves.project(line_mm, points)[0]) - points


def _waves(n_rays: int) -> Floats:
    """Constant, cosine and sine of the angle and of twice the angle (5, n_rays) at the rays of a section."""
    angle = 2 * np.pi * np.arange(n_rays) / n_rays
    return np.stack([np.ones(n_rays), np.cos(angle), np.sin(angle), np.cos(2 * angle), np.sin(2 * angle)])


def _fit(rho: Floats, weight: Floats, necks: _Necks, medial_mm: Floats) -> Tube:
    """One least-squares step: rho = r + a cos + b sin + c cos 2 + d sin 2, with a smooth oval r, c, d.

    The axis points + a n1 + b n2 is smooth too. Across the way into a neck it is drawn to the medial line (k, 3): a
    wall of which a wide neck has left a slope is one along which a circle rolls, and the medial line bulges into the
    sac, but not to its side.
    """
    points, (n, n_rays) = necks.tube.points_mm, rho.shape
    frames = curves.parallel_frames(points)
    normal, right = _equations(rho, weight, necks, frames, medial_mm)
    blocks, bent = _stiffness(necks.tube, frames, n_rays)
    for i, j in product(range(5), repeat=2):
        blocks[i][j] = blocks[i][j] + diags(normal[i, j])
    ridge = 1e-6 * n_rays * diags(np.ones(5 * n))
    solution = spsolve(csc_matrix(bmat(blocks) + ridge), (right - bent).ravel()).reshape(5, n)
    moved = points + solution[1][:, None] * frames[:, 1] + solution[2][:, None] * frames[:, 2]
    evenly = curves.resample_evenly(moved, n)
    return Tube(evenly, _turned(_bounded(solution[[0, 3, 4]].T), frames, curves.parallel_frames(evenly)))


def _equations(rho: Floats, weight: Floats, necks: _Necks, frames: Floats, medial_mm: Floats) -> tuple[Floats, Floats]:
    """Normal equations (5, 5, n) and their right side (5, n): of every section's rays, and of what is known beside."""
    (points, oval), n_rays = necks.tube, rho.shape[1]
    basis = _waves(n_rays)
    normal = np.einsum("ik,nk,jk->ijn", basis, weight, basis)
    right = np.einsum("ik,nk,nk->in", basis, weight, rho)
    for i, value in zip((0, 3, 4), oval.T, strict=True):
        normal[i, i] += necks.trust + (ROUND_TRUST * n_rays if i else 0.0)
        right[i] += necks.trust * value
    aside = SIDE_TRUST * n_rays * np.einsum("nk,nkd,nd->n", necks.across, frames[:, 1:], _toward(medial_mm, points))
    right[1:3] += aside * necks.across.T
    normal[1:3, 1:3] += SIDE_TRUST * n_rays * np.einsum("ni,nj->ijn", necks.across, necks.across)
    return normal, right


def _stiffness(tube: Tube, frames: Floats, n_rays: int) -> tuple[list[list[Any]], Floats]:
    """Stiffness (5 by 5 sparse blocks) of the oval and of the axis against short waves, and how (5, n) it bends now."""
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


def _bounded(oval: Floats) -> Floats:
    """Ovals (n, 3) as far from round as `OVAL_MOST` allows, none of them without width."""
    radius = np.maximum(oval[:, 0], 0.1)
    most = OVAL_MOST * radius / np.maximum(np.hypot(oval[:, 1], oval[:, 2]), 1e-12)
    return np.column_stack([radius, oval[:, 1:] * np.minimum(most, 1.0)[:, None]])


def _turned(oval: Floats, frames: Floats, others: Floats) -> Floats:
    """Ovals (n, 3) whose angles are counted in frames (n, 3, 3), counted in others."""
    along, across = (np.einsum("nd,nd->n", others[:, 1], frames[:, k]) for k in (1, 2))
    turned = (oval[:, 1] + 1j * oval[:, 2]) * np.exp(-2j * np.arctan2(across, along))
    return np.stack([oval[:, 0], turned.real, turned.imag], axis=1)
