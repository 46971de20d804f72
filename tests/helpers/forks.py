"""A fork with a sac on it, from a phantom, and its paths."""

from dataclasses import replace
from functools import cache

import numpy as np

from vstent.anatomy.restore.paths import on_path
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.geometry.vessel import Vessel
from vstent.phantoms import Sac, bifurcation, phantom_surface

PHANTOM = replace(bifurcation(), sac=Sac(np.array([0.0, 0.0, 16.2]), np.array([0.0, 0.0, 1.0]), 2.6, 2.6))
"""An artery of 3.5 mm along z with two arms of 3.0 mm in the x-z plane, and a sac between them."""


@cache
def fork():
    """The restored fork."""
    return restore(trace(Vessel(phantom_surface(PHANTOM, edge_mm=0.3))))


def arm(name):
    """The fork with a path in the first place."""
    return on_path(fork(), name)
