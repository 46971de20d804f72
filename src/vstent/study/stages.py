"""Stages of a study; the store measures and reports each of them, and keeps their results."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from math import isfinite
from pathlib import Path
from re import fullmatch
from typing import Any, Final

import numpy as np

from vstent.anatomy.morphology import Measures, morphology
from vstent.anatomy.openings import opening_at
from vstent.anatomy.read import read_vessel
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.deployment.deploy import deploy, propose_landing, propose_size
from vstent.deployment.measure import measure
from vstent.devices.catalogue import find_design, find_sizes
from vstent.devices.design import Size
from vstent.devices.ranges import how_sure
from vstent.devices.stent import Deployment, Landing, Stent
from vstent.devices.treatment import BARE, Implant, Treatment
from vstent.errors import DeviceError, FlowError, InputError, LandingError, ReadError, VstentError
from vstent.flow.beside import Beside
from vstent.flow.case import FlowCase, FlowField
from vstent.flow.convergence import Sensitivity, convergence
from vstent.flow.grade import computation_of, grade
from vstent.flow.indices import indices, ratios
from vstent.flow.ostium import ostium, surfaces_beside
from vstent.flow.problem import flow_case, vessel_case
from vstent.flow.settings import FlowSettings
from vstent.flow.simulation import OnProgress, foretell_cost, simulate_case
from vstent.geometry.vessel import Anatomy, Vessel
from vstent.io.files import is_surface_file
from vstent.io.images import read_image
from vstent.kernels.arrays import Floats
from vstent.plan.bands import bands
from vstent.plan.uncertainty import Uncertainty, vary
from vstent.study.folder import flow_folder
from vstent.study.keys import ANATOMY, VESSEL, stage_name
from vstent.study.outputs import write_field
from vstent.study.settings import Point, Settings
from vstent.study.store import Key, Store, Unfinished
from vstent.units import counted

SLOWEST_M_S: Final = 0.01
"""Smallest plausible mean speed at an inlet, in m/s; below it the inflow is taken to be in another unit."""
FASTEST_M_S: Final = 2.0
"""Largest plausible mean speed at an inlet, in m/s; above it the inflow is taken to be in another unit."""

NEAR_MM: Final = 3.0
"""Largest distance from the vessel wall, in mm, at which another interpretation of a point is proposed."""


def find_anatomy(path: Path, settings: Settings, store: Store, keys: Mapping[str, Key]) -> Anatomy:
    """Read, segment, repair, trace, trim and restore; a result stored for this input is returned without computation.

    The store keeps the result in memory until its `settle` writes it.

    Parameters
    ----------
    path : a scan or a surface.
    settings : settings of the study.
    store : results of the study.
    keys : keys of its stages, of `vstent.study.keys`.

    Raises
    ------
    InputError
        An input or option cannot be used. Where no vessel is found at the point `at_mm`, the message proposes the same
        point in another frame or as a voxel index, if there is a vessel.
    """
    kept = store.find(ANATOMY, keys[ANATOMY], Anatomy)
    if kept is not None:
        return kept
    try:
        return _find_anatomy(path, settings, store, keys)
    except InputError as error:
        if settings.anatomy.at_mm is None or settings.anatomy.neck_mm is not None:
            raise
        found = other_reading(path, settings)
        if not found:
            raise
        raise type(error)(f"{error} {found}") from error


def other_reading(path: Path, settings: Settings) -> str:
    """Return a question that proposes another interpretation of the point `at_mm`; empty where none finds a vessel."""
    for words, point_mm in _readings(path, settings):
        with suppress(VstentError):
            vessel = trace(_vessel(path, replace(settings, anatomy=replace(settings.anatomy, at_mm=point_mm))))
            near_mm = vessel.lumen.closest(np.array([point_mm]))[1][0]
            if near_mm < NEAR_MM:
                return f"Did you mean {','.join(f'{x:.1f}' for x in point_mm)} ({words})?"
    return ""


def _readings(path: Path, settings: Settings) -> Iterator[tuple[str, Point]]:
    """Yield other interpretations of the point `at_mm`, as a description and a point in LPS mm."""
    x, y, z = settings.anatomy.at_mm or (0.0, 0.0, 0.0)
    yield "the point given is RAS", (-x, -y, z)
    if not (path.is_file() and is_surface_file(path)):
        given = settings.input
        image = read_image(path, spacing_mm=given.spacing_mm, shape=given.shape, acquisition=given.acquisition)
        if all(0 <= i < n for i, n in zip((x, y, z), image.voxels.shape, strict=True)):
            i, j, k = image.to_mm(np.array([[x, y, z]]))[0].tolist()
            yield "the point given is a voxel index", (i, j, k)
    yield "with the first sign changed", (-x, y, z)
    yield "with the second sign changed", (x, -y, z)


def _find_anatomy(path: Path, settings: Settings, store: Store, keys: Mapping[str, Key]) -> Anatomy:
    """Return the anatomy of an input, computed."""
    given = settings.anatomy
    whole = find_vessel(path, settings, store, keys)
    neck_mm = None if given.neck_mm is None else np.array(given.neck_mm, dtype=np.float64)
    at_mm = _array(given.at_mm) if neck_mm is None else neck_mm.mean(axis=0)
    outlet_mm = _array(given.outlet_mm)
    if outlet_mm is not None:
        opening_at(whole, outlet_mm)  # checked before trimming, which may cut this outlet off
    with store.stage("trim") as tell:
        traced = trim(whole, at_mm=at_mm, upstream_mm=given.upstream_mm, downstream_mm=given.downstream_mm)
        tell(" ".join(traced.notes[len(whole.notes) :]))
    with store.stage("restore") as tell:
        anatomy = restore(traced, at_mm=_array(given.at_mm), outlet_mm=outlet_mm, neck_mm=neck_mm)
        tell(" ".join([*anatomy.notes, *(f"Sac volume {a.sac.volume_mm3:.0f} mm3." for a in anatomy.aneurysms)]))
    store.hold(ANATOMY, keys[ANATOMY], anatomy)
    return anatomy


def find_vessel(path: Path, settings: Settings, store: Store, keys: Mapping[str, Key]) -> Vessel:
    """Read, segment, repair and trace; a result stored for this input is returned without computation.

    The store keeps the result in memory until its `settle` writes it.
    """
    kept = store.find(VESSEL, keys[VESSEL], Vessel)
    if kept is not None:
        return kept
    with store.stage("segment") as tell:
        vessel = _vessel(path, settings)
        tell(" ".join(vessel.notes))
    with store.stage("trace") as tell:
        traced = trace(vessel, inlet_mm=_array(settings.anatomy.inlet_mm))
        widths = ", ".join(f"{inlet.role} {inlet.diameter_mm:.1f} mm wide" for inlet in traced.inlets)
        found = f"{counted(len(traced.outlets), 'outlet')}; {widths}."
        tell(" ".join([found, *traced.notes[len(vessel.notes) :]]))
    store.hold(VESSEL, keys[VESSEL], traced)
    return traced


def _vessel(path: Path, settings: Settings) -> Vessel:
    """Return the repaired vessel of an input, without openings and centerlines."""
    at_mm, inlet_mm = settings.anatomy.at_mm, settings.anatomy.inlet_mm
    if at_mm is None and inlet_mm is not None and is_surface_file(path):  # it chooses a piece of the surface
        at_mm = np.atleast_2d(inlet_mm)[0]
    return read_vessel(path, **asdict(settings.input), at_mm=at_mm)


def finished_anatomy(out: Path, store: Store, keys: Mapping[str, Key]) -> Anatomy:
    """Return the stored anatomy of a finished run of a case folder; ReadError is raised where it is missing."""
    anatomy = store.find(ANATOMY, keys[ANATOMY], Anatomy)
    if anatomy is None:
        raise ReadError(f"{out} does not hold the artery of its run: give the same command as for that run again")
    return anatomy


def deploy_all(
    anatomy: Anatomy, settings: Settings, store: Store, keys: Mapping[str, Key]
) -> tuple[dict[str, dict[str, Deployment]], dict[str, str]]:
    """Deploy the implants of every treatment in the given or the proposed sizes; stored ones are not computed again.

    Raises
    ------
    DeviceError, LandingError
        No treatment can be deployed; the reason is that of the last one.
    """
    found: dict[str, dict[str, Deployment]] = {}
    failures: dict[str, str] = {}
    for treatment in settings.treatments:
        try:
            found[treatment.name] = _deployed(treatment, anatomy, store, keys)
        except (DeviceError, LandingError) as error:
            if len(failures) + 1 == len(settings.treatments):  # the last one too
                raise
            failures[treatment.name] = f"not deployed: {error}"
            store.progress(f"deploy {treatment.name}", 1.0, failures[treatment.name])
    return found, failures


def _deployed(treatment: Treatment, anatomy: Anatomy, store: Store, keys: Mapping[str, Key]) -> dict[str, Deployment]:
    """Return the deployed implants of a treatment by id, each stored or computed."""
    found: dict[str, Deployment] = {}
    for implant in treatment.implants:
        stage = f"deploy {stage_name(treatment, implant)}"
        deployment = store.find(stage, keys[stage], Deployment)
        if deployment is None:
            with store.stage(stage) as tell:
                try:
                    deployment = deploy_implant(implant, anatomy, [found[name].stent for name in implant.inside])
                except (DeviceError, LandingError) as error:
                    if len(treatment.implants) > 1:
                        error.args = (f"{implant.id}, an implant of {treatment.name}: {error}",)
                    raise
                tell(deployment.advice)
            store.hold(stage, keys[stage], deployment)
        found[implant.id] = deployment
    return found


def deploy_implant(implant: Implant, anatomy: Anatomy, inside: Sequence[Stent] = ()) -> Deployment:
    """Deploy an implant in the given size and place; missing values are proposed.

    Parameters
    ----------
    implant : the implant.
    anatomy : vessel, sacs and paths.
    inside : implants that are there before it, in the order of their deployment.
    """
    anatomy = on_path(anatomy, implant.placing.path)
    size = size_of(implant, anatomy)
    landing = landing_of(implant, anatomy, size)
    return deploy(find_design(implant.device), anatomy, size=size, landing=landing, inside=inside)


def landing_of(implant: Implant, anatomy: Anatomy, size: Size) -> Landing | None:
    """Return the given place of an implant, or the proposed one with the given shift; None where neither is given.

    Parameters
    ----------
    implant : the implant.
    anatomy : vessel, sacs and paths, that of the implant in the first place.
    size : size of the implant.
    """
    placing = implant.placing
    if placing.position_mm is not None:
        return Landing(placing.position_mm, placing.anchor)
    if not placing.shift_mm:
        return None
    proposed = propose_landing(find_design(implant.device), anatomy, size)
    return replace(proposed, abscissa_mm=proposed.abscissa_mm + placing.shift_mm)


def on_path(anatomy: Anatomy, name: str) -> Anatomy:
    """Return the anatomy with a path in the first place, where implants are deployed.

    Raises
    ------
    InputError
        There is no path of this name.
    """
    path = anatomy.path(name)
    return replace(anatomy, paths=(path, *(other for other in anatomy.paths if other is not path)))


def size_of(implant: Implant, anatomy: Anatomy) -> Size:
    """Return the given size of an implant; where diameter or length is missing, the best of the matching sizes.

    Parameters
    ----------
    implant : the implant.
    anatomy : vessel, sacs and paths.

    Raises
    ------
    DeviceError
        The device is not made in that size.
    LandingError
        No matching size fits the artery.
    """
    design = find_design(implant.device)
    sizes = find_sizes(design, diameter_mm=implant.diameter_mm, length_mm=implant.length_mm)
    if implant.diameter_mm is not None and implant.length_mm is not None:
        return sizes[0]
    return propose_size(replace(design, sizes=sizes), anatomy)


def check_inflow(anatomy: Anatomy, flow: FlowSettings | None) -> None:
    """Refuse a mean inflow that no artery has, because it is probably in another unit.

    Raises
    ------
    InputError
        The mean speed at an inlet is implausible.
    """
    if flow is None or flow.inflow_mL_s is None:
        return
    case = vessel_case(anatomy.vessel, flow)
    for inlet, part_mL_s, speed_m_s in zip(case.vessel.inlets, case.inlets_mL_s, case.inlet_speeds_m_s, strict=True):
        if not SLOWEST_M_S <= speed_m_s <= FASTEST_M_S:
            raise InputError(
                f"a mean inflow of {part_mL_s:g} mL/s through an inlet {inlet.diameter_mm:.1f} mm wide is "
                f"{speed_m_s:.2g} m/s, but blood flows in arteries at {SLOWEST_M_S:g} to {FASTEST_M_S:g} m/s: "
                "give mL/s (240 mL/min are 4 mL/s), or choose another inlet"
            )


def engine_folders(out: Path, settings: Settings) -> dict[str, Path]:
    """Return the folder of the engine's own files for every flow, by treatment; empty where no flow is computed."""
    if settings.flow is None:
        return {}
    names = (BARE, *(treatment.name for treatment in settings.treatments))
    return {name: flow_folder(out, name) / settings.flow.numerics.engine for name in names}


