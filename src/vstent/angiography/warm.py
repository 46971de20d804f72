"""Compile the kernels of angiograms ahead of their first use."""

import numpy as np

from vstent.angiography.network import Network
from vstent.angiography.transport import Transport
from vstent.kernels.footprints import footprints


def warm() -> None:
    """March a frame through two cells, and project one; numba keeps the compiled code."""
    arm = np.array([1.0, 2.0, 1.0, 1.0, 1.0])
    footprints(np.zeros((1, 3)), np.ones(1), np.eye(3), arm, np.array([2, 2]))
    cells = np.array([[0, 0, 0], [0, 0, 1]])
    two = Network(
        cells=cells,
        width=np.ones(2, dtype=np.int32),
        spacing_mm=1.0,
        points_mm=cells.astype(np.float64),
        volume_mm3=np.ones(2),
        left=np.array([0, 1, 2]),
        right=np.array([1, 3, 0]),
        axis=np.full(3, 2),
        flux_mm3_s=np.ones((1, 3)),
        time_s=np.zeros(1),
        period_s=np.inf,
        openings=2,
        inlets=1,
        correction_fraction=0.0,
    )
    list(Transport(two, inflow=lambda _: 1.0).frames(0.1, 0.1))
