"""Run a cohort: many cases with several devices, one table row for each pair, even where a case fails.

Every row is written into the folder of its case as soon as it is known, under a key of everything that it depends on
(hash of the input, settings, version). After an interruption the next run computes only the missing rows. The table is
assembled from the rows.
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
"""Name of the folder that contains the folders of the cases."""


class Progress(Protocol):
    """Function that is called when a case has ended."""

    def __call__(self, done: int, total: int, name: str, rows: Sequence[Row]) -> None:
        """Report the end of a case.

        Parameters
        ----------
        done, total : number of cases that have ended, and of all.
        name : name of the case that has just ended.
        rows : its rows of the table.
        """


def left_to_do(cases: Sequence[Case], out: Path, *, keeps_files: bool = False) -> list[Task]:
    """Return the missing tasks: cases with the devices whose rows do not exist, or whose process died.

    Parameters
    ----------
    cases : all cases of the cohort.
    out : folder of the cohort.
    keeps_files : whether to keep the case folder of every case.
    """
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
    """Run the tasks; a case whose process died gets rows with the outcome ``lost``.

    Parameters
    ----------
    tasks : the tasks, see `left_to_do`.
    out : folder of the cohort.
    crew : the processes or workers that run the tasks.
    progress : called when a case has ended.


    Raises
    ------
    InputError
        The crew cannot start.
    VstentError
        The crew itself is lost; finished cases are kept.
    """
    for done, ended in enumerate(crew.do(tasks), start=1):
        task = tasks[ended.number]
        for device, key in task.keys.items():
            if read_row(task.folder, device, key) is None:
                write_row(task, device, {"outcome": LOST, "stage": "", "sentence": ended.fault})
        progress(done, len(tasks), task.case.name, collect([task.case], out))


def collect(cases: Sequence[Case], out: Path) -> list[Row]:
    """Return the existing rows, in the order of cases and devices."""
    rows = [read_row(_folder(case, out), device, key) for case in cases for device, key in case.keys.items()]
    return [row for row in rows if row is not None]


def write_table(out: Path, rows: Sequence[Row]) -> list[Path]:
    """Write ``cohort.csv`` and, where pyarrow is installed, ``cohort.parquet``; return the paths written."""
    write_rows(out / "cohort.csv", rows)
    is_written = write_parquet(out / "cohort.parquet", rows)
    return [out / "cohort.csv", *([out / "cohort.parquet"] if is_written else [])]


def _folder(case: Case, out: Path) -> Path:
    """Return the folder of a case."""
    return out / CASES / case.name
