"""Sobol points, against those of scipy."""

import numpy as np
import pytest
from scipy.stats import qmc

from vstent.errors import InputError
from vstent.kernels.sobol import centered_points


@pytest.mark.parametrize("dimensions", [1, 2, 5, 13, 24])
@pytest.mark.parametrize("samples", [1, 2, 7, 64, 600])
def test_points_are_those_of_scipy(dimensions, samples):
    unit = qmc.Sobol(dimensions, scramble=False).random_base2(int(np.ceil(np.log2(samples))))
    np.testing.assert_array_equal(centered_points(dimensions, samples), 2 * (unit + 0.5 / len(unit)) - 1)


def test_too_many_dimensions_are_refused():
    with pytest.raises(InputError, match="at most 24"):
        centered_points(25, 8)
