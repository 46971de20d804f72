"""Compile the kernels of the contrast transport ahead of their first use."""

import numpy as np

from vstent.angiography.network import Network
from vstent.angiography.transport import Transport


def warm() -> None:
    """March a frame through two cells; numba keeps the compiled code."""
    cells = np.array([[0, 0, 0], [0, 0, 1]])
    faces = np.array([0, 1, 2]), np.array([1, 3, 0]), np.full(3, 2)
    fixed = np.ones((1, 3)), np.zeros(1), np.inf, 2, 1, 0.0
    two = Network(cells, np.ones(2), 1.0, cells * 1.0, np.ones(2), *faces, *fixed)
    list(Transport(two, inflow=lambda _: 1.0).frames(0.1, 0.1))
