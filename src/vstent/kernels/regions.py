"""Regions of a triangle mesh with a short border."""

from typing import Final

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix, diags
from scipy.sparse.linalg import splu

from vstent.kernels import triangles
from vstent.kernels.arrays import Bools, Floats, Ints

N_STEPS: Final = 40
"""Largest number of steps; a border has converged when none of its vertices changes sides."""
FLATTEST: Final = 0.05
"""Cotangents below this count as this: weights stay positive on obtuse triangles."""


def stiffness(vertices: Floats, faces: Ints) -> csc_matrix:
    """Matrix (n, n) of the Dirichlet energy of functions linear on triangles.

    Cotangent weights (Pinkall and Polthier 1993, Experiment. Math. 2:15).
    """
    n = len(vertices)
    total = csc_matrix((n, n))
    for k in range(3):
        o, a, b = vertices[faces[:, k]], faces[:, (k + 1) % 3], faces[:, (k + 2) % 3]
        p, q = vertices[a] - o, vertices[b] - o
        sine = np.maximum(np.linalg.norm(np.cross(p, q), axis=1), 1e-12)
        weight = 0.5 * np.maximum(np.einsum("ij,ij->i", p, q) / sine, FLATTEST)
        total = total + csc_matrix(coo_matrix((weight, (a, b)), shape=(n, n)))
    both = total + total.T
    return csc_matrix(diags(np.asarray(both.sum(axis=1)).ravel()) - both)


def areas_around(vertices: Floats, faces: Ints) -> Floats:
    """A third of the areas (n,) of the triangles around every vertex."""
    share = np.repeat(triangles.areas(vertices[faces]) / 3, 3)
    return np.bincount(faces.ravel(), share, minlength=len(vertices)).astype(np.float64)


def region(vertices: Floats, faces: Ints, gain: Floats, is_fixed: Bools, reach: float) -> Floats:
    """Level (n,), negative inside, of the region for which gain minus length of the border is greatest nearby.

    Parameters
    ----------
    vertices, faces : (n, 3), (m, 3) the mesh.
    gain : (n,) gain per area, in 1 / length; the region begins where it is positive.
    is_fixed : (n,) vertices that stay as they begin.
    reach : length over which the border moves in a step, longer than the mesh's edges.

    Diffusion and threshold in turn (Merriman, Bence and Osher 1994, J. Comput. Phys. 112:334), the gain as a force.
    """
    area = np.maximum(areas_around(vertices, faces), 1e-12)
    solver = splu(csc_matrix(diags(area) + reach**2 * stiffness(vertices, faces)))
    start = gain > 0
    inside = start
    for _ in range(N_STEPS):
        # An implicit step leaves a slope of 1 / (2 reach) across the border: this much moves it by reach^2 gain.
        smooth = solver.solve(area * inside) + 0.5 * reach * gain
        now = np.where(is_fixed, start, smooth > 0.5)
        if (now == inside).all():
            break
        inside = now
    level = 0.5 - smooth
    return np.where(inside, np.minimum(level, -1e-6), np.maximum(level, 1e-6))
