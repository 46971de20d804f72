"""The parent artery under a sac of known shape."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from sac_truth import (
    GLUED,
    X,
    anatomy_of,
    beside_the_fork_without_sac,
    moved_mm,
    neck_center_mm,
    relative_errors,
    scanned_anatomy_of,
)
from scipy.optimize import brentq
from scipy.spatial import cKDTree
from scipy.special import ndtr
from told import place_in

from vstent import phantoms
from vstent.anatomy.morphology import morphology
from vstent.anatomy.repair import repair
from vstent.anatomy.restore.neck import Flank, unblurred
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.restore.sac import is_island
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.errors import InputError
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy, Aneurysm, Vessel
from vstent.io.surfaces import read_surface
from vstent.kernels import curves, triangles
from vstent.phantoms import tube, with_sac

IN_BRIEF = ("wide on the inside of a bend", "beside a branch", "neck of 2 diameters", "tall")
"""Those that the default suite tries."""
SCANS_IN_BRIEF = (("demo", 0.28),)
NECK_TOLERANCE = {0.15: 0.05, 0.28: 0.05, 0.4: 0.08}
"""Of a scan by voxel edge (mm)."""


def _rows(every: list, brief: tuple) -> list:
    return [pytest.param(row, marks=() if row in brief else pytest.mark.validation, id=str(row)) for row in every]


@pytest.fixture(scope="module")
def demo() -> tuple[Anatomy, phantoms.Phantom]:
    phantom = phantoms.demo_phantom()
    return anatomy_of(phantom), phantom


def test_a_bulge_without_a_neck_is_refused(demo, monkeypatch: pytest.MonkeyPatch) -> None:
    anatomy, _ = demo
    (sac,) = anatomy.aneurysms
    shut = replace(sac, neck=Surface(sac.neck.vertices_mm[:1] + 1e-6 * sac.neck.vertices_mm, sac.neck.faces))
    monkeypatch.setattr("vstent.anatomy.restore.restore.cut_sac", lambda *_: shut)
    monkeypatch.setattr("vstent.anatomy.restore.restore.plane_sac", lambda *_: None)
    with pytest.raises(InputError, match="is too flat: no sac is left beyond its neck"):
        restore(anatomy.vessel, at_mm=sac.sac.vertices_mm.mean(axis=0))


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
    foot = float(anatomy.parent.axis.nearest_abscissa_mm(neck_center_mm(phantom)[None])[0])
    proximal_mm, distal_mm = anatomy.parent.span_mm(aneurysm)
    assert proximal_mm < foot < distal_mm


def test_neck_and_sac_share_their_rim(demo) -> None:
    (aneurysm,) = demo[0].aneurysms
    assert aneurysm.sac.closest(aneurysm.neck_mm)[1].max() < 1e-9
    flux = (aneurysm.neck.areas_mm2[:, None] * aneurysm.neck.normals).sum(axis=0)
    others = aneurysm.sac.areas_mm2[:, None] * aneurysm.sac.normals
    # The vector area of a closed surface is zero: the neck's is that of the rest of the sac.
    on_neck = aneurysm.neck.closest(aneurysm.sac.corners_mm.mean(axis=1))[1] < 1e-9
    np.testing.assert_allclose(flux, others[~on_neck].sum(axis=0), atol=1e-6)


@pytest.mark.parametrize("name", _rows(list(GLUED), IN_BRIEF))
def test_artery_neck_and_sac_of_an_exact_wall(name: str) -> None:
    phantom = GLUED[name]()
    anatomy = anatomy_of(phantom)
    radius_error, distance_mm = relative_errors(anatomy, phantom)
    assert np.abs(radius_error).mean() < 0.005
    assert distance_mm.max() < 0.03
    (aneurysm,) = anatomy.aneurysms
    # What 0.25 mm triangles cut off a crevice is not known to the method; of a neck of 2.8 mm it is 2 %.
    np.testing.assert_allclose(aneurysm.neck.area_mm2, phantom.neck_area_mm2, rtol=0.025)
    np.testing.assert_allclose(aneurysm.sac.volume_mm3, phantom.sac_volume_mm3, rtol=0.005)
    assert aneurysm.sac.boundary_loops == ()


@pytest.mark.parametrize("row", _rows([(name, h) for name in GLUED for h in NECK_TOLERANCE], SCANS_IN_BRIEF))
def test_artery_neck_and_sac_of_a_noisy_scan(row: tuple[str, float]) -> None:
    name, voxel_mm = row
    phantom = GLUED[name]()
    anatomy = scanned_anatomy_of(phantom, voxel_mm)
    radius_error, distance_mm = relative_errors(anatomy, phantom)
    assert np.abs(radius_error).mean() < 0.02
    assert np.quantile(distance_mm, 0.95) < 0.15
    assert distance_mm.max() < 0.3
    (aneurysm,) = anatomy.aneurysms
    if (name, voxel_mm) != ("small", 0.4):  # a neck of 2.8 by 1.9 mm is 7 by 5 voxels: it comes out a sixth too large
        np.testing.assert_allclose(aneurysm.neck.area_mm2, phantom.neck_area_mm2, rtol=NECK_TOLERANCE[voxel_mm])
    # A wall of constant convexity is blurred inwards: a shallow sac loses more of its volume.
    np.testing.assert_allclose(aneurysm.sac.volume_mm3, phantom.sac_volume_mm3, rtol=0.03 if voxel_mm < 0.3 else 0.05)


@pytest.mark.parametrize(("voxel_mm", "noise"), [(0.28, 1), (0.4, 2)])  # this noise joins branch and sac at 0.28 mm
def test_last_digits_do_not_move_the_neck_of_a_sac_that_a_branch_touches(voxel_mm: float, noise: int) -> None:
    phantom = GLUED["touching a branch"]()
    vessel = scanned_anatomy_of(phantom, voxel_mm, noise).vessel
    for seed in range(2):
        shift_mm = 1e-4 * np.random.default_rng(seed).normal(size=vessel.lumen.vertices_mm.shape)
        moved = Surface(vessel.lumen.vertices_mm + shift_mm, vessel.lumen.faces)
        (aneurysm,) = restore(replace(vessel, lumen=moved)).aneurysms
        assert aneurysm.neck.area_mm2 == pytest.approx(phantom.neck_area_mm2, rel=NECK_TOLERANCE[voxel_mm])
        assert aneurysm.sac.volume_mm3 == pytest.approx(phantom.sac_volume_mm3, rel=0.03)
        assert aneurysm.plane is not None
        assert aneurysm.plane.bulge_fraction > 0.95


@pytest.mark.parametrize("stretch", [1.5, 1 / 1.5], ids=["sac on the wide side", "sac on the narrow side"])
def test_an_oval_artery_is_its_own_wall_and_keeps_its_sac(stretch: float) -> None:
    # A round artery drawn out across its axis by as much as it is pressed in: volumes stay.
    round_one = with_sac(phantoms.tube(length_mm=26), abscissa_mm=13, width_mm=6.0, neck_mm=3.8, direction=X)
    assert round_one.sac is not None
    surface = phantoms.phantom_surface(round_one, edge_mm=0.3)
    factor = np.array([np.sqrt(stretch), 1 / np.sqrt(stretch), 1.0])
    anatomy = restore(trace(Vessel(Surface(surface.vertices_mm * factor, surface.faces))))
    (aneurysm,) = anatomy.aneurysms
    np.testing.assert_allclose(aneurysm.sac.volume_mm3, round_one.sac_volume_mm3, rtol=0.01)
    landed = anatomy.parent.landing_surface.vertices_mm[~anatomy.parent.is_continued] / factor
    error = np.hypot(landed[:, 0], landed[:, 1]) / 2.0 - 1
    beside = np.abs(landed[:, 2] - 13) > 5.0
    assert np.abs(error).max() < 0.06
    assert np.abs(error[beside]).max() < 0.01
    inside = (landed[:, 2] > 1.0) & (landed[:, 2] < 25.0)  # at the ends rays leave by the opening
    assert not anatomy.parent.is_restored[~anatomy.parent.is_continued][beside & inside].any()


def test_two_sacs_are_both_found_and_the_one_at_a_point_alone() -> None:
    long = phantoms.tube(length_mm=46)
    first = with_sac(long, abscissa_mm=15, width_mm=5.0, neck_mm=3.6, direction=X)
    second = with_sac(long, abscissa_mm=30, width_mm=7.0, neck_mm=4.5, direction=np.array([-0.5, 1.0, 0.0]))
    assert first.sac is not None
    assert second.sac is not None
    vessel = trace(Vessel(phantoms.phantom_surface(replace(first, blebs=(second.sac,)), edge_mm=0.3)))
    anatomy = restore(vessel)
    middles_mm = [np.mean(anatomy.parent.span_mm(one)) for one in anatomy.aneurysms]
    is_upward = anatomy.parent.axis.points_mm[0, 2] < 1
    found = {round(z if is_upward else 46 - z): one for z, one in zip(middles_mm, anatomy.aneurysms, strict=True)}
    assert list(found) == [30, 15]  # the larger first
    (note,) = (note for note in anatomy.notes if note.startswith("2 sacs, the largest first: "))
    for part, phantom in zip(note.split(";")[:2], (second, first), strict=True):
        np.testing.assert_allclose(place_in(part), phantom.sac.center_mm, atol=1.0)
    for abscissa_mm, phantom in ((15, first), (30, second)):
        np.testing.assert_allclose(found[abscissa_mm].sac.volume_mm3, phantom.sac_volume_mm3, rtol=0.01)
        np.testing.assert_allclose(found[abscissa_mm].neck.area_mm2, phantom.neck_area_mm2, rtol=0.03)
    (alone,) = restore(vessel, at_mm=first.sac.center_mm).aneurysms
    np.testing.assert_allclose(alone.sac.volume_mm3, first.sac_volume_mm3, rtol=0.01)


def test_the_flank_is_freed_of_the_blur_of_the_artery_below_it() -> None:
    """A wall along z, the artery's wall at z = 0: the tissue between them is blurred from both sides."""
    y, z = np.meshgrid(np.linspace(-1, 1, 5), np.linspace(0.4, 2.0, 33), indexing="ij")
    number = np.arange(y.size).reshape(y.shape)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.concatenate([np.stack([q.ravel() for q in t], axis=1) for t in ((a, b, c), (a, c, d))])
    blur_mm = 0.25
    # Tissue between the sac (x < 0) and the artery (z < 0), both flat: seen at the x where it is half of itself.
    x = np.array([brentq(lambda x, h=h: ndtr(x / blur_mm) - ndtr(-h / blur_mm) - 0.5, 0, 3) for h in z.ravel()])
    seen = Flank(np.stack([x, y.ravel(), z.ravel()], axis=1), faces, z.ravel(), number[:, 0])
    assert x.max() > 0.03
    freed = unblurred(seen, blur_mm).vertices_mm
    inner = (np.abs(y.ravel()) < 0.9) & (z.ravel() > 0.45)
    assert np.abs(freed[inner, 0]).max() < 0.12 * x[inner].max()  # the normals lean where the flank leans


