"""Run one case of a cohort and write one row per treatment, also where the case fails."""

import json
import shutil
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

from vstent.cohort.cases import Case
from vstent.devices.treatment import BARE
from vstent.errors import VstentError
from vstent.io.files import atomic
from vstent.io.writers import write_json, write_text
from vstent.reporting.figures import patient_picture
from vstent.study.pipeline import restore_vessel, run
from vstent.study.progress import OnProgress, Progress
from vstent.study.settings import Settings
from vstent.study.workers import alone
from vstent.units import BYTES_PER_MB

Row = dict[str, Any]
"""One case with one treatment: column name to value."""

COST: Final = ("case_s", "case_cpu_s", "peak_memory_MB")
"""Columns on run time and memory; they describe the computer, so they differ between runs."""
DONE: Final = "done"
"""Outcome of a treatment that was deployed and measured."""
FAILED: Final = "failed"
"""Outcome where the input cannot be used or a flow cannot be computed; a repetition would give the same."""
LOST: Final = "lost"
"""Outcome where the process died; the next run repeats the case."""


@dataclass(frozen=True, eq=False)
class Task:
    """Remaining work of one case."""

    case: Case
    """The case; its treatments are those whose rows are missing."""
    folder: Path
    """Folder in which its rows are written."""
    keys: Mapping[str, str]
    """Key of every missing row, by treatment."""
    keeps_files: bool = False
    """Whether all files of `vstent run` are kept, in subfolder ``study``."""


class _Watch:
    """Remembers the current stage of a study."""

    stage = "read"

    def __call__(self, now: Progress) -> None:
        self.stage = now.stage


def row_path(folder: Path, treatment: str) -> Path:
    """Return the file of the row of a treatment in the folder of a case."""
    return folder / f"{treatment}.json"


def picture_path(folder: Path, treatment: str) -> Path:
    """Return the file of the picture of a treatment in the folder of a case."""
    return folder / f"{treatment}.webp"


def work(task: Task) -> None:
    """Run one case: deploy every missing treatment and write the rows.

    A treatment that does not fit, or an input that cannot be used, gives a row with its stage and error message.
    """
    with alone():
        began, cpu = time.perf_counter(), time.process_time()
        rows = _rows(task)
        done = tuple(one for one in task.case.settings.treatments if rows[one.name]["outcome"] == DONE)
        if task.keeps_files and done and len(rows) > 1:  # one study of all treatments, read from stored results
            run(
                task.case.path,
                task.folder / "study",
                replace(task.case.settings, treatments=done),
                _Watch(),
                replaces=True,
            )
        if not task.keeps_files:
            shutil.rmtree(task.folder / "study", ignore_errors=True)
        spent = time.perf_counter() - began, time.process_time() - cpu, peak_memory_MB()
        cost = dict(zip(COST, spent, strict=True))
        for treatment, row in rows.items():
            write_row(task, treatment, row | cost)


def _rows(task: Task) -> dict[str, Row]:
    """Return the rows of a case by treatment; the artery is restored once, and failures are rows too."""
    case, study = task.case, task.folder / "study"
    treatments = case.settings.treatments
    failed = _failure(task, lambda watch: restore_vessel(case.path, study, case.settings, watch, replaces=True))
    if failed:
        return {treatment.name: failed for treatment in treatments}
    rows: dict[str, Row] = {}
    for treatment in treatments:
        name, alone = treatment.name, replace(case.settings, treatments=(treatment,))

        def with_treatment(watch: OnProgress, name: str = name, alone: Settings = alone) -> None:
            found = run(case.path, study, alone, watch, replaces=True)
            implants = list(found.implants[name].values())
            with atomic(picture_path(task.folder, name)) as partial:
                partial.write_bytes(patient_picture(found.anatomy, implants).webp)
            advice = " ".join(one.advice for one in implants)
            rows[name] = {"outcome": DONE, "stage": "", "sentence": advice} | flat_metrics(found.metrics, name)

        failed = _failure(task, with_treatment)
        if failed:
            rows[name] = failed
    return rows


def _failure(task: Task, do: Callable[[OnProgress], object]) -> Row:
    """Call a function and return the row of its failure; empty where it succeeds."""
    watch = _Watch()
    try:
        do(watch)
    except VstentError as error:
        return {"outcome": FAILED, "stage": watch.stage, "sentence": str(error)}
    except Exception as error:  # noqa: BLE001 one failed case must not end the cohort; its row states the error
        write_text(task.folder / "traceback.txt", traceback.format_exc())
        sentence = f"unexpected error, {type(error).__name__}: {error}. Please report it with traceback.txt."
        return {"outcome": FAILED, "stage": watch.stage, "sentence": sentence}
    return {}


def flat_metrics(metrics: Mapping[str, Any], treatment: str) -> Row:
    """Return all metrics of a study that concern one treatment, under dotted keys.

    Measures of the implant of a treatment with one begin with ``implant``, those of several with ``implants.ID``.
    """
    found = dict(metrics["treatments"][treatment])
    implants = found.pop("implants")
    parts = {"vessel": metrics["vessel"], BARE: metrics["treatments"].get(BARE, {}).get("flow", {})}
    alone = {"implant": next(iter(implants.values()))} if len(implants) == 1 else {"implants": implants}
    return _flat(parts | alone | found, "")


def _flat(values: Mapping[str, Any], before: str) -> Row:
    """Return nested values under dotted keys."""
    row: Row = {}
    for name, value in values.items():
        row |= _flat(value, f"{before}{name}.") if isinstance(value, Mapping) else {f"{before}{name}": value}
    return row


def write_row(task: Task, treatment: str, row: Row) -> None:
    """Write the row of a treatment with the key of everything it depends on."""
    named = {"case": task.case.name, "treatment": treatment} | row
    kept = {"key": task.keys[treatment], "row": named, "settings": asdict(task.case.settings)}
    write_json(row_path(task.folder, treatment), kept)


def read_row(folder: Path, treatment: str, key: str) -> Row | None:
    """Return the row of a treatment; None where it is missing, damaged, or has another key."""
    try:
        kept = json.loads(row_path(folder, treatment).read_text(encoding="utf-8"))
        return dict(kept["row"]) if kept["key"] == key else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def peak_memory_MB() -> float | None:
    """Return the largest resident memory of this process so far; None where the system does not report it."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    import sys

    per_unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * per_unit / BYTES_PER_MB
