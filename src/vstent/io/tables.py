"""Read and write tables: CSV and Parquet."""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vstent.errors import ReadError
from vstent.io.files import atomic, existing
from vstent.io.writers import SIGNIFICANT_DIGITS, write_text
from vstent.kernels.arrays import Floats


def read_columns(path: Path, count: int) -> Floats:
    """Read a CSV file of numbers as an array; lines above the first number are titles.

    Parameters
    ----------
    path : the file; columns are separated by commas, semicolons or tabs.
    count : number of columns.

    Returns (n, count) numbers.

    Raises
    ------
    ReadError
        The file is missing, or a line does not hold `count` finite numbers.
    """
    lines = existing(path).read_text(encoding="utf-8-sig", errors="replace").splitlines()
    rows: list[list[float]] = []
    for number, line in enumerate(lines, start=1):
        words = [word for word in line.replace(";", ",").replace("\t", ",").split(",") if word.strip()]
        values = [_number(word) for word in words]
        is_title = not rows and all(value is None for value in values)
        if not values or is_title:
            continue
        if len(values) != count or None in values:
            raise ReadError(
                f"line {number} of {path} is {line[:60]!r}: give {count} finite numbers, with decimal points, "
                "separated by commas"
            )
        rows.append([float(value) for value in values if value is not None])
    if not rows:
        raise ReadError(f"{path} holds no numbers: give {count} columns, separated by commas")
    return np.array(rows)


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows of named values as CSV.

    There is one column per name in the order of first use. Missing values are empty, floats have seven digits, and
    booleans are ``true`` and ``false``.

    Parameters
    ----------
    path : the file.
    rows : values by column name.
    """
    names = columns_of(rows)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    writer.writerows([_plain(row.get(name)) for name in names] for row in rows)
    write_text(path, text.getvalue())


def columns_of(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the names of all columns, in the order of first use."""
    return list(dict.fromkeys(name for row in rows for name in row))


def write_parquet(path: Path, rows: Sequence[Mapping[str, Any]]) -> bool:
    """Write rows of named values as Parquet.

    Parameters
    ----------
    path : the file.
    rows : values by column name.

    Returns False where pyarrow is not installed; nothing is written then.
    """
    try:
        from pyarrow import parquet, table
    except ImportError:
        return False
    with atomic(path) as partial:
        parquet.write_table(table({name: [row.get(name) for row in rows] for name in columns_of(rows)}), partial)
    return True


def _plain(value: Any) -> Any:
    """Return a value as it is written to a CSV file."""
    if isinstance(value, bool | np.bool_):
        return "true" if value else "false"
    return f"{value:.{SIGNIFICANT_DIGITS}g}" if isinstance(value, float) else value


def _number(word: str) -> float | None:
    """Return a finite number read from text, or None."""
    try:
        value = float(word)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
