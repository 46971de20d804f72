"""Read the cases of a cohort from a folder or a CSV file."""

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final, TypeVar

from vstent.devices.catalogue import find_design
from vstent.devices.treatment import Treatment, with_device
from vstent.errors import InputError, ReadError
from vstent.io.files import IMAGE_SUFFIXES, SURFACE_SUFFIXES, suffix
from vstent.io.tables import finite
from vstent.study.keys import hash_of, measures_key, refuse_missing, study_keys
from vstent.study.types import Settings
from vstent.units import MM_PER

Number = TypeVar("Number", int, float)


@dataclass(frozen=True, eq=False)
class Case:
    """One patient of a cohort."""

    name: str
    """Name of the case in the table, and of its folder."""
    path: Path
    """Scan or surface."""
    settings: Settings
    """Settings of the study, with the treatments to compare."""

    @cached_property
    def keys(self) -> dict[str, str]:
        """Key of the row of every treatment; it covers everything that the row depends on."""
        source, keys = hash_of(self.path), {}
        for treatment in self.settings.treatments:
            alone = replace(self.settings, treatments=(treatment,))
            keys[treatment.name] = str(measures_key(alone, study_keys(source, alone), {}))
        return keys


def find_cases(cohort: Path, settings: Settings) -> tuple[Case, ...]:
    """Return the cases of a folder (every scan or surface in it) or of a CSV file.

    Parameters
    ----------
    cohort : a folder, or a CSV file with column titles. Column ``input`` holds paths relative to the folder of the
        file, ``case`` holds names (default: the file name), ``devices`` holds names separated by spaces. The other
        columns are settings: ``units``, ``threshold``, ``at``, ``inlet`` (one point, or several separated by
        semicolons), ``outlet``, ``spacing``, ``shape``, ``diameter``, ``length``, ``center``. An empty cell takes the
        value of `settings`.
    settings : settings for every case.

    Raises
    ------
    ReadError
        The folder or file does not exist, or holds no case.
    InputError
        A row of the file cannot be used, or two cases have the same name.
    """
    refuse_missing(cohort)
    cases = _in_folder(cohort, settings) if cohort.is_dir() else _in_file(cohort, settings)
    if not cases:
        raise ReadError(f"{cohort} holds no cases: give a folder of scans or surfaces, or a CSV file of their paths")
    names = [case.name for case in cases]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(
            f"{cohort} has two cases called {twice[0]}: give them names in the column `case` of a CSV file"
        )
    for device in {device for case in cases for device in case.settings.devices}:
        find_design(device)
    return tuple(cases)


def _in_folder(folder: Path, settings: Settings) -> list[Case]:
    """Return a case for every scan or surface of a folder, in the order of their names."""
    shown = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    return [Case(_name(path), path, settings) for path in shown if _is_case(path)]


def _is_case(path: Path) -> bool:
    """Return whether a path is a scan or a surface."""
    if path.is_dir():
        return any(file.is_file() for file in path.iterdir())  # files of a DICOM series need no suffix
    return suffix(path) in (*SURFACE_SUFFIXES, *IMAGE_SUFFIXES)


def _name(path: Path) -> str:
    """Return the name of a case: its file name without the suffix."""
    return path.name if path.is_dir() else path.name[: len(path.name) - len(suffix(path))] or path.name


