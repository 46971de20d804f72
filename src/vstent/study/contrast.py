"""Angiograms of the flows of a case folder: computed from its stored flows, stored, and added to its metrics."""

import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any, Final

from vstent.angiography.angiogram import Angiogram, AngiogramSettings, Watch, angiogram
from vstent.devices.treatment import BARE
from vstent.errors import InputError
from vstent.flow.case import FlowField
from vstent.flow.indices import ratios
from vstent.geometry.vessel import Anatomy
from vstent.io.tables import write_rows
from vstent.io.writers import write_json
from vstent.study.folder import CACHE, claimed
from vstent.study.keys import angiogram_key, study_keys
from vstent.study.progress import OnProgress
from vstent.study.provenance import METRICS
from vstent.study.repeat import finished_run
from vstent.study.stages import finished_anatomy
from vstent.study.store import UNREADABLE, Key, Store

FOLDER: Final = "angiogram"
"""Subfolder of the case folder with the results."""
CURVES: Final = "curves.csv"
"""File with the time-density curves of all flows."""
NUMBERS: Final = "angiogram.json"
"""File with settings, measures and advice of all flows."""

Record = Callable[[str, Key, Store, Callable[[], FlowField | None]], AbstractContextManager[Watch | None]]
"""Takes the name of a flow, its key, the store, and what reads the flow (None where there is none); its context yields
what watches the frames, or None."""


def angiograms(
    out: Path, settings: AngiogramSettings, progress: OnProgress, *, record: Record | None = None
) -> dict[str, Angiogram]:
    """Compute the angiogram of every flow of a case folder, and write curves, numbers and metrics.

    An angiogram that is stored for the same flow and settings is not computed again, unless its frames are watched.

    Parameters
    ----------
    out : the case folder of a finished run with flows.
    settings : settings of the angiograms.
    progress : called at every stage.
    record : returns what watches the frames of a flow (see `Record`).

    Returns angiograms by name of the flow, ``bare`` first.

    Raises
    ------
    ReadError
        The folder holds no finished run of this version.
    InputError
        The run has no flow, or the window is too short for contrast to reach the sac.
    FlowError
        A flow does not fit in the free memory.
    """
    source, study = finished_run(out)
    with claimed(out):
        store = Store(out / CACHE, progress)
        keys = study_keys(source, study)
        anatomy = finished_anatomy(out, store, keys)
        flows = _flow_keys(keys)
        found = {name: _one(out, anatomy, name, key, settings, store, record) for name, key in flows.items()}
        _write(out, found, settings, flows)
    return found


def _flow_keys(keys: Mapping[str, Key]) -> dict[str, Key]:
    """Return the keys of the flows of a run by treatment, ``bare`` first."""
    return {stage.removeprefix("flow "): key for stage, key in keys.items() if stage.startswith("flow ")}


def _one(
    out: Path,
    anatomy: Anatomy,
    name: str,
    key: Key,
    settings: AngiogramSettings,
    store: Store,
    record: Record | None,
) -> Angiogram:
    """Return the angiogram of one flow, stored or computed."""
    stage, own = f"angiogram {name}", angiogram_key(key, settings)
    carrier = cache(lambda: store.find(f"flow {name}", key, FlowField))
    with nullcontext() if record is None else record(name, key, store, carrier) as watch:
        found = None if watch else store.find(stage, own, Angiogram)
        if found is not None:
            return found
        field = carrier()
        if field is None:
            raise InputError(
                f"{out} holds no flow of {name}, and contrast moves with the flow: run the case again without --no-flow"
            )
        with store.stage(stage) as tell:
            found = angiogram(anatomy, field, settings, watch=watch, progress=_teller(store, stage))
            tell(found.advice)
        store.keep(stage, own, found)
        return found


def _teller(store: Store, stage: str) -> Callable[[float], None]:
    """Return a function that reports a finished fraction with the time that is left."""
    began = time.monotonic()

    def tell(part: float) -> None:
        left_s = (time.monotonic() - began) * (1 - part) / part if part > 0 else None
        store.progress(stage, 0.99 * part, "", seconds_left=left_s)

    return tell


def _write(out: Path, found: Mapping[str, Angiogram], settings: AngiogramSettings, keys: Mapping[str, Key]) -> None:
    """Write the curves, the numbers, and the metrics with the numbers added."""
    folder = out / FOLDER
    folder.mkdir(exist_ok=True)
    former = _former_keys(folder / NUMBERS)
    write_rows(folder / CURVES, list(_rows(found)))
    flows = {
        name: {"flow": str(keys[name]), "measures": one.measures, "advice": one.advice} for name, one in found.items()
    }
    write_json(folder / NUMBERS, {"settings": asdict(settings), "flows": flows, "research_use_only": True})
    metrics = json.loads((out / METRICS).read_text(encoding="utf-8"))
    _drop(metrics, former)
    add_measures(metrics, {name: one.measures for name, one in found.items()})
    write_json(out / METRICS, metrics)


def _rows(found: Mapping[str, Angiogram]) -> Iterator[dict[str, Any]]:
    """Yield the rows of the table of curves."""
    for name, one in found.items():
        curves = one.curves
        for time_s, sac, parent in zip(curves.time_s, curves.sac_mg_mL, curves.parent_mg_mL, strict=True):
            yield {
                "flow": name,
                "time_s": float(time_s),
                "sac_iodine_mg_mL": float(sac),
                "parent_artery_iodine_mg_mL": float(parent),
            }


def _former_keys(path: Path) -> set[str]:
    """Return the keys of all measures of the angiograms that a case folder holds; empty where it holds none."""
    try:
        flows = json.loads(path.read_text(encoding="utf-8"))["flows"]
        return {key for one in flows.values() for key in one["measures"]}
    except UNREADABLE:
        return set()


def _drop(metrics: dict[str, Any], keys: set[str]) -> None:
    """Remove measures of earlier angiograms from nested metrics: a new one need not have all of them."""
    for treatment in metrics["treatments"].values():
        for part, gone in (("flow", keys), ("change", {f"{key}_ratio" for key in keys})):
            for key in gone & treatment.get(part, {}).keys():
                del treatment[part][key]


def add_measures(metrics: dict[str, Any], measures: Mapping[str, Mapping[str, float]]) -> None:
    """Add the measures of angiograms to the flows of nested metrics.

    Parameters
    ----------
    metrics : metrics of a case; changed in place.
    measures : measures by treatment.
    """
    for name, values in measures.items():
        treatment = metrics["treatments"].get(name, {})
        if "flow" in treatment:
            treatment["flow"].update(values)
        if "change" in treatment:
            treatment["change"].update(ratios(dict(measures.get(BARE, {})), dict(values)))


def kept_measures(out: Path, keys: Mapping[str, Key]) -> dict[str, dict[str, float]]:
    """Return the measures of the angiograms in a case folder that belong to the flows of a run, by name."""
    try:
        flows = json.loads((out / FOLDER / NUMBERS).read_text(encoding="utf-8"))["flows"]
        own = {name: str(key) for name, key in _flow_keys(keys).items()}
        return {name: dict(one["measures"]) for name, one in flows.items() if one["flow"] == own.get(name)}
    except UNREADABLE:
        return {}
