import subprocess
import sys

import numpy as np
import pytest

from vstent.anatomy.repair import repair
from vstent.devices.stent import tube_faces
from vstent.errors import ReadError, UnitError
from vstent.geometry.surface import Surface
from vstent.io.surfaces import hydraulic_diameter, read_surface
from vstent.io.vtk_reader import read_mesh
from vstent.io.writers import polydata_of, write_stl, write_surface


def cylinder(radius=2.0, length=24.0, rows=13, columns=24):
    angle = 2 * np.pi * np.arange(columns) / columns
    ring = radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    z = np.linspace(0, length, rows)
    vertices = (ring[None] + z[:, None, None] * [0, 0, 1]).reshape(-1, 3)
    return Surface(vertices, tube_faces(rows, columns))


def vtk_write(path, surface, *, ascii_text):
    from vtkmodules.vtkIOGeometry import vtkOBJWriter, vtkSTLWriter
    from vtkmodules.vtkIOLegacy import vtkPolyDataWriter
    from vtkmodules.vtkIOPLY import vtkPLYWriter
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    writers = {
        ".stl": vtkSTLWriter,
        ".obj": vtkOBJWriter,
        ".ply": vtkPLYWriter,
        ".vtk": vtkPolyDataWriter,
        ".vtp": vtkXMLPolyDataWriter,
    }
    writer = writers[path.suffix]()
    writer.SetInputData(polydata_of(surface.vertices_mm, surface.faces))
    writer.SetFileName(str(path))
    if path.suffix == ".vtp":
        writer.SetDataModeToAscii() if ascii_text else writer.SetDataModeToBinary()
    elif path.suffix != ".obj":
        writer.SetFileTypeToASCII() if ascii_text else writer.SetFileTypeToBinary()
    writer.Write()
    return path


def triangles_of(surface):
    """Corner positions, each triangle rotated to its first corner, in a fixed order."""
    corners = np.round(surface.corners_mm, 4) + 0.0
    rotated = np.stack([np.roll(c, -np.lexsort(c.T)[0], axis=0) for c in corners]).reshape(-1, 9)
    return rotated[np.lexsort(rotated.T)]


@pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply", ".vtk", ".vtp"])
@pytest.mark.parametrize("ascii_text", [True, False])
def test_every_format_gives_the_same_triangles(tmp_path, suffix, ascii_text):
    surface = cylinder()
    read, _ = read_surface(vtk_write(tmp_path / f"a{suffix}", surface, ascii_text=ascii_text))
    np.testing.assert_allclose(triangles_of(read), triangles_of(surface), atol=2e-3)  # OBJ and STL: single precision


@pytest.mark.parametrize("write", [write_stl, write_surface])
def test_what_we_write_we_read(tmp_path, write):
    path = tmp_path / ("a.stl" if write is write_stl else "a.vtp")
    write(path, cylinder())
    read, _ = read_surface(path)
    np.testing.assert_array_equal(triangles_of(read), triangles_of(cylinder()))


def test_quads_are_cut_along_the_shorter_diagonal_and_larger_polygons_into_fans(tmp_path):
    path = tmp_path / "a.obj"
    points = [
        (0, 0, 0),
        (40, 0, 0),
        (50, 10, 0),
        (10, 10, 0),
        (0, 0, 5),
        (10, 0, 5),
        (12, 6, 5),
        (5, 10, 5),
        (-2, 6, 5),
    ]
    path.write_text("".join("v {} {} {}\n".format(*p) for p in points) + "f 1 2 3 4\nf 2 3 4 1\nf 5 6 7 8 9\n")
    vertices, faces, _ = read_mesh(path)
    assert [{1, 3} <= set(f) for f in faces.tolist()] == [True, True, True, True, False, False, False]
    surface = Surface(vertices, faces)
    assert surface.areas_mm2.sum() == pytest.approx(400 + 400 + 100)
    np.testing.assert_allclose(surface.normals, np.broadcast_to([0, 0, 1], (7, 3)), atol=1e-12)


