"""Stages of a study; the store measures and reports each of them, and keeps their results."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from math import isfinite
from pathlib import Path
from typing import Any, Final

import numpy as np

from vstent.anatomy.morphology import Measures, morphology
from vstent.anatomy.openings import opening_at
from vstent.anatomy.repair import repair
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.segment import segment
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.deployment.deploy import deploy, propose_size
from vstent.deployment.measure import measure
from vstent.deployment.struts import over_restored
from vstent.devices.catalogue import find_sizes
from vstent.devices.design import BARE, Design, Size
from vstent.devices.ranges import how_sure
from vstent.devices.stent import Deployment, Landing, Stent
from vstent.errors import DeviceError, FlowError, InputError, LandingError, VstentError
from vstent.flow.beside import Beside
from vstent.flow.case import FlowCase, FlowField, FlowSettings
from vstent.flow.convergence import Sensitivity, convergence
from vstent.flow.grade import QUALITY, computation_of, grade
from vstent.flow.indices import compare, indices
from vstent.flow.ostium import ostium
from vstent.flow.simulation import OnProgress, flow_case, foretell_cost, simulate_case
from vstent.geometry.image import Image
from vstent.geometry.vessel import Anatomy, Vessel
from vstent.io.files import is_surface_file
from vstent.io.images import read_image
from vstent.io.surfaces import read_surface
from vstent.kernels.arrays import Floats
from vstent.plan.bands import bands
from vstent.plan.uncertainty import Uncertainty, vary
from vstent.study.keys import ANATOMY, VESSEL
from vstent.study.outputs import write_field
from vstent.study.store import Key, Store, Unfinished
from vstent.study.types import Placing, Point, Settings
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
        if settings.at_mm is None or settings.neck_mm is not None:
            raise
        found = other_reading(path, settings)
        if not found:
            raise
        raise type(error)(f"{error} {found}") from error


def other_reading(path: Path, settings: Settings) -> str:
    """Return a question that proposes another interpretation of the point `at_mm`; empty where none finds a vessel."""
    for words, point_mm in _readings(path, settings):
        with suppress(VstentError):
            vessel = trace(_vessel(path, replace(settings, at_mm=point_mm)))
            near_mm = vessel.lumen.closest(np.array([point_mm]))[1][0]
            if near_mm < NEAR_MM:
                return f"Did you mean {','.join(f'{x:.1f}' for x in point_mm)} ({words})?"
    return ""


def _readings(path: Path, settings: Settings) -> Iterator[tuple[str, Point]]:
    """Yield other interpretations of the point `at_mm`, as a description and a point in LPS mm."""
    x, y, z = settings.at_mm or (0.0, 0.0, 0.0)
    yield "the point given is RAS", (-x, -y, z)
    if not (path.is_file() and is_surface_file(path)):
        image = _image(path, replace(settings, crop_mm=None))
        if all(0 <= i < n for i, n in zip((x, y, z), image.voxels.shape, strict=True)):
            i, j, k = image.to_mm(np.array([[x, y, z]]))[0].tolist()
            yield "the point given is a voxel index", (i, j, k)
    yield "with the first sign changed", (-x, y, z)
    yield "with the second sign changed", (x, -y, z)


def _find_anatomy(path: Path, settings: Settings, store: Store, keys: Mapping[str, Key]) -> Anatomy:
    """Return the anatomy of an input, computed."""
    whole = find_vessel(path, settings, store, keys)
    neck_mm = None if settings.neck_mm is None else np.array(settings.neck_mm, dtype=np.float64)
    at_mm = _array(settings.at_mm) if neck_mm is None else neck_mm.mean(axis=0)
    outlet_mm = _array(settings.outlet_mm)
    if outlet_mm is not None:
        opening_at(whole, outlet_mm)  # checked before trimming, which may cut this outlet off
    with store.stage("trim") as tell:
        traced = trim(whole, at_mm=at_mm, upstream_mm=settings.upstream_mm, downstream_mm=settings.downstream_mm)
        tell(" ".join(traced.notes[len(whole.notes) :]))
    with store.stage("restore") as tell:
        anatomy = restore(traced, at_mm=_array(settings.at_mm), outlet_mm=outlet_mm, neck_mm=neck_mm)
        tell(" ".join([*anatomy.notes, *(f"Sac volume {a.sac.volume_mm3:.0f} mm3." for a in anatomy.aneurysms)]))
    store.hold(ANATOMY, keys[ANATOMY], anatomy)
    return anatomy


def find_vessel(path: Path, settings: Settings, store: Store, keys: Mapping[str, Key]) -> Vessel:
    """Read, segment, repair and trace; a result stored for this input is returned without computation.

    The store keeps the result in memory until its `settle` writes it.

    Parameters
    ----------
    path : a scan or a surface.
    settings : settings of the study.
    store : results of the study.
    keys : keys of its stages, of `vstent.study.keys`.
    """
    kept = store.find(VESSEL, keys[VESSEL], Vessel)
    if kept is not None:
        return kept
    with store.stage("segment") as tell:
        vessel = _vessel(path, settings)
        tell(" ".join(vessel.notes))
    with store.stage("trace") as tell:
        traced = trace(vessel, inlet_mm=_array(settings.inlet_mm))
        widths = ", ".join(f"{inlet.role} {inlet.diameter_mm:.1f} mm wide" for inlet in traced.inlets)
        found = f"{counted(len(traced.outlets), 'outlet')}; {widths}."
        tell(" ".join([found, *traced.notes[len(vessel.notes) :]]))
    store.hold(VESSEL, keys[VESSEL], traced)
    return traced


def _vessel(path: Path, settings: Settings) -> Vessel:
    """Return the repaired vessel of an input, without openings and centerlines."""
    if path.is_file() and is_surface_file(path):
        surface, notes = read_surface(path, units=settings.units, frame=settings.frame)
        vessel = Vessel(surface, notes=notes)
    else:
        image = _image(path, settings)
        vessel = segment(image, threshold=settings.threshold, at_mm=_array(settings.at_mm))
    near_mm = _array(settings.inlet_mm if settings.at_mm is None else settings.at_mm)
    lumen, repairs = repair(vessel.lumen, at_mm=None if near_mm is None else np.atleast_2d(near_mm)[0])
    return replace(vessel, lumen=lumen, notes=(*vessel.notes, *repairs))


def _image(path: Path, settings: Settings) -> Image:
    """Return the scan, cropped where requested."""
    image = read_image(path, spacing_mm=settings.spacing_mm, shape=settings.shape, acquisition=settings.acquisition)
    return image if settings.crop_mm is None else image.cropped(np.array(settings.crop_mm, dtype=np.float64))


def deploy_all(
    designs: Mapping[str, Design], anatomy: Anatomy, settings: Settings, store: Store, keys: Mapping[str, Key]
) -> tuple[dict[str, Deployment], dict[str, str]]:
    """Deploy every device in the given or the proposed size; a stored deployment is returned without computation.

    Parameters
    ----------
    designs : designs by device name.
    anatomy : vessel, parent artery and sacs.
    settings : settings of the study.
    store : results of the study; it keeps new deployments in memory until its `settle` writes them.
    keys : keys of its stages.

    Returns
    -------
    deployments : dict
        Deployments by device name.
    failures : dict
        Reasons by the name of each device that was not deployed.

    Raises
    ------
    DeviceError, LandingError
        No device can be deployed; the reason is that of the last one.
    """
    deployments: dict[str, Deployment] = {}
    failures: dict[str, str] = {}
    for name, design in designs.items():
        stage = f"deploy {name}"
        kept = store.find(stage, keys[stage], Deployment)
        if kept is not None:
            deployments[name] = kept
            continue
        try:
            with store.stage(stage) as tell:
                deployments[name] = deploy_one(design, anatomy, settings.placing(name))
                tell(deployments[name].advice)
            store.hold(stage, keys[stage], deployments[name])
        except (DeviceError, LandingError) as error:
            if len(failures) + 1 == len(designs):  # the last one too
                raise
            failures[name] = f"not deployed: {error}"
            store.progress(stage, 1.0, failures[name])
    return deployments, failures


def deploy_one(design: Design, anatomy: Anatomy, placing: Placing) -> Deployment:
    """Deploy a device in the given size and position; missing values are proposed.

    Parameters
    ----------
    design : the device.
    anatomy : vessel, parent artery and sacs.
    placing : given size and position.
    """
    landing = None if placing.center_mm is None else Landing(placing.center_mm)
    return deploy(design, anatomy, size=size_of(design, anatomy, placing), landing=landing)


def size_of(design: Design, anatomy: Anatomy, placing: Placing) -> Size:
    """Return the given size of a device; where diameter or length is missing, the best of the matching sizes.

    Parameters
    ----------
    design : the device.
    anatomy : vessel, parent artery and sacs.
    placing : given size and position.

    Raises
    ------
    DeviceError
        The device is not made in that size.
    LandingError
        No matching size fits the artery.
    """
    sizes = find_sizes(design, diameter_mm=placing.diameter_mm, length_mm=placing.length_mm)
    if placing.diameter_mm is not None and placing.length_mm is not None:
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
    case = FlowCase(anatomy.vessel, settings=flow)
    for inlet, part_mL_s, speed_m_s in zip(case.vessel.inlets, case.inlets_mL_s, case.inlet_speeds_m_s, strict=True):
        if not SLOWEST_M_S <= speed_m_s <= FASTEST_M_S:
            raise InputError(
                f"a mean inflow of {part_mL_s:g} mL/s through an inlet {inlet.diameter_mm:.1f} mm wide is "
                f"{speed_m_s:.2g} m/s, but blood flows in arteries at {SLOWEST_M_S:g} to {FASTEST_M_S:g} m/s: "
                "give mL/s (240 mL/min are 4 mL/s), or choose another inlet"
            )


def engine_folders(out: Path, settings: Settings) -> dict[str, Path]:
    """Return the folder of the engine's own files for every flow, by name; empty where no flow is computed."""
    if settings.flow is None:
        return {}
    return {name: out / "flow" / name / settings.flow.engine for name in (BARE, *settings.devices)}