def _in_file(path: Path, settings: Settings) -> list[Case]:
    """Return a case for every row of a CSV file."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = list(csv.DictReader(file))
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(
            f"{path} cannot be read as a CSV file: {error}. Save it as UTF-8 with column titles."
        ) from error
    return [_case(path, number, row, settings) for number, row in enumerate(rows, start=2)]


def _case(file: Path, line: int, row: dict[str, Any], settings: Settings) -> Case:
    """Return the case of one row of a CSV file; `line` is its line number for messages."""
    given = {str(key).strip(): value.strip() for key, value in row.items() if isinstance(value, str) and value.strip()}
    where = f"line {line} of {file}"
    unknown = sorted(set(given) - {"case", "input", *COLUMNS})
    if unknown:
        raise InputError(
            f"{where} has an unknown column {unknown[0]!r}: the columns are case, input, {', '.join(COLUMNS)}"
        )
    if "input" not in given:
        raise InputError(f"{where} has no input: fill in its column `input`")
    path = file.parent / given["input"]
    found: dict[str, dict[str, Any]] = {"input": {}, "anatomy": {}, "treatments": {}}
    for title in set(given) & set(COLUMNS):
        section, name, read = COLUMNS[title]
        try:
            found[section][name] = read(given[title])
        except ValueError as error:
            raise InputError(f"{where}: {title} is {given[title]!r}, which cannot be used: {error}") from error
    name = given.get("case", _name(path))
    if Path(name).name != name:
        raise InputError(f"{where} names its case {name!r}: give a name without slashes")
    try:
        changed = replace(
            settings,
            input=replace(settings.input, **found["input"]),
            anatomy=replace(settings.anatomy, **found["anatomy"]),
            treatments=_treatments(settings.treatments, **found["treatments"]),
        )
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    return Case(name, path, changed)


def _treatments(
    usual: tuple[Treatment, ...], *, devices: Sequence[str] | None = None, **size: float
) -> tuple[Treatment, ...]:
    """Return the treatments with the devices of a row, or the usual ones, each with the size and place of the row."""
    if devices is None and not size:
        return usual
    return tuple(with_device(name, **size) for name in devices or [name for one in usual for name in one.devices])


def _size(text: str) -> float:
    """Return a finite number above zero read from text."""
    return _above_zero(finite(text))


def _count(text: str) -> int:
    """Return a whole number above zero read from text."""
    return _above_zero(int(text))


def _above_zero(value: Number) -> Number:
    """Return a value above zero; ValueError is raised for others."""
    if value <= 0:
        raise ValueError("it must be above zero")
    return value


def _units(text: str) -> str:
    """Return a length unit read from text."""
    if text not in MM_PER:
        raise ValueError(f"give one of {', '.join(MM_PER)}")
    return text


def _words(text: str) -> list[str]:
    """Return the words of a text separated by spaces, commas or semicolons."""
    return text.replace(",", " ").replace(";", " ").split()


def _three(kind: Callable[[str], Any]) -> Callable[[str], tuple[Any, ...]]:
    """Return a reader of three values of one kind."""

    def read(text: str) -> tuple[Any, ...]:
        values = tuple(kind(word) for word in _words(text))
        if len(values) != 3:
            raise ValueError("three numbers are needed")
        return values

    return read


def _points(text: str) -> tuple[tuple[float, ...], ...]:
    """Return points read from text, three numbers each."""
    values = [finite(word) for word in _words(text)]
    if len(values) % 3:
        raise ValueError("three numbers are needed for every point")
    return tuple(tuple(values[k : k + 3]) for k in range(0, len(values), 3))


COLUMNS: Final[dict[str, tuple[str, str, Callable[[str], Any]]]] = {
    "devices": ("treatments", "devices", _words),
    "units": ("input", "units", _units),
    "threshold": ("input", "threshold", finite),
    "at": ("anatomy", "at_mm", _three(finite)),
    "inlet": ("anatomy", "inlet_mm", _points),
    "outlet": ("anatomy", "outlet_mm", _three(finite)),
    "spacing": ("input", "spacing_mm", _three(_size)),
    "shape": ("input", "shape", _three(_count)),
    "diameter": ("treatments", "diameter_mm", _size),
    "length": ("treatments", "length_mm", _size),
    "center": ("treatments", "center_mm", finite),
}
"""Columns of a CSV file: the section of the settings and the setting that each sets, and the function that reads it."""


def row_count(cases: Sequence[Case]) -> int:
    """Return the number of rows of the cohort's table."""
    return sum(len(case.settings.treatments) for case in cases)
