"""Curved walls on the grid: weights of interpolated bounce-back (Bouzidi, Firdaouss and Lallemand 2001)."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from vstent.flow.lattice.scales import ODD_RATE
from vstent.kernels.arrays import Floats

CURVE: Final = np.array([1.0, -2.0, 0.0, 1.0, 0.0], np.float32)
"""The second difference along a link, of a, b, c, e and g (see `d3q19.defer`)."""


def linear_weights(fraction: Floats, has_one: NDArray[np.bool_]) -> Floats:
    """Linear interpolated reflection (Bouzidi, Firdaouss and Lallemand 2001, Phys. Fluids 13, 3452, eq. 5).

    Half-way where it would need the cell behind and that is no blood.
    """
    zero = np.zeros_like(fraction)
    near = np.stack([2 * fraction, 1 - 2 * fraction, zero], axis=1)
    far = np.stack([0.5 / fraction, zero, 1 - 0.5 / fraction], axis=1)
    weight = np.where(fraction[:, None] < 0.5, near, far)
    weight[~has_one & (fraction < 0.5)] = (1.0, 0.0, 0.0)
    return weight


def quadratic_weights(fraction: Floats) -> Floats:
    """Quadratic interpolated reflection (Lallemand and Luo 2003, J. Comput. Phys. 184, 406, eq. 10): (l, 5)."""
    x, zero = fraction, np.zeros_like(fraction)
    near = np.stack([x * (1 + 2 * x), 1 - 4 * x**2, zero, -x * (1 - 2 * x), zero], axis=1)
    far = np.stack([1 / (x * (2 * x + 1)), zero, (2 * x - 1) / x, zero, (1 - 2 * x) / (1 + 2 * x)], axis=1)
    return np.where(x[:, None] < 0.5, near, far)


def parabolic_weights(fraction: Floats, relaxation_steps: float) -> tuple[Floats, Floats]:
    """Reflection that is exact for a parabola along the link: (l, 5) weights of a, b, c, e and g (see `d3q19.defer`).

    And how much of `CURVE` they would have more (l,) without viscosity.

    Quadratic interpolation alone lets blood slip by up to an eighth of a squared cell times the flow's curvature: its
    populations carry, beside the velocity, second differences and what the odd rate has still to relax (Ginzburg and
    d'Humieres 2003, Phys. Rev. E 68, 066614, sec. III). Both are put back by the second difference, a - 2 b + e; how
    much of it comes with the viscosity is taken between a plane channel and a tube, for read off the populations it
    would be wrong where a screen's force meets the wall.
    """
    x, even, odd = fraction, relaxation_steps - 0.5, 1 / ODD_RATE - 0.5
    per = 1 / np.maximum(1, x * (2 * x + 1))
    viscous = even * (odd + np.abs(x - 0.5)) * per
    return quadratic_weights(fraction) + np.outer(x * (1 - x) * per - viscous, CURVE), viscous
