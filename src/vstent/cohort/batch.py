"""Run a cohort: one table row per case and treatment, also where a case fails.

Each row is written into the folder of its case as soon as it is known, under a key of everything it depends on: the
hash of the input, the settings and the version. A later run computes only the rows that are missing. The table is
collected from the rows.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, Protocol

from vstent.cohort.cases import Case
from vstent.cohort.work import LOST, Row, Task, picture_path, read_row, work, write_row
from vstent.io.tables import write_parquet, write_rows
from vstent.study.workers import AbstractWorkers

CASES: Final = "cases"
"""Subfolder of the output folder that holds one folder per case."""


class Progress(Protocol):
    """Called when a case has ended."""

    def __call__(self, done: int, total: int, name: str, rows: Sequence[Row]) -> None:
        """Report that `done` of `total` cases have ended; the last one is called `name` and has these rows."""


def left_to_do(cases: Sequence[Case], out: Path, *, keeps_files: bool = False) -> list[Task]:
    """Return the work that is missing: cases with those treatments whose row is missing or whose process died.

    Parameters
    ----------
    cases : cases of the cohort.
    out : output folder of the cohort.
    keeps_files : whether all files of every study are kept.
    """
    tasks = []
    for case in cases:
        folder, keys = _folder(case, out), case.keys
        rows = {treatment: read_row(folder, treatment, key) for treatment, key in keys.items()}
        missing = {name for name, row in rows.items() if row is None or row["outcome"] == LOST}
        if missing:
            treatments = tuple(one for one in case.settings.treatments if one.name in missing)
            shorter = replace(case, settings=replace(case.settings, treatments=treatments))
            tasks.append(Task(shorter, folder, {one.name: keys[one.name] for one in treatments}, keeps_files))
    return tasks


def run_cohort(tasks: Sequence[Task], out: Path, workers: AbstractWorkers, progress: Progress) -> None:
    """Run tasks in parallel; a case whose process died gets rows that state it.

    Parameters
    ----------
    tasks : tasks from `left_to_do`.
    out : output folder of the cohort.
    workers : processes or cluster that runs the tasks.
    progress : called when a case has ended.

    Raises
    ------
    InputError
        The processes or the cluster cannot be started.
    VstentError
        The connection to the cluster is lost; finished rows are kept.
    """
    for done, ended in enumerate(workers.do(work, tasks), start=1):
        task = tasks[ended.number]
        for treatment, key in task.keys.items():
            if read_row(task.folder, treatment, key) is None:
                write_row(task, treatment, {"outcome": LOST, "stage": "", "sentence": ended.fault})
        progress(done, len(tasks), task.case.name, collect([task.case], out))


def collect(cases: Sequence[Case], out: Path) -> list[Row]:
    """Return the rows that exist, in the order of cases and treatments.

    Parameters
    ----------
    cases : cases of the cohort.
    out : output folder of the cohort.
    """
    rows = [read_row(_folder(case, out), treatment, key) for case in cases for treatment, key in case.keys.items()]
    return [row for row in rows if row is not None]


def pictures_of(rows: Sequence[Row], out: Path) -> dict[tuple[str, str], bytes]:
    """Return the pictures that exist of cases with treatments, as WebP by name of case and treatment.

    Parameters
    ----------
    rows : rows of the cohort table.
    out : output folder of the cohort.
    """
    paths = {(row["case"], row["treatment"]): picture_path(out / CASES / row["case"], row["treatment"]) for row in rows}
    return {key: path.read_bytes() for key, path in paths.items() if path.is_file()}


def write_table(out: Path, rows: Sequence[Row]) -> list[Path]:
    """Write ``cohort.csv`` and, where pyarrow is installed, ``cohort.parquet``; return the paths written."""
    write_rows(out / "cohort.csv", rows)
    is_written = write_parquet(out / "cohort.parquet", rows)
    return [out / "cohort.csv", *([out / "cohort.parquet"] if is_written else [])]


def _folder(case: Case, out: Path) -> Path:
    """Return the folder of a case in the output folder `out`."""
    return out / CASES / case.name
