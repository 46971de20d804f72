"""Interpolation between scattered points: local fits as one sparse matrix."""

from typing import Final

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from vstent.kernels.arrays import Floats

NEIGHBOURS: Final = 32
"""Number of source points in a fit."""
RIDGE: Final = 1e-5
"""Regularization of slopes and curvatures, relative to the weight of the points."""
BLOCK: Final = 20_000
"""Number of fits solved at once."""


def fits(sources: Floats, targets: Floats) -> csr_matrix:
    """Return the matrix (t, s) that interpolates from scattered sources (s, 3) to targets (t, 3), exact for quadratics.

    Moving least squares over the nearest sources (Lancaster and Salkauskas 1981, Math. Comput. 37, 141). Where the
    sources are in one plane, the derivatives that they do not determine are taken as zero.
    """
    count = min(NEIGHBOURS, len(sources))
    tree = cKDTree(sources)
    weights, columns = [], []
    for start in range(0, max(len(targets), 1), BLOCK):
        block = targets[start : start + BLOCK]
        distance, near = tree.query(block, k=count)
        distance = np.asarray(distance)
        reach = 1.05 * distance[:, -1:]
        weight = (1 - (distance / reach) ** 2) ** 2
        x, y, z = np.moveaxis((sources[near] - block[:, None]) / reach[..., None], 2, 0)
        basis = np.stack([np.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, y * z, z * x], axis=2)
        weighted = basis * weight[..., None]
        matrix = np.einsum("tki,tkj->tij", weighted, basis)
        matrix[:, 1:, 1:] += RIDGE * weight.sum(axis=1)[:, None, None] * np.eye(9)
        value = np.zeros((len(matrix), 10, 1))
        value[:, 0] = 1
        weights.append(np.einsum("tki,ti->tk", weighted, np.linalg.solve(matrix, value)[..., 0]))
        columns.append(near)
    starts = np.arange(len(targets) + 1) * count
    columns_of = np.concatenate(columns).ravel()
    return csr_matrix((np.concatenate(weights).ravel(), columns_of, starts), shape=(len(targets), len(sources)))


def near_means(sources: Floats, targets: Floats, reach: float) -> csr_matrix:
    """Return the matrix (t, s) of inverse-distance weighted means over the four nearest of sources (s, d)."""
    count = min(4, len(sources))
    distance, near = cKDTree(sources).query(targets, k=count)
    weight = 1 / (np.asarray(distance).reshape(-1, count) ** 2 + (0.1 * reach) ** 2)
    weight /= weight.sum(axis=1, keepdims=True)
    starts = np.arange(len(targets) + 1) * count
    return csr_matrix((weight.ravel(), near.ravel(), starts), shape=(len(targets), len(sources)))
