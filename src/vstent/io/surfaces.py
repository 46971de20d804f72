"""Read surface files (STL, VTP, VTU, VTM, VTK, OBJ, PLY) as a `Surface` in LPS mm."""

import codecs
import os
import re
from pathlib import Path
from typing import Final, Literal, get_args

import numpy as np

from vstent.errors import ReadError, UnitError
from vstent.geometry.surface import Surface
from vstent.io.apart import read_apart
from vstent.io.double_wall import inner_wall
from vstent.io.files import SURFACE_SUFFIXES, existing, is_vtk_image, suffix
from vstent.kernels import topology, triangles
from vstent.units import MM_PER

Unit = Literal["m", "cm", "mm"]
"""Length unit of a surface file."""
Frame = Literal["lps", "ras"]
"""Patient frame of coordinates: x to the left and y to the back (LPS, DICOM), or x to the right and y to the front."""

VESSEL_DIAMETER_MM: Final = (0.8, 14.0)
"""Smallest and largest hydraulic diameter 4 V / A of intracranial vessel trees with sacs, in mm; decides the unit."""
GIANT_DIAMETER_MM: Final = 25.0
"""Largest hydraulic diameter 4 V / A with a giant sac, in mm: an artery of 4 mm with a sac of 36 mm.

The hydraulic diameter of a sphere is 2/3 of its diameter.
"""
TYPICAL_DIAMETER_MM: Final = 3.5
"""Typical hydraulic diameter in mm; of several possible units the one closest to it is chosen."""
VESSEL_SIZE_MM: Final = (5.0, 400.0)
"""Smallest and largest diagonal of the bounding box of a vessel tree, in mm."""


def read_surface(
    path: Path, *, units: Unit | None = None, frame: Frame | None = None
) -> tuple[Surface, tuple[str, ...]]:
    """Read the wall of a vessel from an STL, VTP, VTU, VTM, VTK, OBJ or PLY file.

    The inner wall of a hollow model (inner and outer wall) is returned.

    Parameters
    ----------
    path : the file; polygons with more than three corners are triangulated, and the outer faces of a grid are used.
    units : unit of its coordinates; None: derived from the size of the vessel and reported in a note.
    frame : frame of its coordinates; None: the one that the file states (``SPACE=RAS`` in a header, comment or field
        data), else LPS.

    Returns
    -------
    surface : Surface
        The mesh in LPS mm as it is in the file, including its faults (see `vstent.anatomy.repair`).
    notes : tuple of str
        One sentence for every assumption.

    Raises
    ------
    ReadError
        The file is missing, damaged, empty, or not what its name says.
    UnitError
        The size is that of no intracranial vessel in the given unit, or in any.
    """
    path = existing(path)
    surface, stated = _read(path)
    if len(surface.faces) < 4:
        raise ReadError(
            f"{path.name} holds {len(surface.faces)} triangles, too few for a vessel. Give the wall of the vessel."
        )
    bad = ~np.isfinite(surface.vertices_mm).all(axis=1)
    if bad.any():
        raise ReadError(
            f"{path.name} has {bad.sum()} vertices that are not numbers (first: {bad.argmax()}). Export it again."
        )
    if not surface.areas_mm2.sum() > 0 or not np.isfinite(_diagonal(surface)):
        raise ReadError(f"{path.name} has no area: all its triangles are lines or points. Export it again.")
    if units is not None and units not in get_args(Unit):
        raise UnitError(f"Unit {units} is not known: give m, cm or mm.")
    if frame not in (None, *get_args(Frame)):
        raise UnitError(f"Frame {frame} is not known: give lps or ras.")
    notes: tuple[str, ...] = ()
    if (frame or stated.lower()) == "ras":
        surface = Surface(surface.vertices_mm * RAS_TO_LPS, surface.faces)
        notes = () if frame else ("The file states RAS coordinates (SPACE=RAS): they were converted to LPS.",)
    inner = inner_wall(_joined(surface))
    if inner is not None:
        surface, notes = inner, (*notes, "The file holds an inner and an outer wall: the inner one is used.")
    size, diameter = _diagonal(surface), hydraulic_diameter(surface)
    unit = units or _guessed(size, diameter, path)
    if units is None:
        notes = (
            *notes,
            f"Length unit: {unit}, derived from the size (hydraulic diameter {diameter * MM_PER[unit]:.2f} mm, "
            f"extent {size * MM_PER[unit]:.0f} mm). If it is wrong, give the unit (--units).",
        )
    elif not _fits(size * MM_PER[unit], diameter * MM_PER[unit], GIANT_DIAMETER_MM):
        raise UnitError(
            f"{path.name} in {unit} would be {size * MM_PER[unit]:.4g} mm long with a hydraulic diameter of "
            f"{diameter * MM_PER[unit]:.4g} mm, which no brain vessel has. Give another unit (--units)."
        )
    return Surface(surface.vertices_mm * MM_PER[unit], surface.faces), notes


