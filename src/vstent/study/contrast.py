"""Angiograms of the flows of a case folder: computed from its stored flows, stored, and added to its metrics."""

import json
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final

from vstent.angiography.angiogram import Angiogram, AngiogramSettings, angiogram, entering
from vstent.angiography.history import History, Recorder
from vstent.devices.stent import Stent
from vstent.devices.treatment import BARE
from vstent.errors import InputError
from vstent.flow.case import FlowField
from vstent.flow.indices import ratios
from vstent.geometry.vessel import Anatomy
from vstent.io.tables import write_rows
from vstent.io.writers import write_json
from vstent.study.folder import CACHE, METRICS, claimed
from vstent.study.keys import angiogram_key, study_keys
from vstent.study.progress import OnProgress
from vstent.study.repeat import finished_run
from vstent.study.stages import deploy_all, finished_anatomy
from vstent.study.store import UNREADABLE, Key, Store

FOLDER: Final = "angiogram"
"""Subfolder of the case folder with the results."""
CURVES: Final = "curves.csv"
"""File with the time-density curves of all flows."""
NUMBERS: Final = "angiogram.json"
"""File with settings, measures and advice of all flows."""


def angiograms(
    out: Path, settings: AngiogramSettings, progress: OnProgress
) -> tuple[dict[str, Angiogram], dict[str, History]]:
    """Return angiogram and contrast of every flow of a case folder, ``bare`` first, and write curves and metrics.

    Those that are stored for the same flow and settings are not computed again. ReadError is raised where the folder
    holds no finished run of this version, InputError where the run has no flow or the window is too short for contrast
    to reach the sac, and FlowError where a flow does not fit in the free memory.
    """
    source, study = finished_run(out)
    with claimed(out):
        store, keys = Store(out / CACHE, progress), study_keys(source, study)
        anatomy = finished_anatomy(out, store, keys)
        flows = _flow_keys(keys)
        both = {name: angiogram_of(out, anatomy, name, key, settings, store) for name, key in flows.items()}
        found = {name: one for name, (one, _) in both.items()}
        _write(out, found, settings, flows)
    return found, {name: history for name, (_, history) in both.items()}


def _flow_keys(keys: Mapping[str, Key]) -> dict[str, Key]:
    """Return the keys of the flows of a run by treatment, ``bare`` first."""
    return {stage.removeprefix("flow "): key for stage, key in keys.items() if stage.startswith("flow ")}


def angiogram_of(
    out: Path, anatomy: Anatomy, name: str, flow: Key, settings: AngiogramSettings, store: Store
) -> tuple[Angiogram, History]:
    """Return the angiogram of one flow and its contrast over time, stored or computed."""
    stage, stage_of_history, key = f"angiogram {name}", f"contrast {name}", angiogram_key(flow, settings)
    history = store.load(stage_of_history, key, History)
    found = None if history is None else store.find(stage, key, Angiogram)
    if history is not None and found is not None:
        return found, history
    field = store.find(f"flow {name}", flow, FlowField)
    if field is None:
        raise InputError(
            f"{out} holds no flow of {name}, and contrast moves with the flow: run the case again without --no-flow"
        )
    recorder = Recorder(field, entering(settings.bolus, field)[1], begin_s=settings.bolus.begin_s)
    began = time.monotonic()

    def told(part: float) -> None:
        left_s = (time.monotonic() - began) * (1 - part) / part if part > 0 else None
        store.progress(stage, 0.99 * part, "", seconds_left=left_s)

    with store.stage(stage) as tell:
        found = angiogram(anatomy, field, settings, watch=recorder.watch, progress=told)
        tell(found.advice)
    history = recorder.history()
    store.save(stage, key, found)
    store.save(stage_of_history, key, history)
    return found, history


def _write(out: Path, found: Mapping[str, Angiogram], settings: AngiogramSettings, keys: Mapping[str, Key]) -> None:
    """Write the curves, the numbers, and the metrics with the numbers added."""
    folder = out / FOLDER
    folder.mkdir(exist_ok=True)
    former = {key for flow in written(out).values() for key in flow["measures"]}
    rows = [
        {
            "flow": name,
            "time_s": float(time_s),
            "sac_iodine_mg_mL": float(sac),
            "parent_artery_iodine_mg_mL": float(parent),
        }
        for name, one in found.items()
        for time_s, sac, parent in zip(one.curves.time_s, one.curves.sac_mg_mL, one.curves.parent_mg_mL, strict=True)
    ]
    write_rows(folder / CURVES, rows)
    flows = {
        name: {"flow": str(keys[name]), "measures": one.measures, "advice": one.advice} for name, one in found.items()
    }
    write_json(folder / NUMBERS, {"settings": asdict(settings), "flows": flows, "research_use_only": True})
    metrics = json.loads((out / METRICS).read_text(encoding="utf-8"))
    for treatment in metrics["treatments"].values():  # a new angiogram need not have all measures of the former
        for part, gone in (("flow", former), ("change", {f"{key}_ratio" for key in former})):
            for key in gone & treatment.get(part, {}).keys():
                del treatment[part][key]
    add_measures(metrics, {name: one.measures for name, one in found.items()})
    write_json(out / METRICS, metrics)


def written(out: Path) -> dict[str, Any]:
    """Return key and measures of the angiograms that a case folder holds, by name of the flow."""
    with suppress(*UNREADABLE):
        flows = json.loads((out / FOLDER / NUMBERS).read_text(encoding="utf-8"))["flows"]
        return {name: {"flow": str(one["flow"]), "measures": dict(one["measures"])} for name, one in flows.items()}
    return {}


def add_measures(metrics: dict[str, Any], measures: Mapping[str, Mapping[str, float]]) -> None:
    """Add the measures of angiograms, by treatment, to the flows of nested metrics in place."""
    for name, values in measures.items():
        treatment = metrics["treatments"].get(name, {})
        if "flow" in treatment:
            treatment["flow"].update(values)
        if "change" in treatment:
            treatment["change"].update(ratios(dict(measures.get(BARE, {})), dict(values)))


def stored_measures(out: Path, keys: Mapping[str, Key]) -> dict[str, dict[str, float]]:
    """Return the measures of the angiograms in a case folder that belong to the flows of a run, by name."""
    own = {name: str(key) for name, key in _flow_keys(keys).items()}
    return {name: one["measures"] for name, one in written(out).items() if one["flow"] == own.get(name)}


def stents_of(out: Path, names: Iterable[str]) -> tuple[Anatomy, dict[str, list[Stent]]]:
    """Return the anatomy of a finished case folder, and the implants of the named treatments as its run deployed them.

    ReadError is raised where the folder holds no finished run of this version.
    """
    source, study = finished_run(out)
    store, keys = Store(out / CACHE), study_keys(source, study)
    anatomy = finished_anatomy(out, store, keys)
    chosen = replace(study, treatments=tuple(one for one in study.treatments if one.name in set(names)))
    deployed = deploy_all(anatomy, chosen, store, keys)[0] if chosen.treatments else {}
    return anatomy, {name: [one.stent for one in implants.values()] for name, implants in deployed.items()}
