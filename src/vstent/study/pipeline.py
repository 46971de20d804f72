"""Run a study of one patient: from a file to the flow before and after, with files, provenance and resumption.

The geometry is computed first, and nothing is written until every device is deployed, so that an unusable input leaves
no files. After that each finished stage is stored in the folder under a key of everything it depends on. A rerun of the
same study reads it instead of computing it.
"""

from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from vstent.anatomy.morphology import morphology
from vstent.devices.stent import Deployment
from vstent.flow.convergence import Sensitivity
from vstent.flow.simulation import check_engine
from vstent.geometry.vessel import Anatomy, Vessel
from vstent.io import writers
from vstent.study.contrast import add_measures, kept_measures
from vstent.study.crate import NAME as CRATE
from vstent.study.folder import CACHE, INPUT, LAYOUT, RUN, claiming, implant_folder
from vstent.study.former import merged, note_begun, refuse_other_anatomy, refuse_other_input
from vstent.study.keys import ANATOMY, VESSEL, anatomy_keys, hash_of, key_of, measures_key, stage_name, study_keys
from vstent.study.outputs import (
    IMPLANT,
    take_away_measures,
    take_away_results,
    take_away_study,
    write_anatomy,
    write_implant,
    write_vessel,
)
from vstent.study.progress import OnProgress, Progress
from vstent.study.provenance import METRICS, provenance
from vstent.study.repeat import SECONDS, former_source, is_of_another
from vstent.study.settings import Settings
from vstent.study.stages import (
    check_inflow,
    compute_flows,
    deploy_all,
    engine_folders,
    find_anatomy,
    find_vessel,
    measure_study,
    neck_notes,
    refine,
    vary_all,
)
from vstent.study.store import Store, silent
from vstent.study.types import CaseResult, Computed

Implants = Mapping[str, Mapping[str, Deployment]]
"""Deployed implants by treatment and id."""


@claiming
def run(
    path: Path,
    out: Path,
    settings: Settings,
    progress: OnProgress = silent,
    *,
    replaces: bool = False,
) -> CaseResult:
    """Run one study and write its folder; a study that was stopped there resumes.

    Results of the same input and settings in the folder are kept, and new treatments are added to them. A treatment
    that does not fit, or whose flow cannot be computed, is reported in `CaseResult.failures`; the others are computed.

    Parameters
    ----------
    path : a scan or a surface.
    out : the case folder.
    settings : settings of the study; missing values are proposed.
    progress : called at every stage. Where the stage ``measure`` begins, it gets what has been computed.
    replaces : whether results of another input or of other settings are replaced.

    Returns
    -------
    CaseResult
        Anatomy, implants, flows, metrics and provenance.

    Raises
    ------
    InputError
        An input or option cannot be used, no treatment fits, or the folder holds results that this run would
        invalidate; nothing has been written.
    FlowError
        The flow in the bare artery could not be computed; everything before it is kept.
    FolderError
        Another process uses the folder, or it cannot be written.
    """
    check_engine(settings.flow)
    store = Store(out / CACHE, progress)
    source = hash_of(path)
    if not replaces:
        settings = merged(out, source, settings)
    keys = study_keys(source, settings)
    store.foretell(keys)
    anatomy = find_anatomy(path, settings, store, keys)
    check_inflow(anatomy, settings.flow)
    implants, failures = deploy_all(anatomy, settings, store, keys)
    told = provenance(path, source, settings)
    has_former = replaces and is_of_another(out, told)
    _settle(path, out, source, store)
    note_begun(out, settings)
    if has_former:
        take_away_study(out, engine_folders(out, settings).values())
    (out / CRATE).unlink(missing_ok=True)  # it describes files that this run replaces
    write_anatomy(out, anatomy)
    for treatment in settings.treatments:
        for implant in treatment.implants if treatment.name in implants else ():
            folder, name = implant_folder(out, treatment.name, implant.id), stage_name(treatment, implant)
            key = key_of("vstent.study.outputs:write_implant", keys[f"deploy {name}"])
            write = partial(write_implant, folder, implants[treatment.name][implant.id])
            store.write_once(f"struts {name}", key, folder, IMPLANT, write)
    fields, unflown = compute_flows(out, anatomy, implants, settings, store, keys)
    failures |= unflown
    varied = vary_all(anatomy, implants, settings, store, keys)
    found = Computed(anatomy, implants, fields, store.peek(VESSEL, keys[VESSEL], Vessel))

    def measures() -> dict[str, Any]:
        progress(Progress("measure", 0.0, computed=found))
        return measure_study(anatomy, implants, fields, settings, varied, failures)

    metrics = store.compute_once("measure", measures_key(settings, keys, failures), measures)
    add_measures(metrics, kept_measures(out, keys) if fields else {})
    writers.write_json(out / METRICS, metrics)
    told[SECONDS] = store.seconds
    writers.write_json(out / RUN, told, is_exact=True)
    of_flows = (f"Flow, {name}: {field.advice}" for name, field in fields.items())
    of_failures = (f"{name}: {sentence}" for name, sentence in failures.items())
    notes = (*of_failures, *anatomy.vessel.notes, *anatomy.notes, *of_flows, *neck_notes(metrics))
    return CaseResult(
        **vars(found),
        name=out.resolve().name,
        metrics=metrics,
        provenance=told,
        failures=failures,
        notes=notes,
        keys=keys,
    )


