"""Vessels that mislead: openings on a sac, lobes, trims too short, arteries that are sacs themselves."""

from dataclasses import replace
from functools import cache
from importlib import import_module

import numpy as np
import pytest
from told import place_in

from vstent import phantoms
from vstent.anatomy.repair import repair
from vstent.anatomy.restore.axis import fit_axis
from vstent.anatomy.restore.bulges import find_bulges
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.restore.tubes import tubes_of
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.errors import InputError
from vstent.geometry.vessel import Anatomy, Centerline, Vessel
from vstent.units import place


def more(*of: object) -> object:
    """A further case of a test, which the default suite leaves out."""
    return pytest.param(*of, marks=pytest.mark.validation)


def traced(phantom: phantoms.Phantom) -> Vessel:
    return trace(Vessel(repair(phantoms.phantom_surface(phantom, edge_mm=0.3))[0]))


@pytest.fixture(scope="module")
def demo() -> Anatomy:
    return restore(traced(phantoms.demo_phantom()))


@cache
def with_a_stub_in_its_dome(length_mm: float, radius_mm: float) -> Anatomy:
    return restore(traced(demo_with_a_stub_in_its_dome(length_mm=length_mm, radius_mm=radius_mm)))


def demo_with_a_stub_in_its_dome(*, length_mm: float, radius_mm: float) -> phantoms.Phantom:
    """The demo's phantom and a branch that leaves the dome of its sac and is cut off so far beyond it."""
    phantom = phantoms.demo_phantom()
    assert phantom.sac is not None
    reach = np.linspace(0.0, phantom.sac.height_radius_mm + length_mm, 120)
    points = phantom.sac.center_mm + reach[:, None] * phantom.sac.direction
    stub = Centerline(points, np.full(len(points), radius_mm))
    return replace(phantom, branches=(*phantom.branches, stub))


def test_a_short_branch_out_of_the_sac_is_not_the_parent_artery(demo) -> None:
    anatomy = with_a_stub_in_its_dome(1.0, 0.7)
    assert "outlet_1 (diameter 3.6 mm)" in anatomy.notes[0]
    np.testing.assert_allclose(anatomy.aneurysms[0].neck.area_mm2, demo.aneurysms[0].neck.area_mm2, rtol=0.03)
    np.testing.assert_allclose(anatomy.aneurysms[0].sac.volume_mm3, demo.aneurysms[0].sac.volume_mm3, rtol=0.02)


@pytest.mark.parametrize(("length_mm", "radius_mm"), [(1.0, 0.7), more(2.0, 1.2)])
def test_an_opening_on_a_sac_is_told_with_its_place(length_mm: float, radius_mm: float) -> None:
    anatomy = with_a_stub_in_its_dome(length_mm, radius_mm)
    (note,) = (note for note in anatomy.notes if "from the wall of a sac" in note)
    end_mm = anatomy.vessel.outlets[1].center_mm
    assert note.startswith(f"outlet_2, {2 * radius_mm:.1f} mm wide at {place(end_mm)}, is ")


@pytest.mark.parametrize("anatomy", ["demo", "a branch from the dome"])
def test_a_branch_that_leaves_from_the_sac_is_told(anatomy: str, demo) -> None:
    from_dome = demo_with_a_stub_in_its_dome(length_mm=8.0, radius_mm=0.7)
    found = demo if anatomy == "demo" else restore(traced(from_dome))
    told = [note.split(",")[0] for note in found.notes if "leaves from a sac" in note]
    assert told == ([] if anatomy == "demo" else ["outlet_2"])


def test_openings_far_from_the_sac_are_not_told(demo) -> None:
    assert not any("from the wall of a sac" in note for note in demo.notes)


