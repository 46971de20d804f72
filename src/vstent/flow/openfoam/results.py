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
    """Read an ASCII field of a case, joined over the folders of its processes if it is decomposed."""
    parts = sorted(folder.glob("processor[0-9]*"), key=lambda part: int(part.name[9:])) or [folder]
    fields = [_parsed(part / time / name) for part in parts]
    return VolumeField(
        np.concatenate([field.inside for field in fields]),
        _joined([field.patches for field in fields]),
        _joined([field.references for field in fields]),
    )


def _joined(parts: list[dict[str, Floats]]) -> dict[str, Floats]:
    """Return the values of all processes by patch; empty parts are skipped because their width is unknown."""
    joined = {}
    for name in {name for part in parts for name in part}:
        values = [part[name] for part in parts if name in part]
        joined[name] = np.concatenate([part for part in values if len(part)] or values[:1])
    return joined


def _parsed(path: Path) -> VolumeField:
    """Return a field read from one file."""
    try:
        text = path.read_text(encoding="utf-8")
        inside, _, boundary = text.partition("boundaryField")
        fields = [
            {
                name: _values(body[match.end() :])
                for name, body in _PATCH.findall(boundary)
                if (match := entry.search(body))
            }
            for entry in (_ENTRY, _REFERENCE)
        ]
        return VolumeField(_values(inside[inside.index("internalField") :]), *fields)
    except (OSError, ValueError) as error:
        raise ReadError(
            f"OpenFOAM's field {path} is missing or damaged ({error}): delete its case folder and compute again"
        ) from error


def _values(text: str) -> Floats:
    """Return the values (n, d) of the first entry in a text; ``uniform v`` gives one row."""
    listed, uniform = _LIST.search(text), _UNIFORM.search(text)
    if listed is None or (uniform is not None and uniform.start() + 3 < listed.start()):
        if uniform is None:
            raise ValueError("an entry without a value")
        return _numbers(uniform[1])[None]
    count, bracket = int(listed[2]), listed[3]
    end = re.compile(r"\)\s*;" if bracket == "(" else r"\}\s*;").search(text, listed.end() - 1)
    if end is None:
        raise ValueError("a list without an end")
    numbers = _numbers(text[listed.end() : end.start()])
    if bracket == "{":
        return np.tile(numbers, (count, 1))
    width = 3 if listed[1] == "vector" else 1
    if len(numbers) != count * width:
        raise ValueError(f"a list of {count} entries with {len(numbers)} numbers")
    return numbers.reshape(count, width)


def _numbers(text: str) -> Floats:
    """Return all numbers in a text of lists."""
    return np.array(text.translate(str.maketrans("()", "  ")).split(), dtype=np.float64)


def times(folder: Path) -> list[str]:
    """Return the names of the times written, in order and without 0; of a decomposed case those of its first part."""
    place = folder / "processor0" if (folder / "processor0").is_dir() else folder
    names = [entry.parent.name for entry in place.glob("*/U") if re.fullmatch(r"[0-9.e+-]+", entry.parent.name)]
    return sorted((name for name in names if float(name) > 0), key=float)
