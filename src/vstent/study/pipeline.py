"""Run a study of one patient: from a file to the flow before and after, with files, provenance and resumption.

The geometry is computed first, and nothing is written until every device is deployed, so that an unusable input leaves
no files. After that each finished stage is stored in the folder under a key of everything it depends on. A rerun of the
same study reads it instead of computing it.
"""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from vstent.anatomy.morphology import morphology
from vstent.deployment.straightening import Straightening
from vstent.devices.treatment import BARE
from vstent.flow.case import FlowField
from vstent.flow.convergence import Sensitivity, convergence
from vstent.flow.problem import flow_case
from vstent.flow.settings import FlowSettings
from vstent.flow.simulation import check_engine
from vstent.geometry.vessel import Anatomy, Vessel
from vstent.io import writers
from vstent.study import outputs, stages
from vstent.study.contrast import add_measures, stored_measures
from vstent.study.crate import NAME as CRATE
from vstent.study.folder import (
    CACHE,
    INPUT,
    LAYOUT,
    METRICS,
    RUN,
    TREATMENTS,
    claimed,
    implant_folder,
    straightened_folder,
)
from vstent.study.keys import (
    ANATOMY,
    STRAIGHTENED,
    VESSEL,
    anatomy_keys,
    hash_of,
    key_of,
    measures_key,
    stage_name,
    study_keys,
)
from vstent.study.progress import OnProgress, Progress
from vstent.study.repeat import SECONDS, former_source, is_of_another, merged, note_begun, provenance, refuse_other
from vstent.study.settings import Settings
from vstent.study.store import Key, Store, silent


@dataclass(frozen=True, eq=False)
class Computed:
    """What a study has computed before it is measured; enough to draw it."""

    anatomy: Anatomy
    """Vessel, sacs and paths."""
    implants: stages.Implants
    """Deployed implants by treatment and id."""
    fields: Mapping[str, FlowField]
    """Flows by treatment, ``bare`` first; empty where no flow was requested."""
    whole: Vessel | None
    """The vessel before it was trimmed; None where it is not stored."""
    yielded: Mapping[str, Straightening]
    """Arteries that have yielded to treatments, with the devices in them, by the name of the treatment."""
    shown: Mapping[str, FlowField]
    """Flows to draw by treatment: as `fields`, and in an artery that has yielded the one with its devices."""


@dataclass(frozen=True, eq=False)
class CaseResult(Computed):
    """Result of a study."""

    name: str
    """Name of the case folder (the name of a scan may be the patient's)."""
    metrics: dict[str, Any]
    """Metrics: ``vessel``, ``treatments.NAME.{implants.ID,flow,change,quality}``; the end of each key is its unit."""
    provenance: dict[str, Any]
    """Versions, input with hash, settings, seconds per stage."""
    failures: dict[str, str]
    """Reason why a treatment was not deployed or its flow not computed, by treatment."""
    notes: tuple[str, ...]
    """Findings, assumptions and repairs, and the reliability of every flow, one sentence each."""
    keys: dict[str, Key]
    """Keys of the stages by name."""


