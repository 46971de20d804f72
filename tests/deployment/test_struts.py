"""Wires woven on the contour, and their solids."""

import itertools
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial import cKDTree
from tubes import arc, line, tube, with_neck

from vstent.deployment import wires
from vstent.deployment.deploy import deploy
from vstent.deployment.struts import blood, over_restored, struts, united
from vstent.devices import catalogue, design as device, formulas
from vstent.errors import DeviceError
from vstent.geometry.surface import Surface

SILK, ENTERPRISE = catalogue.find_design("silk"), catalogue.find_design("enterprise")
SIZES = {
    "silk": catalogue.find_size(SILK, diameter_mm=4, length_mm=15),
    "enterprise": catalogue.find_size(ENTERPRISE, length_mm=14),
}
BOTH = pytest.mark.parametrize("design", [SILK, ENTERPRISE], ids=["silk", "enterprise"])


@cache
def straight():
    return tube(line(32), 1.9)


@cache
def bent():
    return tube(arc(7, np.pi / 2, 10), 1.9)


@cache
def stent(artery, design):
    return deploy(design, artery, size=SIZES[design.key]).stent


def polylines(device_in_place):
    starts = device_in_place.wire_starts
    return [device_in_place.wire_points_mm[a:b] for a, b in itertools.pairwise(starts)]


def test_silks_thick_wires_are_spread_evenly_over_both_hands():
    diameter_um = wires.wire_diameters_um(SILK)
    thick = np.flatnonzero(diameter_um == 50)
    assert len(diameter_um) == 24
    assert set(np.diff(np.append(thick, thick[0] + 24))) == {6}
    assert sorted(stent(straight(), SILK).wire_diameter_um) == [30.0] * 40 + [50.0] * 8


def test_wires_keep_their_length_but_for_the_weave():
    """Waves of height a over a piece b lengthen it by (pi a / (2 b))^2."""
    piece_mm = device.piece_length_mm(SILK, SIZES["silk"])
    pieces = formulas.grid(SILK, SIZES["silk"]).lattice_rows - 1
    lengths = np.array(
        [np.linalg.norm(np.diff(line, axis=0), axis=1).sum() for line in polylines(stent(straight(), SILK))]
    )
    weave = (np.pi * 0.0165 / (2 * piece_mm)) ** 2
    assert lengths.mean() / (pieces * piece_mm) == pytest.approx(1 + weave, abs=0.003)
    assert np.ptp(lengths) / lengths.mean() < 0.02


def finely(points, times=8):
    t = np.arange(len(points))
    fine = np.linspace(0, len(points) - 1, (len(points) - 1) * times + 1)
    return np.stack([np.interp(fine, t, c) for c in points.T], axis=1)


def test_no_two_wires_touch_deeper_than_a_micrometre():
    found = polylines(stent(straight(), SILK))
    radius_mm = stent(straight(), SILK).wire_diameter_um * 5e-4
    fine = [finely(points) for points in found]
    points, owner = np.concatenate(fine), np.repeat(np.arange(len(fine)), [len(p) for p in fine])
    near = cKDTree(points).query_pairs(0.052, output_type="ndarray")
    near = near[owner[near[:, 0]] != owner[near[:, 1]]]
    gap_mm = np.linalg.norm(points[near[:, 0]] - points[near[:, 1]], axis=1)
    depth_mm = radius_mm[owner[near[:, 0]]] + radius_mm[owner[near[:, 1]]] - gap_mm
    assert len(near) > 1000
    assert depth_mm.max() < 0.001
    assert depth_mm.max() > -0.001  # and they do touch


def test_every_wire_goes_over_and_under_in_turn():
    for points in polylines(stent(straight(), SILK)):
        height_mm = np.linalg.norm(points[:, :2], axis=1) - 1.85
        samples = (len(points) - 1) // (formulas.grid(SILK, SIZES["silk"]).lattice_rows - 1)
        side = np.sign(height_mm[::samples])
        assert np.all(side[1:] == -side[:-1])