def test_an_stl_text_that_breaks_off_is_told_at_whatever_length(tmp_path):
    """Where 84 bytes and a whole number of fifties are left, VTK takes the letters for numbers."""
    facet = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 3 0 0\nvertex 0 3 {}\nendloop\nendfacet\n"
    whole = "solid a\n" + "".join(facet.format(k) for k in range(60)) + "endsolid a\n"
    path = tmp_path / "a.stl"
    path.write_text(whole)
    assert len(read_mesh(path).faces) == 60
    for lost in range(len("endsolid a\n"), len("endsolid a\n") + 50):
        path.write_text(whole[:-lost])
        with pytest.raises(ReadError, match="fewer triangles than it states"):
            read_surface(path, units="mm")


@pytest.mark.parametrize("unit", ["m", "cm", "mm"])
def test_unit_is_guessed_and_said(tmp_path, unit):
    scale = {"m": 1e-3, "cm": 0.1, "mm": 1.0}[unit]
    write_surface(tmp_path / "a.vtp", Surface(cylinder().vertices_mm * scale, cylinder().faces))
    read, notes = read_surface(tmp_path / "a.vtp")
    np.testing.assert_allclose(read.vertices_mm, cylinder().vertices_mm, atol=1e-12)
    assert notes[0].startswith(f"Length unit: {unit}, ")
    given_unit, no_notes = read_surface(tmp_path / "a.vtp", units=unit)
    np.testing.assert_array_equal(given_unit.vertices_mm, read.vertices_mm)
    assert no_notes == ()


@pytest.mark.parametrize("units", [None, "mm"])
def test_a_giant_aneurysm_is_read(tmp_path, units):
    scale = 20.0 / hydraulic_diameter(cylinder())
    write_surface(tmp_path / "a.vtp", Surface(cylinder().vertices_mm * scale, cylinder().faces))
    assert hydraulic_diameter(read_surface(tmp_path / "a.vtp", units=units)[0]) == pytest.approx(20.0)
    write_surface(tmp_path / "b.vtp", Surface(cylinder().vertices_mm * 1.5 * scale, cylinder().faces))
    with pytest.raises(UnitError, match=r"have 0\.8 to 25 mm|of 30 mm, which no brain vessel"):
        read_surface(tmp_path / "b.vtp", units=units)


@pytest.mark.parametrize("scale", [1e-6, 1e3, 1e6])
def test_what_fits_no_unit_is_refused(tmp_path, scale):
    write_surface(tmp_path / "a.vtp", Surface(cylinder().vertices_mm * scale, cylinder().faces))
    with pytest.raises(UnitError, match="has the size of a brain vessel in no unit"):
        read_surface(tmp_path / "a.vtp")


def test_a_unit_that_makes_it_a_thousand_times_too_large_is_refused(tmp_path):
    write_surface(tmp_path / "a.vtp", cylinder())
    with pytest.raises(UnitError, match=r"a\.vtp in m would be 2.*mm long"):
        read_surface(tmp_path / "a.vtp", units="m")
    with pytest.raises(UnitError, match="not known"):
        read_surface(tmp_path / "a.vtp", units="inch")


def test_hydraulic_diameter_of_a_tube_is_its_diameter_whichever_way_its_faces_look():
    tube = cylinder(radius=1.7, columns=400)
    assert hydraulic_diameter(tube) == pytest.approx(3.4, rel=1e-3)
    turned = np.array(tube.faces)
    turned[::3] = turned[::3, ::-1]
    assert hydraulic_diameter(Surface(tube.vertices_mm, turned)) == pytest.approx(3.4, rel=1e-3)


@pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply", ".vtk", ".vtp"])
def test_text_and_emptiness_are_refused_in_one_sentence_and_silence(tmp_path, capfd, suffix):
    for content in ("I am only a text.\nWith two lines.\n", ""):
        (tmp_path / f"a{suffix}").write_text(content)
        with pytest.raises(ReadError, match=f"a{suffix}") as caught:
            read_surface(tmp_path / f"a{suffix}")
        assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


def test_empty_mesh_nan_and_flat_are_refused(tmp_path):
    write_surface(tmp_path / "empty.vtp", Surface(np.zeros((0, 3)), np.zeros((0, 3))))
    with pytest.raises(ReadError, match="holds no surface"):
        read_surface(tmp_path / "empty.vtp")
    broken = np.array(cylinder().vertices_mm)
    broken[17, 1] = np.nan
    write_surface(tmp_path / "nan.vtp", Surface(broken, cylinder().faces))
    with pytest.raises(ReadError, match=r"1 vertices that are not numbers \(first: 17\)"):
        read_surface(tmp_path / "nan.vtp")
    write_surface(
        tmp_path / "line.vtp",
        Surface(np.outer(np.arange(6.0), [1, 1, 1]), [[0, 1, 2], [1, 2, 3], [2, 3, 4], [3, 4, 5]]),
    )
    with pytest.raises(ReadError, match="no area"):
        read_surface(tmp_path / "line.vtp")


def test_other_files_are_refused(tmp_path):
    (tmp_path / "a.docx").write_text("x")
    with pytest.raises(ReadError, match="not a surface file"):
        read_surface(tmp_path / "a.docx")
    with pytest.raises(ReadError, match="does not exist"):
        read_surface(tmp_path / "nowhere.stl")


@pytest.mark.parametrize(
    ("name", "unit", "faces"),
    [
        ("aneurisk_C0038.vtp", "mm", 77991),
        ("visc2011_metres.stl", "m", 17501),
        ("healthy_siphon.vtk", "mm", 61440),
        ("bifurcation_coarse.vtp", "mm", 3226),
    ],
)
def test_real_surfaces(shared_data, name, unit, faces):
    surface, notes = read_surface(shared_data / name)
    assert len(surface.faces) == faces
    assert notes[0].startswith(f"Length unit: {unit}, ")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows does not count a process's seconds")
@pytest.mark.parametrize(("busy", "lives"), [("while True: pass", False), ("time.sleep(1.6)", True)])
def test_a_reader_has_so_much_of_the_processor_and_may_wait_for_it(busy: str, lives: bool) -> None:
    begin = "import time\nfrom vstent.io.child import limit\nlimit(4e9, 1.0)\n"
    ended = subprocess.run([sys.executable, "-c", begin + busy], check=False, timeout=60)
    assert (ended.returncode == 0) == lives


# -- frames, grids and blocks, two walls -------------------------------------------------------------------------------


def ras(surface):
    return Surface(surface.vertices_mm * [-1, -1, 1], surface.faces)


def stated(tmp_path, kind, frame):
    """Write a cylinder in a frame with the words that 3D Slicer uses, and return the file."""
    words = f"3D Slicer output. SPACE={frame}"
    surface = ras(cylinder()) if frame == "RAS" else cylinder()
    path = tmp_path / f"a{kind}"
    if kind == ".stl":
        write_stl(path, surface)
        path.write_bytes(words.encode().ljust(80) + path.read_bytes()[80:])
    elif kind == ".obj":
        rows = [f"v {x} {y} {z}" for x, y, z in surface.vertices_mm.tolist()]
        path.write_text(
            "\n".join([f"# {words}", *rows, *(f"f {a} {b} {c}" for a, b, c in (surface.faces + 1).tolist())])
        )
    elif kind == ".ply":
        head = (
            f"ply\nformat ascii 1.0\ncomment {words}\nelement vertex {len(surface.vertices_mm)}\n"
            "property float x\nproperty float y\nproperty float z\n"
            f"element face {len(surface.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
        )
        rows = [f"{x} {y} {z}" for x, y, z in surface.vertices_mm.tolist()]
        path.write_text(head + "\n".join([*rows, *(f"3 {a} {b} {c}" for a, b, c in surface.faces.tolist())]) + "\n")
    else:
        from vtkmodules.vtkCommonCore import vtkStringArray
        from vtkmodules.vtkIOLegacy import vtkPolyDataWriter
        from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

        data = polydata_of(surface.vertices_mm, surface.faces)
        writer = vtkXMLPolyDataWriter() if kind == ".vtp" else vtkPolyDataWriter()
        if kind == ".vtp":
            array = vtkStringArray()
            array.SetName("SPACE")
            array.InsertNextValue(frame)
            data.GetFieldData().AddArray(array)
        else:
            writer.SetHeader(words)
        writer.SetFileName(str(path))
        writer.SetInputData(data)
        writer.Write()
    return path


