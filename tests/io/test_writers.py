import json
import os
import stat

import numpy as np
import pytest
from hypothesis import given, strategies as st
from hypothesis.extra import numpy as hnp

from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Centerline
from vstent.io.files import atomic, is_surface_file, suffix
from vstent.io.writers import (
    grid_corners,
    write_cells,
    write_centerlines,
    write_json,
    write_lines,
    write_stl,
    write_surface,
    write_text,
)

TETRAHEDRON = Surface([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def vtk_read(path):
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader, vtkXMLUnstructuredGridReader

    reader = vtkXMLPolyDataReader() if path.suffix == ".vtp" else vtkXMLUnstructuredGridReader()
    reader.SetFileName(str(path))
    reader.Update()
    data = reader.GetOutput()
    arrays = [
        {a.GetArrayName(i): vtk_to_numpy(a.GetArray(i)) for i in range(a.GetNumberOfArrays())}
        for a in (data.GetPointData(), data.GetCellData())
    ]
    return data, vtk_to_numpy(data.GetPoints().GetData()), arrays


def test_surface_with_arrays_comes_back_exactly(tmp_path):
    vector, flag = np.arange(12.0).reshape(4, 3), np.array([True, False, True, True])
    write_surface(
        tmp_path / "a.vtp",
        TETRAHEDRON,
        {"velocity_m_s": vector, "is_restored": flag},
        {"area_mm2": TETRAHEDRON.areas_mm2},
    )
    data, points, (on_points, on_cells) = vtk_read(tmp_path / "a.vtp")
    np.testing.assert_array_equal(points, TETRAHEDRON.vertices_mm)
    np.testing.assert_array_equal(on_points["velocity_m_s"], vector)
    np.testing.assert_array_equal(on_points["is_restored"], [1, 0, 1, 1])
    np.testing.assert_array_equal(on_cells["area_mm2"], TETRAHEDRON.areas_mm2)
    assert data.GetNumberOfPolys() == 4


def test_array_of_the_wrong_length_is_refused_and_leaves_no_file(tmp_path):
    with pytest.raises(ValueError, match="a has 3 rows where 4"):
        write_surface(tmp_path / "a.vtp", TETRAHEDRON, {"a": np.zeros(3)})
    assert list(tmp_path.iterdir()) == []


def test_lines_of_different_lengths(tmp_path):
    points = np.random.default_rng(0).normal(size=(9, 3))
    write_lines(
        tmp_path / "a.vtp", points, np.array([0, 2, 6, 9]), {"x": np.arange(9)}, {"wire_id": np.array([5, 6, 7])}
    )
    data, read, (on_points, on_cells) = vtk_read(tmp_path / "a.vtp")
    np.testing.assert_array_equal(read, points)
    np.testing.assert_array_equal(on_cells["wire_id"], [5, 6, 7])
    np.testing.assert_array_equal(on_points["x"], np.arange(9))
    assert [[data.GetCell(c).GetPointId(i) for i in range(data.GetCell(c).GetNumberOfPoints())] for c in range(3)] == [
        [0, 1],
        [2, 3, 4, 5],
        [6, 7, 8],
    ]


def test_centerlines_bear_the_names_of_vmtk(tmp_path):
    t = np.linspace(0, 1, 30)[:, None]
    lines = [Centerline(t * [10, 0, 0], np.full(30, 2.0)), Centerline(t[:20] * [0, 7, 0], np.linspace(2, 1, 20))]
    write_centerlines(tmp_path / "c.vtp", lines)
    _, points, (on_points, on_cells) = vtk_read(tmp_path / "c.vtp")
    np.testing.assert_allclose(on_points["Abscissas"], np.linalg.norm(points, axis=1), atol=1e-12)
    np.testing.assert_array_equal(
        on_points["MaximumInscribedSphereRadius"], np.concatenate([line.inscribed_radius_mm for line in lines])
    )
    np.testing.assert_allclose(
        np.einsum("ij,ij->i", on_points["FrenetTangent"], on_points["ParallelTransportNormals"]), 0, atol=1e-12
    )
    np.testing.assert_array_equal(on_cells["CenterlineIds"], [0, 1])


def test_cells_share_their_corners_and_fill_their_volume(tmp_path):
    grid = np.stack(np.meshgrid(*[np.arange(n) for n in (5, 4, 3)], indexing="ij"), axis=-1).reshape(-1, 3)
    kept = grid[np.random.default_rng(1).random(len(grid)) < 0.6]
    centers = kept * 0.25 + [10.0, -3.0, 7.125]
    corners, cells = grid_corners(centers, np.full(len(centers), 0.25))
    assert len(np.unique(np.round(corners, 9), axis=0)) == len(corners) == len(np.unique(cells))
    np.testing.assert_allclose(corners[cells].mean(axis=1), centers, atol=1e-12)
    edges = corners[cells[:, [1, 3, 4]]] - corners[cells[:, [0]]]
    np.testing.assert_allclose(np.linalg.det(edges), 0.25**3, rtol=1e-9)  # right-handed: no cell inside out
    speed = np.random.default_rng(2).random((len(kept), 3))
    write_cells(tmp_path / "f.vtu", centers, np.full(len(kept), 0.25), {"velocity_m_s": speed})
    data, points, (_, on_cells) = vtk_read(tmp_path / "f.vtu")
    np.testing.assert_array_equal(on_cells["velocity_m_s"], speed)
    np.testing.assert_array_equal(points, corners)
    np.testing.assert_allclose(data.GetBounds(), np.stack([corners.min(axis=0), corners.max(axis=0)], axis=1).ravel())


def test_300_000_cells_are_written_in_seconds(tmp_path):
    import time

    grid = np.stack(np.meshgrid(*[np.arange(67.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    began = time.perf_counter()
    write_cells(tmp_path / "f.vtu", grid, np.ones(len(grid)), {"velocity_m_s": grid.astype(np.float32)})
    assert time.perf_counter() - began < 10.0  # a loop over cells would take a minute


def test_stl_is_binary_with_outward_normals(tmp_path):
    write_stl(tmp_path / "a.stl", TETRAHEDRON)
    data = (tmp_path / "a.stl").read_bytes()
    assert len(data) == 84 + 4 * 50
    assert not data.startswith(b"solid")  # readers would take it for text
    numbers = np.frombuffer(data[84:134][:48], "<f4").reshape(4, 3)
    np.testing.assert_array_equal(numbers, [[0, 0, -1], [0, 0, 0], [0, 1, 0], [1, 0, 0]])


def test_json_is_sorted_rounded_and_plain(tmp_path):
    content = {"b": np.float32(0.1), "a": [np.int64(3), True, None, "Å"], "c": {"x": np.array([1 / 3, 2.0])}}
    write_json(tmp_path / "m.json", content)
    text = (tmp_path / "m.json").read_text(encoding="utf-8")
    assert json.loads(text) == {"a": [3, True, None, "Å"], "b": 0.1, "c": {"x": [0.3333333, 2.0]}}
    assert text.index('"a"') < text.index('"b"') < text.index('"c"')


@pytest.mark.parametrize("bad", [np.nan, np.inf, {"deep": [1.0, np.float64(np.nan)]}, object()])
def test_json_refuses_what_it_cannot_hold_and_keeps_the_old_file(tmp_path, bad):
    write_json(tmp_path / "m.json", {"old": 1})
    with pytest.raises(ValueError, match=r"bad.*which JSON cannot hold"):
        write_json(tmp_path / "m.json", {"bad": bad})
    assert json.loads((tmp_path / "m.json").read_text()) == {"old": 1}
    assert len(list(tmp_path.iterdir())) == 1


def test_a_file_that_fails_half_way_is_not_there(tmp_path):
    write_text(tmp_path / "a.txt", "old")

    def stopped():
        with atomic(tmp_path / "a.txt") as partial:
            partial.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stopped()
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("a.txt", "old")]


@pytest.mark.skipif(os.name != "posix", reason="file modes are POSIX's")
def test_files_have_the_usual_mode(tmp_path):
    (tmp_path / "usual").write_text("")
    write_text(tmp_path / "new" / "ours", "")
    assert stat.S_IMODE((tmp_path / "new" / "ours").stat().st_mode) == stat.S_IMODE((tmp_path / "usual").stat().st_mode)


@given(centers=hnp.arrays(np.int64, st.tuples(st.integers(1, 40), st.just(3)), elements=st.integers(-50, 50)))
def test_grid_corners_of_any_set_of_cubes(centers):
    unique = np.unique(centers, axis=0)
    corners, cells = grid_corners(unique * 0.3, np.full(len(unique), 0.3))
    np.testing.assert_allclose(corners[cells].mean(axis=1), unique * 0.3, atol=1e-9)
    every = (unique[:, None] + np.array(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5])).reshape(3, -1).T).reshape(
        -1, 3
    )
    assert len(corners) == len(np.unique(every, axis=0))


def test_suffixes():
    from pathlib import Path

    assert [suffix(Path(p)) for p in ("A.STL", "b.nii.gz", "c.d.vtp", "dir/none", "x.RAW.GZ")] == [
        ".stl",
        ".nii.gz",
        ".vtp",
        "",
        ".raw.gz",
    ]
    assert is_surface_file(Path("A.VTP"))
    assert not is_surface_file(Path("a.nii.gz"))
