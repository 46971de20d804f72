"""Read the cases of a cohort from a folder or a CSV file."""

import csv
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from vstent.devices.catalogue import find_design
from vstent.errors import InputError, ReadError
from vstent.fields import flag
from vstent.flow.simulation import check_engine
from vstent.io.files import IMAGE_SUFFIXES, SURFACE_SUFFIXES, existing, suffix
from vstent.study.keys import hash_of, measures_key, study_keys
from vstent.study.settings import OPTIONS, Settings, settings_of
from vstent.study.store import Key


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
    def keys(self) -> dict[str, Key]:
        """Key of the row of every treatment; it covers everything that the row depends on."""
        source, keys = hash_of(self.path), {}
        for treatment in self.settings.treatments:
            alone = replace(self.settings, treatments=(treatment,))
            keys[treatment.name] = measures_key(alone, study_keys(source, alone), {})
        return keys


def find_cases(cohort: Path, given: Mapping[str, Any]) -> tuple[Case, ...]:
    """Return the cases of a folder (every scan or surface in it) or of a CSV file with column titles.

    Column ``input`` holds paths and ``case`` names (default: the file name); every option of the settings may be a
    column of its name. Paths are relative to the folder of the file. A flag is yes or no, and several values, such as
    devices or inlets, are separated by semicolons. An empty cell takes the value of `given`, options by name.

    Raises
    ------
    ReadError
        The folder or file does not exist, or holds no case.
    InputError
        A row of the file cannot be used, or two cases have the same name.
    """
    existing(cohort)
    if cohort.is_dir():
        settings = settings_of(given)
        shown = sorted(path for path in cohort.iterdir() if not path.name.startswith("."))
        cases = [Case(_name(path), path, settings) for path in shown if _is_case(path)]
    else:
        cases = _in_file(cohort, given)
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
    for flow in {case.settings.flow for case in cases}:
        check_engine(flow, runs_here=False)
    return tuple(cases)


def _is_case(path: Path) -> bool:
    """Return whether a path is a scan or a surface."""
    if path.is_dir():
        return any(file.is_file() for file in path.iterdir())  # files of a DICOM series need no suffix
    return suffix(path) in (*SURFACE_SUFFIXES, *IMAGE_SUFFIXES)


def _name(path: Path) -> str:
    """Return the name of a case: its file name without the suffix."""
    return path.name if path.is_dir() else path.name[: len(path.name) - len(suffix(path))] or path.name


def _in_file(path: Path, given: Mapping[str, Any]) -> list[Case]:
    """Return a case for every row of a CSV file."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = list(csv.DictReader(file))
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(
            f"{path} cannot be read as a CSV file: {error}. Save it as UTF-8 with column titles."
        ) from error
    return [_case(path, number, row, given) for number, row in enumerate(rows, start=2)]


def _case(file: Path, line: int, row: Mapping[str, Any], given: Mapping[str, Any]) -> Case:
    """Return the case of one row of a CSV file; `line` is its line number for messages."""
    cells = {str(key).strip(): value.strip() for key, value in row.items() if isinstance(value, str) and value.strip()}
    where = f"line {line} of {file}"
    unknown = sorted(set(cells) - set(COLUMNS))
    if unknown:
        raise InputError(f"{where} has an unknown column {unknown[0]!r}: the columns are {', '.join(COLUMNS)}")
    if "input" not in cells:
        raise InputError(f"{where} has no input: fill in its column `input`")
    path = file.parent / cells.pop("input")
    name = cells.pop("case", _name(path))
    if Path(name).name != name:
        raise InputError(f"{where} names its case {name!r}: give a name without slashes")
    values = dict(given)
    try:
        for title, text in cells.items():
            try:
                if title in OPPOSITES:
                    values |= {title: True, OPPOSITES[title]: None} if flag(text) else {}
                else:
                    values[title] = OPTIONS[title].cell(text, file.parent)
            except InputError as error:
                raise InputError(f"column {title}: {error}") from error
        return Case(name, path, settings_of(values))
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


OPPOSITES: Final = {option.off[0]: name for name, option in OPTIONS.items() if option.off[0]}
"""Options that switch another one off, and that one."""
COLUMNS: Final = ("case", "input", *OPTIONS, *OPPOSITES)
"""Columns of a CSV file."""
