"""Read OpenFOAM's output: fields on cells and boundary faces, and the times written."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from vstent.errors import ReadError
from vstent.kernels.arrays import Floats

_LIST: Final = re.compile(r"nonuniform\s+(?:List<(\w+)>\s*)?(\d+)\s*([({])")
"""Matches the start of a list of values."""
_UNIFORM: Final = re.compile(r"uniform\s+(\([^)]*\)|[^\s;]+)\s*;")
"""Matches a uniform value."""
_PATCH: Final = re.compile(r"^ {4}(\w+)\n {4}\{\n(.*?)^ {4}\}", re.DOTALL | re.MULTILINE)
"""Matches the entry of a patch."""
_ENTRY: Final = re.compile(r"^ {8}value\s+", re.MULTILINE)
"""Matches the start of a patch's value."""
_REFERENCE: Final = re.compile(r"^ {8}refValue\n.*?^ {12}value\s+", re.DOTALL | re.MULTILINE)
"""Matches the start of a patch's reference value, which a factor multiplies."""


@dataclass(frozen=True, eq=False)
class VolumeField:
    """A field of OpenFOAM, joined over all processes."""

    inside: Floats
    """(n, d) values in the cells; (1, d) if uniform."""
    patches: dict[str, Floats]
    """(f, d) values on the faces of every patch that has them; (1, d) if uniform."""
    references: dict[str, Floats]
    """(f, d) reference values of the patches whose values are a multiple of them."""


def read_field(folder: Path, time: str, name: str) -> VolumeField:
    """Read an ASCII field of a case, joined over the folders of its processes if it is decomposed.

    Raises
    ------
    ReadError
        The field is missing or damaged.
    """
    parts = sorted(folder.glob("processor[0-9]*"), key=lambda part: int(part.name[9:])) or [folder]
    fields = [_parsed(part / time / name) for part in parts]
    return VolumeField(
        np.concatenate([field.inside for field in fields]),
        _by_patch([field.patches for field in fields]),
        _by_patch([field.references for field in fields]),
    )


def _by_patch(parts: list[dict[str, Floats]]) -> dict[str, Floats]:
    """Return the values of all processes by patch."""
    names = {name for part in parts for name in part}
    return {name: _joined([part[name] for part in parts if name in part]) for name in names}


def _joined(parts: list[Floats]) -> Floats:
    """Return the values of all processes joined; empty parts are skipped because their width is unknown."""
    return np.concatenate([part for part in parts if len(part)] or parts[:1])


def _parsed(path: Path) -> VolumeField:
    """Return a field read from one file."""
    try:
        text = path.read_text()
        inside, _, boundary = text.partition("boundaryField")
        values = _values(inside[inside.index("internalField") :])
        return VolumeField(values, _entries(boundary, _ENTRY), _entries(boundary, _REFERENCE))
    except (OSError, ValueError) as error:
        raise ReadError(
            f"OpenFOAM's field {path} is missing or damaged ({error}): delete its case folder and compute again"
        ) from error


def _entries(boundary: str, entry: re.Pattern[str]) -> dict[str, Floats]:
    """Return the values that follow an entry, for the patches that have it."""
    bodies = _PATCH.findall(boundary)
    return {name: _values(body[found.end() :]) for name, body in bodies if (found := entry.search(body))}


def _values(text: str) -> Floats:
    """Return the values (n, d) of the first entry in a text; ``uniform v`` gives one row."""
    listed, uniform = _LIST.search(text), _UNIFORM.search(text)
    if listed is None or (uniform is not None and uniform.start() + 3 < listed.start()):
        if uniform is None:
            raise ValueError("an entry without a value")
        return _numbers(uniform[1])[None]
    kind, count = listed[1], int(listed[2])
    end = re.compile(r"\)\s*;" if listed[3] == "(" else r"\}\s*;").search(text, listed.end() - 1)
    if end is None:
        raise ValueError("a list without an end")
    numbers = _numbers(text[listed.end() : end.start()])
    width = {"scalar": 1, "vector": 3, None: 1}[kind]
    if listed[3] == "{":
        return np.tile(numbers, (count, 1))
    if len(numbers) != count * width:
        raise ValueError(f"a list of {count} entries with {len(numbers)} numbers")
    return numbers.reshape(count, width)


def _numbers(text: str) -> Floats:
    """Return all numbers in a text of lists."""
    return np.array(text.translate(str.maketrans("()", "  ")).split(), dtype=np.float64)


def times(folder: Path) -> list[str]:
    """Return the names of the times written, in order and without 0.

    If the case is decomposed, they are those of the first process.
    """
    place = folder / "processor0" if (folder / "processor0").is_dir() else folder
    names = [entry.name for entry in place.iterdir() if entry.is_dir() and re.fullmatch(r"[0-9.e+-]+", entry.name)]
    return sorted((name for name in names if float(name) > 0 and (place / name / "U").exists()), key=float)