def test_the_neck_lies_on_the_landing_surface_in_the_lumen(demo) -> None:
    anatomy, phantom = demo
    (aneurysm,) = anatomy.aneurysms
    assert anatomy.parent.landing_surface.closest(aneurysm.neck_mm)[1].max() < 1e-6
    assert anatomy.vessel.closed.signed_distance(aneurysm.neck_mm).max() < 0.05
    # The true neck is where the sac's ellipsoid meets the artery.
    assert np.abs(phantom.sac.implicit_mm(aneurysm.neck_mm)[0]).max() < 0.05


def test_a_branch_that_passes_close_to_the_sac_takes_nothing_of_its_wall() -> None:
    phantom = GLUED["touching a branch"]()
    (aneurysm,) = anatomy_of(phantom).aneurysms
    assert phantom.sac is not None
    angle = np.linspace(-0.5, 0.5, 21)
    facing_mm = phantom.sac.center_mm + 3.5 * np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    assert aneurysm.sac.closest(facing_mm)[1].max() < 0.02


def test_low_wall_apart_from_every_opening_is_where_the_sac_touches_an_artery() -> None:
    lumen = phantoms.phantom_surface(tube(length_mm=10))
    x, _, z = lumen.vertices_mm.T
    touching, artery = (np.abs(z - 6) < 1) & (x > 1), z < 3
    np.testing.assert_array_equal(is_island(lumen, touching | artery), touching)
    bridge = (np.abs(z - 4) < 2.5) & (np.abs(x - 1.5) < 0.5)
    assert not is_island(lumen, touching | artery | bridge).any()


