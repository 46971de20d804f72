"""Curved walls on the grid: weights of interpolated bounce-back (Bouzidi, Firdaouss and Lallemand 2001)."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from vstent.flow.lattice.scales import ODD_RATE
from vstent.kernels.arrays import Floats

CURVE: Final = np.array([1.0, -2.0, 0.0, 1.0, 0.0], np.float32)
"""Coefficients of the second difference along a link, for the populations a, b, c, e and g (see `d3q19.defer`)."""


def linear_weights(fraction: Floats, has_one: NDArray[np.bool_]) -> Floats:
    """Return the weights (l, 3) of linearly interpolated bounce-back for populations a, b and c (see `d3q19.paths`).

    A link whose wall is nearer than half-way needs the cell behind. Where that is not blood, half-way bounce-back is
    used.

    Shapes: `fraction` (l,), `has_one` (l,).

    References
    ----------
    Bouzidi, Firdaouss and Lallemand 2001, Phys. Fluids 13, 3452, eq. 5.
    """
    zero = np.zeros_like(fraction)
    near = np.stack([2 * fraction, 1 - 2 * fraction, zero], axis=1)
    far = np.stack([0.5 / fraction, zero, 1 - 0.5 / fraction], axis=1)
    weight = np.where(fraction[:, None] < 0.5, near, far)
    weight[~has_one & (fraction < 0.5)] = (1.0, 0.0, 0.0)
    return weight


def quadratic_weights(fraction: Floats) -> Floats:
    """Return the weights (l, 5) of quadratically interpolated bounce-back for a, b, c, e and g (see `d3q19.defer`).

    Shapes: `fraction` (l,).

    References
    ----------
    Lallemand and Luo 2003, J. Comput. Phys. 184, 406, eq. 10.
    """
    x, zero = fraction, np.zeros_like(fraction)
    near = np.stack([x * (1 + 2 * x), 1 - 4 * x**2, zero, -x * (1 - 2 * x), zero], axis=1)
    far = np.stack([1 / (x * (2 * x + 1)), zero, (2 * x - 1) / x, zero, (1 - 2 * x) / (1 + 2 * x)], axis=1)
    return np.where(x[:, None] < 0.5, near, far)


def parabolic_weights(fraction: Floats, relaxation_steps: float) -> tuple[Floats, Floats]:
    """Return the weights of bounce-back that is exact for a parabolic velocity along the link.

    Quadratic interpolation alone leaves a slip velocity of up to an eighth of the squared grid spacing times the flow's
    curvature. The reason is that the populations carry, beside the velocity, second differences and the part that the
    odd relaxation rate has not yet relaxed. The second difference a - 2 b + e compensates for both. Its viscous part is
    a compromise between a plane channel and a tube; determining it from the populations would be wrong where the force
    of a screen meets the wall.

    Shapes: `fraction` (l,).

    References
    ----------
    Ginzburg and d'Humieres 2003, Phys. Rev. E 68, 066614, sec. III.
    """
    x, even, odd = fraction, relaxation_steps - 0.5, 1 / ODD_RATE - 0.5
    per = 1 / np.maximum(1, x * (2 * x + 1))
    viscous = even * (odd + np.abs(x - 0.5)) * per
    return quadratic_weights(fraction) + np.outer(x * (1 - x) * per - viscous, CURVE), viscous
