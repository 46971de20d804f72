"""Surface files -> Surface in mm."""

import os
from pathlib import Path
from typing import Final, Literal, get_args

import numpy as np

from vstent.errors import ReadError, UnitError
from vstent.geometry.surface import Surface
from vstent.io.files import SURFACE_SUFFIXES, existing, suffix
from vstent.io.vtk_child import read_apart
from vstent.kernels import topology, triangles
from vstent.units import MM_PER

Unit = Literal["m", "cm", "mm"]

VESSEL_DIAMETER_MM: Final = (0.8, 14.0)
"""Hydraulic diameters 4 V / A of intracranial vessel trees, sacs included, by which a unit is guessed."""
GIANT_DIAMETER_MM: Final = 25.0
"""That of an artery 4 mm wide with a giant sac of 36 mm: 4 V / A of a sphere is two thirds of its diameter."""
TYPICAL_DIAMETER_MM: Final = 3.5
VESSEL_SIZE_MM: Final = (5.0, 400.0)
"""Diagonals of their bounding boxes."""


def read_surface(path: Path, *, units: Unit | None = None) -> tuple[Surface, tuple[str, ...]]:
    """Read the wall of a vessel from an STL, VTP, VTK, OBJ or PLY file.

    Parameters
    ----------
    path : the file; polygons of more than three corners are triangulated.
    units : the unit of its coordinates; guessed from the vessel's size, and said in a note, where not given.

    Returns
    -------
    surface : the mesh in mm exactly as it is in the file, faults included (see `vstent.repair`).
    notes : what was assumed.

    Raises
    ------
    ReadError
        The file is missing, damaged, empty, or not what its name says.
    UnitError
        In the given unit, or in any, no intracranial vessel has this size.
    """
    path = existing(path)
    surface = _checked(_read(path), path)
    if units is not None and units not in get_args(Unit):
        raise UnitError(f"Unit {units} is not known: give m, cm or mm.")
    size, diameter = _diagonal(surface), hydraulic_diameter(surface)
    unit = _guessed(size, diameter, path) if units is None else _accepted(units, size, diameter, path)
    note = (
        ""
        if units is not None
        else (
            f"Unit guessed: {unit} (hydraulic diameter 4 V / A = {diameter * MM_PER[unit]:.2f} mm, "
            f"extent {size * MM_PER[unit]:.0f} mm); --units overrules."
        )
    )
    return Surface(surface.vertices_mm * MM_PER[unit], surface.faces), (note,) if note else ()


def _read(path: Path) -> Surface:
    kind = suffix(path)
    if kind not in SURFACE_SUFFIXES:
        raise ReadError(f"{path.name} is not a surface file: give one of {', '.join(SURFACE_SUFFIXES)}.")
    if path.is_dir() or path.stat().st_size == 0:
        raise ReadError(f"{path.name} is {'a folder' if path.is_dir() else 'empty'}, not a surface file.")
    _refuse_mislabelled(path, kind)
    mesh = None if kind == ".stl" and _is_torn_text(path) else read_apart(path)
    if mesh is None or len(mesh[1]) == 0:
        raise ReadError(
            f"{path.name} holds no triangles, or not all that it announces: it is empty, damaged or not a {kind} file; "
            "copy it again or export it anew."
        )
    return Surface(*mesh)


TAIL_BYTES: Final = 4096
"""So near its end an STL file in text has its last line."""
_BEGINS: Final = {".vtp": (b"<",), ".vtk": (b"# vtk",), ".ply": (b"ply",)}


def _refuse_mislabelled(path: Path, kind: str) -> None:
    """Look at the first bytes: readers that meet another format can take long or worse before they give up."""
    with path.open("rb") as file:
        head = file.read(512)
    wrong = kind in _BEGINS and not head.lstrip(b"\xef\xbb\xbf \r\n\t").lower().startswith(_BEGINS[kind])
    if kind == ".stl":
        wrong = not (_is_ascii_stl(head) or _is_binary_stl(path, head))
    if kind == ".stl" and wrong and not head.lstrip().lower().startswith(b"solid") and len(head) >= 84:
        raise ReadError(
            f"{path.name} breaks off, or is not a .stl file: its header announces {_n_stl(head)} triangles and there "
            f"is room for {(path.stat().st_size - 84) // 50}; copy it again."
        )
    if wrong:
        raise ReadError(
            f"{path.name} is not a {kind} file, whatever its name says: it begins with {head[:16]!r}; export it again."
        )