def compute_flows(
    out: Path,
    anatomy: Anatomy,
    deployments: Mapping[str, Deployment],
    settings: Settings,
    store: Store,
    keys: Mapping[str, Key],
) -> tuple[dict[str, FlowField], dict[str, str]]:
    """Compute the flow without and with each device; each is stored as soon as it is finished.

    With a GPU it is stored while the next one is computed.

    Parameters
    ----------
    out : the case folder.
    anatomy : vessel, parent artery and sacs.
    deployments : deployments by device name.
    settings : settings of the study.
    store : results of the study.
    keys : keys of its stages.

    Returns
    -------
    fields : dict
        Flows by name, ``bare`` first.
    failures : dict
        Reasons by the name of each device whose flow could not be computed.

    Raises
    ------
    FlowError
        The flow without a device could not be computed.
    """
    if settings.flow is None:
        return {}, {}
    fields: dict[str, FlowField] = {}
    failures: dict[str, str] = {}
    folders = engine_folders(out, settings)
    stored = []
    with Beside(settings.flow) as beside:
        for name in (BARE, *(name for name in deployments if name not in settings.without_flow)):
            stent = None if name == BARE else deployments[name].stent
            stage, keep = f"flow {name}", None
            field = store.find(stage, keys[stage], FlowField)
            if field is None:
                if name == BARE:
                    _plan(anatomy, {name: one.stent for name, one in deployments.items()}, settings.flow, store)
                try:
                    with store.stage(stage) as tell:
                        field = compute_flow(
                            anatomy,
                            stent,
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
            stored.append(beside.do(partial(_keep, keep, out / "flow" / name, field)))
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
    stent: Stent | None,
    settings: FlowSettings,
    *,
    start: FlowField | None,
    folder: Path,
    progress: OnProgress,
    unfinished: Unfinished,
) -> FlowField:
    """Compute one flow; an unfinished one resumes.

    Parameters
    ----------
    anatomy : vessel, parent artery and sacs.
    stent : the deployed device; None: no device.
    settings : settings of the flow.
    start : the flow without a device, where it is known.
    folder : folder of the engine's own files.
    progress : called at every check.
    unfinished : saved states of its runs.
    """
    case = flow_case(anatomy, stent, settings)
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
    _plan(anatomy, {}, flow, store)
    with store.stage("convergence") as tell:
        done: list[str] = []

        def told(fraction: float, sentence: str) -> None:
            done.append(sentence)
            store.progress("convergence", 0.99 * fraction, sentence)

        folder = out / "flow" / "convergence" / flow.engine
        found = convergence(flow_case(anatomy, None, flow), folder=folder, told=told)
        tell(" ".join(done))
    return found


