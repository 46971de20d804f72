"""Structures of devices: outer layers, strands, closed and flared ends of braids, open cells of laser-cut devices."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tubes import arc, line, on_parent, tube

from vstent.deployment.braid import over_openings
from vstent.deployment.deploy import deploy
from vstent.deployment.measure import measure, wire_stretches
from vstent.deployment.sketch import measured_wall, sketch
from vstent.deployment.struts import struts
from vstent.devices.design import Braid, LaserCut, Size, Strands
from vstent.devices.formulas import deployed_length_mm, free_diameters_mm, grid, mesh_rows, row_spacing_mm
from vstent.devices.stent import Landing
from vstent.errors import DeviceError
from vstent.flow.media import media
from vstent.flow.settings import Blood

FREE_MM, WIDER_MM = 3.7, 4.3
PROFILE = ((0.0, WIDER_MM), (0.08, FREE_MM), (0.92, FREE_MM), (1.0, WIDER_MM))
DUAL = Braid("dual", "Dual", ((48, 30.0),), 1.15, (Size(4.0, 13.0, 4.2),), strands=(Strands(16, 60.0, "outside", 2.5),))
BESIDE = (Strands(2, 80.0, "beside"),)
LOOPED = Braid("looped", "Looped", ((16, 60.0),), 1.13, (Size(4.5, 15.0, 4.7),), BESIDE, has_closed_ends=True)
FLARED = Braid("flared", "Flared", ((16, 60.0),), 1.0, (Size(3.5, 15.0, FREE_MM, 0.0, PROFILE),))
OPEN = LaserCut(
    "open", "Open", 16, 60.0, 60.0, 0.61, (Size(4.5, 21.0, 4.5),), joined_crowns=("1000", "0010"), crown_gap_um=150.0
)
STRUCTURES = (DUAL, LOOPED, FLARED, OPEN)
RADIUS_MM = 1.9


@cache
def straight():
    return tube(line(40), RADIUS_MM)


@cache
def bend():
    return tube(arc(7.0, np.pi / 2, 14), RADIUS_MM)


@cache
def deployed(design, name):
    return deploy(design, bend() if name == "bend" else straight(), size=design.sizes[0], landing=Landing(19.5))


def is_closed(surface):
    """Every edge belongs to two triangles, which run along it in opposite directions."""
    edges = np.concatenate([surface.faces[:, [i, (i + 1) % 3]] for i in range(3)]).astype(np.int64)
    key = edges[:, 0] * len(surface.vertices_mm) + edges[:, 1]
    return len(np.unique(key)) == len(key) and np.array_equal(
        np.sort(key), np.sort(edges[:, 1] * len(surface.vertices_mm) + edges[:, 0])
    )


@pytest.mark.parametrize("name", ["straight", "bend"])
@pytest.mark.parametrize("design", STRUCTURES, ids=lambda design: design.key)
def test_every_structure_keeps_the_length_of_its_wires_and_is_meshed_and_screened_as_drawn(design, name):
    done = deployed(design, name)
    found, solid = measure(bend() if name == "bend" else straight(), done), struts(done.stent)
    assert abs(found["mean_wire_stretch_fraction"]) < 0.01
    assert found["p95_wire_stretch_fraction"] < 0.015
    assert found["max_outside_mm"] == 0.0
    assert is_closed(solid)
    assert solid.volume_mm3 > 0
    (metal,) = media(done.stent, Blood())
    # The samples of the screen represent half the area between neighbouring wires of each family.
    assert (2 * metal.area_mm2 / metal.spacing_mm).sum() == pytest.approx(done.stent.wire_length_mm, rel=1e-6)
    if name == "straight":
        assert found["metal_coverage_fraction"] == pytest.approx(found["metal_coverage_formula_fraction"], rel=0.04)
        assert found["pore_density_per_mm2"] == pytest.approx(found["pore_density_formula_per_mm2"], rel=0.002)
        assert done.stent.deployed_length_mm == pytest.approx(
            deployed_length_mm(design, design.sizes[0], found["mean_diameter_mm"]), rel=1e-3
        )


def test_the_outer_layer_is_longer_than_the_mesh_at_both_ends_and_lies_between_it_and_the_wall():
    stent, size = deployed(DUAL, "straight").stent, DUAL.sizes[0]
    radius_mm = np.hypot(*stent.wire_points_mm[:, :2].T)
    along_mm = stent.wire_points_mm[:, 2]
    is_outer = stent.wire_diameter_um[stent.point_wires] == 60.0
    assert radius_mm[~is_outer].max() + 0.015 < radius_mm[is_outer].min() - 0.03 + 1e-3
    assert radius_mm[is_outer].max() + 0.03 == pytest.approx(RADIUS_MM, abs=2e-3)
    first, last = mesh_rows(DUAL, size)
    spacing_mm = float(row_spacing_mm(DUAL, size, 2 * (RADIUS_MM - 0.15)))
    beyond = grid(DUAL, size).lattice_rows - 1 - last
    assert along_mm[~is_outer].min() - along_mm[is_outer].min() == pytest.approx(first * spacing_mm, rel=1e-3)
    assert along_mm[is_outer].max() - along_mm[~is_outer].max() == pytest.approx(beyond * spacing_mm, rel=1e-3)
    assert beyond == first == round(2.5 / float(row_spacing_mm(DUAL, size, 4.0)))
    assert np.diff(stent.mesh_abscissa_mm) == pytest.approx((last - first) * spacing_mm, rel=1e-3)


def test_a_braid_with_closed_ends_is_as_many_closed_wires_as_its_rows_and_wires_have_common_divisors():
    for length_mm in (14.0, 15.0, 16.0, 17.0):
        size = Size(4.5, length_mm, 4.7)
        design = replace(LOOPED, sizes=(size,), strands=())
        stent = sketch(measured_wall(design, size, straight()), Landing(19.5)).stent
        ends = stent.wire_points_mm[stent.wire_starts[:-1]], stent.wire_points_mm[stent.wire_starts[1:] - 1]
        assert np.allclose(*ends, atol=1e-12)
        assert len(stent.wire_diameter_um) == np.gcd(grid(design, size).lattice_rows - 1, 8)
        open_ends = sketch(measured_wall(replace(design, has_closed_ends=False), size, straight()), Landing(19.5)).stent
        assert stent.wire_length_mm == pytest.approx(open_ends.wire_length_mm, rel=0.02)


def test_strands_run_beside_wires_of_the_mesh_without_passing_through_them():
    stent = deployed(LOOPED, "straight").stent
    strand = stent.wire_points_mm[stent.wire_starts[-2] : stent.wire_starts[-1]]
    mesh = stent.wire_points_mm[: stent.wire_starts[-3]]
    apart_mm = np.linalg.norm(strand[:, None] - mesh[None], axis=2).min(axis=1)
    assert apart_mm.min() > 0.9 * 0.5 * (0.06 + 0.08)
    assert np.median(apart_mm) < 2 * 0.5 * (0.06 + 0.08)


def test_in_a_wide_artery_flared_ends_open_to_their_own_free_diameter():
    wide = tube(line(40), 2.6)
    done = deploy(FLARED, wide, size=FLARED.sizes[0], landing=Landing(20.0))
    wanted_mm = free_diameters_mm(FLARED, FLARED.sizes[0])
    assert done.stent.row_diameter_mm == pytest.approx(wanted_mm, rel=0.01)
    assert abs(wire_stretches(done.stent).mean()) < 0.01
    fast = sketch(measured_wall(FLARED, FLARED.sizes[0], wide), Landing(20.0)).stent
    assert fast.deployed_length_mm == pytest.approx(done.stent.deployed_length_mm, rel=0.01)
    assert fast.row_diameter_mm == pytest.approx(wanted_mm, rel=0.02)


def test_a_flare_opens_until_its_wires_lie_across_the_axis():
    steep = replace(FLARED, braid_angle_rad=1.3)
    free_mm = free_diameters_mm(steep, steep.sizes[0])
    assert free_mm.max() == pytest.approx(FREE_MM * np.sin(1.5) / np.sin(1.3))
    stent = deploy(steep, tube(line(40), 2.6), size=steep.sizes[0], landing=Landing(20.0)).stent
    assert stent.row_diameter_mm == pytest.approx(free_mm, rel=0.01)


def outer_neck():
    """The bend with a part of the outer side of its wall restored, as over a neck."""
    artery = bend()
    points_mm = artery.parent.landing_surface.vertices_mm
    s = artery.parent.axis.nearest_abscissa_mm(points_mm)
    away = np.linalg.norm(points_mm - [7.0, 0.0, 0.0], axis=1) > 7.0 + 0.5 * RADIUS_MM
    is_neck = (np.abs(s - 19.5) < 2.0) & away & (np.abs(points_mm[:, 1]) < 1.6)
    return on_parent(artery, is_restored=is_neck)


def test_free_crowns_point_out_over_a_neck_outside_a_bend_and_into_the_lumen_inside_it():
    inside, over = deployed(OPEN, "bend"), deploy(OPEN, outer_neck(), size=OPEN.sizes[0], landing=Landing(19.5))
    held, free = measure(bend(), inside), measure(outer_neck(), over)
    assert held["free_crowns_count"] == free["free_crowns_count"] > 0
    assert held["max_crown_outward_mm"] == 0.0
    # A straight tip of one strut row leaves a wall of curvature 1 / 8.9 mm by h^2 / (2 * 8.9), h being the row spacing.
    height_mm = float(row_spacing_mm(OPEN, OPEN.sizes[0], 2 * RADIUS_MM - 0.12))
    straight_mm = height_mm**2 / 8.9
    assert 0.3 * straight_mm < free["max_crown_outward_mm"] < straight_mm
    assert 0.05 < held["max_crown_inward_mm"] < height_mm**2 / 5.1
    assert over_openings(outer_neck(), over.stent.nodes_mm).any()
    reach_mm = [
        np.linalg.norm(points_mm[(points_mm[:, 2] > 0) & (points_mm[:, 0] < 7)] - [7.0, 0.0, 0.0], axis=1).max()
        for points_mm in (inside.stent.wire_points_mm, over.stent.wire_points_mm)
    ]
    assert reach_mm[0] < 7 + RADIUS_MM < reach_mm[1] - 0.05


def test_open_cells_shorten_less_in_a_bend_than_closed_ones_and_not_at_all_in_a_tube():
    closed = replace(OPEN, joined_crowns=(), crown_gap_um=0.0)
    for name, more in (("straight", -0.01), ("bend", 0.5)):
        opened, joined = deployed(OPEN, name).stent, deployed(closed, name).stent
        assert opened.deployed_length_mm - joined.deployed_length_mm >= more
    assert deployed(OPEN, "straight").stent.deployed_length_mm == pytest.approx(
        deployed(closed, "straight").stent.deployed_length_mm, rel=1e-4
    )


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"strands": (Strands(5, 60.0, "outside"),)}, "Give an even number"),
        ({"strands": (Strands(6, 60.0, "beside"),)}, "divides the number of wires"),
        ({"strands": (Strands(2, 60.0, "beside", 1.0),)}, "longer than the mesh"),
        ({"wires": ((8, 50.0), (8, 60.0)), "strands": ()}, "closed ends"),
    ],
)
def test_a_braid_that_cannot_be_made_is_refused(change, said):
    with pytest.raises(DeviceError, match=said):
        replace(LOOPED, **change)


@pytest.mark.parametrize(("rows", "said"), [(("0000",), "rings are separate"), (("10", "102"), "Give 0 and 1")])
def test_rings_that_hang_together_nowhere_are_refused(rows, said):
    with pytest.raises(DeviceError, match=said):
        replace(OPEN, joined_crowns=rows)
