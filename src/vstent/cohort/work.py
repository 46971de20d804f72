"""Run one case of a cohort and write one row per device, also where the case fails."""

import json
import shutil
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

from vstent.cohort.cases import Case
from vstent.errors import VstentError
from vstent.io.files import atomic
from vstent.io.writers import write_json, write_text
from vstent.reporting.figures import patient_picture
from vstent.study.crews import alone
from vstent.study.pipeline import restore_vessel, run
from vstent.study.types import Progress, Settings
from vstent.units import BYTES_PER_MB

Row = dict[str, Any]
"""One case with one device: column name to value."""

COST: Final = ("case_s", "case_cpu_s", "peak_memory_MB")
"""Columns on run time and memory; they describe the computer, so they differ between runs."""
DONE: Final = "done"
"""Outcome of a device that was deployed and measured."""
FAILED: Final = "failed"
"""Outcome where the input cannot be used or a flow cannot be computed; a repetition would give the same."""
LOST: Final = "lost"
"""Outcome where the process died; the next run repeats the case."""


@dataclass(frozen=True, eq=False)
class Task:
    """Remaining work of one case."""

    case: Case
    """The case; its devices are those whose rows are missing."""
    folder: Path
    """Folder in which its rows are written."""
    keys: Mapping[str, str]
    """Key of every missing row, by device."""
    keeps_files: bool = False
    """Whether all files of `vstent run` are kept, in subfolder ``study``."""


class _Watch:
    """Remembers the current stage of a study."""

    stage = "read"

    def __call__(self, stage: str, fraction: float, detail: str) -> None:
        self.stage = stage


def row_path(folder: Path, device: str) -> Path:
    """Return the file of the row of a device in the folder of a case."""
    return folder / f"{device}.json"


def picture_path(folder: Path, device: str) -> Path:
    """Return the file of the picture of a device in the folder of a case."""
    return folder / f"{device}.webp"


def work(task: Task) -> None:
    """Run one case: deploy every missing device and write the rows.

    A device that does not fit, or an input that cannot be used, gives a row with its stage and error message.
    """
    with alone():
        began, cpu = time.perf_counter(), time.process_time()
        rows = _rows(task)
        done = tuple(device for device, row in rows.items() if row["outcome"] == DONE)
        if task.keeps_files and done and len(rows) > 1:  # one study of all devices, read from stored results
            run(
                task.case.path,
                task.folder / "study",
                replace(task.case.settings, devices=done),
                _Watch(),
                replaces=True,
            )
        if not task.keeps_files:
            shutil.rmtree(task.folder / "study", ignore_errors=True)
        spent = time.perf_counter() - began, time.process_time() - cpu, peak_memory_MB()
        cost = dict(zip(COST, spent, strict=True))
        for device, row in rows.items():
            write_row(task, device, row | cost)


def _rows(task: Task) -> dict[str, Row]:
    """Return the rows of a case by device; the artery is restored once, and failures are rows too."""
    case, study = task.case, task.folder / "study"
    devices = case.settings.devices
    failed = _failure(task, lambda watch: restore_vessel(case.path, study, case.settings, watch, replaces=True))
    if failed:
        return dict.fromkeys(devices, failed)
    rows: dict[str, Row] = {}
    for device in devices:
        alone = replace(case.settings, devices=(device,))

        def with_device(watch: Progress, device: str = device, alone: Settings = alone) -> None:
            found = run(case.path, study, alone, watch, replaces=True)
            advice = found.deployments[device].advice
            with atomic(picture_path(task.folder, device)) as partial:
                partial.write_bytes(patient_picture(found.anatomy, found.deployments[device]).webp)
            rows[device] = {"outcome": DONE, "stage": "", "sentence": advice} | flat_metrics(found.metrics, device)

        failed = _failure(task, with_device)
        if failed:
            rows[device] = failed
    return rows


def _failure(task: Task, do: Callable[[Progress], object]) -> Row:
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


def flat_metrics(metrics: Mapping[str, Any], device: str) -> Row:
    """Return all metrics of a study that concern one device, under dotted keys.

    Parameters
    ----------
    metrics : metrics of the study.
    device : name of the device.
    """
    parts = {"vessel": metrics["vessel"], "bare": metrics.get("bare", {})} | dict(metrics["stents"][device])
    return _flat(parts, "")


def _flat(values: Mapping[str, Any], before: str) -> Row:
    """Return nested values under dotted keys."""
    row: Row = {}
    for name, value in values.items():
        row |= _flat(value, f"{before}{name}.") if isinstance(value, Mapping) else {f"{before}{name}": value}
    return row


def write_row(task: Task, device: str, row: Row) -> None:
    """Write the row of a device with the key of everything it depends on.

    Parameters
    ----------
    task : task of the case.
    device : name of the device.
    row : values by column name.
    """
    named = {"case": task.case.name, "device": device} | row
    kept = {"key": task.keys[device], "row": named, "settings": asdict(task.case.settings)}
    write_json(row_path(task.folder, device), kept)


def read_row(folder: Path, device: str, key: str) -> Row | None:
    """Return the row of a device; None where it is missing, damaged, or has another key.

    Parameters
    ----------
    folder : folder of the case.
    device : name of the device.
    key : key of everything that the row depends on.
    """
    try:
        kept = json.loads(row_path(folder, device).read_text(encoding="utf-8"))
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
