"""Array helpers against numpy."""

import numpy as np

from vstent.kernels.arrays import unique_rows


def test_unique_rows_are_those_of_numpy():
    rows = np.random.default_rng(4).integers(-9, 10, (400, 4)) * [1, 0, 30000, 1]
    found, place = unique_rows(rows)
    wanted, wanted_place = np.unique(rows, axis=0, return_inverse=True)
    assert np.array_equal(found, wanted)
    assert np.array_equal(place, wanted_place.ravel())