def _is_ascii_stl(head: bytes) -> bool:
    return head.lstrip().lower().startswith(b"solid") and (b"facet" in head.lower() or len(head) == 512)


def _is_binary_stl(path: Path, head: bytes) -> bool:
    return len(head) >= 84 and path.stat().st_size >= 84 + 50 * _n_stl(head)


def _is_torn_text(path: Path) -> bool:
    """Whether an STL file in text lacks its end: VTK reads one torn file in fifty as if it were binary."""
    with path.open("rb") as file:
        head = file.read(512)
        file.seek(-min(TAIL_BYTES, path.stat().st_size), os.SEEK_END)
        tail = file.read().lower()
    return _is_ascii_stl(head) and not _is_binary_stl(path, head) and b"endsolid" not in tail


def _n_stl(head: bytes) -> int:
    """Triangles that a binary STL file announces."""
    return int.from_bytes(head[80:84], "little")


def _checked(surface: Surface, path: Path) -> Surface:
    if len(surface.faces) < 4:
        raise ReadError(
            f"{path.name} holds {len(surface.faces)} triangles, which is no vessel; give the wall of the vessel."
        )
    bad = ~np.isfinite(surface.vertices_mm).all(axis=1)
    if bad.any():
        raise ReadError(
            f"{path.name} has {bad.sum()} vertices that are not numbers (first: vertex {bad.argmax()}); repair it."
        )
    if not surface.areas_mm2.sum() > 0 or not np.isfinite(_diagonal(surface)):
        raise ReadError(f"{path.name} has no area: all of its triangles are lines or points; export it again.")
    return surface


def _diagonal(surface: Surface) -> float:
    used = surface.vertices_mm[np.unique(surface.faces)]
    return float(np.linalg.norm(np.ptp(used, axis=0)))


def hydraulic_diameter(surface: Surface) -> float:
    """Return 4 V / A of the capped surface in its own unit: the diameter, if it were one long tube."""
    kept, same = topology.first_equals(surface.vertices_mm)
    welded = same[surface.faces].astype(np.int32)
    faces, _ = topology.oriented(welded[topology.sound_faces(welded)])
    points = surface.vertices_mm[kept]
    vertices, closed = triangles.cap(points, faces, triangles.boundary_loops(points, faces))
    return float(4 * abs(triangles.volume(vertices[closed])) / surface.area_mm2)


def _fits(size_mm: float, diameter_mm: float, widest_mm: float) -> bool:
    return VESSEL_DIAMETER_MM[0] <= diameter_mm <= widest_mm and VESSEL_SIZE_MM[0] <= size_mm <= VESSEL_SIZE_MM[1]


def _guessed(size: float, diameter: float, path: Path) -> str:
    usual, giant = (
        [unit for unit, mm in MM_PER.items() if _fits(size * mm, diameter * mm, widest_mm)]
        for widest_mm in (VESSEL_DIAMETER_MM[1], GIANT_DIAMETER_MM)
    )
    fitting = usual or giant
    if not fitting:
        raise UnitError(
            f"{path.name} fits no unit: its extent is {size:.4g} and its mean diameter {diameter:.4g}, but vessels "
            f"of the brain are {VESSEL_DIAMETER_MM[0]:g} to {GIANT_DIAMETER_MM:g} mm wide; scale it to mm."
        )
    return min(fitting, key=lambda unit: abs(np.log(diameter * MM_PER[unit] / TYPICAL_DIAMETER_MM)))


def _accepted(unit: str, size: float, diameter: float, path: Path) -> str:
    if not _fits(size * MM_PER[unit], diameter * MM_PER[unit], GIANT_DIAMETER_MM):
        raise UnitError(
            f"{path.name} read in {unit} would be {size * MM_PER[unit]:.4g} mm long with a mean diameter of "
            f"{diameter * MM_PER[unit]:.4g} mm, which no vessel of the brain has; give another --units."
        )
    return unit