def compute_flows(
    out: Path,
    anatomy: Anatomy,
    implants: Mapping[str, Mapping[str, Deployment]],
    settings: Settings,
    store: Store,
    keys: Mapping[str, Key],
) -> tuple[dict[str, FlowField], dict[str, str]]:
    """Compute the flow in the bare artery and with every treatment; each is stored as soon as it is finished.

    With a GPU it is stored while the next one is computed.

    Raises
    ------
    FlowError
        The flow in the bare artery could not be computed.
    """
    if settings.flow is None:
        return {}, {}
    fields: dict[str, FlowField] = {}
    failures: dict[str, str] = {}
    folders, stored = engine_folders(out, settings), []
    stents = {BARE: [], **{name: [one.stent for one in found.values()] for name, found in implants.items()}}
    names = (BARE, *(one.name for one in settings.treatments if one.has_flow and one.name in implants))
    with Beside(settings.flow.numerics) as beside:
        for name in names:
            stage, keep = f"flow {name}", None
            field = store.find(stage, keys[stage], FlowField)
            if field is None:
                if name == BARE:
                    _plan(anatomy, stents, settings.flow, store)
                try:
                    with store.stage(stage) as tell:
                        field = compute_flow(
                            anatomy,
                            stents[name],
                            settings.flow,
                            start=fields.get(BARE),
                            folder=folders[name],
                            progress=store.teller(stage),
                            unfinished=store.unfinished(stage, keys[stage]),
                        )
                        tell(field.advice)
                except FlowError as error:
                    if name == BARE:
                        raise
                    failures[name] = f"flow not computed: {error}"
                    store.progress(stage, 1.0, failures[name])
                    continue
                keep = store.keeping(stage, keys[stage], field)
            fields[name] = field
            stored.append(beside.do(partial(_keep, keep, flow_folder(out, name), field)))
    for done in stored:
        done()
    return fields, failures


