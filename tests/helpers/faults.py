"""Everything that we know can go wrong with what vstent is given, and what it must answer.

`FAULTS` is the list: tests/test_faults.py plays every entry, and docs/pages.py makes a page of the same list with the
sentences that came out. An entry is played in an empty folder of its own.
"""

import contextlib
import gzip
import io
import os
import resource
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest import mock

import numpy as np
import pydicom
import SimpleITK

from vstent import phantoms
from vstent.cli import main
from vstent.geometry.image import Image
from vstent.geometry.surface import Surface
from vstent.io.dicom_writer import write_dicom
from vstent.io.writers import polydata_of, write_stl, write_surface
from vstent.study.folder import claimed

INPUT, FAILED, DONE = 2, 1, 0
"""Exit codes: what was given cannot be used; the machine did not allow it; done (what was wrong is mended and said)."""

Maker = Callable[[Path], list[str]]
"""Makes the bad thing in an empty folder and returns the command line; the word OUT stands for the case folder."""


@dataclass(frozen=True)
class Fault:
    """One thing that goes wrong."""

    group: str
    name: str
    make: Maker
    code: int
    said: str
    """Words of the answer."""
    around: Callable[[Path], contextlib.AbstractContextManager[object]] = lambda _: contextlib.nullcontext()
    """State of the machine during the command; takes the case folder."""
    is_heavy: bool = False
    """Whether it is left to `make validation`."""


@dataclass(frozen=True)
class Outcome:
    """What came of it."""

    code: int
    sentence: str
    told: str
    """All that was written to standard error."""


def play(fault: Fault, folder: Path) -> Outcome:
    """Make the fault, run the command, and return its answer."""
    out = folder / "out"
    with contextlib.redirect_stdout(io.StringIO()):
        with contextlib.redirect_stderr(io.StringIO()):
            argv = [str(out) if word == "OUT" else word for word in fault.make(folder)]
        with contextlib.redirect_stderr(io.StringIO()) as told, fault.around(out):
            code = _exit_code(argv)
    lines = told.getvalue().splitlines()
    spoken = [line for line in lines if line.startswith("vstent")]
    return Outcome(code, spoken[-1] if spoken else " ".join(lines), told.getvalue())


def _exit_code(argv: list[str]) -> int:
    try:
        return main(argv)
    except SystemExit as stopped:
        return int(stopped.code or 0)


# -- sound files to spoil ----------------------------------------------------------------------------------------------


@cache
def artery() -> Surface:
    """Return a small artery with a sac."""
    return phantoms.phantom_surface(phantoms.demo_phantom(), edge_mm=0.8)


SPACING_MM = 0.5


@cache
def scan() -> Image:
    """Return a scan of a straight tube of radius 2 mm that leaves it at both ends."""
    i, j = np.meshgrid(*[np.arange(20) - 9.6] * 2, indexing="ij")
    edge = 1 / (1 + np.exp((np.hypot(i, j) - 2.0 / SPACING_MM) / 0.4))
    noise = np.random.default_rng(7).normal(0, 10, (20, 20, 44))
    return Image((100 + 900 * edge[:, :, None] + noise).astype(np.int16), np.diag([SPACING_MM] * 3 + [1.0]))


@cache
def surface_file(suffix: str, *, text: bool = False) -> bytes:
    """Return the artery in a format of VTK's."""
    from vtkmodules.vtkIOGeometry import vtkOBJWriter, vtkSTLWriter
    from vtkmodules.vtkIOLegacy import vtkPolyDataWriter
    from vtkmodules.vtkIOPLY import vtkPLYWriter
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    kinds = {
        ".stl": vtkSTLWriter,
        ".obj": vtkOBJWriter,
        ".ply": vtkPLYWriter,
        ".vtk": vtkPolyDataWriter,
        ".vtp": vtkXMLPolyDataWriter,
    }
    writer = kinds[suffix]()
    writer.SetInputData(polydata_of(artery().vertices_mm, artery().faces))
    if suffix == ".vtp":
        writer.SetDataModeToAscii() if text else writer.SetDataModeToBinary()
    elif suffix != ".obj":
        writer.SetFileTypeToASCII() if text else writer.SetFileTypeToBinary()
    with TemporaryDirectory() as folder:
        writer.SetFileName(f"{folder}/a{suffix}")
        writer.Write()
        return Path(folder, f"a{suffix}").read_bytes()


@cache
def image_file(suffix: str, *, packed: bool = False) -> bytes:
    """Return the scan in a format of ITK's."""
    with TemporaryDirectory() as folder:
        SimpleITK.WriteImage(itk_scan(), f"{folder}/a{suffix}", packed)
        return Path(folder, f"a{suffix}").read_bytes()


