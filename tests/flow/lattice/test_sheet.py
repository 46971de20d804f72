"""The distribution of a screen over grid cells, against the same sums over all pairs of samples and cells."""

import numpy as np

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
    assert len(on_grid(empty, blood(np.random.default_rng(1)), ORIGIN_MM, CELL_MM).cell) == 0
