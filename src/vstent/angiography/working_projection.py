"""Propose the working projection: the C-arm direction that shows the neck in profile and the sac beside the artery."""

from typing import Final

import numpy as np
from scipy.ndimage import binary_closing
from scipy.spatial import cKDTree

from vstent.angiography.view import axes_of
from vstent.geometry.vessel import Anatomy
from vstent.kernels.arrays import Bools, Floats, Ints

REACH_DEG: Final = (90, 40)
"""Largest LAO or RAO angle and largest CRA or CAU angle that are proposed; units reach them around a head."""
STEP_DEG: Final = 5
"""Step of the directions that are compared."""
GRID_MM: Final = 0.5
"""Edge of the squares in which shadows are compared."""
OF_NECK: Final = 0.5
"""Weight of the squared cosine between the beam and the normal of the neck, relative to the overlap."""
OF_ARTERY: Final = 0.25
"""Weight of the squared cosine between the beam and the artery at the neck: foreshortening."""
OF_ANGLES: Final = 0.05
"""Weight of the angles, relative to their reach: of two equal directions the one nearer to frontal is proposed."""


def working_projection(anatomy: Anatomy) -> tuple[float, float]:
    """Return primary and secondary angle in radians of the proposed direction.

    Of all directions within reach, in steps of 5 degrees, it has the smallest sum of: the part of the sac's shadow that
    the rest of the vessel overlaps; the squared cosines of the angles between the beam and the normal of the neck, and
    between the beam and the artery at the neck; and a little for large angles. Without a sac the artery is seen with
    the least foreshortening.

    Parameters
    ----------
    anatomy : vessel, parent artery and sacs.
    """
    walls_mm = _sac_and_rest(anatomy) if anatomy.aneurysms else None
    reach_p, reach_s = REACH_DEG
    coarse = 2 * STEP_DEG
    near = _cheapest(anatomy, walls_mm, _grid((-reach_p, reach_p), (-reach_s, reach_s), coarse))
    around = [
        (max(angle - STEP_DEG, -reach), min(angle + STEP_DEG, reach))
        for angle, reach in zip(near, REACH_DEG, strict=True)
    ]
    primary, secondary = np.radians(_cheapest(anatomy, walls_mm, _grid(around[0], around[1], STEP_DEG)))
    return float(primary), float(secondary)


def _grid(primary: tuple[int, int], secondary: tuple[int, int], step: int) -> Ints:
    """Return all directions (k, 2) in degrees between two pairs of limits."""
    pairs = np.meshgrid(*(np.arange(low, high + 1, step) for low, high in (primary, secondary)))
    return np.stack(pairs, axis=-1).reshape(-1, 2)


def _cheapest(anatomy: Anatomy, walls_mm: tuple[Floats, Floats] | None, angles_deg: Ints) -> tuple[int, int]:
    """Return the direction in degrees with the smallest sum of costs, of directions (k, 2)."""
    axes = np.stack([axes_of(*pair) for pair in np.radians(angles_deg)])
    cost = OF_ANGLES * np.linalg.norm(angles_deg / np.array(REACH_DEG), axis=1) + _foreshortening(anatomy, axes[:, 2])
    if walls_mm is not None:
        cost += [overlap(*walls_mm, one) for one in axes]
    primary, secondary = angles_deg[int(np.argmin(np.round(cost, 9)))]
    return int(primary), int(secondary)


def _foreshortening(anatomy: Anatomy, toward: Floats) -> Floats:
    """Return the cost (k,) of beams (k, 3) along the artery or across the neck."""
    axis = anatomy.parent.axis
    if not anatomy.aneurysms:
        tangents = np.gradient(axis.points_mm, axis.abscissa_mm, axis=0)
        return np.asarray(np.mean((toward @ tangents.T) ** 2, axis=1))
    aneurysm = anatomy.aneurysms[0]
    ends = np.array(anatomy.parent.span_mm(aneurysm))
    start, end = axis.at(np.clip(ends + np.array([-1.0, 1.0]), 0.0, axis.length_mm))
    normal = (aneurysm.neck.areas_mm2[:, None] * aneurysm.neck.normals).sum(axis=0)
    along, across = ((vector / max(float(np.linalg.norm(vector)), 1e-12)) for vector in (end - start, normal))
    return np.asarray(OF_ARTERY * (toward @ along) ** 2 + OF_NECK * (toward @ across) ** 2)


def _sac_and_rest(anatomy: Anatomy) -> tuple[Floats, Floats]:
    """Return points (s, 3) on the largest sac and (r, 3) on the other walls, with the landing surface."""
    sac_mm = anatomy.aneurysms[0].sac.vertices_mm
    lumen_mm = anatomy.vessel.lumen.vertices_mm
    away = cKDTree(sac_mm).query(lumen_mm, distance_upper_bound=GRID_MM)[0] > GRID_MM
    return sac_mm, np.concatenate([lumen_mm[away], anatomy.parent.landing_surface.vertices_mm])


def overlap(sac_mm: Floats, rest_mm: Floats, axes: Floats) -> float:
    """Return the part of the shadow of the sac that lies in the shadow of the rest, in parallel light.

    Parameters
    ----------
    sac_mm, rest_mm : (s, 3) and (r, 3) points, closer than 0.5 mm on their surfaces.
    axes : (3, 3) right, up and toward the detector.
    """
    sac, rest = ((points @ axes[:2].T) / GRID_MM for points in (sac_mm, rest_mm))
    low = np.floor(sac.min(axis=0)).astype(int) - 2
    shape = tuple(np.ceil(sac.max(axis=0)).astype(int) - low + 3)
    shadow = _shadow(sac, low, shape)
    return float(np.count_nonzero(shadow & _shadow(rest, low, shape)) / np.count_nonzero(shadow))


def _shadow(points: Floats, low: np.ndarray, shape: tuple[int, ...]) -> Bools:
    """Return the squares of a grid in which points (n, 2) lie, with gaps of one square closed."""
    index = np.floor(points).astype(int) - low
    index = index[((index >= 0) & (index < shape)).all(axis=1)]
    shadow = np.zeros(shape, dtype=bool)
    shadow[index[:, 0], index[:, 1]] = True
    return np.asarray(binary_closing(shadow, np.ones((3, 3), dtype=bool)))
