"""Cohort: many patients, many devices: one row each in one table, whatever happens to whom.

Every row is written into its case's folder as soon as it is known, under a key of all that it depends on (the input's
hash, the settings, this version). Whoever dies, the next run does what is missing and nothing else; the table is made
from the rows.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, Protocol

from vstent.cohort.cases import Case
from vstent.cohort.crews import AbstractCrew
from vstent.cohort.work import LOST, Row, Task, read_row, write_row
from vstent.io.tables import write_parquet, write_rows

CASES: Final = "cases"
"""Folder that holds a folder for every case."""


class Progress(Protocol):
    """Told when a case has ended."""

    def __call__(self, done: int, total: int, name: str, rows: Sequence[Row]) -> None:
        """`done` of `total` cases have ended, the last is called `name` and has these rows."""


def left_to_do(cases: Sequence[Case], out: Path, *, keeps_files: bool = False) -> list[Task]:
    """Return what is missing: the cases with the devices whose rows are not there, or were lost."""
    tasks = []
    for case in cases:
        folder, keys = _folder(case, out), case.keys
        rows = {device: read_row(folder, device, key) for device, key in keys.items()}
        missing = tuple(device for device, row in rows.items() if row is None or row["outcome"] == LOST)
        if missing:
            shorter = replace(case, settings=replace(case.settings, devices=missing))
            tasks.append(Task(shorter, folder, {device: keys[device] for device in missing}, keeps_files))
    return tasks


def run_cohort(tasks: Sequence[Task], out: Path, crew: AbstractCrew, progress: Progress) -> None:
    """Let a crew do the tasks; a case whose process died gets rows that say so.

    Raises
    ------
    InputError
        When the crew cannot begin.
    VstentError
        When the crew itself is lost; what was finished is kept.
    """
    for done, ended in enumerate(crew.do(tasks), start=1):
        task = tasks[ended.number]
        for device, key in task.keys.items():
            if read_row(task.folder, device, key) is None:
                write_row(task, device, {"outcome": LOST, "stage": "", "sentence": ended.fault})
        progress(done, len(tasks), task.case.name, collect([task.case], out))


def collect(cases: Sequence[Case], out: Path) -> list[Row]:
    """Return the rows that are there, in the order of cases and devices."""
    rows = [read_row(_folder(case, out), device, key) for case in cases for device, key in case.keys.items()]
    return [row for row in rows if row is not None]


def write_table(out: Path, rows: Sequence[Row]) -> list[Path]:
    """Write ``cohort.csv`` and, where pyarrow is installed, ``cohort.parquet``; return what was written."""
    write_rows(out / "cohort.csv", rows)
    is_written = write_parquet(out / "cohort.parquet", rows)
    return [out / "cohort.csv", *([out / "cohort.parquet"] if is_written else [])]


def _folder(case: Case, out: Path) -> Path:
    return out / CASES / case.name