@pytest.mark.parametrize("kind", [".stl", ".obj", ".ply", ".vtp", ".vtk"])
@pytest.mark.parametrize("frame", ["RAS", "LPS"])
def test_the_frame_that_a_file_states_is_obeyed(tmp_path, kind, frame):
    surface, notes = read_surface(stated(tmp_path, kind, frame))
    center_mm = surface.corners_mm.mean(axis=(0, 1))
    np.testing.assert_allclose(center_mm, cylinder().corners_mm.mean(axis=(0, 1)), atol=1e-4)
    assert ("The file states RAS" in notes[0]) == (frame == "RAS")
    turned, _ = read_surface(tmp_path / f"a{kind}", frame="lps" if frame == "RAS" else "ras")
    np.testing.assert_allclose(turned.corners_mm.mean(axis=(0, 1)), center_mm * [-1, -1, 1], atol=1e-4)


def test_our_own_files_state_lps(tmp_path):
    write_stl(tmp_path / "a.stl", cylinder())
    write_surface(tmp_path / "a.vtp", cylinder())
    assert b"SPACE=LPS" in (tmp_path / "a.stl").read_bytes()[:80]
    assert read_mesh(tmp_path / "a.vtp").space == "LPS"


@pytest.mark.parametrize("kind", [".vtu", ".vtm"])
def test_grids_and_blocks_of_surfaces_are_read(tmp_path, kind):
    from vtkmodules.vtkCommonDataModel import vtkMultiBlockDataSet
    from vtkmodules.vtkFiltersCore import vtkAppendFilter
    from vtkmodules.vtkIOXML import vtkXMLMultiBlockDataWriter, vtkXMLUnstructuredGridWriter

    surface = cylinder()
    half = len(surface.faces) // 2
    parts = [polydata_of(surface.vertices_mm, part) for part in (surface.faces[:half], surface.faces[half:])]
    if kind == ".vtu":
        grid = vtkAppendFilter()
        for part in parts:
            grid.AddInputData(part)
        grid.Update()
        writer, data = vtkXMLUnstructuredGridWriter(), grid.GetOutput()
    else:
        writer, data = vtkXMLMultiBlockDataWriter(), vtkMultiBlockDataSet()
        inner = vtkMultiBlockDataSet()
        inner.SetBlock(0, parts[1])
        data.SetBlock(0, parts[0])
        data.SetBlock(1, None)
        data.SetBlock(2, inner)
    writer.SetFileName(str(tmp_path / f"a{kind}"))
    writer.SetInputData(data)
    writer.Write()
    found, _ = read_surface(tmp_path / f"a{kind}")
    assert found.area_mm2 == pytest.approx(surface.area_mm2, rel=1e-6)
    assert len(found.faces) == len(surface.faces)


def tube_between(radius_mm, *, length_mm=30.0, around=40, along=60, is_inward=False):
    """Return an open tube along z, as vertices and faces."""
    angle, z = np.meshgrid(2 * np.pi * np.arange(around) / around, np.linspace(0, length_mm, along))
    points = np.stack([radius_mm * np.cos(angle), radius_mm * np.sin(angle), z], axis=-1).reshape(-1, 3)
    faces = tube_faces(along, around)
    return points, faces[:, ::-1] if is_inward else faces


