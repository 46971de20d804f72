"""An anatomy with all walls moved."""

import numpy as np
import pytest

from vstent import phantoms
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.geometry.vessel import Vessel
from vstent.plan.widening import widened


def test_the_neck_plane_moves_with_the_wall() -> None:
    phantom = phantoms.with_sac(phantoms.tube(length_mm=24), abscissa_mm=12)
    anatomy = restore(trace(Vessel(phantoms.phantom_surface(phantom, edge_mm=0.4))))
    sac, wider = anatomy.aneurysms[0], widened(anatomy, 0.2).aneurysms[0]
    assert sac.plane is not None
    assert wider.plane is not None
    radius_mm = np.sqrt(sac.plane.area_mm2 / np.pi)
    # The wall leans by 40 degrees where it is cut, so its section grows by 0.1 mm / cos(40 degrees) at most.
    assert radius_mm + 0.05 < np.sqrt(wider.plane.area_mm2 / np.pi) < radius_mm + 0.13
    factors = np.array(wider.plane.area_band_mm2) / np.array(sac.plane.area_band_mm2)
    assert factors == pytest.approx(wider.plane.area_mm2 / sac.plane.area_mm2)
    height_mm = (wider.plane.rim_mm - wider.plane.center_mm) @ wider.plane.normal
    assert np.abs(height_mm).max() < 1e-9