def _keep(keep: Callable[[], None] | None, folder: Path, field: FlowField) -> None:
    """Store a flow, unless it was read from the store, and write its files."""
    if keep is not None:
        keep()
    write_field(folder, field)


def compute_flow(
    anatomy: Anatomy,
    stents: Sequence[Stent],
    settings: FlowSettings,
    *,
    start: FlowField | None,
    folder: Path,
    progress: OnProgress,
    unfinished: Unfinished,
) -> FlowField:
    """Compute one flow; an unfinished one resumes."""
    case = flow_case(anatomy, stents, settings)
    return simulate_case(case, start=start, folder=folder, progress=progress, checkpoint=unfinished)


def refine(out: Path, anatomy: Anatomy, settings: Settings, store: Store) -> Sensitivity:
    """Compute the flow without a device on three grids, with three time steps and in three positions on the grid.

    Parameters
    ----------
    out : the case folder.
    anatomy : vessel, parent artery and sacs.
    settings : settings of the study; the grid spacing is that of the finest grid.
    store : results of the study.
    """
    flow = settings.flow or FlowSettings()
    _plan(anatomy, {BARE: ()}, flow, store)
    with store.stage("convergence") as tell:
        done: list[str] = []

        def told(fraction: float, sentence: str) -> None:
            done.append(sentence)
            store.progress("convergence", 0.99 * fraction, sentence)

        folder = out / "convergence" / flow.numerics.engine
        found = convergence(flow_case(anatomy, (), flow), folder=folder, told=told)
        tell(" ".join(done))
    return found


