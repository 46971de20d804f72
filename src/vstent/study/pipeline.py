"""Study of one case: from a scan or surface to the flow without and with each device, in a case folder.

Nothing is written until every device is deployed, so an unusable input leaves no files. From then on every finished
stage is stored in the case folder under a key of everything that it depends on. Running the same study again reads
stored stages instead of computing them.
"""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from vstent.anatomy.morphology import morphology
from vstent.devices.catalogue import find_design
from vstent.devices.design import BARE
from vstent.flow.convergence import Sensitivity
from vstent.geometry.vessel import Anatomy, Vessel
from vstent.io import writers
from vstent.study.crate import NAME as CRATE
from vstent.study.folder import CACHE, claiming
from vstent.study.ledger import ANATOMY, Ledger, hash_of
from vstent.study.outputs import (
    take_away_measures,
    take_away_results,
    take_away_study,
    write_anatomy,
    write_stent,
    write_vessel,
)
from vstent.study.provenance import INPUT, METRICS, RUN, provenance
from vstent.study.repeat import SECONDS, former_source, is_of_another
from vstent.study.stages import (
    check_inflow,
    compute_flows,
    deploy_all,
    engine_folders,
    find_anatomy,
    find_vessel,
    measure_all,
    refine,
    vary_all,
)
from vstent.study.types import CaseResult, Progress, Settings


@claiming
def run(path: Path, out: Path, settings: Settings, progress: Progress) -> CaseResult:
    """Run one study and write its case folder; an interrupted study in that folder is resumed.

    Parameters
    ----------
    path : a scan or a surface.
    out : the case folder.
    settings : settings; fields that are None are chosen automatically.
    progress : called at each stage.

    Raises
    ------
    InputError
        The input or a setting cannot be used; nothing has been written.
    FlowError
        A flow could not be computed; the finished stages are kept.
    FolderError
        Another process uses the folder, or it cannot be written to.
    """
    designs = {name: find_design(name) for name in settings.devices}
    ledger = Ledger(out / CACHE, progress)
    source = hash_of(path)
    anatomy = find_anatomy(path, source, settings, ledger)
    check_inflow(anatomy, settings.flow)
    deployments = deploy_all(designs, anatomy, settings, ledger)
    told = provenance(path, source, settings)
    has_former = is_of_another(out, told)
    _settle(path, out, source, ledger)
    if has_former:
        take_away_study(out, engine_folders(out, settings).values())
    (out / CRATE).unlink(missing_ok=True)  # it describes files that are now rewritten
    write_anatomy(out, anatomy)
    for name, deployment in deployments.items():
        with ledger.stage(f"struts {name}") as tell:
            tell(write_stent(out / "stents" / name, deployment))
    fields = compute_flows(out, anatomy, deployments, settings, ledger, source)
    varied = vary_all(anatomy, deployments, settings, ledger, source)
    with ledger.stage("measure"):
        metrics = measure_all(anatomy, deployments, fields)
        for name, spread in varied.items():
            metrics["stents"][name]["uncertainty"] = spread
        writers.write_json(out / METRICS, metrics)
    told[SECONDS] = ledger.seconds
    writers.write_json(out / RUN, told, is_exact=True)
    of_flows = (f"Flow {_described(name)}: {field.advice}" for name, field in fields.items())
    notes = (*anatomy.vessel.notes, *anatomy.notes, *of_flows)
    return CaseResult(out.resolve().name, anatomy, deployments, fields, metrics, told, notes)


@claiming
def trace_vessel(path: Path, out: Path, settings: Settings, progress: Progress) -> Vessel:
    """Extract the vessel, its openings and its centerlines, without trimming, and write them.

    Parameters
    ----------
    path : a scan or a surface.
    out : the folder to write.
    settings : settings; fields that are None are chosen automatically.
    progress : called at each stage.

    Raises
    ------
    InputError
        The input or a setting cannot be used; nothing has been written.
    """
    ledger = Ledger(out / CACHE, progress)
    source = hash_of(path)
    vessel = find_vessel(path, source, settings, ledger)
    _settle(path, out, source, ledger)
    write_vessel(out, vessel)
    return vessel


@claiming
def restore_vessel(path: Path, out: Path, settings: Settings, progress: Progress) -> tuple[Anatomy, dict[str, Any]]:
    """Find the sac and its neck, reconstruct the parent artery, measure both and write them.

    A study in the same case folder reuses these stages, and this function reuses those of a study.

    Parameters
    ----------
    path : a scan or a surface.
    out : the case folder.
    settings : settings; fields that are None are chosen automatically.
    progress : called at each stage.

    Returns
    -------
    anatomy : vessel, parent artery and sacs.
    measures : morphology, by metric key.

    Raises
    ------
    InputError
        The input or a setting cannot be used; nothing has been written.
    """
    ledger = Ledger(out / CACHE, progress)
    source = hash_of(path)
    anatomy = find_anatomy(path, source, settings, ledger)
    measures = morphology(anatomy)
    _settle(path, out, source, ledger)
    write_anatomy(out, anatomy)
    writers.write_json(out / "morphology.json", measures)
    return anatomy, measures


@claiming
def refine_flow(path: Path, out: Path, settings: Settings, progress: Progress) -> Sensitivity:
    """Compute the flow without a device for three grid spacings, time steps and positions on the grid.

    The results are written to ``convergence.json``.

    Parameters
    ----------
    path : a scan or a surface.
    out : the case folder.
    settings : settings; fields that are None are chosen automatically. The grid spacing is the finest of the three.
    progress : called at each stage.

    Raises
    ------
    InputError
        The input or a setting cannot be used; nothing has been written.
    FlowError
        A flow could not be computed.
    """
    ledger = Ledger(out / CACHE, progress)
    source = hash_of(path)
    anatomy = find_anatomy(path, source, settings, ledger)
    check_inflow(anatomy, settings.flow)
    _settle(path, out, source, ledger)
    found = refine(out, anatomy, settings, ledger)
    kept = {one.name: asdict(one) for one in found.refinements}
    kept["grid_position"] = {key: asdict(one) for key, one in found.positions.items()}
    writers.write_json(out / "convergence.json", kept)
    return found


def _described(flow: str) -> str:
    """Return the name of a flow in words: without a device, or with which."""
    return "without a device" if flow == BARE else f"with {flow}"


def _settle(path: Path, out: Path, source: str, ledger: Ledger) -> None:
    """Store the results that wait and record the input; delete results of another input or of another anatomy."""
    former = former_source(out)
    if former not in (source, None):
        take_away_results(out)
    elif former is not None and ledger.is_held(ANATOMY):
        take_away_measures(out)
    ledger.settle()
    writers.write_json(out / CACHE / INPUT, {"path": str(path.resolve()), "sha256": source})
