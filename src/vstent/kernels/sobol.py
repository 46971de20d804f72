"""Points of a Sobol sequence, which fill a cube more evenly than random ones.

scipy.stats, which has the same points, is not used because its import takes half a second.
"""

from typing import Final

import numpy as np

from vstent.errors import InputError
from vstent.kernels.arrays import Floats, Ints

_DIRECTIONS: Final = (
    (3, (1,)),
    (7, (1, 3)),
    (11, (1, 3, 1)),
    (13, (1, 1, 1)),
    (19, (1, 1, 3, 3)),
    (25, (1, 3, 5, 13)),
    (37, (1, 1, 5, 5, 17)),
    (41, (1, 1, 5, 5, 5)),
    (47, (1, 1, 7, 11, 19)),
    (55, (1, 1, 5, 1, 1)),
    (59, (1, 1, 1, 3, 11)),
    (61, (1, 3, 5, 5, 31)),
    (67, (1, 3, 3, 9, 7, 49)),
    (91, (1, 1, 1, 15, 21, 21)),
    (97, (1, 3, 1, 13, 27, 49)),
    (103, (1, 1, 1, 15, 7, 5)),
    (109, (1, 3, 1, 15, 13, 25)),
    (115, (1, 1, 5, 5, 19, 61)),
    (131, (1, 3, 7, 11, 23, 15, 103)),
    (137, (1, 3, 7, 13, 13, 15, 69)),
    (143, (1, 1, 3, 13, 7, 35, 63)),
    (145, (1, 3, 5, 9, 1, 25, 53)),
    (157, (1, 3, 1, 13, 9, 35, 107)),
)
"""Primitive polynomial, its coefficients as bits, and initial numbers of every dimension from the second on (Joe and
Kuo 2008, SIAM J. Sci. Comput. 30:2635)."""


def centered_points(dimensions: int, samples: int) -> Floats:
    """Return the first points (n, d) of a Sobol sequence, -1 to 1, each in the middle of its stratum.

    Parameters
    ----------
    dimensions : int
        Number d of dimensions.
    samples : int
        Number n of points; it is rounded up to a power of two.

    Raises
    ------
    InputError
        There are more dimensions than the table has.
    """
    if dimensions > len(_DIRECTIONS) + 1:
        raise InputError(f"{dimensions} uncertain numbers cannot be varied. Give ranges to at most 24 of them.")
    bits = int(np.ceil(np.log2(samples)))
    number = np.arange(1 << bits)
    gray = number ^ (number >> 1)
    unit = np.zeros((len(number), dimensions))
    for d in range(dimensions):
        at = np.zeros(len(number), np.int64)
        for k, direction in enumerate(_direction_numbers(d, bits)):
            at ^= np.where((gray >> k) & 1, direction << (bits - 1 - k), 0)
        unit[:, d] = at / len(number)
    return 2 * (unit + 0.5 / len(number)) - 1


def _direction_numbers(dimension: int, bits: int) -> Ints:
    """Return the direction numbers m (bits,) of a dimension, the first of which is 0 (van der Corput)."""
    numbers = np.ones(bits, np.int64)
    if dimension == 0:
        return numbers
    polynomial, first = _DIRECTIONS[dimension - 1]
    degree = len(first)
    for k in range(bits):
        if k < degree:
            numbers[k] = first[k]
            continue
        numbers[k] = numbers[k - degree]
        for j in range(1, degree + 1):
            if (polynomial >> (degree - j)) & 1:
                numbers[k] ^= numbers[k - j] << j
    return numbers