@cache
def real_sac(path: Path) -> Aneurysm:
    lumen = repair(read_surface(path)[0])[0]
    (aneurysm,) = restore(trim(trace(Vessel(lumen)))).aneurysms
    return aneurysm


def test_a_sac_on_a_coarse_mesh_is_cut_where_its_branches_leave(shared_data: Path) -> None:
    aneurysm = real_sac(shared_data / "bifurcation_coarse.vtp")
    # One daughter runs along the sac, less than a triangle away: the neck must not climb between them.
    height_mm = np.ptp(aneurysm.neck_mm @ _mean_direction(aneurysm.neck))
    assert height_mm < 0.7 * np.sqrt(4 * aneurysm.neck.area_mm2 / np.pi)
    assert aneurysm.sac.boundary_loops == ()


def test_a_sac_at_a_fork_is_what_the_fork_without_it_lacks(shared_data) -> None:
    sick, healthy = (read_surface(shared_data / f"bifurcation_{name}_sac.stl")[0] for name in ("with", "without"))
    (aneurysm,) = restore(trace(Vessel(sick))).aneurysms
    lacking_mm3 = sick.closed.volume_mm3 - healthy.closed.volume_mm3
    assert aneurysm.sac.volume_mm3 == pytest.approx(lacking_mm3, rel=0.01)
    # Both branches leave alike, whichever of them the parent artery follows.
    low, high = aneurysm.neck_mm.min(axis=0), aneurysm.neck_mm.max(axis=0)
    assert low[:2] == pytest.approx(-high[:2], abs=0.4)
    assert sharpest_rad(aneurysm.neck_mm) < np.radians(45)


