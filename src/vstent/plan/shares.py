"""Samples of uncertain numbers, and the share of each in the variance of a result (first-order Sobol indices).

The result is fitted by a constant plus Legendre polynomials of first and second degree in each cause alone. For
uniform, independent causes these polynomials are orthonormal. The variance due to one cause is then the sum of its
squared coefficients (Sudret 2008, Reliab. Eng. Syst. Saf. 93:964). This is its first-order Sobol index, exact if the
result is a sum of quadratic functions. The residual of the fit contains interactions of causes and curvature of higher
degree.
"""

from pathlib import Path
from typing import Final

import numpy as np
from scipy.special import fdtri

from vstent.kernels.arrays import Floats

INTERVAL: Final = (0.025, 0.975)
"""Quantiles at the ends of a band or an interval: 95 % of the samples lie in it."""
STORED: Final = Path(__file__).with_name("sobol.npy")
"""First 128 points of a Sobol sequence in 24 dimensions, in units of 1/128."""
STEADY: Final = 1e-9
"""Relative range of a result below which it counts as constant."""
CONFIDENCE: Final = 0.95
"""Confidence of the F test by which the share of a cause must differ from chance."""


def centered_points(dimensions: int, samples: int) -> Floats:
    """Return the first points (n, d) of a Sobol sequence, -1 to 1, each in the middle of its stratum."""
    count = 1 << int(np.ceil(np.log2(samples)))
    stored = np.load(STORED)  # of scipy's sequence, whose import takes longer than all other work of a band
    if count <= stored.shape[0] and dimensions <= stored.shape[1]:
        unit = stored[:count, :dimensions] / len(stored)
    else:
        from scipy.stats.qmc import Sobol

        unit = Sobol(dimensions, scramble=False).random_base2(count.bit_length() - 1)
    return np.asarray(2 * (unit + 0.5 / count) - 1)


def first_order_shares(points: Floats, values: Floats) -> Floats | None:
    """Compute the fraction of the variance of a result that is due to each cause.

    Degree 2 is left out if there are fewer than twice as many results as unknowns. A share that so few results cannot
    distinguish from chance (F test) is 0.

    Shapes: `points` (n, d), `values` (n,).

    References
    ----------
    Sudret (2008), Reliab. Eng. Syst. Saf. 93:964.
    """
    n, d = points.shape
    if n < d + 2:
        return None
    if np.ptp(values) <= STEADY * max(1e-300, float(np.abs(values).max())):
        return np.zeros(d)
    first, second = np.sqrt(3) * points, 0.5 * np.sqrt(5) * (3 * points**2 - 1)
    is_quadratic = n >= 2 * (1 + 2 * d)
    basis = np.concatenate([np.ones((n, 1)), first, *([second] if is_quadratic else [])], axis=1)
    coefficients = np.linalg.lstsq(basis, values, rcond=None)[0]
    terms, freedom = (basis.shape[1] - 1) // d, n - basis.shape[1]
    left_over = _residual(basis, values) / freedom
    made = (coefficients[1:] ** 2).reshape(-1, d).sum(axis=0)
    others = (np.delete(basis, 1 + cause + d * np.arange(terms), axis=1) for cause in range(d))
    explained = np.array([_residual(one, values) for one in others]) - freedom * left_over
    is_clear = explained > terms * fdtri(terms, freedom, CONFIDENCE) * left_over
    return np.where(is_clear, made, 0.0) / (made.sum() + left_over)


def _residual(basis: Floats, values: Floats) -> float:
    """Return the sum of squares that a fit of values (n,) by the columns of `basis` (n, k) leaves."""
    return float(((values - basis @ np.linalg.lstsq(basis, values, rcond=None)[0]) ** 2).sum())
