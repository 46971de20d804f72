"""Streamlines worth looking at: through the inlet, and through the neck both ways, the same seeds in every pane."""

import numpy as np

from vstent.flow.types import FlowField
from vstent.kernels import curves, lattice_sampling
from vstent.kernels.arrays import Floats, Ints
from vstent.vessel import Anatomy, Aneurysm, Opening

N_INLET, N_NECK = 70, 60
"""Seeds on the inlet's section and on the neck."""
STEP_CELLS = 0.5
"""Arc length between points, in cells."""
LONGEST_MM = 90.0
"""No line is followed further: in a sac they circle for ever."""
SLOWEST_M_S = 2e-4
"""Slower blood is at rest."""


def streamlines(field: FlowField, anatomy: Anatomy) -> tuple[Floats, Ints, Floats]:
    """Return lines as points (p, 3) in mm, the first point of each (w + 1,), and the speeds (p,) in m/s."""
    ahead = [(seed, 1.0) for seed in inlet_seeds_mm(anatomy.vessel.inlet)]
    if anatomy.aneurysms:
        ahead += [(seed, sign) for seed in neck_seeds_mm(anatomy.aneurysms[0]) for sign in (1.0, -1.0)]
    lines = [_follow(field, seed, sign) for seed, sign in ahead]
    lines = [(points, speed) for points, speed in lines if len(points) > 3]
    starts = np.concatenate([[0], np.cumsum([len(points) for points, _ in lines])]).astype(np.int32)
    points = np.concatenate([np.zeros((0, 3)), *(points for points, _ in lines)])
    return points, starts, np.concatenate([np.zeros(0), *(speed for _, speed in lines)])


def inlet_seeds_mm(inlet: Opening) -> Floats:
    """Spread points (n, 3) evenly over the inlet's section, just inside (a sunflower: Vogel 1979)."""
    i = np.arange(N_INLET) + 0.5
    radius_mm, turn = 0.45 * inlet.diameter_mm * np.sqrt(i / N_INLET), np.pi * (3 - np.sqrt(5)) * i
    first = curves.any_perpendicular(inlet.normal)
    second = np.cross(inlet.normal, first)
    disc = radius_mm[:, None] * (np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second)
    return inlet.center_mm - 0.1 * inlet.diameter_mm * inlet.normal + disc


def neck_seeds_mm(aneurysm: Aneurysm) -> Floats:
    """Spread points (n, 3) evenly over the neck's surface: one per equal share of its area."""
    neck = aneurysm.neck
    order = np.argsort(neck.corners_mm.mean(axis=1) @ _longest(neck.vertices_mm), kind="stable")
    share = np.cumsum(neck.areas_mm2[order]) / neck.area_mm2
    chosen = order[np.searchsorted(share, (np.arange(N_NECK) + 0.5) / N_NECK)]
    return neck.corners_mm[chosen].mean(axis=1)


def _longest(points: Floats) -> Floats:
    return np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][0]


def _follow(field: FlowField, seed_mm: Floats, sign: float) -> tuple[Floats, Floats]:
    cell_mm = field.cell_size_mm
    n_most = int(LONGEST_MM / (STEP_CELLS * cell_mm))
    path, speed = np.zeros((n_most, 3)), np.zeros(n_most)
    seed = (seed_mm - field.origin_mm) / cell_mm
    velocity = field.velocity_m_s
    n = lattice_sampling.trace(field.index, velocity, seed, sign * STEP_CELLS, SLOWEST_M_S, path, speed)
    return field.origin_mm + path[:n] * cell_mm, speed[:n]
