"""Read and write tables: CSV and Parquet."""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from vstent.errors import ReadError
from vstent.io.files import atomic, existing
from vstent.io.writers import SIGNIFICANT_DIGITS, write_text
from vstent.kernels.arrays import Floats


def read_columns(path: Path, *counts: int) -> Floats:
    """Return the numbers (n, c) of a CSV file with commas, semicolons or tabs; c is one of `counts`.

    Lines above the first number are titles. ReadError is raised where the file is missing, or a line does not hold
    c finite numbers.
    """
    count = " or ".join(map(str, counts))
    rows: list[list[float]] = []
    for number, line in enumerate(existing(path).read_text("utf-8-sig", "replace").splitlines(), start=1):
        words = [word for word in line.replace(";", ",").replace("\t", ",").split(",") if word.strip()]
        values = [value for word in words if math.isfinite(value := _number(word))]
        if not words or (not rows and not values):
            continue
        if len(values) != len(words) or len(values) not in (counts if not rows else (len(rows[0]),)):
            raise ReadError(
                f"line {number} of {path} is {line[:60]!r}: give {count} finite numbers, with decimal points, "
                "separated by commas"
            )
        rows.append(values)
    if not rows:
        raise ReadError(f"{path} holds no numbers: give {count} columns, separated by commas")
    return np.array(rows)


def _number(word: str) -> float:
    """Return a number read from text; NaN where it is none."""
    with suppress(ValueError):
        return float(word)
    return math.nan


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows of named values as CSV, with one column per name in the order of first use.

    Missing values are empty, floats have seven digits, and booleans are ``true`` and ``false``.
    """

    def plain(value: Any) -> Any:
        """Return a value as it is written."""
        if isinstance(value, bool | np.bool_):
            return "true" if value else "false"
        return f"{value:.{SIGNIFICANT_DIGITS}g}" if isinstance(value, float) else value

    names = columns_of(rows)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    writer.writerows([plain(row.get(name)) for name in names] for row in rows)
    write_text(path, text.getvalue())


def columns_of(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the names of all columns, in the order of first use."""
    return list(dict.fromkeys(name for row in rows for name in row))


def write_parquet(path: Path, rows: Sequence[Mapping[str, Any]]) -> bool:
    """Write rows of named values as Parquet; return False where pyarrow is not installed, and write nothing then."""
    try:
        from pyarrow import parquet, table
    except ImportError:
        return False
    with atomic(path) as partial:
        parquet.write_table(table({name: [row.get(name) for row in rows] for name in columns_of(rows)}), partial)
    return True
