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
    walls = [phantoms.phantom_surface(phantom, edge_mm=0.6)]
    walls += [halved(phantom, walls[0])]
    walls += [halved(phantom, walls[1])]
    coarse, fine, finest = (trace_errors(phantom, traced(phantom, wall)) for wall in walls)
    print(coarse, fine, finest, sep="\n")  # noqa: T201  # `make validation` shows it
    assert coarse.mean_mm < 0.003
    assert coarse.max_mm < 0.01
    assert coarse.radius_mm < 0.003
    assert np.log2(coarse.radius_mm / fine.radius_mm) > 1.95
    # Of 0.0001 mm a part is the phantom's own: its axis is a polyline of steps of 0.04 mm.
    assert np.log2(coarse.radius_mm / finest.radius_mm) / 2 > 1.95
    assert np.log2(coarse.mean_mm / finest.mean_mm) / 2 > 1.5
    assert finest.radius_mm < 0.0001


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
