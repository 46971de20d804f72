"""Where wires are at home on a contour, and metal coverage in bends, beside plain searches and closed formulas."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial import cKDTree
from tubes import arc, tube

from vstent.deployment.coverage import coverage_fractions, quad_areas_mm2
from vstent.deployment.deploy import deploy
from vstent.devices import formulas
from vstent.devices.catalogue import find_design, find_size
from vstent.devices.design import angle_rad, piece_length_mm
from vstent.devices.stent import Landing
from vstent.kernels.coverage import homes
from vstent.units import MM_PER_UM

ENTERPRISE = find_design("enterprise")
SIZE = find_size(ENTERPRISE, length_mm=22)
SIDES = [(0, np.pi / 3), (np.pi / 3, 2 * np.pi / 3), (2 * np.pi / 3, np.pi)]
"""Angles from the outer side of a bend: outer side, beside the bend, inner side."""


def test_points_are_at_home_at_their_nearest_nodes_wherever_the_point_before_was():
    """On a tube bent to a hairpin the way downhill from one leg ends on its inner side, not on the other leg."""
    turn, around = np.meshgrid(np.linspace(0, 1.2 * np.pi, 120), 2 * np.pi * np.arange(48) / 48, indexing="ij")
    out_mm = 4.0 + 1.9 * np.cos(around)
    nodes_mm = np.stack([out_mm * np.cos(turn), out_mm * np.sin(turn), 1.9 * np.sin(around)], axis=-1)
    rng = np.random.default_rng(3)
    walk_mm = nodes_mm[np.arange(119), rng.integers(0, 48)] + rng.normal(scale=0.05, size=(119, 3))
    points_mm = np.concatenate([walk_mm, nodes_mm.reshape(-1, 3)[rng.permutation(5760)[:2000]]])
    found_mm = nodes_mm.reshape(-1, 3)[homes(nodes_mm, points_mm)]
    nearest_mm = cKDTree(nodes_mm.reshape(-1, 3)).query(points_mm)[0]
    assert np.linalg.norm(found_mm - points_mm, axis=1) == pytest.approx(nearest_mm, abs=1e-12)


@cache
def in_bend(design, size, diameter_mm, bend_mm):
    """A device in a bend of 90 degrees, and which of its quads lie on each side of the bend."""
    artery = tube(arc(bend_mm, np.pi / 2, 20.0), 0.5 * diameter_mm)
    middle = Landing(0.5 * float(artery.parent.axis.length_mm))
    stent = deploy(design, artery, size=size, landing=middle).stent
    quads_mm = 0.25 * (stent.nodes_mm[1:] + stent.nodes_mm[:-1])
    quads_mm = quads_mm + np.roll(quads_mm, -1, axis=1)
    outward_mm = np.hypot(quads_mm[..., 0] - bend_mm, quads_mm[..., 2]) - bend_mm
    angle = np.arctan2(np.abs(quads_mm[..., 1]), outward_mm)
    is_bent = (quads_mm[..., 2] > 1) & (quads_mm[..., 0] < bend_mm - 1)
    return stent, [is_bent & (angle >= first) & (angle < last) for first, last in SIDES]


def coverage(stent, chosen):
    """Coverage of the chosen quads."""
    return float(np.average(coverage_fractions(stent)[chosen], weights=quad_areas_mm2(stent)[chosen]))


def test_coverage_in_a_bend_is_that_of_single_samples():
    """Each sample is tested against all struts near it, projected along the normal of its triangle."""
    stent, sides = in_bend(ENTERPRISE, SIZE, 3.8, 7.0)
    contour, draw = stent.contour, np.random.default_rng(0)
    start_mm, end_mm = stent.wire_points_mm[stent.piece_starts], stent.wire_points_mm[stent.piece_starts + 1]
    tree = cKDTree(0.5 * (start_mm + end_mm))
    for chosen in sides:
        faces = np.flatnonzero(np.tile(chosen.ravel(), 2))
        face = draw.choice(faces, 20000, p=contour.areas_mm2[faces] / contour.areas_mm2[faces].sum())
        points_mm = np.einsum("nc,nck->nk", draw.dirichlet(np.ones(3), len(face)), contour.corners_mm[face])
        near, normal = tree.query(points_mm, 40)[1], contour.normals[face][:, None]
        from_mm, along_mm = start_mm[near] - points_mm[:, None], (end_mm - start_mm)[near]
        from_mm = from_mm - (from_mm * normal).sum(2, keepdims=True) * normal
        along_mm = along_mm - (along_mm * normal).sum(2, keepdims=True) * normal
        part = np.clip(-(from_mm * along_mm).sum(2) / (along_mm**2).sum(2), 0, 1)
        away_mm = np.linalg.norm(from_mm + part[..., None] * along_mm, axis=2).min(axis=1)
        is_covered = away_mm < 0.5 * ENTERPRISE.strut_width_um * MM_PER_UM
        assert coverage(stent, chosen) == pytest.approx(is_covered.mean(), rel=0.05)


@pytest.mark.parametrize("bend_mm", [12.0, 9.0, 7.0])
def test_closed_cells_cover_as_much_as_the_net_of_chebyshev(bend_mm):
    """Four struts of length l and width w at the angle a to the axis bound a cell: its coverage is 2 w / (l sin 2a).

    That is least at 45 degrees. On the outer side of a bend a is smaller than in a straight artery.
    """
    stent, sides = in_bend(ENTERPRISE, SIZE, 3.8, bend_mm)
    diameter_mm = 3.8 - 2 * ENTERPRISE.wall_offset_um * MM_PER_UM
    spacing_mm = formulas.row_spacing_mm(ENTERPRISE, SIZE, diameter_mm, 1 / bend_mm)
    length_mm, width_mm = piece_length_mm(ENTERPRISE, SIZE), ENTERPRISE.strut_width_um * MM_PER_UM
    expected = []
    for first, last in SIDES:
        apart = 1 + 0.5 * diameter_mm / bend_mm * np.cos(np.linspace(first, last, 101))
        cells = 2 * width_mm / (length_mm * np.sin(2 * np.arccos(apart * spacing_mm / length_mm)))
        expected.append(np.average(cells, weights=apart))
    assert [coverage(stent, chosen) for chosen in sides] == pytest.approx(expected, rel=0.05)
    assert expected[0] > 1.5 * expected[2]


@pytest.mark.parametrize(
    ("key", "label_mm", "length_mm"),
    [("silk", 4, 20), ("accero", 3.5, 20), ("leo_baby", 3, 18), ("enterprise", 4.5, 22), ("enterprise_2", 4, 23)],
)
def test_coverage_is_higher_inside_a_bend_where_wires_are_above_45_degrees_and_outside_below(key, label_mm, length_mm):
    design = find_design(key)
    size = find_size(design, diameter_mm=label_mm, length_mm=length_mm)
    stent, (outer, _, inner) = in_bend(design, size, label_mm - 0.3, 9.0)
    is_steep = angle_rad(design, size, stent.row_diameter_mm.mean()) > np.pi / 4
    assert is_steep == (key in {"silk", "accero"})
    denser, sparser = (inner, outer) if is_steep else (outer, inner)
    assert coverage(stent, denser) > 1.08 * coverage(stent, sparser)