def test_a_lobe_of_a_sac_is_no_sac_of_its_own(demo, monkeypatch) -> None:
    (bulge,) = find_bulges(demo.vessel.lumen, tubes_of(demo.vessel.centerlines))
    far_side = bulge.points_mm[np.argmax(np.linalg.norm(bulge.points_mm - bulge.dome_mm, axis=1))]
    lobe = replace(bulge, dome_mm=far_side)
    monkeypatch.setattr(import_module("vstent.anatomy.restore.restore"), "find_bulges", lambda *_: [bulge, lobe])
    anatomy = restore(demo.vessel)
    assert len(anatomy.aneurysms) == 1
    assert anatomy.notes[1:] == ("1 more bulge not used: flat, a lobe of a sac, or on another branch.",)


@pytest.fixture(scope="module")
def sac_on_a_tube() -> Vessel:
    phantom = phantoms.with_sac(phantoms.tube(length_mm=40.0), abscissa_mm=20.0, width_mm=6.0, neck_mm=4.0)
    return trace(Vessel(phantoms.phantom_surface(phantom, edge_mm=0.35)), inlet_mm=np.zeros(3))


@pytest.fixture(scope="module")
def neck_mm2(sac_on_a_tube) -> float:
    return restore(sac_on_a_tube).aneurysms[0].neck.area_mm2


@pytest.mark.parametrize("side", ["upstream", "downstream"])
def test_a_trim_that_would_cut_the_sac_is_refused_with_the_least_length(sac_on_a_tube, neck_mm2, side: str) -> None:
    with pytest.raises(
        InputError, match=rf"^2 mm of artery .* mm would be a cut .*: give --{side} [\d.]+ or more"
    ) as refused:
        trim(sac_on_a_tube, **{f"{side}_mm": 2.0})
    least_mm = float(str(refused.value).split()[-3])
    assert 2.0 + 2.0 < least_mm < 2.0 + 2.0 + 1.5  # half a neck and a radius, and what the foot is wider than the neck
    trimmed = restore(trim(sac_on_a_tube, **{f"{side}_mm": least_mm}))
    np.testing.assert_allclose(trimmed.aneurysms[0].neck.area_mm2, neck_mm2, rtol=0.05)


@pytest.mark.parametrize(("side", "usual"), [("before", "UPSTREAM_MM"), ("beyond", "DOWNSTREAM_MM")])
def test_a_length_that_was_not_given_grows_until_the_cut_clears_the_sac(
    sac_on_a_tube, neck_mm2, monkeypatch, side: str, usual: str
) -> None:
    monkeypatch.setattr(import_module("vstent.anatomy.trim"), usual, 2.0)
    trimmed = trim(sac_on_a_tube)
    (note,) = (note for note in trimmed.notes if "instead of 2, because the neck extends" in note)
    assert f"mm are kept {side} the middle of the bulge" in note
    kept_mm = float(note.split()[0])
    assert 2.0 + 2.0 < kept_mm < 2.0 + 2.0 + 1.5
    low, high = sorted(opening.center_mm[2] for opening in trimmed.openings)
    assert (20.0 - low if side == "before" else high - 20.0) == pytest.approx(kept_mm, abs=0.3)
    np.testing.assert_allclose(restore(trimmed).aneurysms[0].neck.area_mm2, neck_mm2, rtol=0.05)
    with pytest.raises(InputError, match="through the sac or next to it"):
        trim(sac_on_a_tube, **{"upstream_mm" if side == "before" else "downstream_mm": 2.0})


def test_nothing_is_cut_or_told_where_the_artery_is_hardly_longer_than_a_length_that_grew(
    sac_on_a_tube, monkeypatch
) -> None:
    monkeypatch.setattr(import_module("vstent.anatomy.trim"), "DOWNSTREAM_MM", 2.0)
    monkeypatch.setattr(import_module("vstent.anatomy.trim"), "SPARE_MM", 18.0)
    assert trim(sac_on_a_tube) is sac_on_a_tube


