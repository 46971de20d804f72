"""Smoothing on triangle meshes: of their vertices, of their mean curvature, and of the border of a region."""

from typing import Final

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix, csr_array, diags
from scipy.sparse.linalg import splu

from vstent.kernels import triangles
from vstent.kernels.arrays import Bools, Floats, Ints

N_STEPS: Final = 40
"""Maximum number of steps. A border has converged when none of its vertices changes sides."""
FLATTEST: Final = 0.05
"""Lower limit of the cotangents, so that the weights of obtuse triangles stay positive."""


def averaging(n_vertices: int, faces: Ints) -> csr_array:
    """Return the sparse (n, n) matrix that averages a value over the neighbours of each vertex.

    A vertex on an open edge has only its neighbours along that edge, so that openings do not shrink.
    """
    edges = np.sort(triangles.directed_edges(faces), axis=1).astype(np.int64)
    code, count = np.unique(edges[:, 0] * n_vertices + edges[:, 1], return_counts=True)
    a, b = code // n_vertices, code % n_vertices
    is_open = count == 1
    is_rim = np.zeros(n_vertices, dtype=bool)
    is_rim[a[is_open]] = is_rim[b[is_open]] = True
    row, column, along = np.concatenate([a, b]), np.concatenate([b, a]), np.concatenate([is_open, is_open])
    keep = along | ~is_rim[row]
    row, column = row[keep], column[keep]
    degree = np.bincount(row, minlength=n_vertices)
    return csr_array((1.0 / degree[row], (row, column)), shape=(n_vertices, n_vertices))


def taubin(vertices: Floats, faces: Ints, *, iterations: int, pass_band: float) -> Floats:
    """Smooth a mesh without shrinking it, by the lambda | mu algorithm (Taubin 1995, ICCV).

    A step with factor lambda and one with factor mu alternate. The gain (1 - lambda k)(1 - mu k) is 1 at k = 0 and at
    the pass band k_PB, with 1 / mu = k_PB - 1 / lambda: components with a Laplacian eigenvalue (0 to 2) below it stay.
    """
    mean, shrink = averaging(len(vertices), faces), 0.6
    grow = 1.0 / (pass_band - 1.0 / shrink)
    has_neighbours = (np.diff(mean.indptr) > 0)[:, None]
    for factor in (shrink, grow) * iterations:
        vertices = vertices + factor * np.where(has_neighbours, mean @ vertices - vertices, 0.0)
    return vertices


def mean_curvature(vertices: Floats, faces: Ints, *, rounds: int) -> Floats:
    """Return the mean curvature (n,) at the vertices; 1 / (2 R) on a cylinder seen from outside.

    It is half the divergence of the vertex normals, which are interpolated linearly on every face, averaged over
    neighbouring vertices `rounds` times.
    """
    corners, n = vertices[faces], len(vertices)
    normal, double_area = triangles.normals(corners), np.maximum(2 * triangles.areas(corners), 1e-12)
    at_corner = triangles.vertex_normals(vertices, faces)[faces]
    divergence = np.zeros(len(faces))
    for k in range(3):
        opposite = corners[:, (k + 2) % 3] - corners[:, (k + 1) % 3]
        divergence += np.einsum("fi,fi->f", np.cross(normal, opposite), at_corner[:, k]) / double_area
    weight = np.bincount(faces.ravel(), np.repeat(double_area, 3), minlength=n)
    total = np.bincount(faces.ravel(), np.repeat(0.5 * divergence * double_area, 3), minlength=n)
    curvature = total / np.maximum(weight, 1e-12)
    mean = averaging(n, faces)
    for _ in range(rounds):
        curvature = mean @ curvature
    return curvature


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