@cache
def vtk_image_file(suffix: str) -> bytes:
    """Return the scan in a format of VTK's: ``.vti`` or legacy ``.vtk``."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkStructuredPoints
    from vtkmodules.vtkIOLegacy import vtkStructuredPointsWriter
    from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

    data = vtkStructuredPoints()
    data.SetDimensions(scan().voxels.shape)
    data.SetSpacing([SPACING_MM] * 3)
    data.GetPointData().SetScalars(numpy_to_vtk(np.asarray(scan().voxels).ravel(order="F"), deep=True))
    writer = (vtkXMLImageDataWriter if suffix == ".vti" else vtkStructuredPointsWriter)()
    writer.SetInputData(data)
    with TemporaryDirectory() as folder:
        writer.SetFileName(f"{folder}/a{suffix}")
        writer.Write()
        return Path(folder, f"a{suffix}").read_bytes()


def itk_scan() -> SimpleITK.Image:
    """Return the scan as ITK has it."""
    image = SimpleITK.GetImageFromArray(np.ascontiguousarray(scan().voxels.T))
    image.SetSpacing([SPACING_MM] * 3)
    return image


# -- makers ------------------------------------------------------------------------------------------------------------


def trace(name: str, content: bytes | Callable[[], bytes], *options: str) -> Maker:
    """Write one file and trace the vessel in it."""

    def make(folder: Path) -> list[str]:
        (folder / name).write_bytes(content() if callable(content) else content)
        return ["trace", str(folder / name), "--out", "OUT", *options]

    return make


def cut(suffix: str, where: float | bytes, *, text: bool = False, packed: bool = False, before: int = 0) -> Maker:
    """Trace a file that breaks off: at a fraction of its length, or at a mark in it, or `before` bytes before that."""

    def content() -> bytes:
        whole = image_file(suffix, packed=packed) if suffix in IMAGES else surface_file(suffix, text=text)
        end = whole.rindex(where) if isinstance(where, bytes) else int(where * len(whole))
        return whole[: end - before]

    return trace(f"torn{suffix}", content)


IMAGES = (".nii", ".nii.gz", ".nrrd", ".mha")


def spoilt(suffix: str, *changes: tuple[bytes, bytes]) -> Maker:
    """Trace a scan whose header says something else."""

    def content() -> bytes:
        data = image_file(suffix)
        for old, new in changes:
            assert old in data, old
            data = data.replace(old, new, 1)
        return data

    return trace(f"odd{suffix}", content)


def nifti(at: int, value: bytes) -> Maker:
    """Trace a NIfTI file with other bytes in its header."""

    def content() -> bytes:
        data = bytearray(image_file(".nii"))
        data[at : at + len(value)] = value
        return bytes(data)

    return trace("odd.nii", content)


def mesh(vertices: Callable[[], np.ndarray], faces: Callable[[], np.ndarray], *options: str) -> Maker:
    """Trace a surface of these vertices and faces."""

    def make(folder: Path) -> list[str]:
        write_surface(folder / "odd.vtp", Surface(vertices(), faces()))
        return ["trace", str(folder / "odd.vtp"), "--out", "OUT", "--units", "mm", *options]

    return make


@cache
def slices() -> dict[str, bytes]:
    """Return the scan as the files of a DICOM series, by name."""
    with TemporaryDirectory() as folder:
        write_dicom(scan(), Path(folder, "series"))
        return {file.name: file.read_bytes() for file in Path(folder, "series").iterdir()}


def series(spoil: Callable[[list[Path]], object]) -> Maker:
    """Trace a DICOM series after something was done to its files."""

    def make(folder: Path) -> list[str]:
        (folder / "series").mkdir()
        for name, content in slices().items():
            (folder / "series" / name).write_bytes(content)
        spoil(sorted((folder / "series").iterdir()))
        return ["trace", str(folder / "series"), "--out", "OUT"]

    return make


def edit(index: int, **values: object) -> Callable[[list[Path]], None]:
    """Change elements of one slice."""

    def change(files: list[Path]) -> None:
        dataset = pydicom.dcmread(files[index])
        for keyword, value in values.items():
            setattr(dataset, keyword, value)
        dataset.save_as(files[index])

    return change


def tilt(files: list[Path]) -> None:
    """Shift every slice a little further, as a tilted gantry does."""
    for k, file in enumerate(files):
        dataset = pydicom.dcmread(file)
        x, y, z = dataset.ImagePositionPatient
        dataset.ImagePositionPatient = [x, y + 0.1 * k, z]
        dataset.save_as(file)


def torn(index: int, length: int) -> Callable[[list[Path]], None]:
    """Let one slice break off."""
    return lambda files: files[index].write_bytes(files[index].read_bytes()[:length])


def raw(values: np.ndarray | bytes, *options: str, name: str = "scan.raw") -> Maker:
    """Trace raw voxels of 20 x 20 x 44."""
    given = options or ("--shape", "20,20,44", "--spacing", str(SPACING_MM))
    return trace(name, values if isinstance(values, bytes) else values.tobytes(order="F"), *given)


def toml(text: str | bytes) -> Maker:
    """Add devices from a file."""

    def make(folder: Path) -> list[str]:
        (folder / "mine.toml").write_bytes(text.encode() if isinstance(text, str) else text)
        return ["devices", "add", str(folder / "mine.toml")]

    return make


def run(*options: str) -> Maker:
    """Run a study of the artery."""

    def make(folder: Path) -> list[str]:
        write_stl(folder / "artery.stl", artery())
        return ["run", str(folder / "artery.stl"), "--out", "OUT", "--device", "silk", "--no-flow", *options]

    return make


def film(*options: str) -> Maker:
    """Film a folder that is no case."""
    return lambda folder: ["angiogram", str(folder), *options]


def inlets_all_over() -> list[str]:
    """Name every opening of the artery as an inlet."""
    return [f"--inlet={','.join(map(str, center_mm))}" for center_mm, _, _ in phantoms.demo_phantom().ends]


def linked(folder: Path) -> list[str]:
    """Trace a link that leads to itself."""
    (folder / "loop.stl").symlink_to(folder / "loop.stl")
    return ["trace", str(folder / "loop.stl"), "--out", "OUT"]


def looped(folder: Path) -> list[str]:
    """Trace a series in whose folder a link leads back to the folder."""
    argv = series(lambda files: (files[0].parent / "again").symlink_to(files[0].parent))(folder)
    return argv


def named(folder: Path) -> list[str]:
    """Trace a good file with an awkward name into a folder with another."""
    path = folder / "Müller, Hans (ü 70) é漢.stl"
    write_stl(path, artery())
    return ["trace", str(path), "--out", str(folder / "Fälle 2026" / "Müller's 'case'"), "--units", "mm"]


def on_gpu(folder: Path) -> list[str]:
    """Compute the artery's flow on a GPU."""
    write_stl(folder / "artery.stl", artery())
    return ["flow", str(folder / "artery.stl"), "--out", "OUT", "--gpu"]


