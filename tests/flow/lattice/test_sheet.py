"""The distribution of a screen over grid cells, against the same sums over all pairs of samples and cells."""

from dataclasses import replace

import numpy as np
import pytest

from vstent.flow.case import Sheet
from vstent.flow.drag import concentration
from vstent.flow.lattice.screen import on_grid
from vstent.units import M_PER_MM

CELL_MM = 0.2
ORIGIN_MM = np.array([1.0, -2.0, 0.5])


def sheet(rng: np.random.Generator) -> Sheet:
    """Samples on wires of nine samples each, partly outside the blood, with any normal."""
    wires = 60
    normals = rng.normal(size=(wires, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    columns = [rng.uniform(0.1, 1.0, wires) for _ in range(6)]
    points_mm = ORIGIN_MM + CELL_MM * rng.uniform(-1, 7, (9 * wires, 3))
    return Sheet(points_mm, *(np.repeat(column, 9, axis=0) for column in (normals, *columns)))


def blood(rng: np.random.Generator) -> np.ndarray:
    """Numbers of the cells of a grid with holes."""
    index = np.full((6, 7, 5), -1, np.int32)
    holds = rng.uniform(size=index.shape) < 0.7
    index[holds] = np.arange(holds.sum())
    return index


def test_every_cell_gets_what_all_samples_give_it():
    rng = np.random.default_rng(7)
    screen, index = sheet(rng), blood(rng)
    found = on_grid((screen,), index, ORIGIN_MM, CELL_MM)
    cells = np.argwhere(index >= 0)
    at = (screen.points_mm - ORIGIN_MM) / CELL_MM
    weight = np.clip(1 - np.abs(cells[:, None] - at), 0, None).prod(axis=2)
    per_volume = weight * screen.area_mm2 / (CELL_MM**3 * M_PER_MM)
    factor = concentration(screen.wire_diameter_mm, screen.spacing_mm, CELL_MM)
    along, across = factor * screen.normal_resistance_Pa_s_m, factor * screen.tangential_resistance_Pa_s_m
    corner = np.indices((2, 2, 2)).reshape(3, -1).T
    part = np.abs(1 - corner - (at - np.floor(at))[:, None]).prod(axis=2)
    height = np.einsum("pd,cd->pc", screen.normals, corner)
    apart = np.abs(height[:, :, None] - height[:, None])
    twice = 0.5 * np.einsum("pa,pb,pab->p", part, part, apart)
    got = np.flatnonzero(per_volume.sum(axis=1) > 0)
    assert 20 < len(got) <= len(cells)
    np.testing.assert_array_equal(found.cell, got)
    normal = (per_volume @ screen.normals)[got]
    np.testing.assert_allclose(found.normal, normal / np.linalg.norm(normal, axis=1)[:, None], rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(found.along_Pa_s_m2, (per_volume @ along)[got], rtol=1e-12)
    np.testing.assert_allclose(found.across_Pa_s_m2, (per_volume @ across)[got], rtol=1e-12)
    squared = (per_volume @ (twice * across**2))[got]
    np.testing.assert_allclose(found.spread_Pa_s_m, squared / found.across_Pa_s_m2, rtol=1e-12)
    np.testing.assert_allclose(found.inertial_per_m, 0.5 * (per_volume @ screen.inertial_loss)[got], rtol=1e-12)


def test_an_empty_sheet_gives_nothing():
    empty = Sheet(np.zeros((0, 3)), np.zeros((0, 3)), *(np.zeros(0) for _ in range(6)))
    assert len(on_grid((empty,), blood(np.random.default_rng(1)), ORIGIN_MM, CELL_MM).cell) == 0


def tensors(found, cells):
    """Return the linear resistance (cells, 3, 3) that entries give to every cell of the grid."""
    result = np.zeros((cells, 3, 3))
    square = found.normal[:, :, None] * found.normal[:, None, :]
    result[found.cell] = found.across_Pa_s_m2[:, None, None] * (np.eye(3) - square)
    result[found.cell] += found.along_Pa_s_m2[:, None, None] * square
    return result


def plane(normal, along, across):
    """A sheet through the middle of the grid, with its resistances."""
    normal = np.array(normal) / np.linalg.norm(normal)
    first = np.cross(normal, [0.36, 0.48, 0.8])
    first /= np.linalg.norm(first)
    ticks = np.arange(-4.0, 4.0, 0.25)
    a, b = (x.ravel()[:, None] for x in np.meshgrid(ticks, ticks))
    points_mm = ORIGIN_MM + CELL_MM * (np.array([2.5, 3.1, 2.2]) + a * first + b * np.cross(normal, first))
    one = np.ones(len(a))
    made = 0.01 * one, along * one, across * one, 0.3 * one, one, one
    return Sheet(points_mm, np.tile(normal, (len(a), 1)), *made)


def turned_by(degrees):
    return np.sin(np.radians(degrees)), 0.0, np.cos(np.radians(degrees))


@pytest.mark.parametrize("across", [50.0, 200.0])
@pytest.mark.parametrize("degrees", [0.0, 30.0, 70.5, 90.0])
def test_the_tensors_of_two_sheets_in_a_cell_add(degrees, across):
    """Exactly in parallel and at a right angle; in between the entry holds the nearest tensor with one axis."""
    sheets = plane((0, 0, 1), 100.0, across), plane(turned_by(degrees), 100.0, across)
    index = np.arange(6 * 7 * 5, dtype=np.int32).reshape(6, 7, 5)
    wanted = sum(tensors(on_grid((one,), index, ORIGIN_MM, CELL_MM), index.size) for one in sheets)
    both = on_grid(sheets, index, ORIGIN_MM, CELL_MM)
    found = tensors(both, index.size)
    np.testing.assert_allclose(np.trace(found, axis1=1, axis2=2), np.trace(wanted, axis1=1, axis2=2), rtol=1e-12)
    meets = np.isin(both.cell, np.intersect1d(*(on_grid((one,), index, ORIGIN_MM, CELL_MM).cell for one in sheets)))
    alone = np.setdiff1d(both.cell, both.cell[meets])
    np.testing.assert_allclose(found[alone], wanted[alone], atol=1e-9 * wanted.max())
    off = np.linalg.norm(found - wanted, ord=2, axis=(1, 2)) / np.maximum(np.linalg.norm(wanted, ord=2, axis=(1, 2)), 1)
    assert off.max() < {0.0: 1e-9, 30.0: 0.04, 70.5: 0.11, 90.0: 0.11}[degrees]


def test_equal_sheets_at_a_right_angle_resist_alike_in_every_direction_across_the_line_where_they_meet():
    one, other = plane((0, 0, 1), 100.0, 50.0), plane((1, 0, 0), 100.0, 50.0)
    other = replace(other, points_mm=one.points_mm)  # in the same cells, by the same shares
    index = np.arange(6 * 7 * 5, dtype=np.int32).reshape(6, 7, 5)
    apart, both = on_grid((one,), index, ORIGIN_MM, CELL_MM), on_grid((one, other), index, ORIGIN_MM, CELL_MM)
    np.testing.assert_allclose(np.abs(both.normal), np.tile([0.0, 1.0, 0.0], (len(both.cell), 1)), atol=1e-9)
    np.testing.assert_allclose(both.across_Pa_s_m2, 1.5 * apart.along_Pa_s_m2)
    np.testing.assert_allclose(both.along_Pa_s_m2, apart.along_Pa_s_m2)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_two_sheets_in_the_same_cells_are_one_of_twice_the_resistance_whichever_way_their_normals_point(sign):
    rng = np.random.default_rng(7)
    one, index = sheet(rng), blood(rng)
    denser = replace(
        one,
        normal_resistance_Pa_s_m=2 * one.normal_resistance_Pa_s_m,
        tangential_resistance_Pa_s_m=2 * one.tangential_resistance_Pa_s_m,
        inertial_loss=2 * one.inertial_loss,
    )
    other = replace(one, normals=sign * one.normals)
    both, dense = (on_grid(media, index, ORIGIN_MM, CELL_MM) for media in ((one, other), (denser,)))
    np.testing.assert_allclose(tensors(both, index.size), tensors(dense, index.size), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(both.spread_Pa_s_m, on_grid((one,), index, ORIGIN_MM, CELL_MM).spread_Pa_s_m)
    np.testing.assert_allclose(both.inertial_per_m, dense.inertial_per_m)
