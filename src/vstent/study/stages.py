"""Stages of a study; the ledger measures and reports each of them."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from math import isfinite
from pathlib import Path
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
from vstent.errors import DeviceError, FlowError, InputError, LandingError, VstentError
from vstent.flow.beside import Beside
from vstent.flow.case import FlowCase, FlowField
from vstent.flow.convergence import Sensitivity, convergence
from vstent.flow.grade import computation_of, grade
from vstent.flow.indices import indices, ratios
from vstent.flow.ostium import ostium
from vstent.flow.problem import flow_case, vessel_case
from vstent.flow.settings import FlowSettings
from vstent.flow.simulation import foretell_cost, simulate_case
from vstent.geometry.vessel import Anatomy, Vessel
from vstent.io.files import is_surface_file
from vstent.io.images import read_image
from vstent.kernels.arrays import Floats
from vstent.plan.bands import bands
from vstent.plan.uncertainty import Uncertainty, vary
from vstent.study.checkpoint import FlowCheckpoint
from vstent.study.folder import flow_folder
from vstent.study.ledger import ANATOMY, Ledger, anatomy_key, key_of, vessel_key
from vstent.study.outputs import write_field
from vstent.study.types import Point, Settings
from vstent.study.written import code_key
from vstent.units import counted

SLOWEST_M_S: Final = 0.01
"""Smallest plausible mean speed at an inlet, in m/s; below it the inflow is taken to be in another unit."""
FASTEST_M_S: Final = 2.0
"""Largest plausible mean speed at an inlet, in m/s; above it the inflow is taken to be in another unit."""

NEAR_MM: Final = 3.0
"""Largest distance from the vessel wall, in mm, at which another interpretation of a point is proposed."""


def find_anatomy(path: Path, source: str, settings: Settings, ledger: Ledger) -> Anatomy:
    """Read, segment, repair, trace, trim and restore; a result stored for this input is returned without computation.

    The ledger keeps the result in memory until its `settle` stores it.

    Parameters
    ----------
    path : a scan or a surface.
    source : SHA-256 of the input.
    settings : settings of the study.
    ledger : record of the study.

    Raises
    ------
    InputError
        An input or option cannot be used. Where no vessel is found at the point `at_mm`, the message proposes the same
        point in another frame or as a voxel index, if there is a vessel.
    """
    key = anatomy_key(source, settings)
    kept = ledger.recall(ANATOMY, key, Anatomy)
    if kept is not None:
        return kept
    try:
        return _find_anatomy(path, source, settings, ledger, key)
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


def _find_anatomy(path: Path, source: str, settings: Settings, ledger: Ledger, key: str) -> Anatomy:
    """Return the anatomy of an input, computed."""
    whole = find_vessel(path, source, settings, ledger)
    neck_mm = None if settings.anatomy.neck_mm is None else np.array(settings.anatomy.neck_mm, dtype=np.float64)
    at_mm = _array(settings.anatomy.at_mm) if neck_mm is None else neck_mm.mean(axis=0)
    outlet_mm = _array(settings.anatomy.outlet_mm)
    if outlet_mm is not None:
        opening_at(whole, outlet_mm)  # checked before trimming, which may cut this outlet off
    with ledger.stage("trim") as tell:
        traced = trim(
            whole, at_mm=at_mm, upstream_mm=settings.anatomy.upstream_mm, downstream_mm=settings.anatomy.downstream_mm
        )
        tell(" ".join(traced.notes[len(whole.notes) :]))
    with ledger.stage("restore") as tell:
        anatomy = restore(traced, at_mm=_array(settings.anatomy.at_mm), outlet_mm=outlet_mm, neck_mm=neck_mm)
        tell(" ".join([*anatomy.notes, *(f"Sac volume {a.sac.volume_mm3:.0f} mm3." for a in anatomy.aneurysms)]))
    ledger.hold(ANATOMY, key, anatomy)
    return anatomy


def find_vessel(path: Path, source: str, settings: Settings, ledger: Ledger) -> Vessel:
    """Read, segment, repair and trace; a result stored for this input is returned without computation.

    The ledger keeps the result in memory until its `settle` stores it.

    Parameters
    ----------
    path : a scan or a surface.
    source : SHA-256 of the input.
    settings : settings of the study.
    ledger : record of the study.
    """
    key = vessel_key(source, settings)
    kept = ledger.recall("vessel", key, Vessel)
    if kept is not None:
        return kept
    with ledger.stage("segment") as tell:
        vessel = _vessel(path, settings)
        tell(" ".join(vessel.notes))
    with ledger.stage("trace") as tell:
        traced = trace(vessel, inlet_mm=_array(settings.anatomy.inlet_mm))
        widths = ", ".join(f"{inlet.role} {inlet.diameter_mm:.1f} mm wide" for inlet in traced.inlets)
        found = f"{counted(len(traced.outlets), 'outlet')}; {widths}."
        tell(" ".join([found, *traced.notes[len(vessel.notes) :]]))
    ledger.hold("vessel", key, traced)
    return traced


def _vessel(path: Path, settings: Settings) -> Vessel:
    """Return the repaired vessel of an input, without openings and centerlines."""
    at_mm, inlet_mm = settings.anatomy.at_mm, settings.anatomy.inlet_mm
    if at_mm is None and inlet_mm is not None and is_surface_file(path):  # it chooses a piece of the surface
        at_mm = np.atleast_2d(inlet_mm)[0]
    return read_vessel(path, **asdict(settings.input), at_mm=at_mm)


def deploy_all(
    anatomy: Anatomy, settings: Settings, ledger: Ledger, source: str
) -> tuple[dict[str, dict[str, Deployment]], dict[str, str]]:
    """Deploy the implants of every treatment in the given or the proposed sizes; stored ones are not computed again.

    Parameters
    ----------
    anatomy : vessel, sacs and paths.
    settings : settings of the study.
    ledger : record of the study; it keeps new deployments in memory until its `settle` stores them.
    source : SHA-256 of the input.

    Returns
    -------
    implants : dict
        Deployed implants by treatment and id.
    failures : dict
        Reasons by the name of each treatment that could not be deployed.

    Raises
    ------
    DeviceError, LandingError
        No treatment can be deployed; the reason is that of the last one.
    """
    found: dict[str, dict[str, Deployment]] = {}
    failures: dict[str, str] = {}
    for treatment in settings.treatments:
        try:
            found[treatment.name] = _deployed(treatment, anatomy, settings, ledger, source)
        except (DeviceError, LandingError) as error:
            if len(failures) + 1 == len(settings.treatments):  # the last one too
                raise
            failures[treatment.name] = f"not deployed: {error}"
            ledger.progress(f"deploy {treatment.name}", 1.0, failures[treatment.name])
    return found, failures


def _deployed(
    treatment: Treatment, anatomy: Anatomy, settings: Settings, ledger: Ledger, source: str
) -> dict[str, Deployment]:
    """Return the deployed implants of a treatment by id, each stored or computed."""
    found: dict[str, Deployment] = {}
    keys = implant_keys(source, settings, treatment)
    for implant in treatment.implants:
        stage = f"deploy {stage_name(treatment, implant)}"
        deployment = ledger.recall(stage, keys[implant.id], Deployment)
        if deployment is None:
            with ledger.stage(stage) as tell:
                deployment = deploy_implant(implant, anatomy, [found[name].stent for name in implant.inside])
                tell(deployment.advice)
            ledger.hold(stage, keys[implant.id], deployment)
        found[implant.id] = deployment
    return found


def stage_name(treatment: Treatment, implant: Implant) -> str:
    """Return the name of an implant in names of stages: that of its treatment, and its own beside others."""
    return treatment.name if len(treatment.implants) == 1 else f"{treatment.name} {implant.id}"


def implant_keys(source: str, settings: Settings, treatment: Treatment) -> dict[str, str]:
    """Return the keys of the deployments of a treatment by the implants' ids.

    Parameters
    ----------
    source : SHA-256 of the input.
    settings : settings of the study.
    treatment : the treatment.
    """
    keys: dict[str, str] = {}
    for implant in treatment.implants:
        given = find_design(implant.device), implant.diameter_mm, implant.length_mm, implant.placing
        inside = [keys[name] for name in implant.inside]
        keys[implant.id] = key_of(code_key(), anatomy_key(source, settings), *given, inside)
    return keys


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

    Parameters
    ----------
    anatomy : vessel with its inlets.
    flow : settings of the flow; None: no flow is computed.

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
    ledger: Ledger,
    source: str,
) -> tuple[dict[str, FlowField], dict[str, str]]:
    """Compute the flow in the bare artery and with every treatment; each is stored as soon as it is finished.

    With a GPU it is stored while the next one is computed.

    Parameters
    ----------
    out : the case folder.
    anatomy : vessel, sacs and paths.
    implants : deployed implants by treatment and id.
    settings : settings of the study.
    ledger : record of the study.
    source : SHA-256 of the input.

    Returns
    -------
    fields : dict
        Flows by treatment, ``bare`` first.
    failures : dict
        Reasons by the name of each treatment whose flow could not be computed.

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
    with Beside(settings.flow.numerics) as beside:
        for name, key in flow_keys(source, settings).items():
            if name not in stents:
                continue  # it could not be deployed
            stage = f"flow {name}"
            field, store = ledger.recall(stage, key, FlowField), None
            if field is None:
                if name == BARE:
                    _plan(anatomy, stents, settings.flow, ledger)
                try:
                    with ledger.stage(stage) as tell:
                        field = simulate_case(
                            flow_case(anatomy, stents[name], settings.flow),
                            start=fields.get(BARE),
                            folder=folders[name],
                            progress=ledger.teller(stage),
                            checkpoint=FlowCheckpoint(ledger.folder, stage, key),
                        )
                        tell(field.advice)
                except FlowError as error:
                    if name == BARE:
                        raise
                    failures[name] = f"flow not computed: {error}"
                    ledger.progress(stage, 1.0, failures[name])
                    continue
                store = ledger.keeping(stage, key, field)
            fields[name] = field
            stored.append(beside.do(partial(_store, store, flow_folder(out, name), field)))
    for done in stored:
        done()
    return fields, failures