def into_a_file(folder: Path) -> list[str]:
    """Trace into a path that is a file."""
    write_stl(folder / "artery.stl", artery())
    (folder / "file").write_text("mine")
    return ["trace", str(folder / "file" / ".." / "artery.stl"), "--out", str(folder / "file" / "case")]


def bomb(members: int) -> bytes:
    """Return `members` times 16 MB of zeros, packed into 16 kB each."""
    return gzip.compress(bytes(1 << 24), 9, mtime=0) * members


def another(files: list[Path]) -> None:
    """Add a slice with other pixels at the position of the third."""
    dataset = pydicom.dcmread(files[2])
    dataset.PixelData = (dataset.pixel_array + 1).tobytes()
    dataset.save_as(files[2].with_name("x.dcm"))


def deflated_bomb(files: list[Path]) -> None:
    """Make one slice unpack to more than half a gigabyte."""
    meta = pydicom.dcmread(files[3]).file_meta
    meta.TransferSyntaxUID = pydicom.uid.DeflatedExplicitVRLittleEndian
    shell = pydicom.FileDataset(None, {}, file_meta=meta, preamble=bytes(128))
    shell.save_as(files[3], enforce_file_format=True)
    packer = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS)
    block = packer.compress(bytes(1 << 24)) + packer.flush(zlib.Z_FULL_FLUSH)
    head = files[3].read_bytes()[: 144 + pydicom.dcmread(files[3]).file_meta.FileMetaInformationGroupLength]
    files[3].write_bytes(head + block * 33)


def packed_vtp() -> bytes:
    """Return a VTP file whose packed block announces 4 GB."""
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    writer = vtkXMLPolyDataWriter()
    writer.SetInputData(polydata_of(artery().vertices_mm, artery().faces))
    writer.SetDataModeToAppended()
    writer.EncodeAppendedDataOff()
    writer.SetCompressorTypeToZLib()
    writer.SetHeaderTypeToUInt32()
    writer.WriteToOutputStringOn()
    with TemporaryDirectory() as folder:
        writer.WriteToOutputStringOff()
        writer.SetFileName(f"{folder}/a.vtp")
        writer.Write()
        data = Path(folder, "a.vtp").read_bytes()
    start = data.index(b"_", data.index(b"<AppendedData")) + 1
    return data[: start + 4] + struct.pack("<2I", 0xFFFFFFF0, 0xFFFFFFF0) + data[start + 12 :]


def bombed_cache(folder: Path) -> list[str]:
    """Go on in a folder whose kept stages unpack to 16 GB."""
    argv = ["restore", *run()(folder)[1:4]]
    assert _exit_code([str(folder / "out") if word == "OUT" else word for word in argv]) == 0
    (kept,) = (folder / "out" / ".vstent").glob("anatomy-*.npz")
    with zipfile.ZipFile(kept) as archive:
        entries = archive.infolist()
    data = bytearray(kept.read_bytes())
    for entry in entries:  # the size unpacked, as the directory at the end of the archive says it
        name = entry.filename.encode()
        place = data.rindex(name) - 46
        data[place + 24 : place + 28] = struct.pack("<I", 0xFFFFFF00)
    kept.write_bytes(bytes(data))
    return argv