@pytest.mark.validation
def test_the_neck_of_a_real_sac_has_no_hooks(shared_data) -> None:
    assert sharpest_rad(real_sac(shared_data / "visc2011_metres.stl").neck_mm) < np.radians(50)


def test_the_neck_of_a_real_sac_at_a_fork_is_the_section_of_the_wall_by_its_plane(shared_data) -> None:
    sac = real_sac(shared_data / "bifurcation_coarse.vtp")
    lumen = read_surface(shared_data / "bifurcation_coarse.vtp")[0]
    assert sac.plane is not None
    assert np.abs((sac.neck_mm - sac.plane.center_mm) @ sac.plane.normal).max() < 1e-9
    assert lumen.closest(sac.neck_mm)[1].max() < 1e-6
    area_mm2 = abs(triangles.polygon_area_vector(sac.neck_mm) @ sac.plane.normal)
    assert sac.plane.area_band_mm2[0] <= area_mm2 <= sac.plane.area_band_mm2[1]


def sharpest_rad(ring_mm: np.ndarray) -> float:
    """Largest turn of a closed curve between pieces of 0.3 mm."""
    ring = np.concatenate([ring_mm, ring_mm[:1]])
    even = curves.resample_evenly(ring, round(curves.arc_length(ring)[-1] / 0.3) + 1)[:-1]
    chord = np.roll(even, -1, axis=0) - even
    chord /= np.linalg.norm(chord, axis=1, keepdims=True)
    return float(np.arccos(np.clip(np.einsum("nd,nd->n", chord, np.roll(chord, 1, axis=0)), -1, 1)).max())


def _mean_direction(neck: Surface) -> np.ndarray:
    total = (neck.areas_mm2[:, None] * neck.normals).sum(axis=0)
    return total / np.linalg.norm(total)


def test_the_neck_does_not_depend_on_the_mesh(demo) -> None:
    anatomy, phantom = demo
    coarse = restore(trace(Vessel(phantoms.phantom_surface(phantom, edge_mm=0.35))))
    np.testing.assert_allclose(coarse.aneurysms[0].neck.area_mm2, anatomy.aneurysms[0].neck.area_mm2, rtol=0.02)


def test_without_a_sac_the_landing_surface_is_the_wall() -> None:
    phantom = phantoms.siphon()
    anatomy = anatomy_of(phantom)
    assert anatomy.aneurysms == ()
    assert any("No sac" in note for note in anatomy.notes)
    vertices = anatomy.parent.landing_surface.vertices_mm[~anatomy.parent.is_restored]
    assert anatomy.vessel.lumen.closest(vertices)[1].max() < 1e-6
    assert anatomy.parent.is_restored.mean() < 0.05


def test_a_point_far_from_any_sac_is_refused() -> None:
    vessel = trace(Vessel(phantoms.phantom_surface(phantoms.torus_arc())))
    with pytest.raises(InputError, match="nothing bulges out of the artery near"):
        restore(vessel, at_mm=np.array([0.0, 10.0, 8.0]))


