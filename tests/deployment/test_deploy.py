"""Whole deployments in arteries whose answer is known."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.optimize import brentq
from tubes import arc, line, on_parent, tube, with_neck

from vstent.anatomy import landing_zones
from vstent.deployment import cells, contour, pieces, sizing
from vstent.deployment.active_contour import ActiveContour
from vstent.deployment.braid import ConstantWire, Profile, expected_profile, march
from vstent.deployment.coverage import coverage_fractions, quad_areas_mm2
from vstent.deployment.deploy import deploy, propose_landing, propose_size
from vstent.deployment.measure import measure
from vstent.deployment.method import SPARE_MM, check_inside, laid_inside
from vstent.deployment.sketch import measured_wall, sketch
from vstent.devices import catalogue, design as device, formulas
from vstent.devices.stent import Landing
from vstent.errors import LandingError
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Centerline
from vstent.plan.rank import rank

SILK, ENTERPRISE = catalogue.find_design("silk"), catalogue.find_design("enterprise")
SILK_SIZE = catalogue.find_size(SILK, diameter_mm=4, length_mm=15)
ENTERPRISE_SIZE = catalogue.find_size(ENTERPRISE, length_mm=14)
DEVICES = pytest.mark.parametrize(
    ("design", "size"), [(SILK, SILK_SIZE), (ENTERPRISE, ENTERPRISE_SIZE)], ids=["silk", "enterprise"]
)
TAPER_MM = (2.0, 1.5)
BEND_MM = 7.0


@cache
def straight(radius_mm=1.9):
    return tube(line(32), radius_mm)


@cache
def tapered():
    return tube(line(32), np.linspace(*TAPER_MM, 161))


@cache
def bent():
    return tube(arc(BEND_MM, np.pi / 2, 10), 1.9)


@cache
def oval():
    return tube(line(32), 2.15, 1.65)


@cache
def widening():
    z = np.linspace(0, 32, 161)
    return tube(line(32), 1.7 + 0.9 / (1 + np.exp(-(z - 16) / 1.5)))


@cache
def deployed(anatomy, design=SILK, size=SILK_SIZE, landing=None):
    return deploy(design, anatomy, size=size, landing=landing)


def wall_distance_mm(anatomy, deployment):
    nodes_mm = deployment.stent.nodes_mm
    return anatomy.parent.landing_surface.closest(nodes_mm.reshape(-1, 3))[1].reshape(nodes_mm.shape[:2])


def outside_mm(anatomy, deployment):
    return measure(anatomy, deployment)["max_outside_mm"]


@DEVICES
def test_in_a_straight_tube_every_node_lies_at_r_minus_dd(design, size):
    done = deployed(straight(), design, size)
    radius_mm = np.linalg.norm(done.stent.nodes_mm[..., :2], axis=2)
    assert np.abs(radius_mm - (1.9 - design.wall_offset_um * 1e-3)).max() < 0.002
    assert done.terminated_fraction[-1] == 1.0
    assert done.outcome == "terminated"
    assert done.wall_gap_mm.max() < 1e-9


@DEVICES
def test_in_a_straight_tube_length_coverage_and_pores_are_the_closed_formulas(design, size):
    done = deployed(straight(), design, size)
    found = measure(straight(), done)
    diameter_mm = 2 * (1.9 - design.wall_offset_um * 1e-3)
    assert found["deployed_length_mm"] == pytest.approx(
        formulas.deployed_length_mm(design, size, diameter_mm), rel=1e-3
    )
    # The formula knows nothing of a laser-cut cell's crowns, which overlap where they are joined.
    assert found["metal_coverage_fraction"] == pytest.approx(
        formulas.coverage_fraction(design, size, diameter_mm), rel=0.02 if design is SILK else 0.03
    )
    assert found["pore_density_per_mm2"] == pytest.approx(
        formulas.pore_density_per_mm2(design, size, diameter_mm), rel=0.02
    )
    assert found["mean_diameter_mm"] == pytest.approx(diameter_mm, rel=1e-3)


def test_rows_and_columns_form_the_lattice_of_the_braid():
    nodes_mm = deployed(straight()).stent.nodes_mm
    piece_mm = np.linalg.norm(nodes_mm[1:] - np.roll(nodes_mm, -1, axis=1)[:-1], axis=2)
    assert piece_mm == pytest.approx(np.full_like(piece_mm, device.piece_length_mm(SILK, SILK_SIZE)), rel=2e-3)


def test_in_a_taper_rows_are_as_far_apart_as_the_local_diameter_says():
    stent = deployed(tapered()).stent
    z = np.linspace(stent.proximal_abscissa_mm, stent.distal_abscissa_mm, 4001)
    slope = (TAPER_MM[1] - TAPER_MM[0]) / 32
    # dd is measured square to the wall
    diameter_mm = 2 * (TAPER_MM[0] + slope * z - 0.05 * np.hypot(1, slope))
    per_mm = 1 / formulas.row_spacing_mm(SILK, SILK_SIZE, diameter_mm)
    rows = float(((per_mm[1:] + per_mm[:-1]) / 2 * np.diff(z)).sum())
    assert rows == pytest.approx(len(stent.nodes_mm) - 1, rel=0.005)
    assert wall_distance_mm(tapered(), deployed(tapered())) == pytest.approx(0.05, abs=1e-6)


def spacing_in_the_bend_mm(diameter_mm):
    """Row spacing at which wires of constant length, closer together outside, fill the circumference; by quadrature."""
    piece_mm = device.piece_length_mm(SILK, SILK_SIZE)
    reach = 1 + 0.5 * diameter_mm / BEND_MM * np.cos(2 * np.pi * (np.arange(2000) + 0.5) / 2000)

    def excess(spacing_mm):
        sines = np.sqrt(1 - (spacing_mm * reach / piece_mm) ** 2)
        return (1 / sines).mean() - 48 * piece_mm / (np.pi * diameter_mm)

    return brentq(excess, 0.0, 0.999 * piece_mm / reach.max())


def test_rows_in_a_bend_are_as_far_apart_as_lets_columns_fill_the_circumference():
    curvature = np.array([0.0, 1 / BEND_MM])
    found_mm = formulas.row_spacing_mm(SILK, SILK_SIZE, 3.7, curvature)
    assert found_mm[0] == pytest.approx(formulas.row_spacing_mm(SILK, SILK_SIZE, 3.7), rel=1e-9)
    assert found_mm[1] == pytest.approx(spacing_in_the_bend_mm(3.7), rel=1e-6)
    assert found_mm[1] < 0.97 * found_mm[0]


def test_in_a_bend_the_device_is_as_long_as_its_rows_say_and_touches_all_round():
    done = deployed(bent())
    straight_mm, bent_mm = formulas.row_spacing_mm(SILK, SILK_SIZE, 3.7), spacing_in_the_bend_mm(3.7)
    in_bend_mm = BEND_MM * np.pi / 2
    rows = len(done.stent.nodes_mm) - 1
    length_mm = rows * straight_mm - in_bend_mm * (straight_mm / bent_mm - 1)
    assert done.stent.deployed_length_mm == pytest.approx(length_mm, rel=0.005)
    assert length_mm < 0.98 * rows * straight_mm
    assert wall_distance_mm(bent(), done) == pytest.approx(0.05, abs=0.001)
    assert outside_mm(bent(), done) == 0.0


@pytest.mark.parametrize("side", [1, -1], ids=["inside", "outside"])
def test_in_a_bend_the_braid_is_denser_inside_and_sparser_outside(side):
    stent = deployed(bent()).stent
    quads_mm = 0.5 * (stent.nodes_mm[1:] + stent.nodes_mm[:-1])
    center_mm = 0.5 * (quads_mm + np.roll(quads_mm, -1, axis=1))
    _, frames = contour.planes(bent().parent.axis).at(stent.row_abscissa_mm)
    middle_mm = bent().parent.axis.at(stent.row_abscissa_mm)
    toward = frames[:-1, None, 0] @ np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]])  # the bend's center
    aside_mm = np.einsum("ijk,ijk->ij", center_mm - middle_mm[:-1, None], np.broadcast_to(-toward, center_mm.shape))
    s = stent.row_abscissa_mm
    in_bend = ((s > 12.5) & (s < 10 + BEND_MM * np.pi / 2 - 2.5))[:-1, None]
    chosen = in_bend & (side * aside_mm > 1.85 * np.cos(0.25))
    hidden = np.average(coverage_fractions(stent)[chosen], weights=quad_areas_mm2(stent)[chosen])
    spacing_mm = spacing_in_the_bend_mm(3.7) * (1 - side * 1.85 / BEND_MM)
    # Rhombs of constant sides, their rows pressed together or drawn apart: wires of one hand lie 2 c h / l apart.
    piece_mm = device.piece_length_mm(SILK, SILK_SIZE)
    apart_mm = 2 * np.sqrt(piece_mm**2 - spacing_mm**2) * spacing_mm / piece_mm
    wire_mm = sum(n * d for n, d in SILK.wires) / 48 * 1e-3
    assert hidden == pytest.approx(1 - (1 - wire_mm / apart_mm) ** 2, rel=0.05)
    straight_fraction = formulas.coverage_fraction(SILK, SILK_SIZE, 3.7)
    assert side * (hidden - straight_fraction) > (0.01 if side > 0 else 0.005)


def stretch(stent):
    """By how much every piece of wire is longer than it was made, relative."""
    shape = formulas.grid(stent.design, stent.size)
    junction_mm = stent.nodes_mm[:: shape.row_split, :: shape.column_split]
    row, column = np.nonzero(np.add.outer(*map(np.arange, junction_mm.shape[:2]))[:-1] % 2 == 0)
    ends_mm = [junction_mm[row + 1, (column + hand) % shape.lattice_columns] for hand in (1, -1)]
    piece_mm = np.linalg.norm(np.array(ends_mm) - junction_mm[row, column], axis=2)
    return piece_mm.ravel() / device.piece_length_mm(stent.design, stent.size) - 1


@pytest.mark.parametrize("artery", [straight, tapered, oval, bent])
def test_pieces_of_wire_keep_their_length(artery):
    found = stretch(deployed(artery()).stent)
    in_bend = artery is bent
    assert abs(found.mean()) < (0.002 if in_bend else 0.001)
    assert np.quantile(np.abs(found), 0.95) < (0.02 if in_bend else 0.002)


def test_on_a_regular_lattice_nothing_slides():
    nodes_mm = deployed(straight()).stent.nodes_mm
    slid = pieces.slide(SILK, SILK_SIZE, nodes_mm, 50, cells.as_drawn)
    assert slid.nodes_mm == pytest.approx(nodes_mm, abs=1e-3)
    assert slid.row == pytest.approx(np.broadcast_to(np.arange(len(nodes_mm))[:, None], slid.row.shape), abs=0.01)


@pytest.mark.parametrize("held", [0, 50, -1])
def test_rows_of_a_bend_tilt_and_draw_together_about_the_one_that_is_landed(held):
    n = len(deployed(bent()).stent.nodes_mm)
    s = np.arange(n) * formulas.row_spacing_mm(SILK, SILK_SIZE, 3.7)
    flat_mm = contour.planes(bent().parent.axis).place(s + 5.0, contour.circles(np.full(n, 1.85), 48))
    held %= n
    row = pieces.slide(SILK, SILK_SIZE, flat_mm, held, cells.as_drawn).row
    assert np.ptp(row - np.arange(n)[:, None]) > 0.5
    mean = row.mean(axis=1)
    assert mean[held] == pytest.approx(held, abs=1e-9)
    # The bend takes 4 % of the spacing: rows on both sides come nearer to the one that stays.
    assert np.ptp(mean) == pytest.approx((n - 1) * (1 - 0.041 * np.mean((s > 5) & (s < 5 + 11))), rel=0.01)
    assert np.all((np.arange(n) - mean) * (np.arange(n) - held) >= -0.05)


def tight_bend(bend_mm):
    """A Pipeline in a half circle of an artery 3.2 mm wide, and the lengths of its cells along the device."""
    pipeline = catalogue.find_design("pipeline")
    size = device.Size(3.25, 12.0, 3.5)
    anatomy = tube(arc(bend_mm, np.pi, 14), 1.6)
    stent = deploy(pipeline, anatomy, size=size, landing=Landing(14 + bend_mm * np.pi / 2)).stent
    row, column = np.nonzero(np.add.outer(np.arange(len(stent.nodes_mm) - 2), np.arange(48)) % 2 == 0)
    return stent, row, np.linalg.norm(stent.nodes_mm[row + 2, column] - stent.nodes_mm[row, column], axis=1)


def test_on_the_inner_side_of_a_bend_cells_are_as_short_as_the_net_of_chebyshev():
    stent, row, cell_mm = tight_bend(3.0)
    in_bend = np.abs(stent.row_abscissa_mm[row + 1] - 14 - 1.5 * np.pi) < 2.5
    shortest_mm = [cell_mm[in_bend & (row == here)].min() for here in np.unique(row[in_bend])]
    diameter_mm = float(np.median(stent.row_diameter_mm))
    spacing_mm = formulas.row_spacing_mm(stent.design, stent.size, diameter_mm, 1 / 3.0)
    expected_mm = float(2 * spacing_mm * (1 - diameter_mm / 6.0))
    assert np.median(shortest_mm) == pytest.approx(expected_mm, rel=0.1)
    assert shortest_mm == pytest.approx(np.full(len(shortest_mm), expected_mm), rel=0.25)


def test_wires_beside_each_other_do_not_overlap():
    _, _, cell_mm = tight_bend(2.2)
    assert cell_mm.min() > 0.8 * np.sqrt(3) * 0.030


def test_without_sliding_pieces_of_wire_in_the_bend_would_stretch(monkeypatch):
    monkeypatch.setattr(pieces, "slide", lambda design, size, nodes_mm, *_: _unslid(nodes_mm))
    found = stretch(deploy(SILK, bent(), size=SILK_SIZE).stent)
    assert np.quantile(np.abs(found), 0.95) > 0.08


def _unslid(nodes_mm):
    row, column = np.indices(nodes_mm.shape[:2]).astype(float)
    return pieces.Slid(nodes_mm, row, column, np.zeros_like(nodes_mm))


def test_in_an_oval_lumen_the_length_follows_the_perimeter():
    done = deployed(oval())
    angle = np.linspace(0, 2 * np.pi, 20001)
    a, b = 2.15, 1.65
    dx, dy = -a * np.sin(angle), b * np.cos(angle)
    perimeter_mm = np.hypot(np.diff(a * np.cos(angle)), np.diff(b * np.sin(angle))).sum() - 2 * np.pi * 0.05
    assert np.hypot(dx, dy).min() > 1  # the offset curve of an ellipse this round is 2 pi dd shorter
    assert done.stent.deployed_length_mm == pytest.approx(
        formulas.deployed_length_mm(SILK, SILK_SIZE, perimeter_mm / np.pi), rel=0.005
    )
    assert wall_distance_mm(oval(), done) == pytest.approx(0.05, abs=0.001)
    around_mm = np.linalg.norm(done.stent.nodes_mm - np.roll(done.stent.nodes_mm, 1, axis=1), axis=2)
    assert around_mm.std() < 0.02 * around_mm.mean()


def test_in_a_wider_tube_the_device_stays_at_its_free_diameter_and_the_gap_is_shown():
    artery = straight(2.6)
    done = deployed(artery)
    radius_mm = np.linalg.norm(done.stent.nodes_mm[..., :2], axis=2)
    assert radius_mm == pytest.approx(np.full_like(radius_mm, 0.5 * SILK_SIZE.free_diameter_mm), rel=1e-3)
    assert done.wall_gap_mm == pytest.approx(np.full_like(radius_mm, 2.6 - 2.1 - 0.05), abs=0.002)
    assert done.stent.deployed_length_mm == pytest.approx(formulas.deployed_length_mm(SILK, SILK_SIZE, 4.2), rel=1e-3)
    assert "Choose a wider size." in done.advice
    found = measure(artery, done)
    assert found["apposed_fraction"] == 0.0
    volume_mm3 = np.pi * 4.2 * found["deployed_length_mm"] * 0.45
    assert found["malapposition_volume_mm3"] == pytest.approx(volume_mm3, rel=0.01)


def test_where_the_artery_widens_only_the_wide_part_stands_off():
    done = deployed(widening())
    diameter_mm = contour.perimeters(done.stent.nodes_mm) / np.pi
    lumen_mm = 2 * np.interp(
        done.stent.row_abscissa_mm, widening().parent.axis.abscissa_mm, widening().parent.section_radius_mm
    )
    wide, narrow = lumen_mm > 4.2 + 0.25, lumen_mm < 4.2 - 0.1
    assert min(wide.sum(), narrow.sum()) > 10
    assert diameter_mm.max() <= SILK_SIZE.free_diameter_mm * (1 + 1e-6)
    assert diameter_mm[wide] == pytest.approx(np.full(wide.sum(), 4.2), abs=0.005)
    assert done.wall_gap_mm[narrow].max() < 0.002
    assert done.wall_gap_mm[wide].mean(axis=1) == pytest.approx((lumen_mm[wide] - 4.2) / 2 - 0.05, abs=0.02)


def test_in_a_bend_wider_than_the_device_tilted_rows_are_no_wider_than_the_free_device():
    stent = deploy(SILK, tube(arc(BEND_MM, np.pi / 2, 14), 2.5), size=SILK_SIZE).stent
    assert stent.row_diameter_mm.max() <= SILK_SIZE.free_diameter_mm * (1 + 1e-6)
    assert stent.row_diameter_mm == pytest.approx(np.full(len(stent.nodes_mm), 4.2), rel=0.01)


@pytest.mark.parametrize("wide_mm", [8.6, 9.2])
def test_a_device_that_ends_in_a_wide_piece_of_a_bend_is_as_long_as_its_rows_say(wide_mm):
    path = arc(20.0, 1.2, 14)
    along_mm = np.arange(len(path[0])) * 0.2
    bulge = np.exp(-(((along_mm - 26.0) / 6.0) ** 4))
    anatomy = tube(path, 1.9 + (0.5 * wide_mm - 1.9) * bulge)
    stent = deploy(SILK, anatomy, size=SILK_SIZE, landing=Landing(30.0)).stent
    assert np.isfinite(stent.nodes_mm).all()
    diameter_mm = contour.perimeters(stent.nodes_mm) / np.pi
    half_mm = 0.5 * (diameter_mm[1:] + diameter_mm[:-1])
    middle_mm = 0.5 * (stent.row_abscissa_mm[1:] + stent.row_abscissa_mm[:-1])
    across = contour.planes(anatomy.parent.axis)
    curvature = np.interp(middle_mm, across.abscissa_mm, across.curvature_per_mm)
    closed_mm = formulas.row_spacing_mm(SILK, SILK_SIZE, half_mm, curvature).sum()
    assert stent.deployed_length_mm == pytest.approx(closed_mm, abs=0.2)
    foreseen = march(SILK, SILK_SIZE, Landing(30.0), expected_profile(SILK, SILK_SIZE, anatomy))
    assert stent.deployed_length_mm == pytest.approx(np.ptp(foreseen), abs=0.5)


@pytest.mark.parametrize("artery", [straight, tapered, bent, oval])
@DEVICES
def test_the_ends_lie_as_close_to_the_wall_as_the_middle(artery, design, size):
    distance_mm = wall_distance_mm(artery(), deployed(artery(), design, size))
    middle = distance_mm[len(distance_mm) // 2]
    for end in (distance_mm[:3], distance_mm[-3:]):
        assert end.max() <= middle.max() + 0.001
        assert end.min() >= middle.min() - 0.001


@pytest.mark.parametrize("artery", [straight, tapered, bent, oval, widening])
def test_the_history_begins_at_the_inscribed_spheres_never_loses_a_node_and_ends_at_the_result(artery):
    done = deployed(artery())
    assert len(done.history_mm) == len(done.terminated_fraction) + 1
    assert np.all(np.diff(done.terminated_fraction) >= 0)
    assert np.array_equal(done.history_mm[-1], done.stent.nodes_mm)
    first = done.history_mm[0]
    center_mm = first.mean(axis=1, keepdims=True)
    radius_mm = np.linalg.norm(first - center_mm, axis=2)
    assert np.ptp(radius_mm, axis=1).max() < 1e-9


def test_a_moved_artery_gives_the_moved_stent():
    rng = np.random.default_rng(5)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn = turn * np.sign(np.linalg.det(turn))
    shift = np.array([30.0, -80.0, 120.0])
    here = tube(arc(BEND_MM, 1.0, 8, 0.4), 2.0, 1.8, around=64)
    vertices_mm = here.parent.landing_surface.vertices_mm
    waves = 0.04 * np.sin(vertices_mm @ rng.normal(size=(3, 3)))  # no point has two nearest ones by symmetry
    here = on_parent(here, landing_surface=Surface(vertices_mm + waves, here.parent.landing_surface.faces))

    def moved(surface):
        return Surface(surface.vertices_mm @ turn.T + shift, surface.faces)

    axis = Centerline(here.parent.axis.points_mm @ turn.T + shift, here.parent.axis.inscribed_radius_mm)
    there = on_parent(here, axis=axis, landing_surface=moved(here.parent.landing_surface))
    size = catalogue.find_size(SILK, diameter_mm=4, length_mm=15)
    a, b = (deploy(SILK, anatomy, size=size, landing=Landing(11.0)) for anatomy in (here, there))
    assert a.stent.nodes_mm @ turn.T + shift == pytest.approx(b.stent.nodes_mm, abs=1e-6)
    assert a.stent.wire_points_mm @ turn.T + shift == pytest.approx(b.stent.wire_points_mm, abs=1e-6)


@pytest.mark.parametrize("bend_mm", [2.3, 1.5])
def test_planes_of_a_sharp_bend_do_not_cross_inside_the_lumen(bend_mm):
    points, _ = arc(bend_mm, np.pi, 10, 0.1)
    across = contour.planes(Centerline(points, np.full(len(points), 1.9)))
    s = np.arange(1.0, across.abscissa_mm[-1] - 1, 0.1)
    rims = across.place(s, contour.circles(np.full(len(s), 1.85), 36))
    ahead = np.einsum("ijk,ik->ij", np.diff(rims, axis=0), across.at(s)[1][:-1, 0])
    assert ahead.min() > 0


def test_in_a_bend_nearly_as_sharp_as_the_artery_is_wide_the_device_still_lies_on_the_wall():
    artery = tube(arc(2.3, np.pi, 10, 0.15), 1.9, around=96)
    done = deployed(artery)
    assert outside_mm(artery, done) == 0
    assert np.sort(done.wall_gap_mm.ravel())[int(0.99 * done.wall_gap_mm.size)] < 0.01


def test_march_places_the_asked_point_of_the_device():
    profile = Profile(np.array([0.0, 40.0]), np.array([4.0, 3.0]))
    for anchor, which in (("proximal", 0), ("center", 50), ("distal", -1)):
        rows_mm = march(SILK, SILK_SIZE, Landing(20.0, anchor), profile)
        assert len(rows_mm) == formulas.grid(SILK, SILK_SIZE).rows
        assert rows_mm[which] == 20.0
        half_mm = 0.5 * (rows_mm[1:] + rows_mm[:-1])
        assert np.diff(rows_mm) == pytest.approx(
            formulas.row_spacing_mm(SILK, SILK_SIZE, profile.at(half_mm)), rel=1e-4
        )


@pytest.mark.parametrize(
    ("abscissa_mm", "length_mm", "said"),
    [
        (5.0, 15, r"15 mm, 18\.0 mm long once deployed, extends [34]\.\d mm beyond the proximal end of the artery"),
        (30.0, 15, r"beyond the distal end of the artery\. Move it at least \d\.\d mm proximally"),
        (16.0, 40, r"40 mm, \d\d\.\d mm long once deployed, exceeds the artery of 32\.0 mm\. Choose a shorter size"),
    ],
)
def test_a_landing_that_does_not_fit_is_refused_with_figures(abscissa_mm, length_mm, said):
    size = catalogue.find_size(SILK, diameter_mm=4, length_mm=length_mm)
    with pytest.raises(LandingError, match=said):
        deploy(SILK, straight(), size=size, landing=Landing(abscissa_mm))


def test_the_proposed_size_is_the_smallest_that_fills_the_wider_zone_and_the_shortest_that_covers_the_neck():
    anatomy = with_neck(tube(line(60), np.linspace(2.0, 1.6, 301)), 26.0, 31.0)
    size = propose_size(SILK, anatomy)
    proximal_mm, distal_mm = landing_zones.landing_diameters_mm(anatomy)
    assert (proximal_mm, distal_mm) == pytest.approx((4 - 0.8 * 23.5 / 60, 4 - 0.8 * 33.5 / 60), abs=1e-6)
    assert size.diameter_mm == 4.0
    landing = propose_landing(SILK, anatomy, size)
    stent = deploy(SILK, anatomy, size=size, landing=landing).stent
    margin_mm = max(4.0, proximal_mm)
    margins = np.array([26 - stent.proximal_abscissa_mm, stent.distal_abscissa_mm - 31])
    assert margins.min() > margin_mm - 0.05
    assert margins[0] == pytest.approx(margins[1], abs=0.1)
    shorter = [s for s in SILK.sizes if s.diameter_mm == 4 and s.length_mm < size.length_mm]
    for s in shorter:
        short = deploy(SILK, anatomy, size=s, landing=propose_landing(SILK, anatomy, s)).stent
        assert min(26 - short.proximal_abscissa_mm, short.distal_abscissa_mm - 31) < margin_mm


def with_wide_pieces(diameter_mm, *pieces_mm):
    """A straight artery of 3 mm with a neck from 28 to 32 mm, wider in some pieces."""
    along_mm = np.linspace(0, 60, 301)
    is_wide = np.logical_or.reduce([(along_mm > first) & (along_mm < last) for first, last in pieces_mm])
    return with_neck(tube(line(60), np.where(is_wide, diameter_mm / 2, 1.5)), 28.0, 32.0)


def test_a_size_that_would_stand_off_beyond_the_landing_zones_gives_way_to_the_next():
    # The zones, 5 mm on either side of the neck, are 3 mm wide; what is proposed for them reaches beyond them.
    anatomy = with_wide_pieces(3.6, (0, 22.9), (37.1, 60))
    assert max(landing_zones.landing_diameters_mm(anatomy)) == pytest.approx(3.0)
    narrow = propose_size(SILK, with_wide_pieces(3.6, (0, 15), (45, 60)))
    assert narrow.diameter_mm == 3.0
    assert measure(anatomy, deploy(SILK, anatomy, size=narrow))["apposed_fraction"] < 0.95
    size = propose_size(SILK, anatomy)
    assert size.diameter_mm == 3.5
    assert measure(anatomy, deploy(SILK, anatomy, size=size))["apposed_fraction"] == 1.0


@pytest.mark.parametrize(("gap_mm", "label_mm"), [(0.09, 3.0), (0.11, 3.5)])
def test_what_stands_off_for_the_proposal_is_what_stands_off_when_measured(gap_mm, label_mm):
    size = catalogue.find_size(SILK, diameter_mm=3, length_mm=15)
    wide_mm = size.free_diameter_mm + 2 * (SILK.wall_offset_um * 1e-3 + gap_mm)
    anatomy = with_wide_pieces(wide_mm, (0, 22.9), (37.1, 60))
    found = measure(anatomy, deploy(SILK, anatomy, size=size))
    assert found["max_wall_gap_mm"] == pytest.approx(gap_mm, abs=0.003)
    assert (found["apposed_fraction"] == 1.0) is (label_mm == 3.0)
    assert propose_size(SILK, anatomy).diameter_mm == label_mm


@pytest.mark.parametrize("wide", [(5.0, (0, 22.9), (37.1, 60)), (3.6, (24.0, 24.4)), (3.6, (28.5, 31.5))])
def test_no_wider_size_is_proposed_where_it_would_stand_off_too_or_for_a_short_bulge_or_one_across_the_neck(wide):
    assert propose_size(SILK, with_wide_pieces(*wide)).diameter_mm == 3.0


def test_near_the_end_of_the_artery_the_landing_gives_way():
    anatomy = with_neck(straight(), 3.0, 7.0)
    size = catalogue.find_size(SILK, diameter_mm=4, length_mm=20)
    stent = deploy(SILK, anatomy, size=size).stent
    assert stent.proximal_abscissa_mm == pytest.approx(sizing.END_MM, abs=0.05)


@cache
def longer_than_foreseen():
    """A neck near the distal end of an artery whose wall is 0.2 mm narrower than its sections say."""
    anatomy = with_neck(straight(), 25.0, 29.0)
    return on_parent(anatomy, section_radius_mm=anatomy.parent.section_radius_mm + 0.1)


def test_a_device_that_would_leave_the_artery_where_it_is_proposed_is_moved_into_it():
    anatomy = longer_than_foreseen()
    proposed = propose_landing(SILK, anatomy, SILK_SIZE)
    with pytest.raises(LandingError, match=r"extends \d\.\d mm beyond the distal end"):
        deploy(SILK, anatomy, size=SILK_SIZE, landing=proposed)
    stent = deploy(SILK, anatomy, size=SILK_SIZE).stent
    assert 32.0 - 2 * SPARE_MM < stent.distal_abscissa_mm < 32.0
    found = rank(anatomy, [replace(SILK, sizes=(SILK_SIZE,))]).candidates[0]
    assert found.measures["distal_end_abscissa_mm"] == stent.distal_abscissa_mm


def test_what_leaves_the_artery_wherever_it_is_moved_to_is_refused_after_some_tries():
    tried = []

    def lay(landing):
        tried.append(landing.abscissa_mm)
        raise LandingError("It leaves the artery.", 0.5 * (-1) ** len(tried))

    with pytest.raises(LandingError):
        laid_inside(lay, Landing(16.0))
    assert tried == [16.0, 15.5, 16.0, 15.5, 16.0]
    with pytest.raises(LandingError, match="exceeds the artery"):
        deploy(SILK, straight(), size=catalogue.find_size(SILK, diameter_mm=4, length_mm=40))


@pytest.mark.parametrize(("off_mm", "told"), [(0.001, "0.1"), (0.09, "0.1"), (0.11, "0.2"), (3.0, "3.0")])
def test_what_is_missing_is_rounded_up_and_moving_by_it_and_a_little_is_enough(off_mm, told):
    for rows_mm, sense in ((np.array([10.0, 32 + off_mm]), -1), (np.array([-off_mm, 10.0]), 1)):
        with pytest.raises(
            LandingError, match=f"extends {told} mm beyond .* at least {told} mm (?:dist|proxim)ally"
        ) as refused:
            check_inside(SILK, SILK_SIZE, rows_mm, 32.0)
        check_inside(SILK, SILK_SIZE, rows_mm + refused.value.move_mm, 32.0)
        assert refused.value.move_mm == pytest.approx(sense * (off_mm + SPARE_MM))


@pytest.mark.parametrize("abscissa_mm", [9999.0, -0.2, 32.1, np.nan])
@pytest.mark.parametrize("method", ["constant_wire", "zhong2016"])
def test_a_landing_point_off_the_artery_is_refused_as_what_it_is(abscissa_mm, method):
    with pytest.raises(LandingError, match=r"^A landing at .* mm from the inlet is not on the parent artery"):
        deploy(SILK, straight(), size=SILK_SIZE, landing=Landing(abscissa_mm), method=method)
    with pytest.raises(LandingError, match="is not on the parent artery"):
        sketch(measured_wall(SILK, SILK_SIZE, straight()), Landing(abscissa_mm))


def test_a_device_has_three_points_to_land_it_by():
    with pytest.raises(LandingError, match=r"by its 'middle'\. Choose one of center, distal, proximal\."):
        Landing(10.0, "middle")


def test_in_a_short_artery_a_narrower_size_is_proposed_before_none():
    anatomy = tube(line(16.6), 1.55)
    size = propose_size(SILK, anatomy)
    assert size == device.Size(3.0, 15.0, 3.2)
    stent = deploy(SILK, anatomy, size=size).stent
    assert 0 < stent.proximal_abscissa_mm < stent.distal_abscissa_mm < 16.6


def test_no_size_fits_a_stump():
    with pytest.raises(LandingError, match=r"No size of Silk up to 4\.5 mm in diameter fits: the shortest would be 1"):
        propose_size(SILK, tube(line(10), 1.9))


def test_a_size_too_wide_for_the_artery_is_not_said_to_be_too_long_for_it():
    wide = device.Size(4.0, 8.0, 4.2)
    design = replace(SILK, sizes=(device.Size(3.0, 25.0, 3.2), device.Size(3.5, 25.0, 3.7), wide))
    anatomy = with_neck(tube(line(20), 1.45), 8.0, 12.0)
    with pytest.raises(LandingError, match=r"up to 3\.5 mm in diameter fits: the shortest would be [2-4]\d\.\d mm l"):
        propose_size(design, anatomy)
    assert deploy(design, anatomy, size=wide).stent.deployed_length_mm < 20


@cache
def beside_a_neck():
    return with_neck(tube(line(60), 1.9), 14.0, 18.0)


@pytest.mark.parametrize(
    ("center_mm", "said"),
    [
        (45.0, r"22\.\d mm short of the proximal end of the neck \(move it proximally\)"),
        (24.0, r"1\.\d mm short of the proximal end of the neck \(move it proximally\)"),
        (20.0, r"only 2\.9 mm beyond the proximal end of the neck \(move it proximally\)"),
        (12.0, r"only 3\.1 mm beyond the distal end of the neck \(move it distally\)"),
    ],
)
def test_a_device_that_misses_the_neck_or_hardly_passes_it_says_by_how_much(center_mm, said):
    assert re.search(said, deploy(SILK, beside_a_neck(), size=SILK_SIZE, landing=Landing(center_mm)).advice)


def test_a_device_too_short_for_the_neck_asks_for_a_longer_one_where_that_helps():
    wide_neck = with_neck(tube(line(60), 1.9), 20.0, 36.0)
    advice = deploy(SILK, wide_neck, size=SILK_SIZE).advice
    assert re.search(r"only 1\.0 mm beyond the \w+ end of the neck \(choose a longer size\); 100% of it is", advice)
    at_the_end = with_neck(tube(line(60), 1.9), 0.0, 5.0)
    assert ", 0.5 mm short of the proximal end of the neck; 100%" in deploy(SILK, at_the_end, size=SILK_SIZE).advice


def test_a_device_labelled_for_far_wider_arteries_says_so():
    thin, wider = tube(line(60), 0.9), tube(line(60), 1.2)
    assert "label diameter" not in deploy(SILK, wider, size=SILK_SIZE).advice
    said = ", label diameter 2.2 times the diameter of the artery (choose a narrower size); "
    assert said in deploy(SILK, thin, size=SILK_SIZE).advice
    enterprise = catalogue.find_design("enterprise")
    said = ", label diameter 2.5 times the diameter of the artery (choose a device for narrower arteries)"
    assert said in deploy(enterprise, thin).advice


@pytest.mark.parametrize(
    ("anatomy", "ends"),
    [
        (straight(), (r"\d+\.\d mm from the inlet", r"\d+\.\d mm from the inlet")),
        (beside_a_neck(), (r"\d\.\d mm proximal to the neck", r"\d\.\d mm distal to the neck")),
    ],
)
def test_of_a_device_that_is_as_it_should_be_no_more_is_said(anatomy, ends):
    form = rf"Silk 4\.00 x 15 mm reaches from {ends[0]} to {ends[1]} \(deployed length 18\.0 mm\); "
    assert re.fullmatch(form + r"100% of it is apposed\.", deploy(SILK, anatomy, size=SILK_SIZE).advice)


def test_of_a_device_wholly_over_restored_wall_nothing_is_said_of_gaps():
    restored = on_parent(
        straight(), is_restored=np.ones(len(straight().parent.landing_surface.vertices_mm), dtype=bool)
    )
    assert deploy(SILK, restored, size=SILK_SIZE).advice.endswith(
        "(deployed length 18.0 mm). All of it is over restored wall."
    )


@pytest.mark.parametrize(
    ("length_mm", "remedy"),
    [
        (14, ", and wider sizes are too long for this artery. Choose another device."),
        (30, "its free diameter is 3.70 mm. Choose a wider size."),
    ],
)
def test_a_wider_size_is_asked_for_where_one_fits(length_mm, remedy):
    lvis = catalogue.find_design("lvis")
    lvis = replace(lvis, sizes=tuple(size for size in lvis.sizes if size.length_mm >= 17))
    narrow = catalogue.find_size(lvis, diameter_mm=3.5, length_mm=17)
    assert remedy in deploy(lvis, tube(line(length_mm), 2.2), size=narrow).advice


def test_a_contour_that_is_not_given_the_time_says_so():
    slow = ConstantWire(ActiveContour(k1=0.001, k2=0.0, iteration_limit=2))
    done = deploy(SILK, oval(), size=SILK_SIZE, method=slow)
    assert done.outcome == "iteration_limit"
    assert "Raise the iteration limit" in done.advice
