"""A straight artery with a small sac, in which flows of a ranking take a second."""

from functools import cache

from vstent import phantoms
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy, Vessel


def wall() -> Surface:
    """Return its wall."""
    phantom = phantoms.with_sac(phantoms.tube(length_mm=32.0), abscissa_mm=16.0, width_mm=5.0, neck_mm=3.6)
    return phantoms.phantom_surface(phantom, edge_mm=0.6)


@cache
def anatomy() -> Anatomy:
    """Return it restored."""
    return restore(trace(Vessel(wall())))