@pytest.mark.parametrize("is_inward", [False, True])
@pytest.mark.parametrize("has_rims", [False, True])
@pytest.mark.parametrize("thickness_mm", [0.1, 0.3, 0.8])
def test_of_a_hollow_model_the_inner_wall_is_read(tmp_path, is_inward, has_rims, thickness_mm):
    inner, inner_faces = tube_between(2.0, is_inward=is_inward)
    outer, outer_faces = tube_between(2.0 + thickness_mm)
    faces = [inner_faces, outer_faces + len(inner)]
    if has_rims:
        for ring in (0, len(inner) - 40):
            a = ring + np.arange(40)
            b, c, d = ring + (np.arange(40) + 1) % 40, a + len(inner), ring + (np.arange(40) + 1) % 40 + len(inner)
            faces += [np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)]
    write_stl(tmp_path / "a.stl", Surface(np.concatenate([inner, outer]), np.concatenate(faces)))
    surface, notes = read_surface(tmp_path / "a.stl")
    assert np.linalg.norm(surface.corners_mm[..., :2], axis=2).max() == pytest.approx(2.0, abs=1e-4)
    assert len(surface.faces) == len(inner_faces)
    assert any("inner and an outer wall" in note for note in notes)


def test_two_arteries_side_by_side_or_one_with_caps_are_no_hollow_model(tmp_path):
    points, faces = tube_between(2.0)
    beside = Surface(
        np.concatenate([points, points + np.array([4.3, 0, 0])]), np.concatenate([faces, faces + len(points)])
    )
    for surface in (beside, cylinder()):
        write_stl(tmp_path / "a.stl", surface)
        found, notes = read_surface(tmp_path / "a.stl")
        assert len(found.faces) == len(surface.faces)
        assert not any("wall" in note for note in notes)


# -- dialects ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "spoil",
    [
        str.upper,
        str.title,
        lambda text: "\ufeff" + text.replace("\n", "\r\n"),
        lambda text: text.replace(".", ","),
        lambda text: text.replace("\n ", "\n\t\t").upper(),
    ],
    ids=["capitals", "title", "windows", "commas", "tabs"],
)
def test_dialects_of_stl_text_give_the_same_triangles(tmp_path, spoil):
    path = vtk_write(tmp_path / "a.stl", cylinder(), ascii_text=True)
    path.write_text(spoil(path.read_text()), newline="")
    read, _ = read_surface(path, units="mm")
    np.testing.assert_allclose(triangles_of(read), triangles_of(cylinder()), atol=2e-3)


def strips_of(rows, columns):
    """Return one strip (vertex numbers) for every ring of a cylinder."""
    around = np.arange(columns + 1) % columns
    return [np.stack([k * columns + around, (k + 1) * columns + around], axis=1).ravel() for k in range(rows - 1)]


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("is_one_list", [True, False])
def test_strips_of_a_ply_file_are_triangles(tmp_path, kind, is_one_list):
    surface, strips = cylinder(), strips_of(13, 24)
    if is_one_list:  # strips end with -1
        strips = [np.concatenate([np.append(strip, -1) for strip in strips])[:-1]]
    head = (
        f"ply\nformat {kind} 1.0\nelement vertex {len(surface.vertices_mm)}\nproperty float x\nproperty float y\n"
        f"property float z\nproperty uchar red\nelement tristrips {len(strips)}\n"
        "property list int int vertex_indices\nend_header\n"
    )
    if kind == "ascii":
        rows = [f"{x} {y} {z} 7" for x, y, z in surface.vertices_mm.tolist()]
        rows += [" ".join(map(str, [len(strip), *strip])) for strip in strips]
        body = "\n".join([*rows, ""]).encode()
    else:
        order = "<" if "little" in kind else ">"
        vertices = np.zeros(len(surface.vertices_mm), [("p", f"{order}f4", 3), ("red", "u1")])
        vertices["p"] = surface.vertices_mm
        words = np.concatenate([[len(strip), *strip] for strip in strips])
        body = vertices.tobytes() + words.astype(f"{order}i4").tobytes()
    (tmp_path / "a.ply").write_bytes(head.encode() + body)
    read, _ = read_surface(tmp_path / "a.ply", units="mm")
    assert len(read.faces) == len(surface.faces)
    assert read.area_mm2 == pytest.approx(surface.area_mm2, rel=1e-6)
    outward = np.einsum("ij,ij->i", read.normals[:, :2], read.corners_mm.mean(axis=1)[:, :2])
    assert (outward > 0).all() or (outward < 0).all()  # every second triangle of a strip is turned


