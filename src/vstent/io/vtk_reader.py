"""Read surfaces and images with VTK's readers, which a damaged file may crash: only `vstent.io.child` calls them."""

import codecs
import re
from pathlib import Path, PureWindowsPath
from tempfile import TemporaryDirectory
from typing import Any, Final, NamedTuple

import numpy as np

from vstent.errors import ReadError, UnitError
from vstent.geometry.image import Image
from vstent.io.files import suffix
from vstent.io.limits import refuse_bomb
from vstent.io.ply_strips import ply_strips
from vstent.io.polydata import triangles_of
from vstent.kernels.arrays import Floats, Ints

LEAST_USED: Final = 0.9
"""Smallest fraction of the points of a complete OBJ file that belong to triangles.

Points come before triangles, so a truncated file has a smaller fraction.
"""
HEAD_BYTES: Final = 1 << 16
"""Number of bytes that hold the header of a file."""
_SPACING: Final = re.compile(
    rb"<ImageData\b[^>]*\sSpacing\s*=\s*[\"']([^\"'>]*)|^\s*(?:SPACING|ASPECT_RATIO)[ \t]+([^\r\n]*)", re.M
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
    """Read the polygons of a surface file as triangles.

    Raises
    ------
    ReadError
        The file holds no triangles, or fewer than it states.
    """
    _refuse_outside(path)
    with TemporaryDirectory() as folder:
        data = _loaded(_plain_stl(path, Path(folder)))
    mesh = None if data is None else _triangles(data, path)
    if mesh is None or len(mesh.faces) == 0:
        raise ReadError(
            f"{path.name} holds no surface, or fewer triangles than it states: it is empty, damaged or not a "
            f"{suffix(path)} file. Copy or export it again."
        )
    return mesh


def read_vtk_image(path: Path, *, has_spacing: bool) -> Image:
    """Read a VTK image (``.vti``, or ``.vtk`` of structured points); its axes are taken as LPS.

    Raises
    ------
    ReadError
        The file is damaged, or has no point data with one value per voxel.
    UnitError
        The file does not state the voxel spacing.
    """
    data = _loaded(path)
    if data is not None and data.IsA("vtkRectilinearGrid"):
        raise ReadError(
            f"{path.name} is a rectilinear grid, which vstent does not read. Export it as structured points."
        )
    image = None if data is None else _image(data, path)
    if image is None:
        raise ReadError(
            f"{path.name} is damaged, or has no point data with one value per voxel. Copy or export it again."
        )
    if not has_spacing and not _states_spacing(path):
        raise UnitError(f"{path.name} does not state a voxel spacing above zero; give --spacing in mm.")
    return image


def _loaded(path: Path) -> Any:
    """Return the data set in a file; None where VTK reports an error, after which its data are incomplete."""
    reader = _reader(suffix(path))
    reader.SetFileName(str(path))
    faults = _faults()
    reader.Update()
    return None if faults else reader.GetOutputDataObject(0)


def _states_spacing(path: Path) -> bool:
    """Return whether the header of an image states three spacings above zero."""
    with path.open("rb") as file:
        found = _SPACING.search(file.read(HEAD_BYTES))
    words = (found[1] or found[2]).split() if found else []
    try:
        return len(words) == 3 and all(0 < float(word) < float("inf") for word in words)
    except ValueError:
        return False


def _refuse_outside(path: Path) -> None:
    """Raise ReadError where a multi-block file names a file that is not in its own folder or below it."""
    if suffix(path) != ".vtm":
        return
    for name in re.findall(r"""\sfile\s*=\s*["']([^"']*)""", path.read_text(encoding="utf-8", errors="replace")):
        if PureWindowsPath(name).anchor or ".." in PureWindowsPath(name).parts:
            raise ReadError(f"{path.name} names the file {name[:80]}. Only files beside it or below are read.")


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


def _reader(kind: str) -> Any:
    """Return VTK's reader for a file suffix."""
    from vtkmodules import vtkIOGeometry, vtkIOLegacy, vtkIOPLY, vtkIOXML

    readers = {
        ".vtp": vtkIOXML.vtkXMLPolyDataReader,
        ".vtu": vtkIOXML.vtkXMLUnstructuredGridReader,
        ".vtm": vtkIOXML.vtkXMLMultiBlockDataReader,
        ".vti": vtkIOXML.vtkXMLImageDataReader,
        ".vtk": vtkIOLegacy.vtkGenericDataObjectReader,
        ".ply": vtkIOPLY.vtkPLYReader,
        ".stl": vtkIOGeometry.vtkSTLReader,
        ".obj": vtkIOGeometry.vtkOBJReader,
    }
    return readers[kind]()


def _faults() -> list[str]:
    """Return a list that collects VTK's error messages; after an error VTK returns incomplete data."""
    from vtkmodules.util.misc import calldata_type
    from vtkmodules.vtkCommonCore import VTK_STRING, vtkOutputWindow

    faults: list[str] = []

    @calldata_type(VTK_STRING)
    def note(_: Any, event: str, text: str) -> None:
        if event == "ErrorEvent" or "Error reading" in text:  # truncated binary data raise a warning only
            faults.append(text)

    window: Any = vtkOutputWindow.GetInstance()
    for event in ("ErrorEvent", "WarningEvent"):
        window.AddObserver(event, note)
    return faults


def _announced(path: Path) -> int:
    """Return the number of polygons that the header of a PLY file states; VTK accepts files with fewer."""
    if suffix(path) != ".ply":
        return 0
    with path.open("rb") as file:
        head = file.read(1 << 16).partition(b"end_header")[0]
    counts = [line.split()[2] for line in head.splitlines() if line.startswith(b"element face")]
    return int(counts[0]) if counts else 0


def _polygons(data: Any) -> Any:
    """Return polygons, the outer faces of a grid, or the joined surfaces of blocks; None for anything else."""
    if data is None or data.IsA("vtkPolyData"):
        return data
    if data.IsA("vtkMultiBlockDataSet"):
        return _joined([one for one in map(_polygons, _blocks(data)) if one is not None])
    if not data.IsA("vtkUnstructuredGrid"):
        return None
    from vtkmodules.vtkFiltersGeometry import vtkGeometryFilter

    outer = vtkGeometryFilter()
    outer.SetInputData(data)
    outer.Update()
    return outer.GetOutput()


def _blocks(data: Any) -> list[Any]:
    """Return all data sets of a multi-block data set, also those of nested blocks."""
    children = [data.GetBlock(number) for number in range(data.GetNumberOfBlocks())]
    return [one for child in children if child is not None for one in (_blocks(child) if _is_multi(child) else [child])]


def _is_multi(data: Any) -> bool:
    """Return whether a data set is a multi-block data set."""
    return bool(data.IsA("vtkMultiBlockDataSet"))


def _joined(surfaces: list[Any]) -> Any:
    """Return surfaces as one; None where there is none."""
    from vtkmodules.vtkFiltersCore import vtkAppendPolyData

    if not surfaces:
        return None
    appended = vtkAppendPolyData()
    for surface in surfaces:
        appended.AddInputData(surface)
    appended.Update()
    return appended.GetOutput()


def _space(data: Any) -> str:
    """Return the frame that the field data of a data set, or of one of its blocks, state under the name SPACE."""
    for one in _blocks(data) if data is not None and _is_multi(data) else [data]:
        array = None if one is None else one.GetFieldData().GetAbstractArray("SPACE")
        if array is not None and array.GetNumberOfValues():
            return str(array.GetVariantValue(0).ToString()).strip().upper()
    return ""


def _image(data: Any, path: Path) -> Image | None:
    """Return a VTK image; None without point data of one value per voxel."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    scalars = data.GetPointData().GetScalars() or data.GetPointData().GetArray(0)
    if scalars is None or scalars.GetNumberOfComponents() != 1:
        return None
    shape, extent = data.GetDimensions(), data.GetExtent()
    voxels = vtk_to_numpy(scalars).reshape(shape, order="F")
    refuse_bomb(f"{path.name} holds {' x '.join(map(str, shape))} voxels", voxels.nbytes, path.stat().st_size)
    matrix = data.GetDirectionMatrix()
    direction = np.array([[matrix.GetElement(row, column) for column in range(3)] for row in range(3)])
    affine = np.eye(4)
    affine[:3, :3] = direction * np.array(data.GetSpacing())
    affine[:3, 3] = np.array(data.GetOrigin()) + affine[:3, :3] @ np.array(extent[::2], dtype=np.float64)
    return Image(voxels, affine)


def _triangles(data: Any, path: Path) -> Mesh | None:
    """Return the triangles of a data set; None where polygons are missing."""
    polygons = _polygons(data)
    if polygons is None:
        return None
    vertices, faces = triangles_of(polygons)
    if suffix(path) == ".ply":
        strips = ply_strips(path)
        faces = np.concatenate([faces, strips[(strips < len(vertices)).all(axis=1)]])
    if len(faces) < _announced(path):
        return None
    if suffix(path) == ".obj" and len(np.unique(faces)) < LEAST_USED * len(vertices):
        return None
    return Mesh(vertices.astype(np.float64), faces.astype(np.int32), _space(data))