def test_a_fusiform_aneurysm_is_told_and_stays_part_of_the_landing_surface() -> None:
    middle = np.array([0.0, 0.0, 15.0])
    bulb = phantoms.Sac(middle, np.array([0.0, 0.0, 1.0]), 3.5, 3.5)
    anatomy = restore(traced(replace(phantoms.tube(length_mm=30.0), sac=bulb)))
    assert anatomy.aneurysms == ()
    assert anatomy.parent.section_radius_mm.max() == pytest.approx(3.5, rel=0.02)
    (note,) = (note for note in anatomy.notes if "fusiform" in note)
    assert note.startswith("The artery is 7.0 mm wide at ")
    np.testing.assert_allclose(place_in(note), middle, atol=0.2)


def test_an_artery_with_a_sac_is_not_called_fusiform(demo) -> None:
    assert not any("fusiform" in note for note in demo.notes)


@pytest.fixture(scope="module")
def sac_that_touches_its_artery_again() -> tuple[phantoms.Phantom, Vessel]:
    """A hairpin 18 mm apart; a sac of 12 mm on one leg, by a wide stalk, whose dome runs 0.4 mm into the other."""
    turn = np.linspace(0.35, np.pi - 0.35, 7)
    legs = [(0.0, 0.0, z) for z in (-16.0, -10.0, -4.0, 2.0)], [(0.0, 18.0, z) for z in (2.0, -4.0, -10.0, -16.0)]
    bend = [(0.0, 9.0 - 9.0 * np.cos(t), 2.0 + 9.0 * np.sin(t)) for t in turn]
    points = phantoms.spline(np.array([*legs[0], *bend, *legs[1]]))
    artery = Centerline(points, np.linspace(2.0, 1.75, len(points)))
    sac = phantoms.Sac(np.array([0.5, 10.6, -4.0]), np.array([0.0, 1.0, 0.0]), 6.0, 6.0)
    stalk = phantoms.Sac(np.array([0.2, 3.3, -4.0]), np.array([0.0, 1.0, 0.0]), 2.6, 2.6)
    phantom = phantoms.Phantom("hairpin", artery, sac=sac, blebs=(stalk,))
    return phantom, traced(phantom)


def test_a_sac_that_touches_its_artery_again_is_no_short_cut(sac_that_touches_its_artery_again) -> None:
    phantom, vessel = sac_that_touches_its_artery_again
    assert any("opens into the artery at two places" in note for note in vessel.notes)
    anatomy = restore(trim(vessel))
    np.testing.assert_allclose(np.ptp(anatomy.parent.own_mm), phantom.parent.length_mm, rtol=0.01)
    np.testing.assert_allclose(anatomy.aneurysms[0].sac.volume_mm3, phantom.sac_volume_mm3, rtol=0.02)
    own_mm = anatomy.parent.landing_surface.vertices_mm[~anatomy.parent.is_continued]
    wall_mm = phantoms.tube_implicit_mm(phantom.parent, own_mm)[0]
    assert np.abs(wall_mm).max() < 0.15


def test_the_wider_of_two_openings_of_a_sac_is_its_neck(sac_that_touches_its_artery_again) -> None:
    _, vessel = sac_that_touches_its_artery_again
    neck = restore(vessel).aneurysms[0]
    assert neck.neck_mm[:, 1].max() < 3.0
    assert 11.0 < neck.neck.area_mm2 < 14.5


def test_a_sac_is_not_trimmed_off_with_an_artery_that_it_touches(sac_that_touches_its_artery_again) -> None:
    _, vessel = sac_that_touches_its_artery_again
    trimmed = trim(vessel)
    assert len(trimmed.outlets) == 1
    assert trimmed.inlet.diameter_mm < 4.2