# -- the machine -------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def full_disk(_: Path) -> Iterator[None]:
    """Let no file grow beyond 20 kB, as on a disk that is full."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@contextlib.contextmanager
def no_gpu(_: Path) -> Iterator[None]:
    """Hide what it takes to use a GPU, where it is installed."""
    with mock.patch("vstent.flow.lattice.gpu.find_spec", return_value=None):
        yield


@contextlib.contextmanager
def little_memory(_: Path) -> Iterator[None]:
    """Let the process have 200 MB more than it has."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * os.sysconf("SC_PAGE_SIZE") + 200_000_000, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


@contextlib.contextmanager
def own_catalogue(out: Path) -> Iterator[None]:
    """Keep the user's own devices out of it."""
    before = os.environ.get("XDG_CONFIG_HOME")
    os.environ["XDG_CONFIG_HOME"] = str(out.parent / "config")
    try:
        yield
    finally:
        os.environ.pop("XDG_CONFIG_HOME")
        if before is not None:
            os.environ["XDG_CONFIG_HOME"] = before


# -- the list ----------------------------------------------------------------------------------------------------------

MESH, SCAN, SLICES, RAW = "surface files", "scans with a header", "DICOM series", "raw volumes"
SHAPE, OPTION, DEVICE, MACHINE = "surfaces that are read", "options", "devices of one's own", "machine and folders"

_TORN = "fewer triangles than it states"
_ANNOUNCED = "breaks off"
_DAMAGED = "is damaged"
_SOURCED = 'source = "none", confidence = "estimated", reason = "none"'


def _device(angle: str = "1.1", count: str = "48", lengths: str = "[15]", more: str = "") -> str:
    return (
        '[[device]]\nkey = "mine"\nname = "Mine"\nmaker = "Me"\nkind = "braid"\n'
        f"wires = [{{ count = {{ value = {count}, low = 2, high = 100 }}, "
        f"diameter_um = {{ value = 30, low = 20, high = 40 }}, {_SOURCED} }}]\n"
        f"braid_angle_rad = {{ value = {angle}, low = 1.0, high = 1.2, {_SOURCED} }}\n"
        f"free_diameter_margin_mm = {{ value = 0.2, low = 0.1, high = 0.3, {_SOURCED} }}\n"
        f"sizes = [{{ diameters_mm = [4], lengths_mm = {lengths}, length_tolerance_mm = 1, {_SOURCED} }}]\n{more}"
    )


def _vertices(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[], np.ndarray]:
    return lambda: change(np.array(artery().vertices_mm))


def _no_number(vertices: np.ndarray) -> np.ndarray:
    vertices[17, 1] = np.nan
    return vertices


def _crossing(vertices: np.ndarray) -> np.ndarray:
    """Push a dent of the wall through the wall opposite."""
    dent = np.linalg.norm(vertices - vertices[400], axis=1) < 1.2
    vertices[dent] += 1.05 * (2 * (vertices.mean(axis=0) - vertices[400]) / 20)
    return vertices


def _faces() -> np.ndarray:
    return np.array(artery().faces)


def _without_a_dome() -> np.ndarray:
    """Return the faces of the artery without the last 1.5 mm of its sac's dome."""
    wall, sac = artery(), phantoms.demo_phantom().sac
    assert sac is not None
    top_mm = (wall.vertices_mm - sac.center_mm) @ sac.direction
    return wall.faces[(top_mm[wall.faces] < top_mm.max() - 1.5).all(axis=1)]


def _two_walls() -> np.ndarray:
    """Return the vertices of the artery, and of a wall 0.4 mm outside it."""
    wall = artery()
    return np.concatenate([wall.vertices_mm, wall.vertices_mm + 0.4 * wall.vertex_normals])


def _two_faces() -> np.ndarray:
    """Return the faces of both walls; those of the inner one look inwards, as in a hollow model."""
    faces = artery().faces
    return np.concatenate([faces[:, ::-1], faces + len(artery().vertices_mm)])


def _sheared(part: float) -> bytes:
    """Return codes, quaternion and rows of a NIfTI header whose second axis leans by `part` towards the first."""
    rows = np.diag([-SPACING_MM, -SPACING_MM, SPACING_MM]).astype("<f4")
    rows[0, 1] = part * SPACING_MM
    return struct.pack("<2h6f", 0, 1, *[0.0] * 6) + np.column_stack([rows, np.zeros(3, "<f4")]).astype("<f4").tobytes()


def _doubled() -> Maker:
    return mesh(lambda: artery().corners_mm.reshape(-1, 3), lambda: np.arange(3 * len(_faces())).reshape(-1, 3))


def _million() -> Maker:
    return mesh(
        lambda: np.concatenate([artery().vertices_mm, np.repeat(artery().vertices_mm[:1], 1_000_000, axis=0)]),
        lambda: np.concatenate([_faces(), len(artery().vertices_mm) + np.arange(999_999).reshape(-1, 3)]),
    )