def _plan(anatomy: Anatomy, stents: Mapping[str, Sequence[Stent]], settings: FlowSettings, store: Store) -> None:
    """Report run time and memory of the flows by treatment; an error is raised where one does not fit in the memory."""
    with store.stage("plan flow") as tell:
        costs = {name: foretell_cost(flow_case(anatomy, found, settings)) for name, found in stents.items()}
        said = costs.pop(BARE)
        tell(" ".join([said, *(f"With {name}, {cost}" for name, cost in costs.items() if cost != said)]))


def vary_all(
    anatomy: Anatomy,
    implants: Mapping[str, Mapping[str, Deployment]],
    settings: Settings,
    store: Store,
    keys: Mapping[str, Key],
) -> dict[str, dict[str, Any]]:
    """Vary the uncertain inputs of every treatment with one implant."""
    if settings.uncertainty is None:
        return {}
    flow = settings.flow if settings.uncertainty.flow_samples else None
    found = {}
    for treatment in settings.treatments:
        stage, deployed = f"vary {treatment.name}", implants.get(treatment.name, {})
        if len(deployed) > 1:
            store.progress(stage, 1.0, "left out: only treatments of one implant are varied.")
        if len(deployed) != 1:
            continue
        (deployment,) = deployed.values()
        varied = store.find(stage, keys[stage], Uncertainty)
        if varied is None:
            with store.stage(stage) as tell:
                told = partial(_tell_count, store, stage)
                begun = store.unfinished(stage, keys[stage])
                varied = vary(anatomy, deployment, settings.uncertainty, flow=flow, progress=told, checkpoint=begun)
                tell(f"{len(varied.points)} deployments; {varied.n_failed} of them did not fit.")
            store.keep(stage, keys[stage], varied)
        found[treatment.name] = varied.metrics()
    return found


