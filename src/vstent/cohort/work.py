"""Run one case of a cohort and write a row for each device, also where something fails."""

import json
import shutil
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

from vstent.cohort.cases import Case
from vstent.errors import VstentError
from vstent.io.writers import write_json, write_text
from vstent.study.pipeline import restore_vessel, run
from vstent.study.types import Progress, Settings

Row = dict[str, Any]
"""Table row of one case with one device: column names and values."""

COST: Final = ("case_s", "case_cpu_s", "peak_memory_MB")
"""Columns that differ between runs, because they depend on the computer."""
DONE: Final = "done"
"""Outcome of a row: finished."""
FAILED: Final = "failed"
"""Outcome of a row: the input cannot be used or a flow cannot be computed; the next run does not repeat it."""
LOST: Final = "lost"
"""Outcome of a row: the process died; the next run repeats it."""
MB: Final = 1e6
"""Bytes in a megabyte."""
_ALONE: Final = threading.Lock()
"""Lock: parallel kernels allow one caller in a process, and a Dask worker may have several threads."""


@dataclass(frozen=True, eq=False)
class Task:
    """The missing rows of one case."""

    case: Case
    """The case, with the devices whose rows are missing."""
    folder: Path
    """Folder in which its rows are written."""
    keys: Mapping[str, str]
    """Key of each missing row, by device."""
    keeps_files: bool = False
    """Whether to keep the case folder as `vstent run` writes it, in ``study`` next to the rows."""


class _Watch:
    """Progress function that remembers the current stage."""

    stage = "read"

    def __call__(self, stage: str, fraction: float, detail: str) -> None:
        self.stage = stage


def row_path(folder: Path, device: str) -> Path:
    """Return the file of a device's row in the folder of a case."""
    return folder / f"{device}.json"


def work(task: Task) -> None:
    """Run the study of one case with every missing device and write the rows.

    A device that does not fit or an input that cannot be used gets a row with the stage and the error message.
    """
    import numba

    with _ALONE:
        numba.set_num_threads(1)  # cases run in parallel, one on each core
        began, cpu = time.perf_counter(), time.process_time()
        rows = _rows(task)
        done = tuple(device for device, row in rows.items() if row["outcome"] == DONE)
        if task.keeps_files and done and len(rows) > 1:  # one study of all devices that work, from stored stages
            run(task.case.path, task.folder / "study", replace(task.case.settings, devices=done), _Watch())
        if not task.keeps_files:
            shutil.rmtree(task.folder / "study", ignore_errors=True)
        spent = time.perf_counter() - began, time.process_time() - cpu, peak_memory_MB()
        cost = dict(zip(COST, spent, strict=True))
        for device, row in rows.items():
            write_row(task, device, row | cost)


def _rows(task: Task) -> dict[str, Row]:
    """Return a row for each device: the artery is restored once, then each device is run in it."""
    case, study = task.case, task.folder / "study"
    devices = case.settings.devices
    failed = _failure(task, lambda watch: restore_vessel(case.path, study, case.settings, watch))
    if failed:
        return dict.fromkeys(devices, failed)
    rows: dict[str, Row] = {}
    for device in devices:
        alone = replace(case.settings, devices=(device,))

        def with_device(watch: Progress, device: str = device, alone: Settings = alone) -> None:
            found = run(case.path, study, alone, watch)
            advice = found.deployments[device].advice
            rows[device] = {"outcome": DONE, "stage": "", "sentence": advice} | flat_metrics(found.metrics, device)

        failed = _failure(task, with_device)
        if failed:
            rows[device] = failed
    return rows


def _failure(task: Task, do: Callable[[Progress], object]) -> Row:
    """Call `do`; return the row of its failure, empty where it succeeds."""
    watch = _Watch()
    try:
        do(watch)
    except VstentError as error:
        return {"outcome": FAILED, "stage": watch.stage, "sentence": str(error)}
    except Exception as error:  # noqa: BLE001 an error in one case must not end the cohort; its row reports it
        write_text(task.folder / "traceback.txt", traceback.format_exc())
        sentence = f"Unexpected error, {type(error).__name__}: {error}. Report it with the file traceback.txt."
        return {"outcome": FAILED, "stage": watch.stage, "sentence": sentence}
    return {}


def flat_metrics(metrics: Mapping[str, Any], device: str) -> Row:
    """Return the metrics of the vessel, the bare flow and one device, under keys joined by dots."""
    parts = {"vessel": metrics["vessel"], "bare": metrics.get("bare", {})} | dict(metrics["stents"][device])
    return _flat(parts, "")


def _flat(values: Mapping[str, Any], before: str) -> Row:
    """Return the values of nested mappings, under keys joined by dots."""
    row: Row = {}
    for name, value in values.items():
        row |= _flat(value, f"{before}{name}.") if isinstance(value, Mapping) else {f"{before}{name}": value}
    return row


def write_row(task: Task, device: str, row: Row) -> None:
    """Write the row of a device with its key."""
    named = {"case": task.case.name, "device": device} | row
    kept = {"key": task.keys[device], "row": named, "settings": asdict(task.case.settings)}
    write_json(row_path(task.folder, device), kept)


def read_row(folder: Path, device: str, key: str) -> Row | None:
    """Return the row of a device; None where it is missing, damaged, or has another key."""
    try:
        kept = json.loads(row_path(folder, device).read_text(encoding="utf-8"))
        return dict(kept["row"]) if kept["key"] == key else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def peak_memory_MB() -> float | None:
    """Return the peak resident memory of this process; None where the system does not report it."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    import sys

    per_unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * per_unit / MB