@claiming
def trace_vessel(path: Path, out: Path, settings: Settings, progress: OnProgress, *, replaces: bool = False) -> Vessel:
    """Find the vessel, its openings and its centerlines, untrimmed, and write them.

    Parameters
    ----------
    path : a scan or a surface.
    out : the folder to write.
    settings : settings of the study; missing values are proposed.
    progress : called at every stage.
    replaces : whether results of another input or of other settings are replaced.

    Raises
    ------
    InputError
        An input or option cannot be used; nothing has been written.
    FolderError
        Another process uses the folder, or it cannot be written.
    """
    store = Store(out / CACHE, progress)
    source = hash_of(path)
    _refuse_loss(out, source, settings, replaces)
    vessel = find_vessel(path, settings, store, anatomy_keys(source, settings))
    _settle(path, out, source, store)
    write_vessel(out, vessel)
    return vessel


@claiming
def restore_vessel(
    path: Path, out: Path, settings: Settings, progress: OnProgress, *, replaces: bool = False
) -> tuple[Anatomy, dict[str, Any]]:
    """Remove the sac, restore the parent artery, measure both, and write them.

    A study in the same folder reuses the result, and the other way round.

    Parameters
    ----------
    path : a scan or a surface.
    out : the case folder.
    settings : settings of the study; missing values are proposed.
    progress : called at every stage.
    replaces : whether results of another input or of other settings are replaced.

    Returns
    -------
    anatomy : vessel, parent artery and sacs.
    measures : Morphology; the end of each key is its unit.

    Raises
    ------
    InputError
        An input or option cannot be used; nothing has been written.
    FolderError
        Another process uses the folder, or it cannot be written.
    """
    store = Store(out / CACHE, progress)
    source = hash_of(path)
    _refuse_loss(out, source, settings, replaces)
    anatomy = find_anatomy(path, settings, store, anatomy_keys(source, settings))
    measures = morphology(anatomy)
    _settle(path, out, source, store)
    write_anatomy(out, anatomy)
    writers.write_json(out / "morphology.json", measures)
    return anatomy, measures


@claiming
def refine_flow(
    path: Path, out: Path, settings: Settings, progress: OnProgress, *, replaces: bool = False
) -> Sensitivity:
    """Compute the flow without a device on three grids, time steps and grid positions; write ``convergence.json``.

    Parameters
    ----------
    path : a scan or a surface.
    out : the case folder.
    settings : settings of the study; its grid spacing, given or proposed, is the finest.
    progress : called at every stage.
    replaces : whether results of another input or of other settings are replaced.

    Raises
    ------
    InputError
        An input or option cannot be used; nothing has been written.
    FlowError
        A flow could not be computed.
    FolderError
        Another process uses the folder, or it cannot be written.
    """
    check_engine(settings.flow)
    store = Store(out / CACHE, progress)
    source = hash_of(path)
    _refuse_loss(out, source, settings, replaces)
    anatomy = find_anatomy(path, settings, store, anatomy_keys(source, settings))
    check_inflow(anatomy, settings.flow)
    _settle(path, out, source, store)
    found = refine(out, anatomy, settings, store)
    kept = {one.name: asdict(one) for one in found.refinements}
    kept["grid_position"] = {key: asdict(one) for key, one in found.positions.items()}
    writers.write_json(out / "convergence.json", kept)
    return found


def _refuse_loss(out: Path, source: str, settings: Settings, replaces: bool) -> None:
    """Raise InputError where a folder holds results of another input or anatomy, unless they are to be replaced."""
    if not replaces:
        refuse_other_input(out, source)
        refuse_other_anatomy(out, settings)


def _settle(path: Path, out: Path, source: str, store: Store) -> None:
    """Store the results held in memory, and remove results of another input or of a replaced anatomy."""
    former = former_source(out)
    if former not in (source, None):
        take_away_results(out)
    elif former is not None and store.is_held(ANATOMY):
        take_away_measures(out)
    writers.write_json(out / CACHE / INPUT, {"layout": LAYOUT, "path": str(path.resolve()), "sha256": source})
    store.settle()
