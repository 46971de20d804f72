"""Read surfaces and images with VTK's readers, which a damaged file may crash: only `vstent.io.child` calls them."""

import codecs
import re
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, NamedTuple

import numpy as np

from vstent.errors import ReadError, UnitError
from vstent.geometry.image import Image
from vstent.io.files import beside, suffix
from vstent.io.limits import refuse_bomb
from vstent.io.polygons import ply_strips, triangles_of
from vstent.io.text_headers import are_lengths
from vstent.kernels.arrays import Floats, Ints

LEAST_USED: Final = 0.9
"""Smallest fraction of the points of a complete OBJ file that belong to triangles.

Points come before triangles, so a truncated file has a smaller fraction.
"""
UNEVEN: Final = 1e-3
"""Largest deviation of a step of a rectilinear grid, as a fraction of the mean step."""
HEAD_BYTES: Final = 1 << 16
"""Number of bytes that hold the header of a file."""
_SPACING: Final = re.compile(
    rb"<ImageData\b[^>]*\sSpacing\s*=\s*[\"']([^\"'>]*)|^\s*(?i:SPACING|ASPECT_RATIO)[ \t]+([^\r\n]*)", re.M
)
"""Spacing in the header of a VTK image, XML or legacy; VTK takes 1 where it cannot read one."""


class Mesh(NamedTuple):
    """Triangles of a file."""

    vertices: Floats
    """(n, 3) vertices."""
    faces: Ints
    """(m, 3) vertex numbers."""
    space: str
    """Frame that the field data state: ``RAS``, ``LPS`` or empty."""


def read_mesh(path: Path) -> Mesh:
    """Read the polygons of a surface file as triangles: those of all blocks, and the outer faces of grids."""
    from vtkmodules.vtkFiltersGeometry import vtkGeometryFilter

    kind = suffix(path)
    if kind == ".vtm":
        for name in re.findall(r"""\sfile\s*=\s*["']([^"']*)""", path.read_text(encoding="utf-8", errors="replace")):
            beside(path, name)
    with TemporaryDirectory() as folder:
        blocks = _blocks(_loaded(_plain_stl(path, Path(folder))))
    vertices, faces = np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    space = ""
    for block in blocks:
        stated = block.GetFieldData().GetAbstractArray("SPACE")
        if not space and stated is not None and stated.GetNumberOfValues():
            space = str(stated.GetVariantValue(0).ToString()).strip().upper()
        surface = block
        if block.IsA("vtkUnstructuredGrid"):
            outer = vtkGeometryFilter()
            outer.SetInputData(block)
            outer.Update()
            surface = outer.GetOutput()
        if surface.IsA("vtkPolyData"):
            own_vertices, own_faces = triangles_of(surface)
            faces = np.concatenate([faces, own_faces + len(vertices)])
            vertices = np.concatenate([vertices, own_vertices])
    is_torn = kind == ".obj" and len(np.unique(faces)) < LEAST_USED * len(vertices)
    if kind == ".ply":
        strips = ply_strips(path)
        faces = np.concatenate([faces, strips[((strips >= 0) & (strips < len(vertices))).all(axis=1)]])
        # VTK accepts files with fewer polygons than their header states.
        head = path.read_bytes()[:HEAD_BYTES].partition(b"end_header")[0]
        counts = [line.split()[2] for line in head.splitlines() if line.startswith(b"element face")]
        is_torn = len(faces) < int(counts[0]) if counts else False
    if is_torn or not len(faces):
        raise ReadError(
            f"{path.name} holds no surface, or fewer triangles than it states: it is empty, damaged or not a "
            f"{kind} file. Copy or export it again."
        )
    return Mesh(vertices, faces.astype(np.int32), space)