def _plan(anatomy: Anatomy, stents: Mapping[str, Stent], settings: FlowSettings, store: Store) -> None:
    """Report run time and memory of the flows; an error is raised where one does not fit in the memory."""
    with store.stage("plan flow") as tell:
        bare = flow_case(anatomy, None, settings)
        said = foretell_cost(bare)
        costs = {name: foretell_cost(replace(bare, stent=over_restored(one, anatomy))) for name, one in stents.items()}
        tell(" ".join([said, *(f"Behind {name}, {cost}" for name, cost in costs.items() if cost != said)]))


def vary_all(
    anatomy: Anatomy,
    deployments: Mapping[str, Deployment],
    settings: Settings,
    store: Store,
    keys: Mapping[str, Key],
) -> dict[str, dict[str, Any]]:
    """Vary the uncertain inputs of every deployment.

    Parameters
    ----------
    anatomy : vessel, parent artery and sacs.
    deployments : deployments by device name.
    settings : settings of the study.
    store : results of the study.
    keys : keys of its stages.

    Returns
    -------
    dict
        Uncertainty metrics by device name; empty without an uncertainty study.
    """
    if settings.uncertainty is None:
        return {}
    flow = settings.flow if settings.uncertainty.flow_samples else None
    found = {}
    for name, deployment in deployments.items():
        stage = f"vary {name}"
        varied = store.find(stage, keys[stage], Uncertainty)
        if varied is None:
            with store.stage(stage) as tell:
                told = partial(_tell_count, store, stage)
                begun = store.unfinished(stage, keys[stage])
                varied = vary(anatomy, deployment, settings.uncertainty, flow=flow, progress=told, checkpoint=begun)
                tell(f"{len(varied.points)} deployments; {varied.n_failed} of them did not fit.")
            store.keep(stage, keys[stage], varied)
        found[name] = varied.metrics()
    return found


