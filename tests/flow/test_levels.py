"""A flow on two grids is read on the finer one where that has cells, written once, and kept as it is."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from shapes import sphere
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkFiltersVerdict import vtkCellSizeFilter
from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridReader

from vstent.flow.case import Blood, FlowField, Level, Phase
from vstent.flow.sampling import is_blood, uniform, values_at
from vstent.io.archive import load_data, save_data
from vstent.kernels.arrays import Floats, Ints
from vstent.study.outputs import write_field

ABOUT = 0.25 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
"""Centers of the fine cells in a coarse one of 1 mm, from its center."""


def coarse_m_s(points_mm: Floats) -> Floats:
    return np.array([0.3, 0.2, 0.1]) + points_mm * np.array([0.01, 0.02, 0.03])


def fine_m_s(points_mm: Floats) -> Floats:
    """Far from what the coarse grid has."""
    return -5.0 - points_mm * np.array([0.03, 0.01, 0.02])


def box(low: tuple[int, int, int], high: tuple[int, int, int]) -> Ints:
    return np.array(low) + np.indices(np.subtract(high, low)).reshape(3, -1).T


def level(cells: Ints, origin_mm: float, size_mm: float, velocity_m_s: Floats) -> Level:
    return Level(cells, np.full(3, origin_mm), size_mm, velocity_m_s, velocity_m_s @ [1.0, 2.0, 3.0])


def flow() -> FlowField:
    """A box of 8 x 8 x 8 mm, fine from x = 2.5 to 6.5 mm; there it ends half a cell lower in y."""
    coarse, fine = box((1, 1, 1), (9, 9, 9)), box((6, 2, 2), (14, 17, 18))
    levels = level(coarse, 0.0, 1.0, coarse_m_s(1.0 * coarse)), level(fine, -0.25, 0.5, fine_m_s(0.5 * fine - 0.25))
    wall = sphere(3.0)
    none, one = np.zeros(len(wall.vertices_mm)), np.ones(1)
    told = Blood(), True, 0.0, "", one, 1, 1.0, 1.0
    return FlowField(levels, wall, none[:, None] * np.ones(3), none, one, one, one, one, *told)


def test_a_place_is_read_on_the_finest_grid_with_cells_all_around_it_but_for_the_wall() -> None:
    field, rng = flow(), np.random.default_rng(1)
    at_mm = rng.uniform(1.0, 8.0, (4000, 3))
    is_fine = (at_mm[:, 0] > 2.75) & (at_mm[:, 0] < 6.25)
    inner = at_mm[:, 1] < 7.75
    velocity_m_s, pressure_Pa = values_at(field, at_mm)
    wanted_m_s = np.where(is_fine[:, None], fine_m_s(at_mm), coarse_m_s(at_mm))
    np.testing.assert_allclose(velocity_m_s[inner], wanted_m_s[inner], rtol=1e-9)
    np.testing.assert_allclose(pressure_Pa[inner], (wanted_m_s @ [1.0, 2.0, 3.0])[inner], rtol=1e-9)
    beside = is_fine & ~inner  # between the last fine cells and the wall the velocity falls to zero
    assert beside.sum() > 50
    share = (8.25 - at_mm[beside, 1]) / 0.5
    level_m_s = fine_m_s(np.where([False, True, False], 7.75, at_mm[beside]))
    np.testing.assert_allclose(velocity_m_s[beside], share[:, None] * level_m_s, rtol=1e-9)
    for grid, wanted in zip(field.levels, (coarse_m_s, fine_m_s), strict=True):  # on the faces between the grids, too
        own = grid.centers_mm if grid is field.finest else grid.centers_mm[field.is_finest[0]]
        np.testing.assert_allclose(values_at(field, own)[0], wanted(own), rtol=1e-9)


def test_cells_of_both_grids_fill_the_blood_once() -> None:
    field = flow()
    assert field.is_finest[0].sum() == 4 * 8 * 8
    assert (field.sizes_mm**3).sum() == pytest.approx(4 * 8 * 8 + 4 * 7.5 * 8)
    is_coarse = field.sizes_mm == 1.0
    np.testing.assert_array_equal(is_coarse, (field.centers_mm[:, 0] < 2.5) | (field.centers_mm[:, 0] > 6.5))
    wanted_m_s = np.where(is_coarse[:, None], coarse_m_s(field.centers_mm), fine_m_s(field.centers_mm))
    np.testing.assert_allclose(field.velocity_m_s, wanted_m_s)
    np.testing.assert_array_equal(field.speed_m_s, np.linalg.norm(field.velocity_m_s, axis=1))
    points_mm = np.random.default_rng(2).uniform(0.0, 9.0, (4000, 3))
    within = ((points_mm > 0.5) & (points_mm < 8.5)).all(axis=1)
    is_cut = (points_mm[:, 0] > 2.5) & (points_mm[:, 0] < 6.5) & (points_mm[:, 1] > 8.0)
    np.testing.assert_array_equal(is_blood(field, points_mm), within & ~is_cut)


def test_the_file_of_a_flow_covers_its_volume_once(tmp_path: Path) -> None:
    field = flow()
    write_field(tmp_path, field)
    reader, sizes = vtkXMLUnstructuredGridReader(), vtkCellSizeFilter()
    reader.SetFileName(str(tmp_path / "field.vtu"))
    sizes.SetInputConnection(reader.GetOutputPort())
    sizes.Update()
    data = sizes.GetOutput()
    volume_mm3 = vtk_to_numpy(data.GetCellData().GetArray("Volume"))
    np.testing.assert_allclose(volume_mm3, field.sizes_mm**3)
    assert volume_mm3.sum() == pytest.approx(4 * 8 * 8 + 4 * 7.5 * 8)
    np.testing.assert_array_equal(vtk_to_numpy(data.GetCellData().GetArray("velocity_m_s")), field.velocity_m_s)
    corners_mm = vtk_to_numpy(data.GetPoints().GetData())
    assert len(np.unique(corners_mm, axis=0)) == len(corners_mm)  # also where the grids meet
    low, high = data.GetBounds()[::2], data.GetBounds()[1::2]
    np.testing.assert_allclose([low, high], [[0.5] * 3, [8.5] * 3])


def test_a_uniform_flow_has_the_fine_cells_and_interpolates_the_coarse_ones() -> None:
    field = flow()
    grid = uniform(field).finest
    assert grid.cell_size_mm == 0.5
    assert (np.lexsort(grid.cells.T[::-1]) == np.arange(len(grid.cells))).all()
    is_fine = (grid.centers_mm[:, 0] > 2.5) & (grid.centers_mm[:, 0] < 6.5)
    np.testing.assert_array_equal(grid.centers_mm[is_fine], field.finest.centers_mm)
    np.testing.assert_array_equal(grid.velocity_m_s[is_fine], field.finest.velocity_m_s)
    np.testing.assert_array_equal(grid.pressure_Pa[is_fine], field.finest.pressure_Pa)
    children_mm = (field.levels[0].centers_mm[field.is_finest[0]][:, None] + ABOUT).reshape(-1, 3)
    order = np.lexsort(children_mm.T[::-1])
    np.testing.assert_allclose(grid.centers_mm[~is_fine], children_mm[order])
    inner = ~is_fine & ((grid.centers_mm > 1.0) & (grid.centers_mm < 8.0)).all(axis=1)
    np.testing.assert_allclose(grid.velocity_m_s[inner], coarse_m_s(grid.centers_mm[inner]))
    one = uniform(field)
    assert uniform(one) is one


def test_a_flow_on_two_grids_comes_back_from_its_archive(tmp_path: Path) -> None:

    field, one = flow(), np.ones(1)
    moving = [replace(level, mean_speed_m_s=2 * level.speed_m_s) for level in field.levels]
    moments = [
        tuple(k * getattr(level, name) for level in moving) for k in (1, 2) for name in ("velocity_m_s", "pressure_Pa")
    ]
    phases = tuple(Phase(k, one, one, *moments[2 * k : 2 * k + 2], field.wall_shear_stress_Pa) for k in range(2))
    field = replace(field, levels=tuple(moving), phases=phases, mean_shear_Pa=np.ones(len(field.wall.vertices_mm)))
    save_data(tmp_path / "flow.npz", field)
    found = load_data(tmp_path / "flow.npz", FlowField)
    for ours, theirs in zip(field.levels, found.levels, strict=True):
        for name in ("cells", "origin_mm", "cell_size_mm", "velocity_m_s", "pressure_Pa", "mean_speed_m_s"):
            np.testing.assert_array_equal(getattr(theirs, name), getattr(ours, name))
    for before, after in zip(field.moments(), found.moments(), strict=True):
        np.testing.assert_array_equal(after.velocity_m_s, before.velocity_m_s)
    assert found.phases[1].velocity_m_s[0].dtype == np.float32
    np.testing.assert_array_equal(found.mean_shear_Pa, field.mean_shear_Pa)
    save_data(tmp_path / "uniform.npz", uniform(field))
    assert (tmp_path / "flow.npz").stat().st_size < (tmp_path / "uniform.npz").stat().st_size
