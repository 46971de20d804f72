"""Shares: how much of a result's variance each cause makes.

The result is fitted by a constant and Legendre polynomials of the first and second degree in every cause alone. They
are orthonormal where the causes are uniform and independent, so the variance that a cause makes is the sum of the
squares of its coefficients (Sudret 2008, Reliab. Eng. Syst. Saf. 93:964): its first-order Sobol index, exact where the
result is a sum of quadratics. What the fit leaves over is the causes' interplay, and curvature of higher degree.
"""

import numpy as np

from vstent.kernels.arrays import Floats

STEADY = 1e-9
"""A result that varies less than this, relative, does not vary."""


def first_order_shares(points: Floats, values: Floats) -> Floats | None:
    """Return the part of the variance of values (n,) that each of d causes makes, (d,); their sum is at most 1.

    Parameters
    ----------
    points : (n, d) causes, -1 to 1 each.
    values : (n,) results.

    None where there are too few results to tell. Degree 2 is left out where there are fewer than twice its unknowns.
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
    left_over = float(((values - basis @ coefficients) ** 2).sum()) / (n - basis.shape[1])
    made = (coefficients[1:] ** 2).reshape(-1, d).sum(axis=0)
    return np.asarray(made / (made.sum() + left_over))