def test_over_the_first_hand_lies_the_second_at_every_crossing():
    shape = formulas.grid(SILK, SIZES["silk"])
    found = polylines(stent(straight(), SILK))
    samples = (len(found[0]) - 1) // (shape.lattice_rows - 1)
    crossings = np.array([points[::samples] for points in found])
    first, second = crossings[:24], crossings[24:]
    for row in range(shape.lattice_rows):
        one, other = (
            hand[:, row, :2] / np.linalg.norm(hand[:, row, :2], axis=1, keepdims=True) for hand in (first, second)
        )
        assert cKDTree(one).query(other)[0].max() < 2e-4
        over = np.linalg.norm(first[:, row, :2], axis=1).mean() - np.linalg.norm(second[:, row, :2], axis=1).mean()
        assert (over > 0) == (row % 2 == 0), row


@BOTH
@pytest.mark.parametrize("artery", [straight, bent])
def test_outer_faces_touch_the_wall_and_never_pass_it(design, artery):
    placed = stent(artery(), design)
    half_mm = 0.5 * (design.strut_thickness_um * 1e-3 if design is ENTERPRISE else 0)
    if design is SILK:
        half_mm = np.repeat(placed.wire_diameter_um, np.diff(placed.wire_starts)) * 5e-4
    distance_mm = artery().parent.landing_surface.closest(placed.wire_points_mm)[1]
    assert (distance_mm - half_mm).min() > -1e-6
    assert (distance_mm - half_mm).min() < 0.002
    centers = artery().parent.axis.at(artery().parent.axis.nearest_abscissa_mm(placed.wire_points_mm))
    assert not artery().parent.landing_surface.crosses(centers, placed.wire_points_mm).any()


def test_laser_cut_rings_meet_crown_to_crown():
    rings = polylines(stent(straight(), ENTERPRISE))
    assert len(rings) == formulas.grid(ENTERPRISE, SIZES["enterprise"]).lattice_rows - 1
    for lower, upper in itertools.pairwise(rings):
        assert np.array_equal(lower[0], lower[-1])
        touching = cKDTree(upper[:-1]).query(lower[:-1])[0] < 1e-6
        assert touching.sum() == ENTERPRISE.n_columns / 2


def test_laser_cut_crowns_are_rounder_than_half_a_strut():
    for points in polylines(stent(straight(), ENTERPRISE)):
        step = np.diff(np.concatenate([points, points[1:2]]), axis=0)
        length = np.linalg.norm(step, axis=1)
        turn = np.arccos(np.clip(np.einsum("ij,ij->i", step[1:], step[:-1]) / length[1:] / length[:-1], -1, 1))
        radius_mm = 0.5 * (length[1:] + length[:-1]) / np.maximum(turn, 1e-9)
        assert radius_mm.min() > 0.039


@BOTH
@pytest.mark.parametrize("artery", [straight, bent])
def test_struts_are_closed_outward_solids_of_the_wires_volume(design, artery):
    placed = stent(artery(), design)
    solid = struts(placed)
    edges = np.concatenate([solid.faces[:, [0, 1]], solid.faces[:, [1, 2]], solid.faces[:, [2, 0]]]).astype(np.int64)
    n = len(solid.vertices_mm)
    there, back = np.sort(edges[:, 0] * n + edges[:, 1]), np.sort(edges[:, 1] * n + edges[:, 0])
    assert np.all(np.diff(there) > 0)  # every directed edge once,
    assert np.array_equal(there, back)  # and once the other way
    assert len(np.unique(solid.faces)) == n
    lengths_mm = np.array([np.linalg.norm(np.diff(line, axis=0), axis=1).sum() for line in polylines(placed)])
    width_mm = placed.wire_diameter_um * 1e-3
    area_mm2 = np.pi / 4 * width_mm**2 if design is SILK else width_mm * ENTERPRISE.strut_thickness_um * 1e-3
    assert solid.volume_mm3 == pytest.approx((area_mm2 * lengths_mm).sum(), rel=0.03)


@BOTH
def test_no_solid_reaches_through_the_wall(design):
    vertices_mm = struts(stent(straight(), design)).vertices_mm
    assert np.linalg.norm(vertices_mm[:, :2], axis=1).max() < 1.9 + 0.003