def _store(store: Callable[[], None] | None, folder: Path, field: FlowField) -> None:
    """Store a flow in the ledger, unless it was read from there, and write its files."""
    if store is not None:
        store()
    write_field(folder, field)


def flow_keys(source: str, settings: Settings) -> dict[str, str]:
    """Return the keys of the flows of a study by treatment, ``bare`` first.

    Parameters
    ----------
    source : SHA-256 of the input.
    settings : settings of the study.
    """
    wanted = [treatment for treatment in settings.treatments if treatment.has_flow]
    anatomy = anatomy_key(source, settings)
    return {
        one.name: key_of(anatomy, settings.flow, *implant_keys(source, settings, one).values())
        for one in (Treatment(BARE), *wanted)
    }


def refine(out: Path, anatomy: Anatomy, settings: Settings, ledger: Ledger) -> Sensitivity:
    """Compute the flow without a device on three grids, with three time steps and in three positions on the grid.

    Parameters
    ----------
    out : the case folder.
    anatomy : vessel, parent artery and sacs.
    settings : settings of the study; the grid spacing is that of the finest grid.
    ledger : record of the study.
    """
    flow = settings.flow or FlowSettings()
    _plan(anatomy, {}, flow, ledger)
    with ledger.stage("convergence") as tell:
        done: list[str] = []

        def told(fraction: float, sentence: str) -> None:
            done.append(sentence)
            ledger.progress("convergence", 0.99 * fraction, sentence)

        folder = out / "convergence" / flow.numerics.engine
        found = convergence(flow_case(anatomy, (), flow), folder=folder, told=told)
        tell(" ".join(done))
    return found


