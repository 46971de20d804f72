"""Run a cohort: one table row per case and treatment, also where a case fails.

Each row is stored in the folder of its case as soon as it is known, under a key of everything it depends on. A later
run computes only the rows that are missing. The table is collected from the rows.
"""

import shutil
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

from vstent.cohort.cases import Case
from vstent.devices.treatment import BARE
from vstent.errors import VstentError
from vstent.io.files import write_bytes
from vstent.io.tables import write_parquet, write_rows
from vstent.io.writers import write_text
from vstent.reporting.figures import patient_picture
from vstent.study.folder import CACHE
from vstent.study.pipeline import restore_vessel, run
from vstent.study.progress import OnProgress, Progress
from vstent.study.repeat import flat
from vstent.study.settings import Settings
from vstent.study.store import Key, Store
from vstent.study.workers import AbstractWorkers, alone
from vstent.units import BYTES_PER_MB

Row = dict[str, Any]
"""One case with one treatment: column name to value."""

CASES: Final = "cases"
"""Subfolder of the output folder that holds one folder per case."""
COST: Final = ("case_s", "case_cpu_s", "peak_memory_MB")
"""Columns on run time and memory; they describe the computer, so they differ between runs."""
DONE: Final = "done"
"""Outcome of a treatment that was deployed and measured."""
FAILED: Final = "failed"
"""Outcome where the input cannot be used or a flow cannot be computed; a repetition would give the same."""
LOST: Final = "lost"
"""Outcome where the process died; the next run repeats the case."""


OnCase = Callable[[int, int, str, Sequence[Row]], None]
"""Called when a case has ended, with the number of ended cases, that of all, and name and rows of this one."""


@dataclass(frozen=True, eq=False)
class Task:
    """Remaining work of one case."""

    case: Case
    """The case; its treatments are those whose rows are missing."""
    folder: Path
    """Folder in which its rows are stored."""
    keys: Mapping[str, Key]
    """Key of every missing row, by treatment."""
    keeps_files: bool
    """Whether all files of `vstent run` are kept, in subfolder ``study``."""


def left_to_do(cases: Sequence[Case], out: Path, *, keeps_files: bool = False) -> list[Task]:
    """Return the work that is missing in an output folder: cases with treatments without a row, or whose process died.

    All files of every study are kept where `keeps_files`.
    """
    tasks = []
    for case in cases:
        folder, keys = out / CASES / case.name, case.keys
        rows = read_rows(folder, keys)
        missing = {name for name in keys if rows.get(name, {}).get("outcome", LOST) == LOST}
        if missing:
            treatments = tuple(one for one in case.settings.treatments if one.name in missing)
            shorter = replace(case, settings=replace(case.settings, treatments=treatments))
            tasks.append(Task(shorter, folder, {one.name: keys[one.name] for one in treatments}, keeps_files))
    return tasks


def run_cohort(tasks: Sequence[Task], out: Path, workers: AbstractWorkers, progress: OnCase) -> None:
    """Run tasks of `left_to_do` in parallel; a case whose process died gets rows that state it.

    Errors are those of the workers; finished rows are kept.
    """
    for done, (number, fault) in enumerate(workers.do(work, tasks), start=1):
        task = tasks[number]
        for treatment in task.keys.keys() - read_rows(task.folder, task.keys).keys():
            _write_row(task, treatment, {"outcome": LOST, "stage": "", "sentence": fault})
        progress(done, len(tasks), task.case.name, collect([task.case], out))


def collect(cases: Sequence[Case], out: Path) -> list[Row]:
    """Return the rows that exist in an output folder, in the order of cases and treatments."""
    return [row for case in cases for row in read_rows(out / CASES / case.name, case.keys).values()]


def pictures_of(rows: Sequence[Row], out: Path) -> dict[tuple[str, str], bytes]:
    """Return the pictures that exist of cases with treatments, as WebP by name of case and treatment."""
    paths = {(row["case"], row["treatment"]): out / CASES / row["case"] / f"{row['treatment']}.webp" for row in rows}
    return {key: path.read_bytes() for key, path in paths.items() if path.is_file()}


def write_table(out: Path, rows: Sequence[Row]) -> list[Path]:
    """Write ``cohort.csv`` and, where pyarrow is installed, ``cohort.parquet``; return the paths written."""
    write_rows(out / "cohort.csv", rows)
    is_written = write_parquet(out / "cohort.parquet", rows)
    return [out / "cohort.csv", *([out / "cohort.parquet"] if is_written else [])]