def run(
    path: Path | str, out: Path | str, settings: Settings, progress: OnProgress = silent, *, replaces: bool = False
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
    path, out = Path(path), Path(out)
    with _begun(path, out, settings, progress, replaces) as (store, source):
        if not replaces:
            settings = merged(out, settings)
        keys = study_keys(source, settings)
        store.foretell(keys)
        anatomy = stages.find_anatomy(path, settings, store, keys)
        stages.check_inflow(anatomy, settings.flow)
        implants, failures = stages.deploy_all(anatomy, settings, store, keys)
        yielded, unyielding = stages.straighten_all(anatomy, implants, settings, store, keys)
        failures |= unyielding
        record = provenance(path, source, settings)
        has_former = replaces and is_of_another(out, record)
        named = [treatment.name for treatment in settings.treatments]
        _save_deferred(path, out, source, store, named, is_replaced=has_former)
        note_begun(out, settings)
        if has_former:
            outputs.take_away_study(out, stages.engine_folders(out, settings).values())
        (out / CRATE).unlink(missing_ok=True)  # it describes files that this run replaces
        outputs.write_anatomy(out, anatomy)
        for treatment in settings.treatments:
            for implant in treatment.implants if treatment.name in implants else ():
                folder, name = implant_folder(out, treatment.name, implant.id), stage_name(treatment, implant)
                key = key_of("vstent.study.outputs:write_implant", keys[f"deploy {name}"])
                write = partial(outputs.write_implant, folder, implants[treatment.name][implant.id])
                store.write_once(f"struts {name}", key, folder, outputs.IMPLANT, write)
        for name, one in yielded.items():
            outputs.write_anatomy(straightened_folder(out, name), one.anatomy)
        flows, unflown = stages.compute_flows(out, anatomy, implants, settings, store, keys, yielded)
        fields = {name: field for name, field in flows.items() if "/" not in name}
        failures |= unflown
        varied = stages.vary_all(anatomy, implants, settings, store, keys)
        shown = {name: flows.get(f"{name}{STRAIGHTENED}", field) for name, field in fields.items()}
        computed = Computed(anatomy, implants, fields, store.load(VESSEL, keys[VESSEL], Vessel), yielded, shown)

        def measures() -> dict[str, Any]:
            progress(Progress("measure", 0.0, computed=computed))
            straightened = stages.measure_straightened(anatomy, yielded, flows, settings.flow)
            return stages.measure_study(anatomy, implants, fields, settings, varied, failures, straightened)

        metrics = store.compute_once("measure", measures_key(settings, keys, failures), measures)
        add_measures(metrics, stored_measures(out, keys) if fields else {})
        writers.write_json(out / METRICS, metrics)
        record[SECONDS] = store.seconds
        writers.write_json(out / RUN, record, is_exact=True)
        of_flows = (f"Flow, {name}: {field.advice}" for name, field in fields.items())
        of_failures = (f"{name}: {sentence}" for name, sentence in failures.items())
        yields = stages.straightening_notes(metrics)
        notes = (*of_failures, *yields, *anatomy.vessel.notes, *anatomy.notes, *of_flows, *stages.neck_notes(metrics))
        return CaseResult(
            **vars(computed),
            name=out.resolve().name,
            metrics=metrics,
            provenance=record,
            failures=failures,
            notes=notes,
            keys=keys,
        )


def trace_vessel(path: Path, out: Path, settings: Settings, progress: OnProgress, *, replaces: bool = False) -> Vessel:
    """Find the vessel, its openings and its centerlines, untrimmed, and write them; all else as in `run`."""
    with _begun(path, out, settings, progress, replaces) as (store, source):
        vessel = stages.find_vessel(path, settings, store, anatomy_keys(source, settings))
        _save_deferred(path, out, source, store)
        outputs.write_vessel(out, vessel)
        return vessel


def restore_vessel(
    path: Path, out: Path, settings: Settings, progress: OnProgress, *, replaces: bool = False
) -> tuple[Anatomy, dict[str, Any]]:
    """Remove the sac, restore the parent artery, write both, and return them with their morphology.

    A study in the same folder reuses the result, and the other way round. Errors and `replaces` are as in `run`.
    """
    with _begun(path, out, settings, progress, replaces) as (store, source):
        anatomy = stages.find_anatomy(path, settings, store, anatomy_keys(source, settings))
        measures = morphology(anatomy)
        _save_deferred(path, out, source, store)
        outputs.write_anatomy(out, anatomy)
        writers.write_json(out / "morphology.json", measures)
        return anatomy, measures


def deploy_treatments(path: Path, out: Path, settings: Settings, progress: OnProgress, *, replaces: bool) -> None:
    """Deploy the treatments and store their implants, for a study in the same folder; errors are as in `run`."""
    with _begun(path, out, settings, progress, replaces) as (store, source):
        keys = study_keys(source, settings)
        stages.deploy_all(stages.find_anatomy(path, settings, store, keys), settings, store, keys)
        _save_deferred(path, out, source, store, [treatment.name for treatment in settings.treatments])


def refine_flow(
    path: Path, out: Path, settings: Settings, progress: OnProgress, *, replaces: bool = False
) -> Sensitivity:
    """Compute the flow without a device on three grids, time steps and grid positions; write ``convergence.json``.

    The grid spacing of the settings, given or proposed, is the finest. Errors and `replaces` are as in `run`.
    """
    check_engine(settings.flow)
    with _begun(path, out, settings, progress, replaces) as (store, source):
        anatomy = stages.find_anatomy(path, settings, store, anatomy_keys(source, settings))
        stages.check_inflow(anatomy, settings.flow)
        _save_deferred(path, out, source, store)
        flow = settings.flow or FlowSettings()
        stages.plan_flows(anatomy, {BARE: ()}, flow, store)
        with store.stage("convergence") as tell:
            sentences: list[str] = []

            def told(fraction: float, sentence: str) -> None:
                sentences.append(sentence)
                store.progress("convergence", 0.99 * fraction, sentence)

            folder = out / "convergence" / flow.numerics.engine
            sensitivity = convergence(flow_case(anatomy, (), flow), folder=folder, told=told)
            tell(" ".join(sentences))
        refinements = {one.name: asdict(one) for one in sensitivity.refinements}
        refinements["grid_position"] = {key: asdict(one) for key, one in sensitivity.positions.items()}
        writers.write_json(out / "convergence.json", refinements)
        return sensitivity


@contextmanager
def _begun(
    path: Path, out: Path, settings: Settings, progress: OnProgress, replaces: bool
) -> Iterator[tuple[Store, str]]:
    """Reserve a case folder; yield its store and the SHA-256 of an input. Results of another one may be refused."""
    with claimed(out):
        source = hash_of(path)
        if not replaces:
            refuse_other(out, source, settings)
        yield Store(out / CACHE, progress), source


def _save_deferred(
    path: Path, out: Path, source: str, store: Store, named: Iterable[str] = (), *, is_replaced: bool = False
) -> None:
    """Store the deferred results, and remove results of another input or of a replaced anatomy.

    Treatments that are not `named` are reported where they are removed with their study, here or by the caller.
    """
    former = former_source(out)
    is_of_other_input = former not in (source, None)
    removed = {folder.name for folder in (out / TREATMENTS).glob("*")} - {BARE, *named}
    if removed and (is_of_other_input or is_replaced):
        names = ", ".join(sorted(removed))
        store.progress("stored results", 1.0, f"removed, because this command does not name them: {names}.")
    if is_of_other_input:
        outputs.take_away_results(out)
    elif former is not None and store.is_deferred(ANATOMY):
        outputs.take_away_measures(out)
    writers.write_json(out / CACHE / INPUT, {"layout": LAYOUT, "path": str(path.resolve()), "sha256": source})
    store.save_deferred()