@pytest.mark.parametrize(("half_angle_rad", "sac_mm"), [more(0.6, 16.5), (0.9, 15.0)])
def test_a_sac_in_the_crotch_of_a_fork_is_the_same_from_any_end(half_angle_rad: float, sac_mm: float) -> None:
    fork = phantoms.bifurcation(radius_mm=1.65, daughter_radius_mm=1.3, half_angle_rad=half_angle_rad)
    phantom = replace(fork, sac=phantoms.Sac(np.array([0.0, 0.4, sac_mm]), np.array([0.0, 0.0, 1.0]), 2.6, 2.6))
    wall = Vessel(phantoms.phantom_surface(phantom, edge_mm=0.3))
    trunk, *arms = (restore(trace(wall, inlet_mm=end[0])).aneurysms[0] for end in phantom.ends)
    for sac in arms:  # 1.3 times as large from an arm, or none, where the line to the other arm cuts through it
        np.testing.assert_allclose(sac.sac.volume_mm3, trunk.sac.volume_mm3, rtol=0.01)
        np.testing.assert_allclose(sac.neck.area_mm2, trunk.neck.area_mm2, rtol=0.1)


@pytest.mark.parametrize(("trunk_mm", "end"), [(1.65, 0), (1.2, 2)])
def test_the_parent_artery_turns_back_into_an_arm_only_where_that_is_much_wider(trunk_mm: float, end: int) -> None:
    phantom = phantoms.bifurcation(radius_mm=trunk_mm, daughter_radius_mm=1.75, half_angle_rad=0.5)
    is_arm = phantom.parent.points_mm[:, 2] > 11.0
    radius_mm = np.where(is_arm, 1.3, phantom.parent.inscribed_radius_mm)
    phantom = replace(phantom, parent=replace(phantom.parent, inscribed_radius_mm=radius_mm))
    vessel = trace(Vessel(phantoms.phantom_surface(phantom, edge_mm=0.3)), inlet_mm=phantom.ends[1][0])
    anatomy = restore(vessel)
    np.testing.assert_allclose(
        anatomy.parent.axis.at(np.array(anatomy.parent.own_mm))[-1], phantom.ends[end][0], atol=0.2
    )


def with_a_dome(phantom: phantoms.Phantom, *, beyond_mm: float, radius_mm: float) -> phantoms.Phantom:
    """A straight artery along z and a small sphere on the middle of its wall, its middle so far beyond it."""
    artery = phantom.parent
    middle = np.array([0.0, artery.inscribed_radius_mm.max() + beyond_mm, 0.5 * artery.length_mm])
    return replace(phantom, sac=phantoms.Sac(middle, np.array([0.0, 1.0, 0.0]), radius_mm, radius_mm))


@pytest.mark.parametrize(("beyond_mm", "radius_mm"), [(0.2, 1.05), more(0.35, 1.35)])
def test_a_blister_is_named_where_no_sac_is_found_and_is_found_where_it_is_named(
    beyond_mm: float, radius_mm: float
) -> None:
    phantom = with_a_dome(phantoms.tube(length_mm=30.0), beyond_mm=beyond_mm, radius_mm=radius_mm)
    vessel = traced(phantom)
    anatomy = restore(vessel)
    assert anatomy.aneurysms == ()
    (note,) = (note for note in anatomy.notes if "too flat" in note)
    height_mm, at_mm = float(note.split()[2]), place_in(note)
    assert height_mm == pytest.approx(beyond_mm + radius_mm, abs=0.15)
    asked = restore(vessel, at_mm=at_mm)
    assert asked.aneurysms[0].sac.volume_mm3 == pytest.approx(phantom.sac_volume_mm3, rel=0.15)
    assert not any("too flat" in note for note in asked.notes)


def test_a_flat_bulge_is_looked_into_on_the_landing_surface_at_hand(monkeypatch) -> None:
    vessel = traced(with_a_dome(phantoms.tube(length_mm=30.0), beyond_mm=0.2, radius_mm=1.05))
    restored, fit = [], fit_axis
    monkeypatch.setattr(
        import_module("vstent.anatomy.restore.restore"), "fit_axis", lambda *of: restored.append(of) or fit(*of)
    )
    assert any("too flat" in note for note in restore(vessel).notes)
    assert len(restored) == 1


