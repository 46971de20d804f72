"""Measurements of a device on a bench, read from a CSV file."""

import csv
import difflib
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from vstent.devices.design import Design
from vstent.devices.ranges import MARGIN, numbers
from vstent.errors import InputError

LABEL: Final = ("label_diameter_mm", "label_length_mm")
"""Columns of the size on the box; every row has them."""
TUBE: Final = "tube_diameter_mm"
"""Column of the inner diameter of the tube or artery; empty where the device lies free."""
NOTE: Final = "source"
"""Column of who measured, or where it is published."""
OBSERVED: Final = {
    "length_mm": 0.2,
    "coverage_percent": 1.5,
    "pore_density_per_mm2": 1.0,
    "cell_length_mm": 0.05,
    "cell_width_mm": 0.05,
    "angle_deg": 1.5,
    "free_diameter_mm": 0.05,
}
"""Columns of measured quantities with their default standard error, in the unit of the column.

The errors are vstent's own: those of calipers on a soft braid, and of pictures with a scale.
"""
DIRECT_ERROR_UM: Final = 2.0
"""Default standard error of a measured wire diameter, strut width or thickness, in um."""
OF_MESH: Final = ("wire", "braid_angle", "n_columns", "strut", "cell_angle")
"""Beginnings of the names of the numbers of a mesh."""
TEMPLATE: Final = """\
label_diameter_mm,label_length_mm,tube_diameter_mm,length_mm,free_diameter_mm,angle_deg,wire_count,wire_diameter_um,source
4.0,20,,,4.27,,48,30,calipers and microscope
4.0,20,,16.8,,,,,free on the table
4.0,20,3.5,27.5,,,,,glass tube A
4.0,20,3.0,31.7,,,,,glass tube B
4.0,20,2.5,35.2,,,,,glass tube C
"""
"""Example of a file: a braid of 48 wires, free and in three tubes."""


@dataclass(frozen=True)
class Measurement:
    """One measured value."""

    row: int
    """Row of the file, counted from 1 with the header."""
    name: str
    """Column, a key of `OBSERVED` or a number of the catalogue that is measured directly."""
    value: float
    """Value, in the unit of the column."""
    error: float
    """Standard error, in the same unit; 0 for counts."""
    label_mm: tuple[float, float]
    """Label diameter and length of the specimen, in mm."""
    tube_mm: float | None
    """Inner diameter of the tube, in mm; None: free."""
    source: str
    """Who measured, or where it is published."""

    @property
    def where(self) -> str:
        """Row and column in words."""
        tube = "free" if self.tube_mm is None else f"in {self.tube_mm:g} mm"
        return f"row {self.row} ({self.name} {self.value:g}, {tube})"


def fitted_names(design: Design) -> tuple[str, ...]:
    """Return the numbers of a device that a fit concerns: mesh and free diameter, without further structures."""
    return tuple(name for name in numbers(design) if name.startswith(OF_MESH) or name == MARGIN)


def read_measurements(path: Path, design: Design) -> tuple[Measurement, ...]:
    """Read the measurements of a device of the same family, counts and widths as `design`, row after row.

    Every row of the CSV file has the columns `LABEL`, and any of the others; empty cells are left out. A column
    ``length_error_mm`` holds the standard error of ``length_mm``, and likewise for the other quantities. An InputError
    is raised where the file cannot be read, has an unknown column, or a cell is not a positive number.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file)
            header = [name.strip() for name in reader.fieldnames or ()]
            rows = [dict(zip(header, row.values(), strict=False)) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path} cannot be read as CSV text. Give the measurements as a CSV file.") from error
    direct = (name for name in fitted_names(design) if name != MARGIN and not name.endswith("_angle_rad"))
    errors = OBSERVED | {name: 0.0 if name.endswith(("count", "columns")) else DIRECT_ERROR_UM for name in direct}
    known = [*LABEL, TUBE, NOTE, *errors, *map(_error_column, errors)]
    for name in (name for name in LABEL if name not in header):
        raise InputError(f"{path} has no column {name}. `vstent devices fit --template` prints an example.")
    for name in (name for name in header if name not in known):
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"Did you mean {near[0]}?" if near else f"Columns are {', '.join(known)}."
        raise InputError(f"{path} has an unknown column {name}. {hint}")
    found = [one for number, row in enumerate(rows, start=2) for one in _of_row(path, number, row, errors)]
    if not found:
        raise InputError(f"{path} has no measured value. `vstent devices fit --template` prints an example.")
    return tuple(found)


def _error_column(name: str) -> str:
    """Return the column with the standard error of another column: ``length_error_mm`` for ``length_mm``."""
    return re.sub("(_per_mm2|_[a-z0-9]+)$", r"_error\1", name)


def _of_row(
    path: Path, number: int, row: Mapping[str, str | None], errors: Mapping[str, float]
) -> Iterator[Measurement]:
    """Yield the measurements of one row of the file; `errors` are the standard errors where it states none."""
    where = f"{path}, row {number}"
    values: dict[str, float] = {}
    for name, cell in row.items():
        if name != NOTE and (text := (cell or "").strip()):
            try:
                values[name] = float(text)
            except ValueError:
                values[name] = math.nan
            if not (math.isfinite(values[name]) and values[name] > 0):
                raise InputError(f"{where}: {name} is {text!r}. Give a positive number or leave it empty.")
    for name in (name for name in LABEL if values and name not in values):
        raise InputError(f"{where}: {name} is empty. Give the size on the box in every row.")
    for name in (name for name in errors if name in values):
        error = values.get(_error_column(name), errors[name])
        label_mm = values[LABEL[0]], values[LABEL[1]]
        yield Measurement(number, name, values[name], error, label_mm, values.get(TUBE), (row.get(NOTE) or "").strip())
