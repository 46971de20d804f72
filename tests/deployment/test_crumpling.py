"""Crumpled cells: the width of cells where it is known, and devices in bends that crumple them or do not."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tubes import arc, line, tube, with_neck

from vstent.deployment.crumpling import CRUMPLED_FRACTION, Cells, cells, place_of_narrowest
from vstent.deployment.deploy import deploy
from vstent.deployment.measure import measure
from vstent.devices import catalogue
from vstent.devices.formulas import angle_rad, grid, row_spacing_mm
from vstent.devices.stent import Stent

ENTERPRISE, ATLAS, PIPELINE = map(catalogue.find_design, ("enterprise", "neuroform_atlas", "pipeline"))
SIZES = {
    "enterprise": catalogue.find_size(ENTERPRISE, diameter_mm=4.5, length_mm=22),
    "neuroform_atlas": catalogue.find_size(ATLAS, diameter_mm=4.0, length_mm=21),
    "pipeline": catalogue.find_size(PIPELINE, diameter_mm=4.25, length_mm=14),
}


@cache
def artery(bend_mm=None):
    return tube(line(44) if bend_mm is None else arc(bend_mm, np.pi / 2, 14), 1.9)


@cache
def siphon(bend_mm=4.0, straight_mm=14.0, step_mm=0.2):
    """Two quarter turns in opposite directions."""
    n, m = round(straight_mm / step_mm), round(0.5 * np.pi * bend_mm / step_mm)
    up = np.linspace(0.0, 0.5 * np.pi, m)
    angle = np.concatenate([np.zeros(n), up, up[::-1], np.zeros(n)])
    tangent, inward = (
        np.stack([first, 0 * angle, second], axis=1)
        for first, second in ((np.sin(angle), np.cos(angle)), (np.cos(angle), -np.sin(angle)))
    )
    points = np.cumsum(step_mm * tangent, axis=0)
    return tube((points, np.stack([tangent, inward, np.cross(tangent, inward)], axis=1)), 1.9)


@cache
def deployed(design, anatomy):
    return deploy(design, anatomy, size=SIZES[design.key])


@pytest.mark.parametrize("design", [ENTERPRISE, ATLAS, PIPELINE])
def test_in_a_straight_artery_every_cell_has_its_full_width(design):
    found = cells(deployed(design, artery()).stent, artery().parent.axis)
    assert found.width_fraction == pytest.approx(np.ones(len(found.width_fraction)), abs=0.004)
    assert not found.inward.any()


@pytest.mark.parametrize("turn_rad", [0.0, 1.0, np.pi / 2, 2.2])
def test_a_cell_that_is_turned_about_its_height_is_as_wide_as_its_cosine(turn_rad):
    stent = deployed(ENTERPRISE, artery()).stent
    shape = grid(stent.design, stent.size)
    row, columns = 5, np.array([3, 5])
    nodes_mm = stent.nodes_mm.copy()
    sides_mm = nodes_mm[row * shape.row_split, columns * shape.column_split]
    middle_mm = sides_mm.mean(axis=0)
    out = middle_mm * [1, 1, 0] / np.linalg.norm(middle_mm[:2])
    turned_mm = np.cos(turn_rad) * (sides_mm - middle_mm) + np.multiply.outer(
        np.sin(turn_rad) * (sides_mm - middle_mm) @ np.cross([0, 0, 1], out), out
    )
    nodes_mm[row * shape.row_split, columns * shape.column_split] = middle_mm + turned_mm
    changed = replace(stent, nodes_mm=nodes_mm)
    found = cells(changed, artery().parent.axis)
    diameter_mm = [one.row_diameter_mm[row * shape.row_split] for one in (stent, changed)]
    width = found.width_fraction
    lattice_row, cells_around = row - 1, shape.lattice_columns // 2
    of_row = slice(lattice_row * cells_around, (lattice_row + 1) * cells_around)
    expected = np.cos(turn_rad) * diameter_mm[0] / diameter_mm[1]
    assert np.abs(width[of_row] - expected).min() < 0.005
    if turn_rad > 1.0:
        assert width[found.narrowest] == pytest.approx(expected, abs=0.005)
        assert found.n_crumpled >= 1
        assert found.abscissa_mm[found.narrowest] == pytest.approx(
            stent.row_abscissa_mm[row * shape.row_split], abs=0.3
        )


@pytest.mark.parametrize("design", [ENTERPRISE, PIPELINE])
def test_in_a_bend_widths_are_those_of_the_corners_seen_from_the_middle_of_the_tube(design):
    """The area of four corners by the shoelace formula, in coordinates of the circle that the axis is."""
    bend_mm, anatomy = 7.0, artery(7.0)
    stent = deployed(design, anatomy).stent
    shape = grid(design, stent.size)
    joints_mm = stent.nodes_mm[:: shape.row_split, :: shape.column_split]
    found, expected, inward = cells(stent, anatomy.parent.axis), [], []
    for row in range(1, shape.lattice_rows - 1):
        for column in range(1 - row % 2, shape.lattice_columns, 2):
            sides = [(row, (column - 1) % shape.lattice_columns), (row, (column + 1) % shape.lattice_columns)]
            corners_mm = np.array([joints_mm[k] for k in (sides[0], (row - 1, column), sides[1], (row + 1, column))])
            middle_mm = corners_mm.mean(axis=0)
            around_rad = np.arctan2(middle_mm[2], bend_mm - middle_mm[0])  # along the bend, which begins at z = 0
            center_mm = [bend_mm * (1 - np.cos(around_rad)), 0.0, bend_mm * np.sin(around_rad)]
            out = (middle_mm - center_mm) / np.linalg.norm(middle_mm - center_mm)
            first = np.cross(out, [0.3, 0.5, 0.8])
            first /= np.linalg.norm(first)
            x, y = corners_mm @ first, corners_mm @ np.cross(out, first)
            area_mm2 = 0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
            height_mm = np.linalg.norm(corners_mm[3] - corners_mm[1])
            full_mm = stent.row_diameter_mm[row * shape.row_split] * np.sin(2 * np.pi / design.n_columns)
            expected.append(2 * area_mm2 / height_mm / full_mm)
            inward.append(out @ [np.cos(around_rad), 0.0, -np.sin(around_rad)])
    inside = np.abs(found.abscissa_mm - 14.0 - 0.25 * np.pi * bend_mm) < 0.25 * np.pi * bend_mm - 1.5
    assert inside.sum() > 10
    assert found.width_fraction[inside] == pytest.approx(np.array(expected)[inside], abs=0.01)
    assert found.inward[inside] == pytest.approx(np.array(inward)[inside], abs=0.02)


def test_outside_a_bend_cells_are_as_narrow_as_the_net_of_chebyshev_and_inside_none_is_crumpled():
    anatomy, size = artery(7.0), SIZES["pipeline"]
    stent = deployed(PIPELINE, anatomy).stent
    found, diameter_mm = cells(stent, anatomy.parent.axis), float(np.median(stent.row_diameter_mm))
    spacing_mm = row_spacing_mm(PIPELINE, size, diameter_mm, 1 / 7.0)
    straight_mm = row_spacing_mm(PIPELINE, size, diameter_mm)
    sine = np.sin(angle_rad(PIPELINE, size, diameter_mm))
    piece_mm = straight_mm / np.sqrt(1 - sine**2)
    inside = np.abs(found.abscissa_mm - 14.0 - 3.5 * 0.5 * np.pi) < 2.5
    for side in (-1, 1):
        width_fraction = np.median(found.width_fraction[inside & (side * found.inward > 0.99)])
        cosine = spacing_mm * (1 - side * diameter_mm / 14.0) / piece_mm
        assert width_fraction == pytest.approx(np.sqrt(1 - cosine**2) / sine, rel=0.03)
    assert measure(anatomy, deployed(PIPELINE, anatomy))["crumpled_cells_count"] == 0


@pytest.mark.parametrize("bend_mm", [7.0, 3.0])
def test_a_bend_in_one_direction_crumples_no_cell(bend_mm):
    done = deployed(ENTERPRISE, artery(bend_mm))
    assert CRUMPLED_FRACTION < measure(artery(bend_mm), done)["min_cell_width_fraction"] < 0.5
    assert "crumpled" not in done.advice


def test_two_bends_in_opposite_directions_crumple_cells_and_the_advice_says_where():
    done = deployed(ENTERPRISE, siphon())
    count, measures = cells(done.stent, siphon().parent.axis).n_crumpled, measure(siphon(), done)
    assert measures["crumpled_cells_count"] == count > 2
    assert measures["crumpled_cells_fraction"] == count / 72
    assert measures["min_cell_width_fraction"] < 0.2
    said = f" {count} of its 72 cells are crumpled, the narrowest to {measures['min_cell_width_fraction']:.0%} of the"
    assert said in done.advice
    assert f"{measures['narrowest_cell_abscissa_mm']:.1f} mm from the inlet" in done.advice
    assert done.advice.count("Move it along the artery.") == 1
    braid = deployed(PIPELINE, siphon())
    assert measure(siphon(), braid)["min_cell_width_fraction"] > 0.6
    assert "crumpled" not in braid.advice


@pytest.mark.parametrize(
    ("at_mm", "inward", "said"),
    [
        (12.1, -1.0, "1.4 mm proximal to the neck, on the outer side of the bend"),
        (14.0, 0.9, "0.5 mm distal to the proximal end of the neck, on the inner side of the bend"),
        (17.0, 0.1, "1.5 mm proximal to the distal end of the neck, between the inner and the outer side of the bend"),
        (20.0, 0.0, "1.5 mm distal to the neck"),
    ],
)
def test_the_place_is_told_from_the_nearer_end_of_the_neck(at_mm, inward, said):
    anatomy = with_neck(artery(), 13.5, 18.5)
    assert place_of_narrowest(anatomy, Cells(*np.array([[0.1], [at_mm], [inward]]))) == said


def test_a_free_crown_that_moves_along_the_artery_leaves_the_width_of_its_cells():
    stent = deployed(ATLAS, artery()).stent
    apart_mm = np.zeros_like(stent.crown_shift_mm)
    apart_mm[0, 4, :, 2], apart_mm[1, 4, :, 2] = -0.2, 0.2
    moved = replace(stent, crown_shift_mm=apart_mm)
    still: Stent = replace(stent, crown_shift_mm=np.zeros_like(apart_mm))
    both = [cells(one, artery().parent.axis).width_fraction for one in (moved, still)]
    assert both[0] == pytest.approx(both[1], abs=0.02)