def _tell_count(store: Store, stage: str, done: int, total: int) -> None:
    """Report that `done` of `total` deployments of a stage are finished."""
    store.progress(stage, 0.99 * done / total, f"{done} of {total}")


def measure_study(
    anatomy: Anatomy,
    deployments: Mapping[str, Deployment],
    fields: Mapping[str, FlowField],
    settings: Settings,
    varied: Mapping[str, Any],
    failures: Mapping[str, str],
) -> dict[str, Any]:
    """Return all metrics of a study: of vessel, devices and flows, with bands, uncertainties and failures.

    Parameters
    ----------
    anatomy : vessel, parent artery and sacs.
    deployments : deployments by device name.
    fields : flows by name, ``bare`` first.
    settings : settings of the study.
    varied : uncertainty metrics by device name.
    failures : reasons why a device was not deployed or its flow not computed, by name.
    """
    metrics = measure_all(anatomy, deployments, fields, settings.flow)
    band_all(anatomy, deployments, metrics, settings)
    for name, spread in varied.items():
        metrics["stents"][name]["uncertainty"] = spread
    return metrics | ({"failures": dict(failures)} if failures else {})


def measure_all(
    anatomy: Anatomy,
    deployments: Mapping[str, Deployment],
    fields: Mapping[str, FlowField],
    settings: FlowSettings | None = None,
) -> dict[str, Any]:
    """Return the metrics of the vessel, every deployment and every flow, with ratios and grades of the flows.

    Parameters
    ----------
    anatomy : vessel, parent artery and sacs.
    deployments : deployments by device name.
    fields : flows by name, ``bare`` first.
    settings : settings of the flows; None: the default.

    Returns
    -------
    dict
        Nested metrics; the end of each key is its unit. ``flow_quality`` holds the grade of every flow, by name.
    """
    sac = anatomy.aneurysms[0] if anatomy.aneurysms else None
    shapes = (sac.sac, ostium(sac, anatomy.vessel.lumen)) if sac else ()
    flow = {name: indices(field, *shapes) for name, field in fields.items()}
    left = {
        name: {"unsettled_fraction": field.unsettled_fraction} if isfinite(field.unsettled_fraction) else {}
        for name, field in fields.items()
    }
    stents: dict[str, dict[str, Any]] = {}
    for name, deployment in deployments.items():
        stents[name] = {"deployment": measure(anatomy, deployment)}
        if name in flow:
            stents[name] |= {"flow": flow[name] | left[name], "ratios": compare(flow[BARE], flow[name])}
    found = {"vessel": morphology(anatomy), "stents": stents}
    if not flow:
        return found
    case = flow_case(anatomy, None, settings)
    quality = {name: _quality(case, field, flow[name]) for name, field in fields.items()}
    return found | {BARE: flow[BARE] | left[BARE], QUALITY: quality}


