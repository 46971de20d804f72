"""Smallest correction of flow rates between cells after which as much leaves every cell as enters it."""

from typing import Final

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.linalg import LinearOperator, cg, splu

from vstent.errors import FlowError
from vstent.kernels.arrays import Floats, Ints, unique_rows

COARSEST: Final = 1500
"""Number of unknowns that are solved directly."""
SMOOTHING: Final = 0.7
"""Damping of the Jacobi smoother."""
TOLERANCE: Final = 1e-9
"""Imbalance that is left, relative to the imbalance before (root mean square)."""
MOST_ITERATIONS: Final = 400
"""Maximum number of iterations."""


class _Level:
    """One level of the multigrid hierarchy: matrix, inverse diagonal, and the coarse unknown of each unknown."""

    def __init__(self, matrix: csr_matrix, cells: Ints) -> None:
        self.matrix = matrix
        self.inverse = 1 / np.maximum(matrix.diagonal(), 1e-12)
        self.is_last = len(cells) <= COARSEST
        if self.is_last:
            self.factor = splu(csr_matrix(matrix + 1e-9 * diags(np.ones(len(cells)))).tocsc())
            return
        coarse, label = unique_rows(cells // 2)
        of_coarse = csr_matrix((np.ones(len(cells)), (np.arange(len(cells)), label)))
        self.spread = of_coarse
        self.gather = csr_matrix(of_coarse.T)
        # Constants on blocks make the coarse matrix twice too stiff, because its cells are twice as far apart.
        self.next = _Level(csr_matrix(0.5 * (self.gather @ matrix @ of_coarse)), coarse)

    def cycle(self, right: Floats) -> Floats:
        """Return the result of one symmetric V-cycle from zero."""
        if self.is_last:
            return np.asarray(self.factor.solve(right))
        found = SMOOTHING * self.inverse * right
        found += SMOOTHING * self.inverse * (right - self.matrix @ found)
        found += self.spread @ self.next.cycle(self.gather @ (right - self.matrix @ found))
        for _ in range(2):
            found += SMOOTHING * self.inverse * (right - self.matrix @ found)
        return found


class Balancer:
    """Solver that balances flow rates on connected cells (n, 3), through faces from `left` to `right` cells (f,)."""

    def __init__(self, cells: Ints, left: Ints, right: Ints) -> None:
        n, ones = len(cells), np.ones(len(left))
        degree = np.bincount(left, minlength=n) + np.bincount(right, minlength=n)
        places = np.r_[left, right, np.arange(n)], np.r_[right, left, np.arange(n)]
        matrix = csr_matrix(coo_matrix((np.r_[-ones, -ones, degree], places), shape=(n, n)))
        self._left, self._right, self._level = left, right, _Level(matrix, cells - cells.min(axis=0))

    def __call__(self, flux: Floats, source: Floats, guess: Floats | None = None) -> tuple[Floats, Floats]:
        """Return the flow rates (f,) corrected so that all cells balance with their source, and the potential (n,)."""
        n = self._level.matrix.shape[0]
        gain = np.bincount(self._right, flux, n) - np.bincount(self._left, flux, n)
        right = np.asarray(gain, dtype=np.float64) + source
        right -= right.mean()
        hierarchy = LinearOperator((n, n), matvec=self._level.cycle, dtype=np.float64)
        potential, failed = cg(
            self._level.matrix, right, x0=guess, rtol=TOLERANCE, maxiter=MOST_ITERATIONS, M=hierarchy
        )
        if failed:
            raise FlowError(
                "the flow rates between the cells cannot be balanced, so contrast would appear from nothing: compute "
                "the flow again with another grid spacing"
            )
        return flux + potential[self._left] - potential[self._right], potential
