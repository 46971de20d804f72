"""Arteries that touch: parted where a way slips through; stenoses, branches and communicating arteries are left."""

from dataclasses import replace

import numpy as np
import pytest
from told import place_in

from vstent import phantoms
from vstent.anatomy.segment import segment
from vstent.anatomy.trace import trace
from vstent.geometry.vessel import Centerline, Vessel
from vstent.kernels import curves
from vstent.phantoms import Phantom, Scanner


def loop(overlap_mm: float) -> Phantom:
    """An artery 3 mm wide that runs through a loop and crosses itself at a right angle."""
    t = np.linspace(-1.45, 1.45, 1201)
    path = np.stack([8 * (t**2 - 1), 8 * t * (t**2 - 1), (1.5 - 0.5 * overlap_mm) * t], axis=1)
    points = curves.resample(path, phantoms.AXIS_STEP_MM)
    return Phantom("loop", Centerline(points, np.full(len(points), 1.5)))


def pair(gap_mm: float) -> Phantom:
    """Two arteries of their own, 4 and 3 mm wide, that cross at a right angle; a gap below 0 is an overlap."""
    x = np.linspace(-10.0, 10.0, 501)
    other = np.stack([x, np.full_like(x, 3.5 + gap_mm), np.full_like(x, 12.0)], axis=1)
    return replace(phantoms.tube(length_mm=24.0), branches=(Centerline(other, np.full(len(x), 1.5)),))


def traced(phantom: Phantom) -> Vessel:
    return trace(Vessel(phantoms.phantom_surface(phantom, edge_mm=0.3)), inlet_mm=phantom.ends[0][0])


def test_a_loop_that_touches_itself_is_followed_all_the_way() -> None:
    phantom = loop(0.1)
    vessel = traced(phantom)
    (line,) = vessel.centerlines
    assert line.length_mm == pytest.approx(phantom.parent.length_mm, rel=0.01)
    assert curves.project(phantom.parent.points_mm, line.points_mm)[1].mean() < 0.02
    assert "touching arteries were separated at" in vessel.notes[-1]
    place_mm = place_in(vessel.notes[-1])
    assert np.linalg.norm(place_mm) < 0.5  # the axes cross above the origin
    assert len(vessel.lumen.boundary_loops) == 2


@pytest.mark.validation
@pytest.mark.parametrize("overlap_mm", [0.0, 0.15, 0.3])
def test_a_scanned_loop_is_followed_all_the_way(overlap_mm: float) -> None:
    phantom = loop(overlap_mm)
    image = phantoms.scan(phantom, np.random.default_rng(0), scanner=Scanner(voxel_mm=0.28, blur_mm=0.22))
    (line,) = trace(segment(image)).centerlines
    assert line.length_mm == pytest.approx(phantom.parent.length_mm, rel=0.02)


def test_of_two_arteries_that_touch_the_one_with_the_inlet_is_kept() -> None:
    vessel = traced(pair(-0.1))
    (line,) = vessel.centerlines
    np.testing.assert_allclose(line.points_mm[-1], [0.0, 0.0, 24.0], atol=0.05)
    assert "% of the wall) was removed" in vessel.notes[-1]
    assert vessel.lumen.vertices_mm[:, 1].max() < 2.1


def test_arteries_that_touch_are_not_parted_where_blood_is_said_to_come_from_both() -> None:
    crossed = pair(-0.1)
    ends_mm = np.array([crossed.ends[k][0] for k in (0, 2)])
    vessel = trace(Vessel(phantoms.phantom_surface(crossed, edge_mm=0.3)), inlet_mm=ends_mm)
    np.testing.assert_allclose([inlet.center_mm for inlet in vessel.inlets], ends_mm, atol=0.05)
    assert len(vessel.outlets) == 2
    assert not any("touching" in note for note in vessel.notes)


def test_openings_keep_their_roles_where_a_vessel_is_parted() -> None:
    fed = phantoms.with_branch(loop(0.1), abscissa_mm=4.0, direction=np.array([0, 0, -1]), radius_mm=0.9, length_mm=7.0)
    ends_mm = np.array([fed.ends[k][0] for k in (0, 2)])
    vessel = trace(Vessel(phantoms.phantom_surface(fed, edge_mm=0.3)), inlet_mm=ends_mm)
    assert "touching arteries were separated at" in vessel.notes[-1]
    assert [opening.role for opening in vessel.openings] == ["inlet", "inlet_2", "outlet_1"]
    np.testing.assert_allclose([inlet.center_mm for inlet in vessel.inlets], ends_mm, atol=0.05)


def test_arteries_joined_by_a_communicating_one_stay_together() -> None:
    bridge = Centerline(np.linspace([0.0, 0.0, 12.0], [0.0, 6.5, 12.0], 164), np.full(164, 0.9))
    far = pair(3.0)
    vessel = traced(replace(far, branches=(*far.branches, bridge)))
    assert sum(abs(outlet.center_mm[0]) > 9 for outlet in vessel.outlets) == 2
    assert not any("touching" in note for note in vessel.notes)


def test_a_stenosis_in_a_bend_and_a_narrow_mouth_of_a_branch_are_no_contacts() -> None:
    bend = phantoms.with_branch(
        phantoms.torus_arc(bend_radius_mm=6.0, angle_rad=2.5, radius_mm=1.6),
        abscissa_mm=4.0,
        direction=np.array([1.0, 0.0, 0.0]),
        radius_mm=1.0,
        length_mm=9.0,
    )
    place = bend.parent.abscissa_mm
    narrow = 1.6 - 1.1 * np.exp(-(((place - 9.0) / 0.8) ** 2))
    branch = bend.branches[0]
    mouth = 1.0 - 0.55 * np.exp(-(((branch.abscissa_mm - 2.2) / 0.6) ** 2))
    vessel = traced(
        replace(
            bend,
            parent=replace(bend.parent, inscribed_radius_mm=narrow),
            branches=(replace(branch, inscribed_radius_mm=mouth),),
        )
    )
    assert len(vessel.outlets) == 2
    assert not any("touching" in note for note in vessel.notes)
    assert min(line.inscribed_radius_mm.min() for line in vessel.centerlines) < 0.55