@pytest.mark.parametrize(
    "phantom",
    [
        phantoms.siphon(),
        phantoms.bifurcation(half_angle_rad=1.2),
        phantoms.with_branch(phantoms.tube(length_mm=30.0), abscissa_mm=15.0, direction=np.ones(3), radius_mm=1.2),
        with_a_dome(phantoms.tube(length_mm=30.0), beyond_mm=-0.6, radius_mm=1.4),
    ],
    ids=["siphon", "bifurcation", "branch", "a bump of 0.8 mm"],
)
def test_no_blister_is_named_on_a_healthy_artery(phantom: phantoms.Phantom) -> None:
    assert not any("too flat" in note for note in restore(traced(phantom)).notes)


def sac_beside_a_stenosis(lost: float, throat_mm: float) -> phantoms.Phantom:
    """A tube of radius 2 mm with a sac at 20 mm; it loses a share of its width `throat_mm` further on, over 6 mm."""
    tube = phantoms.tube(length_mm=40.0)
    points = np.column_stack([np.zeros((2, 401)).T, np.linspace(0.0, 40.0, 401)])
    beyond = np.clip((points[:, 2] - 20.0 - throat_mm) / 3.0, -1.0, 1.0)
    parent = Centerline(points, 2.0 * (1.0 - lost * 0.5 * (1.0 + np.cos(np.pi * beyond))))
    return phantoms.with_sac(replace(tube, parent=parent), abscissa_mm=20.0, width_mm=6.4, neck_mm=3.6)


@cache
def beside_a_stenosis(lost: float, throat_mm: float) -> Anatomy:
    return restore(traced(sac_beside_a_stenosis(lost, throat_mm)))


@pytest.mark.parametrize(
    ("lost", "throat_mm"), [(0.5, -6.0), more(0.5, 6.0), more(0.5, -8.0), (0.6, 8.0), more(0.4, -6.0)]
)
def test_a_stenosis_beside_a_neck_is_no_measure_of_the_artery_across_it(lost: float, throat_mm: float) -> None:
    sac, same = beside_a_stenosis(lost, throat_mm).aneurysms[0], beside_a_stenosis(0.0, 6.0).aneurysms[0]
    np.testing.assert_allclose(sac.neck.area_mm2, same.neck.area_mm2, rtol=0.25)  # 1.4 to 4 times as large without
    np.testing.assert_allclose(sac.sac.volume_mm3, same.sac.volume_mm3, rtol=0.02)


@pytest.mark.parametrize(("lost", "throat_mm"), [(0.5, -6.0), (0.6, 8.0), more(0.6, 5.0), (0.0, 6.0), (0.2, 6.0)])
def test_a_stenosis_beside_a_neck_is_told_with_its_place(lost: float, throat_mm: float) -> None:
    notes = [note for note in beside_a_stenosis(lost, throat_mm).notes if "a stenosis" in note]
    assert len(notes) == (lost > 0.3)
    for note in notes:
        width_mm, rest = note.removeprefix("The artery is ").split(" mm wide at ")
        assert float(width_mm) == pytest.approx(4.0 * (1.0 - lost), abs=0.15)
        np.testing.assert_allclose(place_in(rest), [0.0, 0.0, 20.0 + throat_mm], atol=0.5)


def test_an_artery_that_goes_on_narrow_beyond_a_neck_is_not_called_stenosed() -> None:
    phantom = sac_beside_a_stenosis(0.5, 6.0)
    radius = np.minimum.accumulate(phantom.parent.inscribed_radius_mm)
    tapered = replace(phantom, parent=replace(phantom.parent, inscribed_radius_mm=radius))
    assert not any("a stenosis" in note for note in restore(traced(tapered)).notes)