def apart(surface, width_mm, *, scale=1.0):
    """Return a surface whose triangles share no vertices and miss each other by up to a width."""
    offset = np.random.default_rng(1).uniform(-0.5, 0.5, (len(surface.faces), 3, 3)) * width_mm / np.sqrt(3)
    corners = (surface.corners_mm + offset).reshape(-1, 3) * scale
    return Surface(corners, np.arange(len(corners)).reshape(-1, 3))


@pytest.mark.parametrize(("width_mm", "scale"), [(4e-4, 1.0), (4e-4, 1e-3), (3e-5, 1.0), (0.01, 1.0)])
def test_triangles_that_miss_each_other_by_little_are_one_wall(tmp_path, width_mm, scale):
    write_surface(tmp_path / "a.vtp", apart(cylinder(), width_mm, scale=scale))
    read, notes = read_surface(tmp_path / "a.vtp")
    assert ("mm" if scale == 1.0 else "unit: m,") in notes[0]
    assert hydraulic_diameter(read) == pytest.approx(hydraulic_diameter(cylinder()), rel=0.01)
    whole, repairs = repair(read)
    assert len(whole.boundary_loops) == 2
    assert len(whole.vertices_mm) == len(cylinder().vertices_mm)
    assert any("do not meet" in note for note in repairs) or width_mm < 1e-4


def test_solids_that_miss_each_other_along_a_seam_are_joined(tmp_path):
    surface = cylinder()
    half = len(surface.faces) // 2
    parts = [surface.faces[:half], surface.faces[half:] + len(surface.vertices_mm)]
    vertices = np.concatenate([surface.vertices_mm, surface.vertices_mm + 2e-4])
    write_surface(tmp_path / "a.vtp", Surface(vertices, np.concatenate(parts)))
    whole, repairs = repair(read_surface(tmp_path / "a.vtp", units="mm")[0])
    assert len(whole.boundary_loops) == 2
    assert whole.area_mm2 == pytest.approx(surface.area_mm2, rel=1e-3)
    assert any("do not meet" in note for note in repairs)


def test_the_openings_of_a_sound_surface_are_no_cracks():
    for surface in (cylinder(columns=400), cylinder(radius=2.0, columns=8)):
        assert not any("do not meet" in note for note in repair(surface)[1])


@pytest.mark.parametrize("name", ["/etc/passwd.vtp", "../a.vtp", r"C:\a.vtp"])
def test_only_blocks_beside_a_multi_block_file_are_read(tmp_path, name):
    write_surface(tmp_path / "a.vtp", cylinder())
    (tmp_path / "here").mkdir()
    file = tmp_path / "here" / "a.vtm"
    head = '<VTKFile type="vtkMultiBlockDataSet" version="1.0"><vtkMultiBlockDataSet>'
    file.write_text(f'{head}<DataSet index="0" file="{name}"/></vtkMultiBlockDataSet></VTKFile>')
    with pytest.raises(ReadError, match="Only files beside it or below are read"):
        read_surface(file)
