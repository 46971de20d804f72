"""Regions of a triangle mesh that balance a gain per area against the length of their border."""

from typing import Final

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix, diags
from scipy.sparse.linalg import splu

from vstent.kernels import triangles
from vstent.kernels.arrays import Bools, Floats, Ints

N_STEPS: Final = 40
"""Maximum number of steps. A border has converged when none of its vertices changes sides."""
FLATTEST: Final = 0.05
"""Lower limit of the cotangents, so that the weights of obtuse triangles stay positive."""


def stiffness(vertices: Floats, faces: Ints) -> csc_matrix:
    """Return the matrix (n, n) of the Dirichlet energy of piecewise linear functions on a mesh.

    Its weights are cotangents (Pinkall and Polthier 1993, Experiment. Math. 2:15).
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


def region(vertices: Floats, faces: Ints, gain: Floats, is_fixed: Bools, reach: float) -> Floats:
    """Return a level (n,), negative inside, of the region with the locally largest gain minus border length.

    Diffusion and threshold alternate (Merriman, Bence and Osher 1994, J. Comput. Phys. 112:334), with the gain per area
    (n,) as a force on the border, in 1 / length. The initial region is where it is positive, and fixed vertices (n,)
    keep their side. `reach` is the length over which the border moves in a step; it is longer than the mesh's edges.
    """
    share = np.repeat(triangles.areas(vertices[faces]) / 3, 3)
    area = np.maximum(np.bincount(faces.ravel(), share, minlength=len(vertices)).astype(np.float64), 1e-12)
    solver = splu(csc_matrix(diags(area) + reach**2 * stiffness(vertices, faces)))
    start = gain > 0
    inside = start
    for _ in range(N_STEPS):
        # After an implicit step the slope across the border is 1 / (2 reach); this term moves it by reach^2 gain.
        smooth = solver.solve(area * inside) + 0.5 * reach * gain
        now = np.where(is_fixed, start, smooth > 0.5)
        if (now == inside).all():
            break
        inside = now
    level = 0.5 - smooth
    return np.where(inside, np.minimum(level, -1e-6), np.maximum(level, 1e-6))
