"""Centerlines and walls against analytic axes, synthetic scans and another program's centerlines."""

from pathlib import Path

import numpy as np
import pytest

from vessel_truth import NAMES, PHANTOMS, halved, reference_errors, trace_errors, traced, wall_errors
from vstent import phantoms
from vstent.phantoms import Phantom, Scanner

pytestmark = pytest.mark.validation


@pytest.mark.parametrize("phantom", PHANTOMS, ids=NAMES)
def test_centerlines_converge_to_the_axes(phantom: Phantom) -> None:
    surface = phantoms.phantom_surface(phantom, edge_mm=0.6)
    coarse, fine = (trace_errors(phantom, traced(phantom, wall)) for wall in (surface, halved(phantom, surface)))
    print(coarse, fine, sep="\n")  # noqa: T201  # `make validation` shows it
    assert fine.mean_mm < 0.02
    assert fine.max_mm < 0.1
    assert fine.radius_mm < 0.01
    # A chord lies below its arc by the square of the edge. Spheres are sought among samples of the wall 0.4 mm apart,
    # so their centers are off by up to 0.001 mm however fine the mesh is: that takes a tenth off the order.
    assert np.log2(coarse.radius_mm / fine.radius_mm) > 1.8
    assert fine.mean_mm < max(0.35 * coarse.mean_mm, 0.0015)


@pytest.mark.parametrize("phantom", PHANTOMS, ids=NAMES)
@pytest.mark.parametrize("voxel_mm", [0.15, 0.25, 0.4])
@pytest.mark.parametrize(("blur_voxels", "noise"), [(0.5, 0.03), (1.0, 0.08)])
def test_scanned_walls_lie_where_they_are(phantom: Phantom, voxel_mm: float, blur_voxels: float, noise: float) -> None:
    found = wall_errors(phantom, Scanner(voxel_mm, blur_voxels * voxel_mm, noise))
    print(found)  # noqa: T201
    assert abs(found.diameter_bias) < 0.1
    assert found.p95 < 0.5


@pytest.mark.parametrize("case", ["aneurisk_C0038", "aneurisk_beta"])
def test_real_centerlines_agree_with_vmtk_outside_the_sac(case: str, shared_data: Path) -> None:
    found = reference_errors(shared_data, case)
    print(found)  # noqa: T201
    assert found.n_reached == found.n_reference
    assert found.mean_mm < 0.1
    assert found.radius_mm < 0.05
