"""Murray's law: the flow through an artery grows with the cube of its diameter."""

from collections.abc import Sequence

import numpy as np

from vstent.geometry.vessel import Opening
from vstent.kernels.arrays import Floats


def murray_shares(openings: Sequence[Opening]) -> Floats:
    """Return the parts (k,) of a flow that openings take: as diameter cubed (Murray 1926, PNAS 12, 207)."""
    cubes = np.array([opening.diameter_mm**3 for opening in openings])
    return np.asarray(cubes / cubes.sum())
