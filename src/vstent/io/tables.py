"""Tables of numbers in text files."""

from pathlib import Path

import numpy as np

from vstent.errors import ReadError
from vstent.io.files import existing
from vstent.kernels.arrays import Floats


def read_columns(path: Path, count: int) -> Floats:
    """Read a CSV file of `count` columns of numbers (n, count); lines that do not begin with a number are titles.

    Raises
    ------
    ReadError
        The file is missing, or a line of numbers has not `count` of them.
    """
    lines = existing(path).read_text(encoding="utf-8-sig", errors="replace").splitlines()
    rows: list[list[float]] = []
    for number, line in enumerate(lines, start=1):
        words = [word for word in line.replace(";", ",").replace("\t", ",").split(",") if word.strip()]
        values = [_number(word) for word in words]
        if not values or values[0] is None:
            continue
        if len(values) != count or None in values:
            raise ReadError(f"line {number} of {path} is {line[:60]!r}: give {count} numbers, parted by commas")
        rows.append([float(value) for value in values if value is not None])
    if not rows:
        raise ReadError(f"{path} holds no numbers: give {count} columns, parted by commas")
    return np.array(rows)


def _number(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None
