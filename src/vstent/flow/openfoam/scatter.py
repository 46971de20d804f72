"""From scattered points to others: linear fits as one sparse matrix."""

from typing import Final

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from vstent.kernels.arrays import Floats

NEIGHBOURS: Final = 16
"""Points of a fit."""
BLOCK: Final = 50_000
"""Fits solved at once."""


def linear_fits(sources: Floats, targets: Floats) -> csr_matrix:
    """Matrix (t, s) that takes values at sources (s, 3) to targets (t, 3): exact for linear functions.

    Moving least squares (Lancaster and Salkauskas 1981, Math. Comput. 37, 141) over the nearest sources. Where these
    lie on a plane, the slope across it is taken for zero.
    """
    count = min(NEIGHBOURS, len(sources))
    tree = cKDTree(sources)
    weights, columns = [], []
    for start in range(0, max(len(targets), 1), BLOCK):
        block = targets[start : start + BLOCK]
        distance, near = tree.query(block, k=count)
        weights.append(_fit(sources[near] - block[:, None], np.asarray(distance)))
        columns.append(near)
    weight, column = np.concatenate(weights), np.concatenate(columns)
    starts = np.arange(len(targets) + 1) * count
    return csr_matrix((weight.ravel(), column.ravel(), starts), shape=(len(targets), len(sources)))


def _fit(offset: Floats, distance: Floats) -> Floats:
    """Weights (t, k) of the neighbours at offsets (t, k, 3)."""
    reach = 1.05 * distance[:, -1:]
    weight = (1 - (distance / reach) ** 2) ** 2
    basis = np.concatenate([np.ones((*distance.shape, 1)), offset / reach[..., None]], axis=2)
    weighted = basis * weight[..., None]
    matrix = np.einsum("tki,tkj->tij", weighted, basis)
    matrix[:, 1:, 1:] += 1e-6 * weight.sum(axis=1)[:, None, None] * np.eye(3)
    value = np.zeros((len(matrix), 4, 1))
    value[:, 0] = 1
    return np.asarray(np.einsum("tki,ti->tk", weighted, np.linalg.solve(matrix, value)[..., 0]))


def near_means(sources: Floats, targets: Floats, reach: float) -> csr_matrix:
    """Matrix (t, s) of inverse-distance means over the four nearest sources; points (.., d) of any dimension."""
    count = min(4, len(sources))
    distance, near = cKDTree(sources).query(targets, k=count)
    weight = 1 / (np.asarray(distance).reshape(-1, count) ** 2 + (0.1 * reach) ** 2)
    weight /= weight.sum(axis=1, keepdims=True)
    starts = np.arange(len(targets) + 1) * count
    return csr_matrix((weight.ravel(), near.ravel(), starts), shape=(len(targets), len(sources)))