def work(task: Task) -> None:
    """Run one case: deploy every missing treatment and write the rows.

    A treatment that does not fit, or an input that cannot be used, gives a row with its stage and error message.
    """
    case, study = task.case, task.folder / "study"
    with alone():
        began, cpu = time.perf_counter(), time.process_time()
        rows = _rows(task)
        done = tuple(one for one in case.settings.treatments if rows[one.name]["outcome"] == DONE)
        if task.keeps_files and done and len(rows) > 1:  # one study of all treatments, read from stored results
            run(case.path, study, replace(case.settings, treatments=done), replaces=True)
        if not task.keeps_files:
            shutil.rmtree(study, ignore_errors=True)
        spent = time.perf_counter() - began, time.process_time() - cpu, peak_memory_MB()
        for treatment, row in rows.items():
            _write_row(task, treatment, row | dict(zip(COST, spent, strict=True)))


def _rows(task: Task) -> dict[str, Row]:
    """Return the rows of a case by treatment; the artery is restored once, and failures are rows too."""
    case, study = task.case, task.folder / "study"
    treatments = case.settings.treatments
    failed = _failure(task, lambda progress: restore_vessel(case.path, study, case.settings, progress, replaces=True))
    if failed:
        return {treatment.name: failed for treatment in treatments}
    rows: dict[str, Row] = {}
    for treatment in treatments:
        name, settings = treatment.name, replace(case.settings, treatments=(treatment,))

        def with_treatment(progress: OnProgress, name: str = name, settings: Settings = settings) -> None:
            found = run(case.path, study, settings, progress, replaces=True)
            implants = list(found.implants[name].values())
            write_bytes(task.folder / f"{name}.webp", patient_picture(found.anatomy, implants).webp)
            advice = " ".join(one.advice for one in implants)
            rows[name] = {"outcome": DONE, "stage": "", "sentence": advice} | flat_metrics(found.metrics, name)

        failed = _failure(task, with_treatment)
        if failed:
            rows[name] = failed
    return rows


def _failure(task: Task, do: Callable[[OnProgress], object]) -> Row:
    """Call a function and return the row of its failure, with the stage that it reported; empty where it succeeds."""
    stage = "read"

    def told(now: Progress) -> None:
        nonlocal stage
        stage = now.stage

    try:
        do(told)
    except VstentError as error:
        return {"outcome": FAILED, "stage": stage, "sentence": str(error)}
    except Exception as error:  # noqa: BLE001 one failed case must not end the cohort; its row states the error
        write_text(task.folder / "traceback.txt", traceback.format_exc())
        sentence = f"unexpected error, {type(error).__name__}: {error}. Please report it with traceback.txt."
        return {"outcome": FAILED, "stage": stage, "sentence": sentence}
    return {}


def flat_metrics(metrics: Mapping[str, Any], treatment: str) -> Row:
    """Return all metrics of a study that concern one treatment, under dotted keys.

    Measures of the implant of a treatment with one begin with ``implant``, those of several with ``implants.ID``.
    """
    found = dict(metrics["treatments"][treatment])
    implants = found.pop("implants")
    parts = {"vessel": metrics["vessel"], BARE: metrics["treatments"].get(BARE, {}).get("flow", {})}
    alone = {"implant": next(iter(implants.values()))} if len(implants) == 1 else {"implants": implants}
    return flat(parts | alone | found)


def _write_row(task: Task, treatment: str, row: Row) -> None:
    """Store the row of a treatment under its key, its columns in the order of their names."""
    named = sorted(({"case": task.case.name, "treatment": treatment} | row).items())
    settings = asdict(task.case.settings)
    Store(task.folder / CACHE).write(treatment, task.keys[treatment], {}, values=dict(named), settings=settings)


def read_rows(folder: Path, keys: Mapping[str, Key]) -> dict[str, Row]:
    """Return the rows in the folder of a case that are stored under these keys, by treatment."""
    records = {treatment: Store(folder / CACHE).record(treatment, key) for treatment, key in keys.items()}
    return {treatment: dict(record["values"]) for treatment, record in records.items() if record}


def peak_memory_MB() -> float | None:
    """Return the largest resident memory of this process so far; None where the system does not report it."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    per_unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * per_unit / BYTES_PER_MB
