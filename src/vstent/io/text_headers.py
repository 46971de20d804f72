"""Text headers of NRRD and MetaImage files: what ITK skips in them without a word, and the files that they name."""

import glob
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from vstent.errors import ReadError, UnitError
from vstent.io.files import beside, suffix

NRRD_SUFFIXES: Final = (".nrrd", ".nhdr")
"""Suffixes of NRRD files."""
META_SUFFIXES: Final = (".mha", ".mhd")
"""Suffixes of MetaImage files."""
HEAD_BYTES: Final = 1 << 20
"""Number of bytes in which a header ends; 3D Slicer writes about 1 kB for every segment."""
MM_PER_WORD: Final = {
    **dict.fromkeys(("", "?", "mm", "millimeter", "millimeters", "millimetre", "millimetres"), 1.0),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetre", "centimetres"), 10.0),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1e3),
    **dict.fromkeys(("um", "µm", "μm", "micron", "microns", "micrometer", "micrometers", "micrometre"), 1e-3),
}
"""Length in mm of the units that headers name; without a name it is mm."""
_META_GEOMETRY: Final = {
    key.lower(): key
    for key in (
        *("ElementSpacing", "ElementSize", "Offset", "Position", "Origin", "TransformMatrix", "Rotation"),
        *("Orientation", "DistanceUnits"),
    )
}
"""Keys of a MetaImage header that place the voxels, by their small letters; ITK skips other spellings."""


_ENDS: Final = {
    **dict.fromkeys(NRRD_SUFFIXES, re.compile(rb"\r?\n\r?\n")),
    **dict.fromkeys(META_SUFFIXES, re.compile(rb"^[ \t]*ElementDataFile", re.I | re.M)),
}
"""What follows the fields of a header; the header of detached voxels of a NRRD file ends with the file."""


def fields_of(path: Path) -> dict[str, str]:
    """Return the fields of a header; the names of NRRD fields are in small letters and without spaces.

    ReadError is raised where it does not end, or where ITK skips a key of a MetaImage header, or a line and the next.
    """
    with path.open("rb") as file:
        parts = _ENDS[suffix(path)].split(file.read(HEAD_BYTES), maxsplit=1)
    if len(parts) < 2 and (suffix(path) in META_SUFFIXES or len(parts[0]) == HEAD_BYTES):
        raise ReadError(f"{path.name} is damaged: its header does not end. Copy or export it again.")
    lines = re.split(r"\r?\n", parts[0].decode("utf-8", "replace"))
    if suffix(path) in NRRD_SUFFIXES:
        pairs = [line.partition(":") for line in lines[1:] if not line.startswith("#") and ":=" not in line]
        return {key.strip().lower().replace(" ", ""): value.strip() for key, _, value in pairs}
    words = [re.split(r"\s*[=:]\s*", line.strip(), maxsplit=1) for line in lines if line.strip()]
    for k, (key, *value) in enumerate(words):
        usual = _META_GEOMETRY.get(key.lower(), key)
        if not value:
            raise ReadError(f"{path.name} is damaged: its header has the line {key[:40]!r}. Copy or export it again.")
        if key != usual:
            raise ReadError(f"{path.name} has a field {key[:40]!r}, which readers skip. Write {usual} in its header.")
        if key in _META_GEOMETRY.values() and any(key == other for other, *_ in words[:k]):
            raise ReadError(f"{path.name} states {key} twice. Keep the right one in its header.")
    return dict(words)


def states_spacing(path: Path, fields: dict[str, str]) -> bool:
    """Return whether a header states three spacings above zero; ITK assumes 1 mm where it does not."""
    if suffix(path) in META_SUFFIXES:
        return are_lengths(fields.get("ElementSpacing", fields.get("ElementSize", "")).split()[:3])
    if "spacedirections" in fields:
        vectors = re.findall(r"none|\([^)]*\)", fields["spacedirections"])
        whole = [vector for vector in vectors if vector != "none" and "nan" not in vector.lower()]
        return len(whole) >= 3
    lengths = fields.get("spacings", "").split()
    return are_lengths([length for length in lengths if len(lengths) == 3 or length.lower() != "nan"][:3])


_NUMBER: Final = re.compile(rb"\+?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
"""A positive number; `float` reads others too, such as 1_0, of which other libraries read a part only."""


def are_lengths(words: Sequence[str | bytes]) -> bool:
    """Return whether words are three finite numbers above zero, as every library reads them."""
    plain = [word if isinstance(word, bytes) else word.encode() for word in words]
    return len(plain) == 3 and all(_NUMBER.fullmatch(word) and 0 < float(word) < float("inf") for word in plain)


def holds_segments(path: Path) -> bool:
    """Return whether a file holds segments of 3D Slicer, which may overlap and then lie in several layers."""
    with path.open("rb") as file:
        return suffix(path) in NRRD_SUFFIXES and b"\nSegment0_" in file.read(HEAD_BYTES)


def mm_per_unit(path: Path, fields: dict[str, str]) -> list[float]:
    """Return the length in mm of the unit along each of three axes; UnitError is raised for unknown units."""
    stated = fields.get("DistanceUnits") or fields.get("spaceunits") or fields.get("units") or ""
    words = re.findall(r'"([^"]*)"', stated) if '"' in stated else stated.split()
    lengths = [MM_PER_WORD.get(word.strip().lower()) for word in words]
    if None in lengths:
        raise UnitError(f"{path.name} states lengths in {stated[:60]}, which is not known. Give --spacing in mm.")
    known = [length for length in lengths if length is not None][-3:] or [1.0]
    return known if len(known) == 3 else known[:1] * 3


# -- voxels in other files ---------------------------------------------------------------------------------------------

APART: Final = {
    **dict.fromkeys(META_SUFFIXES, re.compile(rb"^[ \t]*elementdatafile[ \t]*[=:]([^\0\r\n]{1,1000})", re.I | re.M)),
    **dict.fromkeys(NRRD_SUFFIXES, re.compile(rb"^data ?file:([^\0\r\n]{1,1000})", re.I | re.M)),
}
"""Pattern of the header line that names the voxel file: a name, a file pattern, or ``LIST`` and one file per line."""


def voxel_files(path: Path) -> list[Path]:
    """Return the voxel files that a header names, whether they exist or not; only those beside it are allowed."""
    kind = suffix(path)
    if kind not in APART:
        return []
    with path.open("rb") as file:
        line = APART[kind].search(head := file.read(HEAD_BYTES))
    if line is None:
        return []
    name = os.fsdecode(line[1].strip())
    if name.split()[:1] == ["LIST"]:
        return [beside(path, os.fsdecode(one.strip()), "voxel file") for one in head[line.end() :].splitlines()]
    if "%" in name:
        place = beside(path, name.split()[0], "voxel file")
        slices = re.sub(r"%\d*d", "[0-9]*", glob.escape(place.name))
        return [Path(one) for one in sorted(glob.glob(os.path.join(glob.escape(str(place.parent)), slices)))]
    return [] if name.upper() == "LOCAL" else [beside(path, name, "voxel file")]
