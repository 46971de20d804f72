"""What a sentence tells, as numbers."""

import re

import numpy as np

from vstent.kernels.arrays import Floats


def place_in(sentence: str) -> Floats:
    """The first place (3,) in it: see `vstent.units.place`."""
    found = re.search(r"\(([^()]+)\) mm", sentence)
    assert found, sentence
    return np.array([float(x) for x in found[1].split(",")])
