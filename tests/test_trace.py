"""Openings and centerlines on vessels with a known axis."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from shapes import sphere
from vstent import phantoms
from vstent.errors import VesselError
from vstent.kernels import curves, triangles
from vstent.measure import morphology
from vstent.openings import open_ends
from vstent.restore import restore
from vstent.segment import segment
from vstent.surface import Surface
from vstent.trace import trace
from vstent.trim import trim
from vstent.vessel import Vessel


def traced(phantom: phantoms.Phantom) -> Vessel:
    return trace(Vessel(phantoms.phantom_surface(phantom)))


@pytest.fixture(scope="module")
def torus() -> Vessel:
    return traced(phantoms.torus_arc())


@pytest.fixture(scope="module")
def fork() -> Vessel:
    return traced(phantoms.bifurcation())


def test_centerline_and_inscribed_radius_of_a_torus(torus: Vessel) -> None:
    line = torus.centerlines[0]
    inner = (line.abscissa_mm > 2) & (line.abscissa_mm < line.length_mm - 2)
    points = line.points_mm[inner]
    from_axis = np.hypot(np.hypot(points[:, 0], points[:, 2]) - 8.0, points[:, 1])
    assert from_axis.mean() < 0.02
    assert from_axis.max() < 0.1
    assert np.abs(line.inscribed_radius_mm[inner] - 2.0).mean() < 0.01
    assert abs(line.length_mm - 8 * np.pi) < 0.1


def test_openings_have_the_areas_and_directions_of_the_ends(fork: Vessel) -> None:
    phantom = phantoms.bifurcation()
    for opening, (center, normal, radius) in zip([fork.inlet, *fork.outlets], _by_opening(fork, phantom), strict=True):
        np.testing.assert_allclose(opening.area_mm2, np.pi * radius**2, rtol=0.02)
        np.testing.assert_allclose(opening.center_mm, center, atol=0.05)
        assert opening.normal @ normal > 0.999
    assert fork.inlet.area_mm2 > fork.outlets[0].area_mm2


def _by_opening(vessel: Vessel, phantom: phantoms.Phantom) -> list:
    ends = phantom.ends
    return [min(ends, key=lambda e: np.linalg.norm(e[0] - o.center_mm)) for o in [vessel.inlet, *vessel.outlets]]


def test_every_outlet_is_reached_along_the_axis_of_its_branch(fork: Vessel) -> None:
    for line, opening in zip(fork.centerlines, fork.outlets, strict=True):
        np.testing.assert_allclose(line.points_mm[-1], opening.center_mm, atol=1e-3)
        np.testing.assert_allclose(line.points_mm[0], fork.inlet.center_mm, atol=1e-3)
        axis = phantoms.bifurcation().parent.points_mm * [np.sign(opening.center_mm[0]), 1, 1]
        # At the fork the inscribed spheres widen and the medial axis is no longer either tube's: legs only.
        leg = line.points_mm[line.abscissa_mm > 17]
        assert curves.project(axis, leg)[1].mean() < 0.03


def test_rigid_motion_moves_the_centerline(torus: Vessel) -> None:
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    shift = np.array([30.0, -20.0, 7.0])
    moved = trace(
        Vessel(Surface(torus.lumen.vertices_mm @ turn.T + shift, torus.lumen.faces)),
        inlet_mm=(turn @ torus.inlet.center_mm + shift),
    )
    there = torus.centerlines[0].points_mm @ turn.T + shift
    assert curves.project(there, moved.centerlines[0].points_mm)[1].max() < 0.02


def test_flat_caps_are_taken_off() -> None:
    phantom = phantoms.tube(end_radius_mm=1.5)
    opened = Vessel(phantoms.phantom_surface(phantom))
    capped = open_ends(Vessel(opened.closed))
    assert [o.role for o in capped.openings] == ["inlet", "outlet_1"]
    np.testing.assert_allclose([o.diameter_mm for o in capped.openings], [4.0, 3.0], rtol=0.01)


def test_a_blind_arm_is_opened_and_a_sac_is_not() -> None:
    phantom = phantoms.with_sac(phantoms.torus_arc(), abscissa_mm=12.0)
    vessel = Vessel(phantoms.phantom_surface(phantom))
    outlet = vessel.lumen.boundary_loops[1]
    dome = _domed(vessel, outlet)
    assert len(dome.boundary_loops) == 1
    opened = open_ends(Vessel(dome))
    assert len(opened.openings) == 2
    np.testing.assert_allclose(opened.outlets[0].diameter_mm, 4.0, rtol=0.05)


def _domed(vessel: Vessel, loop: np.ndarray) -> Surface:
    """Close one opening by a half sphere, as a scan shows a vessel whose contrast ends."""
    points = vessel.lumen.vertices_mm
    center, outward = triangles.polygon_centroid(points[loop]), -triangles.polygon_area_vector(points[loop])
    outward = outward / np.linalg.norm(outward)
    rings, vertices, faces = [loop], [points], [vessel.lumen.faces]
    for angle in np.linspace(0, np.pi / 2, 9)[1:-1]:
        ring = center + np.cos(angle) * (points[loop] - center) + 2.0 * np.sin(angle) * outward
        rings.append(np.arange(len(loop)) + sum(map(len, vertices)))
        vertices.append(ring)
    vertices.append((center + 2.0 * outward)[None])
    tip = sum(map(len, vertices)) - 1
    for low, high in pairwise(rings):
        n_low, n_high = np.roll(low, -1), np.roll(high, -1)
        faces += [np.stack([n_low, low, high], 1), np.stack([n_low, high, n_high], 1)]
    faces.append(np.stack([np.roll(rings[-1], -1), rings[-1], np.full(len(loop), tip)], 1))
    return Surface(np.concatenate(vertices), np.concatenate(faces))


def test_a_sphere_has_no_way_in() -> None:
    with pytest.raises(VesselError, match="openings"):
        open_ends(Vessel(sphere(3.0)))


def test_the_inlet_can_be_chosen(fork: Vessel) -> None:
    chosen = trace(replace(fork, centerlines=()), inlet_mm=fork.outlets[1].center_mm)
    np.testing.assert_array_equal(chosen.inlet.center_mm, fork.outlets[1].center_mm)
    assert chosen.outlets[0].area_mm2 == fork.inlet.area_mm2


def test_real_centerlines_agree_with_vmtk(shared_data) -> None:
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

    from vstent.io.surfaces import read_surface

    vessel = trace(Vessel(read_surface(shared_data / "aneurisk_C0038.vtp")[0]))
    reader = vtkXMLPolyDataReader()
    reader.SetFileName(str(shared_data / "aneurisk_C0038_centerlines.vtp"))
    reader.Update()
    data = reader.GetOutput()
    reference = vtk_to_numpy(data.GetPoints().GetData()).astype(float)
    radius = vtk_to_numpy(data.GetPointData().GetArray("MaximumInscribedSphereRadius"))
    assert len(vessel.centerlines) == 8
    line = vessel.centerlines[1]
    healthy = (line.abscissa_mm > 5) & (line.abscissa_mm < 60)  # before the sac; VMTK stops short of the ends
    from scipy.spatial import cKDTree

    distance, nearest = cKDTree(reference).query(line.points_mm[healthy])
    assert distance.mean() < 0.1
    assert np.abs(line.inscribed_radius_mm[healthy] - radius[nearest]).mean() < 0.05


def test_the_band_of_the_threshold_is_carried_to_the_measures() -> None:
    image = phantoms.scan(phantoms.siphon(), np.random.default_rng(0), scanner=phantoms.Scanner(0.4, 0.3))
    scanned = segment(image)
    anatomy = restore(trim(trace(scanned)))
    assert anatomy.vessel.threshold_band_mm == scanned.threshold_band_mm > 0.02
    assert morphology(anatomy)["diameter_threshold_band_mm"] == scanned.threshold_band_mm
