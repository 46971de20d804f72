"""Surfaces at which a neck inflow is counted, on a sphere beside a straight artery."""

from dataclasses import replace

import numpy as np
import pytest

from vstent import phantoms
from vstent.anatomy.restore.bulges import find_bulges
from vstent.anatomy.restore.plane import plane_sac
from vstent.anatomy.restore.tubes import tubes_of
from vstent.flow.ostium import SHIFT_MM, ostium, surfaces_beside
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Aneurysm
from vstent.kernels import triangles

PHANTOM = phantoms.with_sac(phantoms.tube(length_mm=24), abscissa_mm=12)


@pytest.fixture(scope="module")
def lumen() -> Surface:
    return phantoms.phantom_surface(PHANTOM, edge_mm=0.3)


@pytest.fixture(scope="module")
def aneurysm(lumen) -> Aneurysm:
    tubes = tubes_of([PHANTOM.parent])
    found = plane_sac(lumen, tubes, find_bulges(lumen, tubes)[0])
    assert found is not None
    return found


def test_the_ostium_is_the_section_by_the_neck_plane_and_bounds_the_sac(lumen, aneurysm) -> None:
    surface, plane = ostium(aneurysm, lumen), aneurysm.plane
    assert surface.area_mm2 == pytest.approx(plane.area_mm2, rel=0.002)
    np.testing.assert_allclose(surface.normals, np.broadcast_to(plane.normal, surface.normals.shape), atol=1e-9)
    (rim,) = triangles.boundary_loops(surface.vertices_mm, surface.faces)
    assert lumen.closest(surface.vertices_mm[rim])[1].max() < 0.01
    below_mm = (aneurysm.sac.vertices_mm - plane.center_mm) @ plane.normal
    assert below_mm.min() > -1e-6


def test_half_a_millimetre_into_the_sac_the_section_is_that_of_the_sphere(lumen, aneurysm) -> None:
    beside, plane, sphere = surfaces_beside(aneurysm), aneurysm.plane, PHANTOM.sac
    assert set(beside) == {"neck_inflow_in_sac", "neck_inflow_in_artery", "plane_inflow"}
    down_mm = (sphere.center_mm - plane.center_mm) @ plane.normal - SHIFT_MM
    section_mm2 = np.pi * (sphere.width_radius_mm**2 - down_mm**2)
    assert beside["neck_inflow_in_sac"].area_mm2 == pytest.approx(section_mm2, rel=0.01)
    assert beside["neck_inflow_in_artery"].area_mm2 == pytest.approx(plane.area_mm2, rel=0.002)
    assert beside["plane_inflow"].area_mm2 == pytest.approx(plane.area_mm2, rel=0.002)
    for name, sign in (("neck_inflow_in_sac", 1), ("neck_inflow_in_artery", -1)):
        surface = beside[name]
        height_mm = (surface.vertices_mm - plane.center_mm) @ plane.normal
        np.testing.assert_allclose(height_mm, sign * SHIFT_MM, atol=1e-6)
        assert (surface.normals @ plane.normal).min() > 0.999


def test_the_direction_of_the_rim_does_not_turn_the_sections(aneurysm) -> None:
    plane = replace(aneurysm.plane, rim_mm=aneurysm.plane.rim_mm[::-1])
    for surface in surfaces_beside(replace(aneurysm, plane=plane)).values():
        assert (surface.normals @ plane.normal).min() > 0.999


def test_a_sac_without_a_plane_is_entered_through_its_neck(lumen, aneurysm) -> None:
    drawn = replace(aneurysm, plane=None)
    assert ostium(drawn, lumen).area_mm2 == pytest.approx(aneurysm.neck.area_mm2, rel=1e-3)
    assert surfaces_beside(drawn) == {}