FAULTS: tuple[Fault, ...] = (
    Fault(MESH, "missing", lambda folder: ["trace", str(folder / "no.stl"), "--out", "OUT"], INPUT, "does not exist"),
    Fault(MESH, "empty", trace("a.stl", b""), INPUT, "is empty"),
    Fault(MESH, "text named .stl", trace("a.stl", b"hello\n"), INPUT, "not a .stl file"),
    Fault(MESH, "STL named .vtp", trace("a.vtp", lambda: surface_file(".stl")), INPUT, "not a .vtp file"),
    Fault(MESH, "Word document", trace("a.docx", b"PK"), INPUT, "is not a scan"),
    Fault(MESH, "STL text, cut after its title", cut(".stl", b" facet", text=True, before=0), INPUT, _TORN),
    Fault(MESH, "STL text, cut in a triangle", cut(".stl", 0.5, text=True), INPUT, _TORN),
    Fault(MESH, "STL text, cut before its last line", cut(".stl", b"endsolid", text=True), INPUT, _TORN),
    Fault(MESH, "STL, cut in its header", cut(".stl", 0.0005), INPUT, "not a .stl file"),
    Fault(MESH, "STL, cut after the count", trace("a.stl", lambda: surface_file(".stl")[:84]), INPUT, _ANNOUNCED),
    Fault(MESH, "STL, cut in a triangle", cut(".stl", 0.5), INPUT, _ANNOUNCED),
    Fault(
        MESH,
        "STL, bytes in the other order",
        trace("a.stl", lambda: surface_file(".stl")[:80] + len(_faces()).to_bytes(4, "big") + bytes(5000)),
        INPUT,
        _ANNOUNCED,
    ),
    Fault(MESH, "PLY, cut in its header", cut(".ply", 0.001), INPUT, _TORN),
    Fault(MESH, "PLY, cut after its header", cut(".ply", b"end_header", before=-11), INPUT, "is damaged"),
    Fault(MESH, "PLY, cut in its vertices", cut(".ply", 0.2), INPUT, "is damaged"),
    Fault(MESH, "PLY, cut in its triangles", cut(".ply", 0.9), INPUT, "is damaged"),
    Fault(MESH, "PLY text, cut in its triangles", cut(".ply", 0.9, text=True), INPUT, _TORN),
    Fault(
        MESH,
        "PLY that announces 10^9 vertices",
        trace("a.ply", b"ply\nformat ascii 1.0\nelement vertex 1000000000\nproperty float x\nend_header\n1\n"),
        INPUT,
        "damaged",
    ),
    Fault(MESH, "VTK, cut after its title", cut(".vtk", b"DATASET"), INPUT, _TORN),
    Fault(MESH, "VTK, cut in its points", cut(".vtk", 0.3), INPUT, _TORN),
    Fault(MESH, "VTK, cut in its triangles", cut(".vtk", 0.9), INPUT, _TORN),
    Fault(MESH, "VTK text, cut in its triangles", cut(".vtk", 0.9, text=True), INPUT, _TORN),
    Fault(MESH, "VTP, cut before its points", cut(".vtp", b"<Points"), INPUT, _TORN),
    Fault(MESH, "VTP, cut in its triangles", cut(".vtp", 0.9), INPUT, _TORN),
    Fault(MESH, "VTP, last line missing", cut(".vtp", b"</VTKFile"), INPUT, _TORN),
    Fault(MESH, "VTP whose packed data announce 4 GB", trace("a.vtp", packed_vtp), INPUT, "damaged"),
    Fault(MESH, "OBJ, cut in its vertices", cut(".obj", 0.2), INPUT, _TORN),
    Fault(MESH, "OBJ, cut in its triangles", cut(".obj", 0.7), INPUT, _TORN),
    Fault(MESH, "lines without triangles", trace("a.obj", b"v 0 0 0\nv 1 0 0\nl 1 2\n"), INPUT, _TORN),
    Fault(SHAPE, "vertex that is no number", mesh(_vertices(_no_number), _faces), INPUT, "first: 17"),
    Fault(
        SHAPE,
        "two triangles",
        mesh(lambda: np.eye(4, 3), lambda: np.array([[0, 1, 2], [0, 2, 3]])),
        INPUT,
        "holds 2 triangles, too few for a vessel",
    ),
    Fault(SHAPE, "flat", mesh(_vertices(lambda v: v * [1, 0, 0]), _faces), INPUT, "no area"),
    Fault(
        SHAPE,
        "a thousand times too large",
        mesh(_vertices(lambda v: v * 1000), _faces),
        INPUT,
        "which no brain vessel has",
    ),
    Fault(SHAPE, "no openings", lambda folder: closed_sphere(folder), INPUT, "openings"),
    Fault(SHAPE, "inside out", mesh(_vertices(np.array), lambda: _faces()[:, ::-1]), DONE, "inside out"),
    Fault(SHAPE, "wall that crosses itself", mesh(_vertices(_crossing), _faces), DONE, ""),
    Fault(SHAPE, "sac cut open", mesh(_vertices(np.array), _without_a_dome), DONE, "cut open"),
    Fault(SHAPE, "inner and outer wall", mesh(_two_walls, _two_faces), DONE, "inner"),
    Fault(SHAPE, "vertices of every triangle apart", _doubled(), DONE, "merged"),
    Fault(SHAPE, "a million points at one place", _million(), DONE, "merged", is_heavy=True),
    Fault(SCAN, "NIfTI, cut in its header", cut(".nii", 0.005), INPUT, _DAMAGED),
    Fault(SCAN, "NIfTI, cut after its header", trace("a.nii", lambda: image_file(".nii")[:352]), INPUT, _ANNOUNCED),
    Fault(SCAN, "NIfTI, cut in its voxels", cut(".nii", 0.5), INPUT, _ANNOUNCED),
    Fault(SCAN, "NIfTI packed, cut at its beginning", trace("a.nii.gz", gzip.compress(b"")[:5]), INPUT, _DAMAGED),
    Fault(SCAN, "NIfTI packed, cut in its voxels", cut(".nii.gz", 0.5), INPUT, _ANNOUNCED),
    Fault(SCAN, "NIfTI of 17 GB in 35 kB", nifti(42, struct.pack("<3h", 2048, 2048, 2048)), INPUT, "17.2 GB"),
    Fault(
        SCAN,
        "NIfTI of 17 GB that are really packed in it",
        trace(
            "a.nii.gz",
            lambda: (
                gzip.compress(
                    image_file(".nii")[:42] + struct.pack("<3h", 2048, 2048, 2048) + image_file(".nii")[48:352]
                )
                + bomb(1025)
            ),
        ),
        INPUT,
        "more than a scan",
    ),
    Fault(SCAN, "NIfTI whose voxels begin elsewhere", nifti(108, struct.pack("<f", -100)), INPUT, "begin at byte -100"),
    Fault(SCAN, "NIfTI with a count below zero", nifti(42, struct.pack("<3h", -20, 20, 44)), INPUT, _DAMAGED),
    Fault(SCAN, "NIfTI with two voxel sizes", nifti(80, struct.pack("<3f", 4, 4, 4)), INPUT, "give --spacing"),
    Fault(SCAN, "NIfTI with voxels of no kind", nifti(70, struct.pack("<2h", 999, 16)), INPUT, _DAMAGED),
    Fault(SCAN, "NIfTI with scaled voxels", nifti(112, struct.pack("<2f", 0.5, 10.0)), DONE, "Threshold"),
    Fault(SCAN, "NIfTI with axes sheared by 0.4 %", nifti(252, _sheared(0.004)), DONE, "not perpendicular"),
    Fault(SCAN, "NIfTI with a gantry tilt of 11 degrees", nifti(252, _sheared(0.2)), DONE, "not perpendicular"),
    Fault(SCAN, "NRRD, cut in its header", cut(".nrrd", b"encoding"), INPUT, _DAMAGED),
    Fault(SCAN, "NRRD, cut in its voxels", cut(".nrrd", 0.5), INPUT, _DAMAGED),
    Fault(SCAN, "NRRD packed, cut in its voxels", cut(".nrrd", 0.5, packed=True), INPUT, _DAMAGED),
    Fault(
        SCAN,
        "NRRD of 69 GB in 35 kB",
        spoilt(".nrrd", (b"sizes: 20 20 44", b"sizes: 2048 2048 8192")),
        INPUT,
        "68.7 GB",
    ),
    Fault(SCAN, "NHDR without its data file", trace("a.nhdr", lambda: detached()), INPUT, _DAMAGED),
    Fault(SCAN, "MHA, cut in its header", cut(".mha", b"ElementType"), INPUT, _DAMAGED),
    Fault(SCAN, "MHA, cut in its voxels", cut(".mha", 0.5), INPUT, _DAMAGED),
    Fault(SCAN, "MHA packed, cut in its voxels", cut(".mha", 0.5, packed=True), INPUT, _DAMAGED),
    Fault(SCAN, "MHA of 17 GB in 35 kB", spoilt(".mha", (b"20 20 44", b"2048 2048 2048")), INPUT, "17.2 GB"),
    Fault(SCAN, "MHA with spacing below zero", spoilt(".mha", (b"0.5 0.5 0.5", b"0.5 -.5 0.5")), INPUT, "above zero"),
    Fault(SCAN, "MHA with spacing 0", spoilt(".mha", (b"0.5 0.5 0.5", b"0.5 0.0 0.5")), INPUT, _DAMAGED),
    Fault(SCAN, "MHA with spacing in metres", spoilt(".mha", (b"0.5 0.5 0.5", b"5e-4 5e-4 5e-4")), INPUT, "no scan of"),
    Fault(
        SCAN,
        "MHA, bytes in the other order",
        spoilt(".mha", (b"ByteOrderMSB = False", b"ByteOrderMSB = True")),
        INPUT,
        "wrong byte order",
    ),
    Fault(SCAN, "MHD without its data file", trace("a.mhd", lambda: detached(".mhd")), INPUT, _DAMAGED),
    Fault(SCAN, "colours", lambda folder: other_scan(folder, np.zeros((5, 6, 7, 3), np.uint8)), INPUT, "3 values per"),
    Fault(SCAN, "voxels that are no numbers", lambda folder: other_scan(folder, holed()), INPUT, "not numbers"),
    Fault(SCAN, "text", trace("a.nrrd", b"not a scan"), INPUT, _DAMAGED),
    Fault(SLICES, "empty folder", lambda folder: empty(folder), INPUT, "no DICOM images"),
    Fault(SLICES, "a slice of no bytes", series(torn(-1, 0)), INPUT, "is not a DICOM file"),
    Fault(SLICES, "cut in the preamble", series(torn(5, 100)), INPUT, "is not a DICOM file"),
    Fault(SLICES, "cut in the header", series(torn(5, 700)), INPUT, _DAMAGED),
    Fault(SLICES, "cut in the pixels", series(torn(5, -100)), INPUT, "damaged"),
    Fault(SLICES, "missing slice", series(lambda files: files[3].unlink()), INPUT, "1 slice is missing"),
    Fault(SLICES, "slice twice", series(lambda f: shutil.copy(f[2], f[2].with_name("x.dcm"))), DONE, "dropped"),
    Fault(SLICES, "two slices at one place", series(another), INPUT, "same position"),
    Fault(SLICES, "one slice only", series(lambda files: [f.unlink() for f in files[1:]]), INPUT, "is alone"),
    Fault(SLICES, "no pixel size", series(edit(5, PixelSpacing=None)), INPUT, "does not state its pixel spacing"),
    Fault(SLICES, "a slice of another size", series(edit(5, Rows=10)), INPUT, "another size"),
    Fault(SLICES, "uneven distances", series(edit(5, ImagePositionPatient=[0, 0, 2.6])), INPUT, "apart elsewhere"),
    Fault(SLICES, "slice out of line", series(edit(5, ImagePositionPatient=[1, 0, 2.5])), INPUT, "out of line"),
    Fault(SLICES, "projections", series(edit(5, NumberOfFrames=3)), INPUT, "series of projections"),
    Fault(
        SLICES,
        "slices of 65535 x 65535",
        series(lambda f: [edit(k, Rows=65535, Columns=65535)(f) for k in range(2)]),
        INPUT,
        "more than a scan",
    ),
    Fault(SLICES, "a slice that unpacks to 0.5 GB", series(deflated_bomb), INPUT, "unpacks to more", is_heavy=True),
    Fault(SLICES, "tilted gantry", series(tilt), DONE, ""),
    Fault(SLICES, "link back to the folder itself", looped, DONE, ""),
    Fault(RAW, "no spacing", raw(scan().voxels, "--shape", "20,20,44"), INPUT, "--spacing"),
    Fault(RAW, "no shape", raw(scan().voxels, "--spacing", "0.5"), INPUT, "--shape"),
    Fault(
        RAW,
        "spacing below zero",
        raw(scan().voxels, "--shape", "20,20,44", "--spacing", "0.5,-1,1"),
        INPUT,
        "-1 mm is out of range",
    ),
    Fault(RAW, "shape below zero", raw(scan().voxels, "--shape", "20,-20,44", "--spacing", "1"), INPUT, "--shape"),
    Fault(RAW, "cut", raw(scan().voxels.tobytes()[:9999]), INPUT, "9999 bytes"),
    Fault(
        RAW,
        "packed, cut",
        raw(gzip.compress(scan().voxels.tobytes())[:200], name="scan.raw.gz"),
        INPUT,
        "cannot be unpacked",
    ),
    Fault(RAW, "16 GB packed where 35 kB belong", raw(bomb(1024), name="scan.raw.gz"), INPUT, "check --shape"),
    Fault(RAW, "zeros", raw(np.zeros((20, 20, 44), np.int16)), INPUT, "no edges"),
    Fault(RAW, "all voxels alike", raw(np.full((20, 20, 44), 700, np.int16)), INPUT, "no edges"),
    Fault(RAW, "bytes in the other order", raw(scan().voxels.astype(">i2")), DONE, "big-endian"),
    Fault(
        RAW,
        "more memory than there is",
        raw(bomb(64), "--shape", "1024,1024,1024", "--spacing", "0.1", name="a.raw.gz"),
        FAILED,
        "out of memory",
        little_memory,
    ),
    Fault(OPTION, "threshold that is no number", run("--threshold", "nan"), INPUT, "'nan' is not a number"),
    Fault(OPTION, "cells of no size", run("--grid-spacing", "0"), INPUT, "0 mm is out of range: give 0.002 to 1 mm"),
    Fault(OPTION, "inflow below zero", run("--flow-rate", "-3"), INPUT, "-3 mL/s is out of range: give above 0"),
    Fault(OPTION, "point of two numbers", run("--at", "1,2"), INPUT, "'1,2' is not 3 numbers"),
    Fault(OPTION, "an inlet given twice", run("--inlet", "0,0,0", "--inlet", "0,1,0"), INPUT, "the same opening"),
    Fault(OPTION, "inlets wherever there is an opening", run(*inlets_all_over()), INPUT, "none is an outlet"),
    Fault(OPTION, "C-arm angle that there is not", film("--view", "LAO 200"), INPUT, "angle is 200 degrees"),
    Fault(OPTION, "C-arm direction of no words", film("--view", "left"), INPUT, "not a C-arm direction"),
    Fault(OPTION, "X-ray source behind the detector", film("--source-isocenter", "1200"), INPUT, "distance is 1200 mm"),
    Fault(OPTION, "film without a run", film("--view", "AP"), INPUT, "run"),
    Fault(OPTION, "device that does not exist", run("--device", "slik"), INPUT, "Did you mean silk"),
    Fault(OPTION, "size that is not made", run("--diameter", "17"), INPUT, "is not made in"),
    Fault(OPTION, "device beyond the artery", run("--center", "900"), INPUT, "is not on the parent artery"),
    Fault(DEVICE, "no TOML", toml("[[device"), INPUT, "not valid TOML", own_catalogue),
    Fault(DEVICE, "no text", toml(b"\xff\xfe\x00"), INPUT, "as text", own_catalogue),
    Fault(
        DEVICE,
        "number without source",
        toml(_device().replace(_SOURCED, 'confidence = "cited", reason = "none"', 1)),
        INPUT,
        "source",
        own_catalogue,
    ),
    Fault(DEVICE, "field that does not exist", toml(_device(more='colour = "red"\n')), INPUT, "colour", own_catalogue),
    Fault(DEVICE, "angle that is not finite", toml(_device(angle="inf")), INPUT, "braid_angle_rad", own_catalogue),
    Fault(DEVICE, "odd number of wires", toml(_device(count="47")), INPUT, "even number", own_catalogue),
    Fault(DEVICE, "number of 5000 digits", toml(_device(count="1" * 5000)), INPUT, "not valid TOML", own_catalogue),
    Fault(DEVICE, "length of 10^300 mm", toml(_device(lengths="[1e300]")), INPUT, "lengths_mm", own_catalogue),
    Fault(
        DEVICE, "name of another device", toml(_device().replace('"mine"', '"silk"')), INPUT, "already", own_catalogue
    ),
    Fault(DEVICE, "brackets 100 000 deep", toml("a = " + "[" * 100_000), INPUT, "mine.toml", own_catalogue),
    Fault(MACHINE, "blanks, umlauts, quotes in paths", named, DONE, ""),
    Fault(MACHINE, "link that leads to itself", linked, INPUT, "does not exist"),
    Fault(MACHINE, "case folder below a file", into_a_file, FAILED, "give another --out"),
    Fault(MACHINE, "case folder that another run works in", run(), FAILED, "is in use by process", claimed),
    Fault(MACHINE, "GPU asked for where there is none", on_gpu, FAILED, "without --gpu", no_gpu),
    Fault(MACHINE, "disk full", run(), FAILED, "free disk space", full_disk),
    Fault(MACHINE, "kept stages that unpack to 16 GB", bombed_cache, DONE, "", is_heavy=True),
)