def test_motion_mirror_and_order_of_the_triangles_do_not_change_the_sac(demo) -> None:
    anatomy, _ = demo
    rng = np.random.default_rng(5)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= -np.sign(np.linalg.det(turn))  # mirrored besides, and the triangles in another order
    faces = rng.permutation(anatomy.vessel.lumen.faces)[:, ::-1]
    moved = restore(trace(Vessel(Surface(anatomy.vessel.lumen.vertices_mm @ turn.T + [5.0, 60.0, -9.0], faces))))
    np.testing.assert_allclose(moved.aneurysms[0].sac.volume_mm3, anatomy.aneurysms[0].sac.volume_mm3, rtol=0.005)
    np.testing.assert_allclose(moved.aneurysms[0].neck.area_mm2, anatomy.aneurysms[0].neck.area_mm2, rtol=0.02)
    there = anatomy.parent.axis.points_mm @ turn.T + [5.0, 60.0, -9.0]
    assert curves.project(there, moved.parent.axis.points_mm)[1].max() < 0.05


def test_trimming_cuts_a_long_artery_square_and_keeps_the_sac() -> None:
    phantom = phantoms.with_sac(phantoms.tube(length_mm=110.0), abscissa_mm=60.0)
    vessel = trim(trace(Vessel(phantoms.phantom_surface(phantom, edge_mm=0.35))))
    low, high = sorted(opening.center_mm[2] for opening in vessel.openings)
    assert 21.0 < low < 26.0
    assert 81.0 < high < 90.0
    np.testing.assert_allclose([o.area_mm2 for o in vessel.openings], np.pi * 4.0, rtol=0.02)
    assert restore(vessel).aneurysms[0].sac.volume_mm3 == pytest.approx(phantom.sac_volume_mm3, rel=0.03)


def test_a_sac_that_trimming_takes_off_is_told() -> None:
    long = phantoms.tube(length_mm=100)
    near, far = (with_sac(long, abscissa_mm=s, width_mm=w, neck_mm=4.0) for s, w in ((20, 7.0), (85, 6.0)))
    assert far.sac is not None
    wall = phantoms.phantom_surface(replace(near, blebs=(far.sac,)), edge_mm=0.4)
    vessel = trim(trace(Vessel(wall), inlet_mm=np.zeros(3)))
    assert "Other bulges that were cut off: 1, the highest 5." in vessel.notes[-1]
    assert far.sac.implicit_mm(place_in(vessel.notes[-1])[None])[0] == pytest.approx(0.0, abs=0.1)
    assert len(restore(vessel).aneurysms) == 1


def test_trimming_keeps_the_lengths_that_are_given() -> None:
    phantom = phantoms.with_sac(phantoms.tube(length_mm=50.0), abscissa_mm=25.0)
    traced = trace(Vessel(phantoms.phantom_surface(phantom, edge_mm=0.35)), inlet_mm=np.zeros(3))
    vessel = trim(traced, upstream_mm=12.0, downstream_mm=9.0)
    low, high = sorted(opening.center_mm[2] for opening in vessel.openings)
    assert low == pytest.approx(13.0, abs=0.1)
    assert high == pytest.approx(34.0, abs=0.1)
    assert "Trimmed to 12 mm of vessel proximal and 9 mm distal to the middle of the bulge at (" in vessel.notes[-1]
    with pytest.raises(InputError, match="above zero"):
        trim(traced, downstream_mm=0.0)


def circle(points_mm: np.ndarray, radius_mm: float) -> np.ndarray:
    """Points on the axis of a straight artery along z with a sac on its +x side -> a circle around the sac's mouth."""
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    return points_mm + radius_mm * np.stack([0 * angle, np.cos(angle), np.sin(angle)], axis=1)


def test_a_neck_drawn_where_it_is_gives_the_sac_that_is_there(demo) -> None:
    anatomy, phantom = demo
    (found,) = anatomy.aneurysms
    (drawn,) = restore(anatomy.vessel, neck_mm=found.neck_mm[::-1]).aneurysms
    np.testing.assert_allclose(drawn.neck.area_mm2, phantom.neck_area_mm2, rtol=0.025)
    np.testing.assert_allclose(drawn.sac.volume_mm3, phantom.sac_volume_mm3, rtol=0.005)
    assert drawn.sac.boundary_loops == ()
    into_sac = phantom.sac.center_mm - drawn.neck.corners_mm.mean(axis=1)
    assert (np.einsum("ij,ij->i", into_sac, drawn.neck.normals) > 0).mean() > 0.99


