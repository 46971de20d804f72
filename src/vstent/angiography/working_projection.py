"""Propose the working projection: the C-arm direction that shows the neck in profile and the sac beside the artery."""

from typing import Final

import numpy as np
from scipy.ndimage import binary_closing
from scipy.spatial import cKDTree

from vstent.angiography.view import axes_of
from vstent.geometry.vessel import Anatomy
from vstent.kernels.arrays import Bools, Floats

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
    """
    walls_mm = _sac_and_rest(anatomy) if anatomy.aneurysms else None
    limits, step = [(-reach, reach) for reach in REACH_DEG], 2 * STEP_DEG
    for _ in range(2):  # all directions in wide steps, then those around the best
        ticks = np.meshgrid(*(np.arange(low, high + 1, step) for low, high in limits))
        angles_deg = np.stack(ticks, axis=-1).reshape(-1, 2)
        axes = np.stack([axes_of(*pair) for pair in np.radians(angles_deg)])
        cost = OF_ANGLES * np.linalg.norm(angles_deg / np.array(REACH_DEG), axis=1)
        cost += _foreshortening(anatomy, axes[:, 2])
        if walls_mm is not None:
            cost += [overlap(*walls_mm, one) for one in axes]
        best = angles_deg[int(np.argmin(np.round(cost, 9)))]
        around = zip(best, REACH_DEG, strict=True)
        limits, step = [(max(a - STEP_DEG, -reach), min(a + STEP_DEG, reach)) for a, reach in around], STEP_DEG
    primary, secondary = np.radians(best)
    return float(primary), float(secondary)


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
    """Return the part of the sac's shadow in the shadow of the rest, in parallel light along the third axis.

    Points on both surfaces, (s, 3) and (r, 3), are closer than 0.5 mm; the other axes are right and up.
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