def _plan(anatomy: Anatomy, stents: Mapping[str, Sequence[Stent]], settings: FlowSettings, ledger: Ledger) -> None:
    """Report run time and memory of the flows by treatment; an error is raised where one does not fit in the memory."""
    with ledger.stage("plan flow") as tell:
        costs = {name: foretell_cost(flow_case(anatomy, found, settings)) for name, found in stents.items()}
        said = costs.pop(BARE)
        tell(" ".join([said, *(f"With {name}, {cost}" for name, cost in costs.items() if cost != said)]))


def vary_all(
    anatomy: Anatomy,
    implants: Mapping[str, Mapping[str, Deployment]],
    settings: Settings,
    ledger: Ledger,
    source: str,
) -> dict[str, dict[str, Any]]:
    """Vary the uncertain inputs of every treatment with one implant.

    Parameters
    ----------
    anatomy : vessel, sacs and paths.
    implants : deployed implants by treatment and id.
    settings : settings of the study.
    ledger : record of the study.
    source : SHA-256 of the input.

    Returns
    -------
    dict
        Uncertainty metrics by treatment; empty without an uncertainty study.
    """
    if settings.uncertainty is None:
        return {}
    flow = settings.flow if settings.uncertainty.flow_samples else None
    found = {}
    for treatment in settings.treatments:
        if len(implants.get(treatment.name, ())) != 1:
            continue
        (deployment,) = implants[treatment.name].values()
        (implant_key,) = implant_keys(source, settings, treatment).values()
        stage = f"vary {treatment.name}"
        numbers = [asdict(one) for one in settings.uncertainty.numbers_of(deployment.stent.design)]
        key = key_of(implant_key, settings.uncertainty, flow, numbers)
        varied = ledger.recall(stage, key, Uncertainty)
        if varied is None:
            with ledger.stage(stage) as tell:
                told = partial(_tell_count, ledger, stage)
                begun = FlowCheckpoint(ledger.folder, stage, key)
                varied = vary(anatomy, deployment, settings.uncertainty, flow=flow, progress=told, checkpoint=begun)
                tell(f"{len(varied.points)} deployments; {varied.n_failed} of them did not fit.")
            ledger.keep(stage, key, varied)
        found[treatment.name] = varied.metrics()
    return found


