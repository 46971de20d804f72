"""Murray's law: the flow through an artery grows with the cube of its diameter."""

from collections.abc import Sequence

import numpy as np

from vstent.geometry.vessel import Opening
from vstent.kernels.arrays import Floats


def murray_shares(openings: Sequence[Opening]) -> Floats:
    """Return the fraction of the flow through each opening, proportional to its diameter cubed.

    Parameters
    ----------
    openings : k openings that share a flow.

    Returns
    -------
    shares : (k,) fractions with a sum of 1.

    References
    ----------
    Murray 1926, PNAS 12:207.
    """
    cubes = np.array([opening.diameter_mm**3 for opening in openings])
    return np.asarray(cubes / cubes.sum())