def closed_sphere(folder: Path) -> list[str]:
    """Trace a closed sphere."""
    from shapes import sphere

    write_stl(folder / "sphere.stl", sphere(3.0))
    return ["trace", str(folder / "sphere.stl"), "--out", "OUT", "--units", "mm"]


def detached(suffix: str = ".nhdr") -> bytes:
    """Return a header whose voxels lie in another file."""
    with TemporaryDirectory() as folder:
        SimpleITK.WriteImage(itk_scan(), f"{folder}/a{suffix}")
        return Path(folder, f"a{suffix}").read_bytes()


def other_scan(folder: Path, values: np.ndarray) -> list[str]:
    """Trace an array (k, j, i), or (k, j, i, 3) of colours."""
    SimpleITK.WriteImage(SimpleITK.GetImageFromArray(values, isVector=values.ndim == 4), str(folder / "a.nrrd"))
    return ["trace", str(folder / "a.nrrd"), "--out", "OUT", "--spacing", "0.5"]


def holed() -> np.ndarray:
    """Return the scan's voxels with one that is no number."""
    values = scan().voxels.T.astype(np.float32)
    values[3, 4, 5] = np.nan
    return values


def empty(folder: Path) -> list[str]:
    """Trace a folder with nothing in it."""
    (folder / "nothing").mkdir()
    return ["trace", str(folder / "nothing"), "--out", "OUT"]