def _tell_count(ledger: Ledger, stage: str, done: int, total: int) -> None:
    """Report that `done` of `total` deployments of a stage are finished."""
    ledger.progress(stage, 0.99 * done / total, f"{done} of {total}")


def measure_all(
    anatomy: Anatomy,
    implants: Mapping[str, Mapping[str, Deployment]],
    fields: Mapping[str, FlowField],
    settings: FlowSettings | None = None,
) -> dict[str, Any]:
    """Return the metrics of the vessel and of every treatment.

    Parameters
    ----------
    anatomy : vessel, sacs and paths.
    implants : deployed implants by treatment and id.
    fields : flows by treatment, ``bare`` first.
    settings : settings of the flows; None: the default.

    Returns
    -------
    dict
        ``vessel`` and ``treatments.NAME.{implants.ID,flow,change,quality}``; the end of each key is its unit. The
        treatment ``bare`` is there where flows are; ``quality`` is the grade of a flow.
    """
    sac = anatomy.aneurysms[0] if anatomy.aneurysms else None
    shapes = (sac.sac, ostium(sac, anatomy.vessel.lumen)) if sac else ()
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


def band_all(
    anatomy: Anatomy,
    implants: Mapping[str, Mapping[str, Deployment]],
    metrics: dict[str, Any],
    settings: Settings,
) -> None:
    """Add to the metrics of every implant the bands from the ranges of its device, and how sure the device is.

    Parameters
    ----------
    anatomy : vessel, sacs and paths.
    implants : deployed implants by treatment and id.
    metrics : result of `measure_all`; every implant gets the entry ``bands``.
    settings : settings of the study, with the sizes that were given.
    """
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