def read_vtk_image(path: Path, *, has_spacing: bool) -> Image:
    """Read an image or a rectilinear grid with even steps (``.vti``, ``.vtr``, ``.vtk``); its axes are taken as LPS."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    data = _loaded(path)
    scalars = None if data is None else data.GetPointData().GetScalars() or data.GetPointData().GetArray(0)
    if scalars is None or scalars.GetNumberOfComponents() != 1:
        raise ReadError(
            f"{path.name} is damaged, or has no point data with one value per voxel. Copy or export it again."
        )
    shape = data.GetDimensions()
    voxels = vtk_to_numpy(scalars).reshape(shape, order="F")
    refuse_bomb(f"{path.name} holds {' x '.join(map(str, shape))} voxels", voxels.nbytes, path.stat().st_size)
    affine = np.eye(4)
    if data.IsA("vtkRectilinearGrid"):
        for axis, array in enumerate((data.GetXCoordinates(), data.GetYCoordinates(), data.GetZCoordinates())):
            places = vtk_to_numpy(array).astype(np.float64)
            steps = np.diff(places)
            if not len(steps) or not np.abs(steps - steps.mean()).max() <= UNEVEN * abs(steps.mean()):
                raise ReadError(
                    f"{path.name} is a grid with uneven spacing. Resample it to one spacing along each axis."
                )
            affine[axis, axis], affine[axis, 3] = steps.mean(), places[0]
        return Image(voxels, affine)
    with path.open("rb") as file:
        stated = _SPACING.search(re.sub(rb"<!--.*?-->", b"", file.read(HEAD_BYTES), flags=re.DOTALL))
    if not has_spacing and not (stated and are_lengths((stated[1] or stated[2]).split())):
        raise UnitError(f"{path.name} does not state a voxel spacing above zero; give --spacing in mm.")
    matrix = data.GetDirectionMatrix()
    direction = np.array([[matrix.GetElement(row, column) for column in range(3)] for row in range(3)])
    affine[:3, :3] = direction * np.array(data.GetSpacing())
    affine[:3, 3] = np.array(data.GetOrigin()) + affine[:3, :3] @ np.array(data.GetExtent()[::2], dtype=np.float64)
    return Image(voxels, affine)


def _loaded(path: Path) -> Any:
    """Return the data set in a file; None where VTK reports an error, after which its data are incomplete."""
    from vtkmodules import vtkIOGeometry, vtkIOLegacy, vtkIOPLY, vtkIOXML
    from vtkmodules.util.misc import calldata_type
    from vtkmodules.vtkCommonCore import VTK_STRING, vtkOutputWindow

    readers = {
        ".vtp": vtkIOXML.vtkXMLPolyDataReader,
        ".vtu": vtkIOXML.vtkXMLUnstructuredGridReader,
        ".vtm": vtkIOXML.vtkXMLMultiBlockDataReader,
        ".vti": vtkIOXML.vtkXMLImageDataReader,
        ".vtr": vtkIOXML.vtkXMLRectilinearGridReader,
        ".vtk": vtkIOLegacy.vtkGenericDataObjectReader,
        ".ply": vtkIOPLY.vtkPLYReader,
        ".stl": vtkIOGeometry.vtkSTLReader,
        ".obj": vtkIOGeometry.vtkOBJReader,
    }
    faults: list[str] = []

    @calldata_type(VTK_STRING)
    def note(_: Any, event: str, text: str) -> None:
        if event == "ErrorEvent" or "Error reading" in text:  # truncated binary data raise a warning only
            faults.append(text)

    reader: Any = readers[suffix(path)]()
    window: Any = vtkOutputWindow.GetInstance()
    reader.SetFileName(str(path))
    for event in ("ErrorEvent", "WarningEvent"):
        window.AddObserver(event, note)
    reader.Update()
    return None if faults else reader.GetOutputDataObject(0)


def _plain_stl(path: Path, folder: Path) -> Path:
    """Return a file with the words of an STL text in small letters and points in its numbers, as VTK needs them."""
    if suffix(path) != ".stl":
        return path
    data = path.read_bytes()
    plain = data.removeprefix(codecs.BOM_UTF8).lower().replace(b",", b".")
    if plain == data or b"\0" in data or not plain.lstrip().startswith(b"solid"):
        return path
    (folder / path.name).write_bytes(plain)
    return folder / path.name


def _blocks(data: Any) -> list[Any]:
    """Return all data sets of a multi-block data set, also those of nested blocks; else the data set, if any."""
    if data is None or not data.IsA("vtkMultiBlockDataSet"):
        return [] if data is None else [data]
    return [block for k in range(data.GetNumberOfBlocks()) for block in _blocks(data.GetBlock(k))]
