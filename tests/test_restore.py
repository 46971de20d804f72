"""The parent artery under a sac of known shape."""

import numpy as np
import pytest

from vstent import phantoms
from vstent.errors import InputError
from vstent.kernels import curves
from vstent.restore import restore
from vstent.surface import Surface
from vstent.trace import trace
from vstent.trim import trim
from vstent.vessel import Anatomy, Vessel


def anatomy_of(phantom: phantoms.Phantom) -> Anatomy:
    return restore(trace(Vessel(phantoms.phantom_surface(phantom))))


def relative_errors(anatomy: Anatomy, phantom: phantoms.Phantom) -> tuple[np.ndarray, np.ndarray]:
    """Radius error (fraction) of the landing surface's sections, and distance (mm) of its vertices to the true wall."""
    axis = anatomy.axis
    inner = (axis.abscissa_mm > 3) & (axis.abscissa_mm < axis.length_mm - 3)
    place = curves.project(phantom.parent.points_mm, axis.points_mm[inner])[0]
    true_mm = np.interp(place, phantom.parent.abscissa_mm, phantom.parent.inscribed_radius_mm)
    rings = anatomy.landing_surface.vertices_mm.reshape(len(axis.points_mm), -1, 3)[inner].reshape(-1, 3)
    wall = phantoms.tube_implicit_mm(phantom.parent, rings)[0]
    return anatomy.section_radius_mm[inner] / true_mm - 1, np.abs(wall)


@pytest.fixture(scope="module")
def demo() -> tuple[Anatomy, phantoms.Phantom]:
    phantom = phantoms.demo_phantom()
    return anatomy_of(phantom), phantom


def test_the_demo_artery_is_restored_under_sac_and_branch(demo) -> None:
    radius_error, distance_mm = relative_errors(*demo)
    assert np.abs(radius_error).mean() < 0.01
    assert np.abs(radius_error).max() < 0.03
    assert np.quantile(distance_mm, 0.95) < 0.1
    assert distance_mm.max() < 0.3


def test_the_sac_has_its_volume_and_is_closed(demo) -> None:
    anatomy, phantom = demo
    (aneurysm,) = anatomy.aneurysms
    assert aneurysm.sac.boundary_loops == ()
    np.testing.assert_allclose(aneurysm.sac.volume_mm3, phantom.sac_volume_mm3, rtol=0.03)
    into_sac = phantom.sac.center_mm - aneurysm.neck.corners_mm.mean(axis=1)
    assert (np.einsum("ij,ij->i", into_sac, aneurysm.neck.normals) > 0).mean() > 0.99
    foot = float(anatomy.axis.nearest_abscissa_mm(phantom.neck_center_mm[None])[0])
    assert aneurysm.proximal_abscissa_mm < foot < aneurysm.distal_abscissa_mm


def test_neck_and_sac_share_their_rim(demo) -> None:
    (aneurysm,) = demo[0].aneurysms
    assert aneurysm.sac.closest(aneurysm.neck_mm)[1].max() < 1e-9
    flux = (aneurysm.neck.areas_mm2[:, None] * aneurysm.neck.normals).sum(axis=0)
    others = aneurysm.sac.areas_mm2[:, None] * aneurysm.sac.normals
    # The vector area of a closed surface is zero: the neck's is that of the rest of the sac.
    on_neck = aneurysm.neck.closest(aneurysm.sac.corners_mm.mean(axis=1))[1] < 1e-9
    np.testing.assert_allclose(flux, others[~on_neck].sum(axis=0), atol=1e-6)


@pytest.mark.parametrize("neck_mm", [4.0, 6.8])
def test_a_sac_on_the_inside_of_a_bend(neck_mm: float) -> None:
    phantom = phantoms.with_sac(
        phantoms.torus_arc(bend_radius_mm=9.0), abscissa_mm=14.0, neck_mm=neck_mm, direction=_inside(14.0 / 9.0)
    )
    radius_error, distance_mm = relative_errors(anatomy := anatomy_of(phantom), phantom)
    assert np.abs(radius_error).mean() < 0.02
    assert np.quantile(distance_mm, 0.95) < 0.15
    np.testing.assert_allclose(anatomy.aneurysms[0].sac.volume_mm3, phantom.sac_volume_mm3, rtol=0.05)


def _inside(angle_rad: float) -> np.ndarray:
    return -np.array([np.cos(angle_rad), 0.0, np.sin(angle_rad)])


def test_without_a_sac_the_landing_surface_is_the_wall() -> None:
    phantom = phantoms.siphon()
    anatomy = anatomy_of(phantom)
    assert anatomy.aneurysms == ()
    assert any("No sac" in note for note in anatomy.notes)
    vertices = anatomy.landing_surface.vertices_mm[~anatomy.is_restored]
    assert anatomy.vessel.lumen.closest(vertices)[1].max() < 1e-6
    assert anatomy.is_restored.mean() < 0.05


def test_a_point_far_from_any_sac_is_refused() -> None:
    vessel = trace(Vessel(phantoms.phantom_surface(phantoms.torus_arc())))
    with pytest.raises(InputError, match="no sac"):
        restore(vessel, at_mm=np.array([0.0, 10.0, 8.0]))


def test_rigid_motion_moves_the_sac(demo) -> None:
    anatomy, _ = demo
    turn = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    lumen = Surface(anatomy.vessel.lumen.vertices_mm @ turn.T + [5.0, 60.0, -9.0], anatomy.vessel.lumen.faces)
    moved = restore(trace(Vessel(lumen)))
    np.testing.assert_allclose(moved.aneurysms[0].sac.volume_mm3, anatomy.aneurysms[0].sac.volume_mm3, rtol=0.01)
    there = anatomy.axis.points_mm @ turn.T + [5.0, 60.0, -9.0]
    assert curves.project(there, moved.axis.points_mm)[1].max() < 0.05


def test_trimming_cuts_a_long_artery_square_and_keeps_the_sac() -> None:
    phantom = phantoms.with_sac(phantoms.tube(length_mm=110.0), abscissa_mm=60.0)
    vessel = trim(trace(Vessel(phantoms.phantom_surface(phantom, edge_mm=0.35))))
    low, high = sorted(opening.center_mm[2] for opening in vessel.openings)
    assert 21.0 < low < 26.0
    assert 81.0 < high < 90.0
    np.testing.assert_allclose([o.area_mm2 for o in vessel.openings], np.pi * 4.0, rtol=0.02)
    assert restore(vessel).aneurysms[0].sac.volume_mm3 == pytest.approx(phantom.sac_volume_mm3, rel=0.03)


def test_the_real_sac_has_the_published_volume(shared_data) -> None:
    from vstent.io.surfaces import read_surface

    anatomy = restore(trim(trace(Vessel(read_surface(shared_data / "aneurisk_C0038.vtp")[0]))))
    # AneuriskWeb cuts the neck by a plane further out: its sac is 344 mm3 with the artery's share of the neck.
    assert anatomy.aneurysms[0].sac.volume_mm3 == pytest.approx(344.4, rel=0.15)