def test_a_neck_drawn_up_the_sac_cuts_it_there() -> None:
    phantom = with_sac(tube(length_mm=40, radius_mm=2.0), abscissa_mm=20, width_mm=7.0, neck_mm=4.5, direction=X)
    assert phantom.sac is not None
    vessel = trace(Vessel(phantoms.phantom_surface(phantom)))
    (aneurysm,) = restore(vessel, neck_mm=circle(phantom.sac.center_mm, 3.4)).aneurysms
    # Half of a sphere, but for the neck's arch: it is vaulted as the artery is below it.
    volume_mm3, flat_mm2 = 2 / 3 * np.pi * 3.5**3, np.pi * 3.4**2
    assert 0.95 * volume_mm3 < aneurysm.sac.volume_mm3 < volume_mm3
    assert flat_mm2 < aneurysm.neck.area_mm2 < 1.1 * flat_mm2
    np.testing.assert_allclose(aneurysm.neck_mm[:, 0], phantom.sac.center_mm[0], atol=0.01)


@pytest.mark.parametrize(
    ("neck_mm", "complaint"),
    [
        (np.zeros((2, 3)), "at least three points"),
        (np.array([[np.nan, 0, 0], [1, 0, 0], [0, 1, 0]]), "at least three points"),
        (circle(np.array([40.0, 0, 20]), 2.0), r"mm from the wall at \(40.0"),
        (circle(np.array([2.0, 0, 30]), 0.02), "separates nothing from the artery"),
        (circle(np.array([30.0, 0, 0]), 2.0)[:, [1, 2, 0]], "around the artery"),
    ],
)
def test_a_neck_that_is_none_is_refused(neck_mm: np.ndarray, complaint: str) -> None:
    vessel = trace(Vessel(phantoms.phantom_surface(tube(length_mm=40, radius_mm=2.0), edge_mm=0.4)))
    with pytest.raises(InputError, match=complaint):
        restore(vessel, neck_mm=neck_mm)


@cache
def aneurisk_C0038(folder: Path) -> Vessel:
    return trace(Vessel(read_surface(folder / "aneurisk_C0038.vtp")[0]))


@pytest.mark.validation
def test_real_centerlines_agree_with_vmtk(shared_data: Path) -> None:
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

    vessel = aneurisk_C0038(shared_data)
    reader = vtkXMLPolyDataReader()
    reader.SetFileName(str(shared_data / "aneurisk_C0038_centerlines.vtp"))
    reader.Update()
    data = reader.GetOutput()
    reference = vtk_to_numpy(data.GetPoints().GetData()).astype(float)
    radius = vtk_to_numpy(data.GetPointData().GetArray("MaximumInscribedSphereRadius"))
    assert len(vessel.centerlines) == 8
    line = vessel.centerlines[1]
    healthy = (line.abscissa_mm > 5) & (line.abscissa_mm < 60)  # before the sac; VMTK stops short of the ends
    distance, nearest = cKDTree(reference).query(line.points_mm[healthy])
    assert distance.mean() < 0.1
    assert np.abs(line.inscribed_radius_mm[healthy] - radius[nearest]).mean() < 0.05


@pytest.mark.validation
def test_the_real_sac_is_that_of_aneurisk_web(shared_data) -> None:
    anatomy = restore(trim(aneurisk_C0038(shared_data)))
    (aneurysm,) = anatomy.aneurysms
    found = morphology(anatomy)
    # AneuriskWeb closes the sac by a plane drawn by hand.
    assert aneurysm.sac.volume_mm3 == found["sac_plane_volume_mm3"] == pytest.approx(344.4, rel=0.12)
    assert found["neck_area_mm2"] == pytest.approx(38.5, rel=0.07)
    assert found["neck_plane_area_low_mm2"] < 38.5 < found["neck_plane_area_high_mm2"]


@pytest.mark.parametrize("side", [pytest.param(-1.0, marks=pytest.mark.validation), 1.0])
def test_the_idealised_bifurcation_is_restored_to_the_one_without_its_sac(shared_data, side: float) -> None:
    sick, healthy, radius, distance_mm = beside_the_fork_without_sac(shared_data, side)
    assert len(sick.aneurysms) == 1
    assert healthy.aneurysms == ()
    assert np.abs(radius).mean() < 0.01
    assert np.quantile(distance_mm, 0.95) < 0.1
    assert distance_mm.max() < 0.2


@pytest.mark.parametrize("name", ["aneurisk_C0015_no_sac.vtp", "healthy_siphon.vtk"])
def test_a_real_healthy_artery_stays_as_it_is(shared_data, name: str) -> None:
    anatomy = restore(trace(Vessel(repair(read_surface(shared_data / name)[0])[0])))  # the siphon comes inside out
    assert anatomy.aneurysms == ()
    assert anatomy.parent.is_restored.mean() < 0.5
    assert moved_mm(anatomy) < 0.05