RAS_TO_LPS: Final = np.array([-1.0, -1.0, 1.0])
"""Factors that convert RAS coordinates to LPS, and back."""
TAIL_BYTES: Final = 4096
"""Number of bytes at the end of an STL text file that contain its last line."""
_BEGINS: Final = {**dict.fromkeys((".vtp", ".vtu", ".vtm"), b"<"), ".vtk": b"# vtk", ".ply": b"ply"}
"""First bytes of a file by its suffix."""
SPACE: Final = re.compile(rb"SPACE\s*[=:]\s*(RAS|LPS)", re.IGNORECASE)
"""Pattern by which 3D Slicer states the frame in a header or comment."""
_HEAD_ENDS: Final = {".stl": b"facet", ".ply": b"end_header", ".obj": b"\nv ", ".vtk": b"DATASET"}
"""First text after the header of a file, by its suffix."""


def _read(path: Path) -> tuple[Surface, str]:
    """Return the surface in the unit and frame of the file, and the frame that it states; empty where it states none.

    Other formats than that of the suffix are refused first: VTK's readers may hang or crash on them.
    """
    kind = suffix(path)
    if kind not in SURFACE_SUFFIXES:
        raise ReadError(
            f"{path.name} is not a surface file that vstent reads. Give one of {', '.join(SURFACE_SUFFIXES)}."
        )
    if path.is_dir() or (n_bytes := path.stat().st_size) == 0:
        raise ReadError(f"{path.name} is {'a folder' if path.is_dir() else 'empty'}, not a surface file.")
    if is_vtk_image(path):
        raise ReadError(f"{path.name} is a scan, not a surface. Read it with vstent.read_image.")
    with path.open("rb") as file:
        head = file.read(4096)
        file.seek(-min(TAIL_BYTES, n_bytes), os.SEEK_END)
        tail = file.read().lower()
    is_text = head[:512].removeprefix(codecs.BOM_UTF8).lstrip().lower().startswith(b"solid") and (
        b"facet" in head[:512].lower() or n_bytes >= 512
    )
    n_stated = int.from_bytes(head[80:84], "little")  # triangles of a binary STL file
    is_whole = n_bytes >= 84 + 50 * n_stated
    is_wrong = not head.lstrip(b"\xef\xbb\xbf \r\n\t").lower().startswith(_BEGINS.get(kind, b""))
    if kind == ".stl" and not is_text and not is_whole:
        is_wrong = True
        if n_bytes >= 84 and not head.lstrip().lower().startswith(b"solid"):
            raise ReadError(
                f"{path.name} breaks off, or is not a .stl file: its header states {n_stated} triangles and there is "
                f"room for {(n_bytes - 84) // 50}. Copy or export it again."
            )
    if is_wrong:
        raise ReadError(f"{path.name} is not a {kind} file: its first bytes are not of that type. Export it again.")
    if kind == ".stl" and is_text and not is_whole and b"endsolid" not in tail:  # VTK reads some of these as binary
        raise ReadError(f"{path.name} holds fewer triangles than it states: it breaks off. Copy or export it again.")
    with read_apart("mesh", path, {}, [path]) as (arrays, words):
        surface = Surface(arrays["vertices"], arrays["faces"])
    header = head[:80] if kind == ".stl" and not is_text else head
    stated = SPACE.search(header.partition(_HEAD_ENDS[kind])[0]) if kind in _HEAD_ENDS else None
    return surface, words["space"] or (stated[1].decode().upper() if stated else "")


def _joined(surface: Surface) -> Surface:
    """Return a surface whose triangles share vertices, also where those miss each other by little."""
    kept, same = topology.first_equals(surface.vertices_mm)
    return Surface(
        surface.vertices_mm[kept], topology.without_cracks(surface.vertices_mm[kept], same[surface.faces])[0]
    )


def _diagonal(surface: Surface) -> float:
    """Return the diagonal of the bounding box."""
    used = surface.vertices_mm[np.unique(surface.faces)]
    return float(np.linalg.norm(np.ptp(used, axis=0)))


def hydraulic_diameter(surface: Surface) -> float:
    """Return the hydraulic diameter 4 V / A of the capped surface, in the unit of the surface."""
    joined = _joined(surface)
    points = joined.vertices_mm
    faces, _ = topology.oriented(joined.faces[topology.sound_faces(joined.faces)])
    vertices, closed = triangles.cap(points, faces, triangles.boundary_loops(points, faces))
    return float(4 * abs(triangles.volume(vertices[closed])) / surface.area_mm2)


def _fits(size_mm: float, diameter_mm: float, widest_mm: float) -> bool:
    """Return whether extent and hydraulic diameter are those of an intracranial vessel."""
    return VESSEL_DIAMETER_MM[0] <= diameter_mm <= widest_mm and VESSEL_SIZE_MM[0] <= size_mm <= VESSEL_SIZE_MM[1]


def _guessed(size: float, diameter: float, path: Path) -> str:
    """Return the unit in which the size is most like that of an intracranial vessel."""
    usual, giant = (
        [unit for unit, mm in MM_PER.items() if _fits(size * mm, diameter * mm, widest_mm)]
        for widest_mm in (VESSEL_DIAMETER_MM[1], GIANT_DIAMETER_MM)
    )
    fitting = usual or giant
    if not fitting:
        raise UnitError(
            f"{path.name} has the size of a brain vessel in no unit: its extent is {size:.4g}, its hydraulic diameter "
            f"{diameter:.4g}, and vessels have {VESSEL_DIAMETER_MM[0]:g} to {GIANT_DIAMETER_MM:g} mm. Scale it to mm."
        )
    return min(fitting, key=lambda unit: abs(np.log(diameter * MM_PER[unit] / TYPICAL_DIAMETER_MM)))
