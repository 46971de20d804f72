"""Baskets in sacs of revolution: rows and height against integrals of the wires' length, gaps, and refusals."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.special import ellipk, ellipkinc
from tubes import line, tube

from vstent.deployment.basket import propose_basket, room_of
from vstent.deployment.deploy import deploy
from vstent.deployment.measure import measure, wire_stretches
from vstent.devices.catalogue import baskets, find_design, find_size
from vstent.devices.design import Basket, Size, piece_length_mm
from vstent.devices.formulas import meridian_mm, rows_along
from vstent.devices.stent import Landing, tube_faces
from vstent.devices.treatment import read_treatment
from vstent.errors import InputError, LandingError
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Aneurysm
from vstent.plan.rank import rank
from vstent.reporting.definitions import DEFINITIONS
from vstent.study.stages import deploy_implant

SPHERE = find_design("web_sls")
BARREL = find_design("web_sl")
AROUND = 96
ROUND = Size(7.0, 7.0, 7.0)
"""A basket that is a sphere outside a sac."""


def sac_of(radius_mm, heights_mm):
    """A straight artery with a sac of revolution about z, of radii at heights, on a flat neck at the lowest."""
    angle = 2 * np.pi * np.arange(AROUND) / AROUND
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rings_mm = [np.column_stack([r * ring, np.full(AROUND, z)]) for r, z in zip(radius_mm, heights_mm, strict=True)]
    wall = np.concatenate([*rings_mm, [[0, 0, heights_mm[0]], [0, 0, heights_mm[-1]]]])
    faces, k, n = tube_faces(len(rings_mm), AROUND), np.arange(AROUND), len(rings_mm) * AROUND
    beside, last = (k + 1) % AROUND, n - AROUND
    bottom = np.stack([np.full(AROUND, n), beside, k], axis=1)
    top = np.stack([np.full(AROUND, n + 1), last + k, last + beside], axis=1)
    sac = Surface(wall, np.concatenate([faces, bottom, top]).astype(np.int32))
    neck = Surface(wall[[*range(AROUND), n]], np.stack([np.full(AROUND, AROUND), k, beside], axis=1).astype(np.int32))
    return replace(tube(line(30), 2.0), aneurysms=(Aneurysm(sac, neck, rings_mm[0]),))


def ball(radius_mm, neck_radius_mm):
    """A sac that is a sphere, cut where it is as wide as its neck below the middle."""
    low_mm = -np.sqrt(radius_mm**2 - neck_radius_mm**2)
    turn = np.linspace(np.arccos(low_mm / radius_mm), 1e-3, 80)
    return sac_of(radius_mm * np.sin(turn), radius_mm * np.cos(turn) - low_mm)


def pot(radius_mm, height_mm):
    """A sac that is a cylinder, open over its whole neck."""
    return sac_of(np.full(40, radius_mm), np.linspace(0.0, height_mm, 40))


def test_rows_of_a_sphere_are_those_of_the_elliptic_integral():
    height_mm, radius_mm = meridian_mm(SPHERE, ROUND)
    rows = rows_along(SPHERE, ROUND, height_mm, radius_mm)
    m, per_rad = np.sin(SPHERE.braid_angle_rad) ** 2, 3.5 / piece_length_mm(SPHERE, ROUND)
    first = np.arcsin(radius_mm[0] / 3.5)
    assert rows[-1] == pytest.approx(2 * per_rad * (ellipk(m) - ellipkinc(first, m)), rel=1e-4)


def test_a_basket_in_a_sac_that_is_wider_has_its_free_shape_and_its_wires_their_length():
    done = deploy(SPHERE, ball(5.0, 2.5), size=ROUND)
    found = measure(ball(5.0, 2.5), done)
    assert found["basket_width_mm"] == pytest.approx(7.0, rel=0.005)
    assert found["height_gain_fraction"] == pytest.approx(-0.01, abs=0.01)  # the ends of the wires are at the markers
    assert np.quantile(np.abs(wire_stretches(done.stent)), 0.95) < 0.01
    assert found["protrusion_mm"] == found["max_outside_mm"] == 0
    assert found["neck_uncovered_fraction"] == 0
    assert found["max_wall_gap_mm"] > 1.0
    assert "is not apposed" in done.advice


@pytest.mark.parametrize("sac_mm", [3.3, 3.0, 2.7])
def test_a_narrower_basket_is_as_much_taller_as_its_wires_require(sac_mm):
    done = deploy(SPHERE, pot(sac_mm, 20.0), size=Size(7.0, 7.0, 7.0), landing=Landing(3.0, "proximal"))
    inside_mm, piece_mm = sac_mm * np.cos(np.pi / AROUND) ** 0.5 - 0.025, piece_length_mm(SPHERE, ROUND)
    first = np.arcsin(SPHERE.marker_radius_mm / 3.5)

    def rows(factor, widest_mm):
        def per_angle(t):
            r = 3.5 * np.sin(t)
            slope = 3.5 * np.cos(t) if r < widest_mm else 0.0
            step = np.hypot(slope, factor * 3.5 * np.sin(t))
            return step / np.sqrt(piece_mm**2 - (2 * np.pi * min(r, widest_mm) / SPHERE.n_columns) ** 2)

        return 2 * quad(per_angle, first, np.pi / 2, points=[np.arcsin(min(1.0, widest_mm / 3.5))])[0]

    factor = brentq(lambda one: rows(one, inside_mm) - rows(1.0, 3.5), 0.5, 3.0)
    found = measure(pot(sac_mm, 20.0), done)
    assert found["basket_height_mm"] == pytest.approx(factor * 7.0 * np.cos(first), rel=0.005)
    assert found["basket_width_mm"] == pytest.approx(2 * inside_mm, rel=0.005)
    assert np.quantile(np.abs(wire_stretches(done.stent)), 0.95) < 0.02


def test_a_basket_one_mm_wider_than_the_sac_gains_two_thirds_of_a_mm_in_height():
    for size in (find_size(BARREL, diameter_mm=w, length_mm=h) for w, h in ((6.0, 4.0), (8.0, 5.0), (10.0, 6.0))):
        sac = pot(0.5 * size.diameter_mm - 0.5, 20.0)
        found = measure(sac, deploy(BARREL, sac, size=size, landing=Landing(3.0, "proximal")))
        assert found["basket_height_mm"] - size.length_mm == pytest.approx(0.65, abs=0.1)


def test_what_does_not_fit_below_the_dome_stands_out_of_the_neck_and_nothing_passes_the_wall():
    sac = ball(3.5, 2.2)
    done = deploy(BARREL, sac, size=find_size(BARREL, diameter_mm=8.0, length_mm=6.0))
    found = measure(sac, done)
    room = room_of(sac.aneurysms[0], BARREL.n_columns)
    assert found["protrusion_mm"] == pytest.approx(-done.stent.proximal_abscissa_mm, abs=0.02)
    assert done.stent.distal_abscissa_mm == pytest.approx(room.height_mm - 0.025, abs=0.02)
    assert found["max_outside_mm"] == 0
    assert found["apposed_fraction"] > 0.95
    points_mm = done.stent.wire_points_mm
    above = points_mm[points_mm @ room.frame[0] > room.origin_mm @ room.frame[0]]
    assert sac.aneurysms[0].sac.signed_distance(above).max() < 0.005
    assert "stands out" in done.advice


def test_the_proposed_size_is_one_mm_wider_than_the_sac_and_one_lower_and_lower_still_where_it_would_stand_out():
    size = propose_basket(BARREL, pot(3.0, 6.4))
    assert (size.diameter_mm, size.length_mm) == (7.0, 5.0)
    sac = ball(3.5, 2.2)  # 7.0 mm wide and 6.2 mm high
    size = propose_basket(BARREL, sac)
    assert (size.diameter_mm, size.length_mm) == (8.0, 4.0)
    assert deploy(BARREL, sac, size=size).stent.proximal_abscissa_mm >= -0.5
    assert deploy(BARREL, sac, size=find_size(BARREL, diameter_mm=8.0, length_mm=5.0)).stent.proximal_abscissa_mm < -0.5


def test_in_a_tall_sac_width_and_height_are_swapped_and_the_basket_fills_more_of_it():
    sac = pot(2.5, 8.0)  # 5 mm wide and 8 mm high
    swapped = propose_basket(BARREL, sac)
    assert (swapped.diameter_mm, swapped.length_mm) == (9.0, 4.0)
    usual = find_size(BARREL, diameter_mm=6.0, length_mm=5.0)  # one up, one down as far as it is made
    by_rule, by_swap = (measure(sac, deploy(BARREL, sac, size=size)) for size in (usual, swapped))
    assert by_swap["volume_ratio_fraction"] > 1.2 * by_rule["volume_ratio_fraction"]
    assert by_swap["apposed_fraction"] > by_rule["apposed_fraction"] > 0.9
    assert by_swap["protrusion_mm"] < 0.5
    assert by_swap["neck_uncovered_fraction"] == 0


def test_a_cup_lies_below_its_rim_with_both_layers_and_its_wires_keep_their_length():
    cup = find_design("contour")
    for sac_mm, label_mm in ((4.0, 11.0), (3.0, 9.0), (6.0, 7.0)):
        sac = ball(sac_mm, 0.5 * sac_mm)
        done = deploy(cup, sac, size=find_size(cup, diameter_mm=label_mm))
        nodes_mm = done.stent.nodes_mm
        rim = len(nodes_mm) // 2
        low, high = nodes_mm[:rim], nodes_mm[:rim:-1]
        apart_mm = np.linalg.norm(high - low, axis=2)
        assert 0.02 < apart_mm.min() <= apart_mm.max() < 0.1
        assert (high[1:-3, :, 2] > low[1:-3, :, 2]).all()
        assert nodes_mm[..., 2].max() == pytest.approx(nodes_mm[rim, :, 2].max(), abs=0.01)
        assert sac.aneurysms[0].sac.signed_distance(done.stent.wire_points_mm).max() < 0.2
        found = measure(sac, done)
        assert found["p95_wire_stretch_fraction"] < 0.05
        assert found["max_outside_mm"] == 0
        assert found["neck_uncovered_fraction"] == 0
        assert found["basket_width_mm"] == pytest.approx(min(2 * sac_mm, label_mm), abs=0.15)
        assert (found["basket_height_mm"] > 2.5) == (label_mm > 2 * sac_mm)


def test_a_cup_is_proposed_a_quarter_wider_than_the_sac():
    assert [propose_basket(find_design("contour"), ball(r, 0.5 * r)).diameter_mm for r in (2.5, 3.0, 4.0)] == [7, 9, 11]


def test_what_makes_no_sense_is_refused_in_a_sentence():
    wide = pot(6.5, 9.0)
    with pytest.raises(LandingError, match=r"neck is up to 13.0 mm wide, and WEB SL 11 mm: the basket would not stay"):
        deploy(BARREL, wide)
    with pytest.raises(LandingError, match=r"neck is up to 4.4 mm wide, and WEB SL 4 mm"):
        deploy(BARREL, ball(3.5, 2.2), size=BARREL.sizes[0])
    with pytest.raises(LandingError, match="has no sac, and WEB SL lies in one"):
        deploy(BARREL, tube(line(30), 2.0))
    with pytest.raises(LandingError, match="is placed by its proximal end"):
        deploy(BARREL, ball(3.5, 2.2), landing=Landing(1.0))
    with pytest.raises(LandingError, match=r"A shift of 50 mm puts .* outside the sac, which is 6.2 mm high"):
        deploy(BARREL, ball(3.5, 2.2), landing=Landing(50.0, "proximal"))
    raised = deploy(BARREL, ball(3.5, 2.2), landing=Landing(3.0, "proximal"))
    assert "lower than asked for, because the dome is in the way" in raised.advice
    with pytest.raises(InputError, match="WEB SL lies in a sac, and the ranking is of devices for arteries"):
        rank(tube(line(30), 2.0), [BARREL])
    sac = ball(3.5, 2.2)
    _, basket = read_treatment("silk + web_sl").implants
    with pytest.raises(LandingError, match="WEB SL lies in a sac alone"):
        deploy("silk", sac, inside=[deploy(BARREL, sac).stent])
    with pytest.raises(LandingError, match="WEB SL lies in a sac alone"):
        deploy_implant(basket, sac, [deploy("silk", tube(line(30), 2.0)).stent])


def test_a_shift_lifts_a_basket_from_the_neck():
    sac = ball(6.0, 2.5)
    (implant,) = read_treatment("web_sl 7x4 @ 1.5").implants
    stent = deploy_implant(implant, sac).stent
    assert stent.size.label == "7.00 x 4 mm"
    assert stent.proximal_abscissa_mm == pytest.approx(1.5, abs=0.01)


def test_every_measure_of_a_basket_is_defined():
    sac = ball(3.5, 2.2)
    found = measure(sac, deploy(BARREL, sac))
    assert [key for key in found if key not in DEFINITIONS] == ["device", "size"]


def test_a_basket_in_a_turned_and_moved_sac_is_the_same_turned_and_moved():
    sac, angle = ball(3.5, 2.2), 0.7
    turn = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    (one,) = sac.aneurysms

    def moved(surface):
        return Surface(surface.vertices_mm @ turn.T + [1, 2, 3], surface.faces)

    other = replace(sac, aneurysms=(Aneurysm(moved(one.sac), moved(one.neck), one.neck_mm @ turn.T + [1, 2, 3]),))
    before, after = (measure(anatomy, deploy(BARREL, anatomy)) for anatomy in (sac, other))
    for key in ("basket_width_mm", "basket_height_mm", "protrusion_mm", "neck_metal_coverage_fraction"):
        assert after[key] == pytest.approx(before[key], rel=0.01)


@pytest.mark.parametrize("key", [key for key, design in baskets().items() if isinstance(design, Basket)])
def test_every_number_of_a_basket_has_a_source_and_a_range_around_its_value(key):
    design = baskets()[key]
    named = {fact.name for fact in design.facts}
    assert {"wires", "wires_diameter_um", "braid_angle_rad", "exponent", "sizes"} <= named
    assert all(one.low <= one.value <= one.high for one in design.ranges)


def test_wires_that_stand_out_of_the_neck_are_metal_in_the_artery():
    sac = ball(3.5, 2.2)
    inside, outside = (
        measure(sac, deploy(BARREL, sac, landing=Landing(at_mm, "proximal")))["metal_in_artery_mm2"]
        for at_mm in (1.0, -2.0)
    )
    assert 0.0 <= inside < 5.0 < outside