def _tell_count(store: Store, stage: str, done: int, total: int) -> None:
    """Report that `done` of `total` deployments of a stage are finished."""
    store.progress(stage, 0.99 * done / total, f"{done} of {total}")


def measure_study(
    anatomy: Anatomy,
    implants: Mapping[str, Mapping[str, Deployment]],
    fields: Mapping[str, FlowField],
    settings: Settings,
    varied: Mapping[str, Any],
    failures: Mapping[str, str],
) -> dict[str, Any]:
    """Return all metrics of a study: of vessel, implants and flows, with bands, uncertainties and failures."""
    metrics = measure_all(anatomy, implants, fields, settings.flow)
    band_all(anatomy, implants, metrics, settings)
    for name, spread in varied.items():
        metrics["treatments"][name]["uncertainty"] = spread
    return metrics | ({"failures": dict(failures)} if failures else {})


def measure_all(
    anatomy: Anatomy,
    implants: Mapping[str, Mapping[str, Deployment]],
    fields: Mapping[str, FlowField],
    settings: FlowSettings | None = None,
) -> dict[str, Any]:
    """Return the metrics of the vessel and of every treatment."""
    sac = anatomy.aneurysms[0] if anatomy.aneurysms else None
    lumen = anatomy.vessel.lumen
    shapes = (sac.sac, ostium(sac, lumen), surfaces_beside(sac, lumen)) if sac and fields else ()
    treatments: dict[str, dict[str, Any]] = {BARE: {}} if fields else {}
    for name, found in implants.items():
        treatments[name] = {"implants": {id_: measure(anatomy, one) for id_, one in found.items()}}
    case = flow_case(anatomy, (), settings) if fields else None
    bare: dict[str, float] = {}
    for name, field in fields.items():
        flow = indices(field, *shapes)
        left = {"unsettled_fraction": field.unsettled_fraction} if isfinite(field.unsettled_fraction) else {}
        treatments[name]["flow"] = flow | left
        if name == BARE:
            bare = flow
        else:
            treatments[name]["change"] = ratios(bare, flow)
        assert case is not None
        treatments[name]["quality"] = _quality(case, field, flow)
    return {"vessel": morphology(anatomy), "treatments": treatments}