def band_all(
    anatomy: Anatomy, deployments: Mapping[str, Deployment], metrics: dict[str, Any], settings: Settings
) -> None:
    """Add the bands that the ranges of its device give to the metrics of every deployment, and how sure the device is.

    Parameters
    ----------
    anatomy : vessel, parent artery and sacs.
    deployments : deployments by device name.
    metrics : result of `measure_all`; every device gets the entry ``bands``.
    settings : settings of the study, with the size if one was given.
    """
    for name, deployment in deployments.items():
        stent = metrics["stents"][name]
        stent["bands"] = bands_of(anatomy, deployment, stent["deployment"], settings.placing(name))


def bands_of(anatomy: Anatomy, deployment: Deployment, measures: Measures, placing: Placing) -> dict[str, Any]:
    """Return the bands that the ranges of its device give to a deployment, and how sure the device is, as metrics.

    Parameters
    ----------
    anatomy : vessel, parent artery and sacs.
    deployment : the deployed device.
    measures : its measures.
    placing : size and position that were given; the band of the proposed size is added where no size was.
    """
    is_proposed = placing.diameter_mm is None and placing.length_mm is None
    found = bands(anatomy, deployment, measures, is_proposed=is_proposed)
    return found.metrics() | {"device": how_sure(deployment.stent.design)}


def _quality(case: FlowCase, field: FlowField, found: Mapping[str, float]) -> dict[str, Any]:
    """Return the grade of a flow, its reasons, and what was computed."""
    judged = grade(case, field, found)
    return {"grade": judged.level, "reasons": list(judged.reasons)} | judged.measures | computation_of(case, field)


def _array(points_mm: Point | tuple[Point, ...] | None) -> Floats | None:
    """Return points as an array (3,) or (n, 3); None where none is given."""
    return None if points_mm is None else np.array(points_mm, dtype=np.float64)
