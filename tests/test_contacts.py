"""Arteries that touch: parted where a way slips through; stenoses, branches and communicating arteries are left."""

from dataclasses import replace

import numpy as np
import pytest

from vstent import phantoms
from vstent.kernels import curves
from vstent.phantoms import Phantom, Sac, Scanner
from vstent.segment import segment
from vstent.surface import Surface
from vstent.trace import trace
from vstent.vessel import Centerline, Vessel


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


def ring(apart_mm: float) -> Phantom:
    """A fork whose equal daughters, 3 mm wide, bend back towards each other to a distance between their axes, and part.

    No shortest way to either end leads from one to the other.
    """
    knots = [(0, 0, 0), (0, 0, 4), (1.6, 0, 7), (3.6, 0, 11), (0.5 * apart_mm, 0, 15), (3.6, 0, 19), (5, 0, 24)]
    right = phantoms.spline(np.array(knots, dtype=float))
    after = right[:, 2] > 3.8
    left = Centerline(right[after] * [-1, 1, 1], np.full(int(after.sum()), 1.5))
    return Phantom("ring", Centerline(right, np.full(len(right), 1.5)), (left,))


def traced(phantom: Phantom) -> Vessel:
    return trace(Vessel(phantoms.phantom_surface(phantom, edge_mm=0.3)), inlet_mm=phantom.ends[0][0])


def test_a_loop_that_touches_itself_is_followed_all_the_way() -> None:
    phantom = loop(0.1)
    vessel = traced(phantom)
    (line,) = vessel.centerlines
    assert line.length_mm == pytest.approx(phantom.parent.length_mm, rel=0.01)
    assert curves.project(phantom.parent.points_mm, line.points_mm)[1].mean() < 0.02
    assert "touch at" in vessel.notes[-1]
    place_mm = np.array([float(x) for x in vessel.notes[-1].split("touch at ")[1].split(" mm")[0].split(", ")])
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
    assert "% of the wall) was left out" in vessel.notes[-1]
    assert vessel.lumen.vertices_mm[:, 1].max() < 2.1


def test_a_window_on_no_path_is_found_by_the_ring_it_makes() -> None:
    phantom = ring(2.85)
    assert phantoms.phantom_surface(phantom, edge_mm=0.3).n_rings == 1
    _is_parted(phantom, traced(phantom))


@pytest.mark.validation
@pytest.mark.parametrize("apart_mm", [3.1, 3.0, 2.9])
def test_a_window_on_no_path_is_found_in_a_scan(apart_mm: float) -> None:
    phantom = ring(apart_mm)
    image = phantoms.scan(phantom, np.random.default_rng(0), scanner=Scanner(voxel_mm=0.28, blur_mm=0.22))
    _is_parted(phantom, trace(segment(image), inlet_mm=phantom.ends[0][0]))


def _is_parted(phantom: Phantom, vessel: Vessel) -> None:
    assert vessel.lumen.n_rings == 0
    assert [note.split(" mm")[0].split(" at ")[0] for note in vessel.notes if "touch" in note] == ["Two arteries touch"]
    place_mm = np.array([float(x) for x in vessel.notes[-1].split("touch at ")[1].split(" mm")[0].split(", ")])
    assert np.linalg.norm(place_mm - [0, 0, 15]) < 0.5
    assert len(vessel.outlets) == 2
    for line in vessel.centerlines:
        beyond = line.points_mm[line.points_mm[:, 2] > 10]
        side = phantom.parent.points_mm * [np.sign(line.points_mm[-1, 0]), 1, 1]
        assert curves.project(side, beyond)[1].max() < 0.2


def test_a_ring_through_a_communicating_artery_stays_one() -> None:
    bridge = Sac(np.array([0.0, 0.0, 15.0]), np.array([1.0, 0.0, 0.0]), width_radius_mm=0.8, height_radius_mm=3.0)
    vessel = traced(replace(ring(4.4), sac=bridge))
    assert vessel.lumen.n_rings == 1
    assert not any("touch" in note for note in vessel.notes)


def test_rings_are_counted_as_on_a_torus() -> None:
    around, along = np.meshgrid(np.arange(12), np.arange(20))
    u, v = 2 * np.pi * around / 12, 2 * np.pi * along / 20
    points = np.stack([(3 + np.cos(u)) * np.cos(v), (3 + np.cos(u)) * np.sin(v), np.sin(u)], axis=-1).reshape(-1, 3)
    here, over = 12 * along + around, 12 * along + (around + 1) % 12
    ahead, both = 12 * ((along + 1) % 20) + around, 12 * ((along + 1) % 20) + (around + 1) % 12
    faces = np.concatenate([np.stack(f, axis=-1).reshape(-1, 3) for f in ((here, ahead, over), (over, ahead, both))])
    assert Surface(points, faces).n_rings == 1
    assert Surface(points, faces[1:]).n_rings == 1  # a hole in the wall opens no ring
    assert phantoms.phantom_surface(phantoms.tube(), edge_mm=0.6).n_rings == 0


def test_arteries_joined_by_a_communicating_one_stay_together() -> None:
    bridge = Centerline(np.linspace([0.0, 0.0, 12.0], [0.0, 6.5, 12.0], 164), np.full(164, 0.9))
    far = pair(3.0)
    vessel = traced(replace(far, branches=(*far.branches, bridge)))
    assert sum(abs(outlet.center_mm[0]) > 9 for outlet in vessel.outlets) == 2
    assert not any("touch" in note for note in vessel.notes)


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
    assert not any("touch" in note for note in vessel.notes)
    assert min(line.inscribed_radius_mm.min() for line in vessel.centerlines) < 0.55