def test_struts_and_blood_together_fill_the_lumen():
    pytest.importorskip("manifold3d")
    solid = struts(stent(bent(), ENTERPRISE))
    metal, left = united(solid), blood(bent(), solid)
    assert 0.9 * solid.volume_mm3 < metal.volume_mm3 < solid.volume_mm3  # crowns of neighbouring rings overlap
    # Edges of the struts, which lie flat against a round wall, stick out of it by a hair.
    outside_mm3 = metal.volume_mm3 + left.volume_mm3 - bent().vessel.closed.volume_mm3
    assert 0 <= outside_mm3 < 0.002 * metal.volume_mm3
    for body in (metal, left):
        assert body.boundary_loops == ()


def test_an_open_solid_is_refused():
    pytest.importorskip("manifold3d")
    solid = struts(stent(straight(), ENTERPRISE))
    with pytest.raises(DeviceError, match="is not closed"):
        united(Surface(solid.vertices_mm, solid.faces[1:]))


def test_wires_over_a_neck_are_left_each_between_its_own_points():
    artery = with_neck(straight(), 14, 18)
    design = stent(straight(), SILK)
    starts = np.array([0, 40, 41, 120, 300])  # a single point is a wire too
    points_mm = np.array([1.9, 0.0, 16.0]) + 0.5 * np.cumsum(np.random.default_rng(5).normal(size=(300, 3)), axis=0)
    walks = replace(design, wire_points_mm=points_mm, wire_starts=starts, wire_diameter_um=[30.0, 50.0, 30.0, 50.0])
    left = over_restored(walks, artery)
    is_over = over_by_samples(points_mm, artery, walks.spacing_mm)
    here, *all_pieces = pieces(walks)
    is_left = is_over[here] & is_over[here + 1]
    for found, row in zip(pieces(left)[1:], all_pieces, strict=True):
        np.testing.assert_array_equal(found, row[is_left])
    assert 0.1 < is_left.mean() < 0.8


@pytest.mark.parametrize("radius_mm", [1.9, 3.6], ids=["apposed", "standing off"])
def test_what_stands_off_the_wall_is_over_the_neck_as_what_lies_on_it(radius_mm):
    """Blood passes the wires there, however far from the neck they are."""
    artery = with_neck(tube(line(32), radius_mm), 13, 19)
    device_in_place = deploy(ENTERPRISE, artery, size=SIZES["enterprise"]).stent
    points_mm = device_in_place.wire_points_mm
    off_mm = artery.parent.landing_surface.closest(points_mm)[1]
    assert (off_mm.min() > 1.0) == (radius_mm > 2)
    left = over_restored(device_in_place, artery).wire_points_mm
    is_over = over_by_samples(points_mm, artery, device_in_place.spacing_mm)
    assert 0.1 < len(left) / len(points_mm) < 0.6
    assert len(left) == pytest.approx(is_over.sum(), abs=4)
    assert len(over_restored(device_in_place, tube(line(32), radius_mm)).wire_points_mm) == 0


def over_by_samples(points_mm, artery, within_mm):
    """Whether the nearest of many points on the wall lies so near to one on the neck."""
    wall, neck = (densely(one) for one in (artery.parent.landing_surface, artery.aneurysms[0].neck))
    foot_mm = wall[cKDTree(wall).query(points_mm)[1]]
    return cKDTree(neck).query(foot_mm)[0] < within_mm


def densely(surface):
    steps = np.linspace(0, 1, 9)
    weights = np.array([(a, b, 1 - a - b) for a in steps for b in steps if a + b <= 1 + 1e-9])
    return np.einsum("wk,fkd->fwd", weights, surface.corners_mm).reshape(-1, 3)


def pieces(device_in_place):
    """First point (p,), both ends (p, 3) and diameter (p,) of every piece of wire."""
    here = np.setdiff1d(np.arange(len(device_in_place.wire_points_mm) - 1), device_in_place.wire_starts[1:] - 1)
    wire = np.searchsorted(device_in_place.wire_starts, here, "right") - 1
    points_mm = device_in_place.wire_points_mm
    return here, points_mm[here], points_mm[here + 1], device_in_place.wire_diameter_um[wire]