def neck_notes(metrics: Mapping[str, Any]) -> tuple[str, ...]:
    """Return a note on every flow whose neck inflow exceeds the flow through all inlets."""
    notes = []
    for name, treatment in metrics["treatments"].items():
        flow = treatment.get("flow", {})
        entering_mL_s = sum(value for key, value in flow.items() if fullmatch(r"inlet(_\d+)?_flow_mL_s", key))
        if flow.get("neck_inflow_mL_s", 0.0) > entering_mL_s:
            notes.append(
                f"Flow, {name}: the neck inflow, {flow['neck_inflow_mL_s']:.2f} mL/s, exceeds the "
                f"{entering_mL_s:.2f} mL/s that enter the vessel: blood crosses the neck to and fro. Compare it with "
                "the inflow 0.5 mm into the sac."
            )
    return tuple(notes)


def band_all(
    anatomy: Anatomy,
    implants: Mapping[str, Mapping[str, Deployment]],
    metrics: dict[str, Any],
    settings: Settings,
) -> None:
    """Add to the metrics of every implant the bands from the ranges of its device, and how sure the device is."""
    for treatment in settings.treatments:
        for implant in treatment.implants if treatment.name in implants else ():
            measures = metrics["treatments"][treatment.name]["implants"][implant.id]
            measures["bands"] = bands_of(anatomy, implants[treatment.name][implant.id], measures, implant)


def bands_of(anatomy: Anatomy, deployment: Deployment, measures: Measures, implant: Implant) -> dict[str, Any]:
    """Return the bands that the ranges of its device give to a deployment, and how sure the device is, as metrics.

    Parameters
    ----------
    anatomy : vessel, sacs and paths.
    deployment : the deployed implant.
    measures : its measures.
    implant : size and place that were given; the band of the proposed size is added where no size was.
    """
    is_proposed = implant.diameter_mm is None and implant.length_mm is None
    found = bands(anatomy, deployment, measures, is_proposed=is_proposed)
    return found.metrics() | {"device": how_sure(deployment.stent.design)}


def _quality(case: FlowCase, field: FlowField, found: Mapping[str, float]) -> dict[str, Any]:
    """Return the grade of a flow, its reasons, and what was computed."""
    judged = grade(case, field, found)
    return {"grade": judged.level, "reasons": list(judged.reasons)} | judged.measures | computation_of(case, field)


def _array(points_mm: Point | tuple[Point, ...] | None) -> Floats | None:
    """Return points as an array (3,) or (n, 3); None where none is given."""
    return None if points_mm is None else np.array(points_mm, dtype=np.float64)
