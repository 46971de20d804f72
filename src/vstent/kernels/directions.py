"""The nineteen directions of D3Q19: from a grid cell to itself and to its neighbours."""

from typing import Final

import numpy as np

from vstent.kernels.arrays import Ints

VELOCITIES: Final[Ints] = np.array(
    [[0, 0, 0]]
    + [[s * (axis == k) for k in range(3)] for axis in range(3) for s in (1, -1)]
    + [
        [s * a for a in pair]
        for pair in ((1, 1, 0), (1, -1, 0), (1, 0, 1), (1, 0, -1), (0, 1, 1), (0, 1, -1))
        for s in (1, -1)
    ],
    dtype=np.int32,
)
"""(19, 3) lattice velocities."""
