"""Stages of a study; the store measures and reports each of them, and keeps their results."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from math import isfinite
from pathlib import Path
from re import fullmatch
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from vstent.anatomy.morphology import Measures, morphology
from vstent.anatomy.openings import opening_at
from vstent.anatomy.read import read_vessel
from vstent.anatomy.restore.paths import on_path
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.deployment.coils import deploy_coils, given_coils
from vstent.deployment.deploy import deploy, propose_landing, propose_size
from vstent.deployment.forks import beyond_mm
from vstent.deployment.measure import jailed_branches, measure, measure_together
from vstent.deployment.method import Progress
from vstent.deployment.straightening import Straightening, described, straighten
from vstent.devices.catalogue import find_design, find_sizes
from vstent.devices.design import Basket, Coil, Size
from vstent.devices.ranges import how_sure
from vstent.devices.stent import Coils, Deployment, Landing, Stent
from vstent.devices.treatment import BARE, Implant, Treatment
from vstent.errors import FlowError, InputError, LandingError, ReadError, VesselError, VstentError
from vstent.flow.background import BackgroundWork
from vstent.flow.case import FlowCase, FlowField
from vstent.flow.ends import ASSUMED
from vstent.flow.engines import Progress as FlowProgress
from vstent.flow.grade import NOT_USABLE, computation_of, grade
from vstent.flow.indices import balance, between_coils, indices, ratios
from vstent.flow.ostium import sac_surfaces
from vstent.flow.problem import flow_case, vessel_case
from vstent.flow.settings import FlowSettings
from vstent.flow.simulation import foretell_cost, simulate_case
from vstent.geometry.vessel import PARENT, Anatomy, Vessel
from vstent.io.files import is_surface_file
from vstent.io.images import read_image
from vstent.kernels.arrays import Floats
from vstent.plan.bands import bands
from vstent.plan.treatments import rank_treatments
from vstent.plan.uncertainty import EFFECTS, Uncertainty, vary, vary_seeds
from vstent.study.folder import flow_folder
from vstent.study.keys import ALONE, ANATOMY, STRAIGHTENED, VESSEL, flow_stage, is_varied, stage_name, yields
from vstent.study.outputs import write_field
from vstent.study.settings import Point, Settings
from vstent.study.store import Key, Store
from vstent.units import counted

Implants = Mapping[str, Mapping[str, Deployment]]
"""Deployed implants by treatment and id."""
Keys = Mapping[str, Key]
"""Keys of the stages of a study, of `vstent.study.keys`, by name."""

SLOWEST_M_S: Final = 0.01
"""Smallest plausible mean speed at an inlet, in m/s; below it the inflow is taken to be in another unit."""
FASTEST_M_S: Final = 2.0
"""Largest plausible mean speed at an inlet, in m/s; above it the inflow is taken to be in another unit."""

NEAR_MM: Final = 3.0
"""Largest distance from the vessel wall, in mm, at which another interpretation of a point is proposed."""


def find_anatomy(path: Path, settings: Settings, store: Store, keys: Keys) -> Anatomy:
    """Return the anatomy of an input, stored or computed; the store writes a new one when `save_deferred` is called.

    Where no vessel is found at the point `at_mm`, the error proposes the same point in another frame or as a voxel
    index, if there is a vessel.
    """
    anatomy = store.find(ANATOMY, keys[ANATOMY], Anatomy)
    if anatomy is not None:
        return anatomy
    given, whole = settings.anatomy, None
    try:
        whole = find_vessel(path, settings, store, keys)
        neck_mm, outlet_mm = _array(given.neck_mm), _array(given.outlet_mm)
        at_mm = _array(given.at_mm) if neck_mm is None else neck_mm.mean(axis=0)
        if outlet_mm is not None:
            opening_at(whole, outlet_mm)  # checked before trimming, which may cut this outlet off
        with store.stage("trim") as tell:
            traced = trim(whole, at_mm=at_mm, upstream_mm=given.upstream_mm, downstream_mm=given.downstream_mm)
            tell(" ".join(traced.notes[len(whole.notes) :]))
        with store.stage("restore") as tell:
            anatomy = restore(traced, at_mm=_array(given.at_mm), outlet_mm=outlet_mm, neck_mm=neck_mm)
            tell(" ".join([*anatomy.notes, *(f"Sac volume {a.sac.volume_mm3:.0f} mm3." for a in anatomy.aneurysms)]))
    except InputError as error:
        is_asked = given.at_mm is not None and given.neck_mm is None
        is_near = whole is not None and is_asked and whole.lumen.closest(np.array([given.at_mm]))[1][0] < NEAR_MM
        question = other_reading(path, settings) if is_asked and not is_near else ""
        if not question:
            raise
        raise type(error)(f"{error} {question}") from error
    store.defer(ANATOMY, keys[ANATOMY], anatomy)
    return anatomy


def ask_for_aneurysm(anatomy: Anatomy, settings: Settings) -> None:
    """Raise VesselError where there is no aneurysm, and a device would get a proposed place nevertheless."""
    placed = [implant.placing.position_mm for treatment in settings.treatments for implant in treatment.implants]
    if not anatomy.aneurysms and not settings.anatomy.without_aneurysm and None in placed:
        raise VesselError(
            "No aneurysm was found, so no size or place of a device is proposed. Give a point in it (--at), or deploy "
            "without one: at a position along the artery (--center), or in its middle (--no-aneurysm)."
        )


def other_reading(path: Path, settings: Settings) -> str:
    """Return a question that proposes another interpretation of the point `at_mm`; empty where none finds a vessel."""
    for words, point_mm in _readings(path, settings):
        with suppress(VstentError):
            vessel = trace(_vessel(path, replace(settings, anatomy=replace(settings.anatomy, at_mm=point_mm))))
            if vessel.lumen.closest(np.array([point_mm]))[1][0] < NEAR_MM:
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


def find_vessel(path: Path, settings: Settings, store: Store, keys: Keys) -> Vessel:
    """Return the traced vessel of an input, stored or computed; the store writes a new one as in `find_anatomy`."""
    traced = store.find(VESSEL, keys[VESSEL], Vessel)
    if traced is not None:
        return traced
    with store.stage("segment") as tell:
        vessel = _vessel(path, settings)
        tell(" ".join(vessel.notes))
    with store.stage("trace") as tell:
        traced = trace(vessel, inlet_mm=_array(settings.anatomy.inlet_mm))
        widths = ", ".join(f"{inlet.role} {inlet.diameter_mm:.1f} mm wide" for inlet in traced.inlets)
        found = f"{counted(len(traced.outlets), 'outlet')}; {widths}."
        tell(" ".join([found, *traced.notes[len(vessel.notes) :]]))
    store.defer(VESSEL, keys[VESSEL], traced)
    return traced


def _vessel(path: Path, settings: Settings) -> Vessel:
    """Return the repaired vessel of an input, without openings and centerlines."""
    at_mm, inlet_mm = settings.anatomy.at_mm, settings.anatomy.inlet_mm
    if at_mm is None and inlet_mm is not None and is_surface_file(path):  # it chooses a piece of the surface
        at_mm = np.atleast_2d(inlet_mm)[0]
    return read_vessel(path, **asdict(settings.input), at_mm=at_mm)


def finished_anatomy(out: Path, store: Store, keys: Keys) -> Anatomy:
    """Return the stored anatomy of a finished run of a case folder; ReadError is raised where it is missing."""
    anatomy = store.find(ANATOMY, keys[ANATOMY], Anatomy)
    if anatomy is None:
        raise ReadError(f"{out} does not hold the artery of its run: give the same command as for that run again")
    return anatomy


def deploy_all(
    anatomy: Anatomy, settings: Settings, store: Store, keys: Keys
) -> tuple[dict[str, dict[str, Deployment]], dict[str, str]]:
    """Return the implants of every treatment, stored or deployed, and the reasons why treatments do not fit, by name.

    InputError is raised where no treatment can be deployed; the reason is that of the last one.
    VesselError is raised where no aneurysm was found, and none is said to be missing.
    """
    ask_for_aneurysm(anatomy, settings)
    deployed: dict[str, dict[str, Deployment]] = {}
    failures: dict[str, str] = {}
    for treatment in settings.treatments:
        implants: dict[str, Deployment] = {}
        try:
            for implant in treatment.implants:
                _check_in_sac(implant, treatment)  # at once: coils take minutes
            for implant in treatment.implants:
                stage = f"deploy {stage_name(treatment, implant)}"
                deployment = store.find(stage, keys[stage], Deployment)
                if deployment is None:
                    with store.stage(stage) as tell:
                        outer = [implants[name].stent for name in implant.inside]
                        deployment = deploy_implant(implant, anatomy, outer, partial(_tell_coils, store, stage))
                        tell(deployment.advice)
                    store.defer(stage, keys[stage], deployment)
                implants[implant.id] = deployment
            deployed[treatment.name] = implants
        except InputError as error:  # such as a path that this artery does not have
            if len(treatment.implants) > 1:
                error.args = (f"{implant.id}, an implant of {treatment.name}: {error}",)
            if len(failures) + 1 == len(settings.treatments):  # the last one too
                if len(treatment.implants) == 1:
                    error.args = (f"{treatment.name}: {error}",)
                raise
            failures[treatment.name] = f"not deployed: {error}"
            store.progress(f"deploy {treatment.name}", 1.0, failures[treatment.name])
    return deployed, failures


def _check_in_sac(implant: Implant, treatment: Treatment) -> None:
    """Raise LandingError where a treatment has devices beside a basket, or after coils."""
    design, is_last = find_design(implant.device), implant is treatment.implants[-1]
    if isinstance(design, Basket) and len(treatment.implants) > 1:
        raise LandingError(f"{design.name} lies in a sac alone: give it a treatment of its own.")
    if isinstance(design, Coil) and not is_last:
        raise LandingError("Coils come last in a treatment, and only once: give other devices before them.")


def deploy_implant(
    implant: Implant, anatomy: Anatomy, inside: Sequence[Stent] = (), progress: Progress | None = None
) -> Deployment:
    """Deploy an implant in the given or proposed size and place, inside implants that are there in this order."""
    design = find_design(implant.device)
    if isinstance(design, Basket | Coil) and (implant.placing.path != PARENT or implant.placing.beside):
        raise LandingError(
            f"{implant.device} is placed in the sac: leave out its path (>), and join it to a stent by + in place of |."
        )
    if isinstance(design, Coil):
        if not replace(implant, density_fraction=None, coils=(), seed=0).is_proposed:
            raise LandingError(
                f"{design.name} have no place of their own: give a packing density, or loops x length of every coil in "
                "parentheses."
            )
        filling = given_coils(design, implant.coils) if implant.coils else implant.density_fraction
        return deploy_coils(design, anatomy, filling, inside=inside, seed=implant.seed, progress=progress)
    if implant.density_fraction is not None or implant.coils:
        raise LandingError(f"{design.name} has neither a packing density nor a list of coils: only coils have them.")
    anatomy = on_path(anatomy, implant.placing.path)
    size = size_of(implant, anatomy)
    landing, beside = landing_of(implant, anatomy, size, inside), implant.placing.beside
    return deploy(design, anatomy, size=size, landing=landing, inside=inside, beside=beside)


def landing_of(implant: Implant, anatomy: Anatomy, size: Size, inside: Sequence[Stent] = ()) -> Landing | None:
    """Return the given place of an implant on the first path, or the proposed one shifted; None where none is given."""
    placing = implant.placing
    if placing.position_mm is not None:
        return Landing(placing.position_mm, placing.anchor)
    if placing.at_fork:
        return Landing(beyond_mm(anatomy.parent, inside), "proximal")
    if not placing.shift_mm:
        return None
    design = find_design(implant.device)
    if isinstance(design, Basket):
        return Landing(placing.shift_mm, "proximal")
    proposed = propose_landing(design, anatomy, size)
    return replace(proposed, abscissa_mm=proposed.abscissa_mm + placing.shift_mm)


def size_of(implant: Implant, anatomy: Anatomy) -> Size:
    """Return the given size of an implant; where diameter or length is missing, the best of the matching sizes."""
    design = find_design(implant.device)
    sizes = find_sizes(design, diameter_mm=implant.diameter_mm, length_mm=implant.length_mm)
    if implant.diameter_mm is not None and implant.length_mm is not None:
        return sizes[0]
    return propose_size(replace(design, sizes=sizes), anatomy)


def straighten_all(
    anatomy: Anatomy, implants: Implants, settings: Settings, store: Store, keys: Keys
) -> tuple[dict[str, Straightening], dict[str, str]]:
    """Return the arteries that have yielded to treatments, stored or computed, and why others failed, by name."""
    found: dict[str, Straightening] = {}
    failures: dict[str, str] = {}
    for treatment in settings.treatments:
        if treatment.name not in implants or not yields(treatment, settings):
            continue
        stage = f"straighten {treatment.name}"
        yielded = store.find(stage, keys[stage], Straightening)
        if yielded is None:
            try:
                with store.stage(stage) as tell:
                    yielded = straighten(anatomy, list(implants[treatment.name].values()), settings.straightening)
                    tell(described(yielded.metrics()))
            except InputError as error:  # such as a device that no longer fits
                failures[treatment.name] = f"not straightened: {error}"
                store.progress(stage, 1.0, failures[treatment.name])
                continue
            store.defer(stage, keys[stage], yielded)
        found[treatment.name] = yielded
    return found, failures


def check_inflow(anatomy: Anatomy, flow: FlowSettings | None) -> None:
    """Raise InputError where no artery has the mean inflow: its unit or an inlet is wrong."""
    if flow is None:
        return
    case = vessel_case(anatomy.vessel, flow)
    if case.inflow_source == ASSUMED and len(anatomy.vessel.inlets) == 1:
        return
    outlets_mm2 = sum(outlet.area_mm2 for outlet in anatomy.vessel.outlets)
    if len(anatomy.vessel.inlets) > 1 and case.inflow_mL_s > FASTEST_M_S * outlets_mm2:
        raise InputError(
            f"{case.inflow_mL_s:.1f} mL/s enter through {len(anatomy.vessel.inlets)} inlets and would leave through "
            f"{outlets_mm2:.1f} mm2 at {case.inflow_mL_s / outlets_mm2:.1f} m/s: check whether each of them brings "
            "blood (--inlet)"
        )
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
    ends = ("", ALONE, STRAIGHTENED) if settings.straightening != "off" else ("",)
    names = (BARE, *(f"{treatment.name}{end}" for treatment in settings.treatments for end in ends))
    return {name: flow_folder(out, name) / settings.flow.numerics.engine for name in names}


def compute_flows(
    out: Path,
    anatomy: Anatomy,
    implants: Implants,
    settings: Settings,
    store: Store,
    keys: Keys,
    yielded: Mapping[str, Straightening] = MappingProxyType({}),
) -> tuple[dict[str, FlowField], dict[str, str]]:
    """Return the flow in the bare artery and with every treatment, and the reasons why others failed, by name.

    In an artery that has yielded to a treatment it is computed without (`ALONE`) and with the devices (`STRAIGHTENED`).

    Each is stored as soon as it is finished; with a GPU while the next one is computed. FlowError is raised where the
    flow in the bare artery cannot be computed.
    """
    if settings.flow is None:
        return {}, {}
    fields: dict[str, FlowField] = {}
    failures: dict[str, str] = {}
    folders = engine_folders(out, settings)
    writing: list[Callable[[], None]] = []
    stents = {BARE: [], **{name: [one.stent for one in deployed.values()] for name, deployed in implants.items()}}
    names = [BARE, *(one.name for one in settings.treatments if one.has_flow and one.name in implants)]
    runs = {name: (anatomy, stents.get(name, []), BARE) for name in names}
    for name in [one for one in names if one in yielded]:
        artery, alone = yielded[name].anatomy, f"{name}{ALONE}"
        runs[alone] = artery, [], alone
        runs[f"{name}{STRAIGHTENED}"] = artery, [one.stent for one in yielded[name].deployed], alone
    with BackgroundWork(settings.flow.numerics) as background:
        for name, (artery, inside, before) in runs.items():
            stage = flow_stage(name)
            field = store.find(stage, keys[stage], FlowField)
            if field is None:
                if name == BARE:
                    plan_flows(anatomy, stents, settings.flow, store)
                try:
                    told, unfinished = partial(_tell_flow, store, stage), store.unfinished(stage, keys[stage])
                    run = {"start": fields.get(before), "progress": told, "checkpoint": unfinished}
                    with store.stage(stage) as tell:
                        field = compute_flow(artery, inside, settings.flow, folder=folders[name], **run)
                        tell(field.advice)
                except FlowError as error:
                    if name == BARE:
                        raise
                    failures[name.partition("/")[0]] = said = f"flow not computed: {error}"
                    store.progress(stage, 1.0, said)
                    continue
                writing.append(background.begin(store.saver(stage, keys[stage], field)))
            fields[name] = field
            writing.append(background.begin(partial(write_field, flow_folder(out, name), field)))
    for is_written in writing:
        is_written()
    return fields, failures


def _tell_coils(store: Store, stage: str, n_coils: int, fraction: float) -> None:
    """Report the progress of placing coils as that of its stage."""
    store.progress(stage, 0.99 * fraction, f"{counted(n_coils, 'coil')} placed")


def _tell_flow(store: Store, stage: str, now: FlowProgress) -> None:
    """Report the progress of a flow as that of its stage."""
    residual = now.residual if isfinite(now.residual) else None
    store.progress(stage, min(now.fraction, 0.99), "", residual=residual, seconds_left=now.seconds_left)


def compute_flow(anatomy: Anatomy, stents: Sequence[Stent], settings: FlowSettings, **how: Any) -> FlowField:
    """Compute one flow as `simulate_case` does; an unfinished one resumes."""
    return simulate_case(flow_case(anatomy, stents, settings), **how)


def plan_flows(anatomy: Anatomy, stents: Mapping[str, Sequence[Stent]], settings: FlowSettings, store: Store) -> None:
    """Report run time and memory of the flows by treatment; an error is raised where one does not fit in the memory."""
    with store.stage("plan flow") as tell:
        costs = {name: foretell_cost(flow_case(anatomy, found, settings)) for name, found in stents.items()}
        bare = costs.pop(BARE)
        tell(" ".join([bare, *(f"With {name}, {cost}" for name, cost in costs.items() if cost != bare)]))


def vary_all(
    anatomy: Anatomy, implants: Implants, settings: Settings, store: Store, keys: Keys
) -> dict[str, dict[str, Any]]:
    """Return the uncertainties of every treatment with one implant, or with coils inside one stent, by name."""
    if settings.uncertainty is None:
        return {}
    flow = settings.flow if settings.uncertainty.flow_samples else None
    spreads = {}
    for treatment in settings.treatments:
        stage, deployed = f"vary {treatment.name}", implants.get(treatment.name, {})
        if not deployed:
            continue
        if not is_varied(treatment):
            store.progress(stage, 1.0, "left out: only one device, alone or with coils, is varied.")
            continue
        deployment, *coils = deployed.values()
        if isinstance(deployment.stent.design, Basket):
            store.progress(stage, 1.0, "left out: baskets are not varied.")
            continue
        varied = store.find(stage, keys[stage], Uncertainty)
        if varied is None:

            def told(done: int, total: int, stage: str = stage) -> None:
                store.progress(stage, 0.99 * done / total, f"{done} of {total}")

            with store.stage(stage) as tell:
                begun = store.unfinished(stage, keys[stage])
                how: dict[str, Any] = {"flow": flow, "progress": told, "checkpoint": begun}
                if isinstance(deployment.stent, Coils):
                    varied = vary_seeds(anatomy, deployment.stent, settings.uncertainty, **how)
                else:
                    way, kept = on_path(anatomy, deployment.stent.path), [one.stent for one in coils]
                    varied = vary(
                        way, deployment, settings.uncertainty, kept, straightening=settings.straightening, **how
                    )
                tell(f"{len(varied.points) - varied.n_failed} of {len(varied.points)} deployments fit the artery.")
            store.save(stage, keys[stage], varied)
        spreads[treatment.name] = varied.metrics()
    return spreads


def measure_study(
    anatomy: Anatomy,
    implants: Implants,
    fields: Mapping[str, FlowField],
    settings: Settings,
    varied: Mapping[str, Any],
    failures: Mapping[str, str],
    yielded: Mapping[str, Any] = MappingProxyType({}),
) -> dict[str, Any]:
    """Return all metrics of a study: of vessel, implants and flows, with bands, uncertainties and failures."""
    shapes = sac_surfaces(anatomy) if fields else ()
    treatments: dict[str, dict[str, Any]] = {BARE: {}} if fields else {}
    for name, deployed in implants.items():
        treatments[name] = measure_treatment(anatomy, deployed)
    if fields:
        case = flow_case(anatomy, (), settings.flow)
    for name, field in fields.items():
        flow = between_coils(indices(field, *shapes), _porosity(implants.get(name, {}), settings.flow))
        left = {"unsettled_fraction": field.unsettled_fraction} if isfinite(field.unsettled_fraction) else {}
        of_flow = case if name == BARE else case.resisted_as(fields[BARE])
        treatments[name]["flow"] = flow | left | balance(of_flow, field)
        if name == BARE:
            bare = flow
        else:
            treatments[name]["change"] = ratios(bare, flow)
        treatments[name]["quality"] = _quality(case, field, flow) | computation_of(of_flow, field)
    for treatment in settings.treatments:
        for implant in treatment.implants if treatment.name in implants else ():
            measures = treatments[treatment.name]["implants"][implant.id]
            deployment = implants[treatment.name][implant.id]
            if not isinstance(deployment.stent.design, Basket | Coil):
                measures["bands"] = bands_of(anatomy, deployment, measures, implant)
    _add(treatments, "uncertainty", varied)
    _add(treatments, "straightening", yielded)
    metrics = {"vessel": morphology(anatomy), "treatments": treatments}
    ranked = rank_treatments(treatments)
    if len(ranked) > 1:
        metrics["ranking"] = ranked
    return metrics | ({"failures": dict(failures)} if failures else {})


def _add(treatments: dict[str, dict[str, Any]], part: str, found: Mapping[str, Any]) -> None:
    """Add a part to the metrics of treatments, from that of each of them by name."""
    for name, values in found.items():
        treatments[name][part] = values


def measure_straightened(
    anatomy: Anatomy,
    yielded: Mapping[str, Straightening],
    fields: Mapping[str, FlowField],
    settings: FlowSettings | None,
) -> dict[str, dict[str, Any]]:
    """Return the metrics of arteries that have yielded to treatments, and of the flows in them, by treatment."""
    found: dict[str, dict[str, Any]] = {}
    for name, artery in yielded.items():
        found[name] = dict(artery.metrics())
        implants = {str(number): one for number, one in enumerate(artery.deployed)}
        for end, deployed in ((ALONE, {}), (STRAIGHTENED, implants)):
            if (field := fields.get(f"{name}{end}")) is not None:
                flow = between_coils(indices(field, *sac_surfaces(artery.anatomy)), _porosity(deployed, settings))
                case = flow_case(artery.anatomy, (), settings)
                quality = _quality(case, field, flow) | computation_of(case.resisted_as(fields[BARE]), field)
                change = ratios(indices(fields[BARE], *sac_surfaces(anatomy)), flow)
                part = {"flow": flow, "change": change, "quality": quality}
                found[name] |= {"bare": part} if end == ALONE else part
    return found


def _quality(case: FlowCase, field: FlowField, flow: Mapping[str, float]) -> dict[str, Any]:
    """Return the grade of a flow with its reasons and measures."""
    judged = grade(case, field, flow)
    return {"grade": judged.level, "reasons": list(judged.reasons)} | judged.measures


def straightening_notes(metrics: Mapping[str, Any]) -> tuple[str, ...]:
    """Return a note on every artery that has yielded to a treatment, with what it does to the velocity in the sac."""
    notes, key = [], "mean_sac_velocity_m_s_ratio"
    for name, treatment in metrics["treatments"].items():
        if found := treatment.get("straightening"):
            varied = treatment.get("uncertainty", {}).get("intervals", {})
            note = f"Straightening, {name}: {described(found, varied)}"
            changes = [part.get("change", {}).get(key) for part in (treatment, found.get("bare", {}), found)]
            if all(changes):
                bands = [varied.get(f"{effect}{key}") for effect in ("", *EFFECTS)]
                pairs = [*zip(changes, bands, strict=True)]
                is_wide = any(band and band["high"] - band["low"] > abs(one - 1) for one, band in pairs)
                alone, straight, both = (
                    f"{one - 1:+.0%}" + (f" ({band['low'] - 1:+.0%} to {band['high'] - 1:+.0%})" if band else "")
                    for one, band in pairs
                )
                poor = NOT_USABLE in (part.get("quality", {}).get("grade") for part in (found.get("bare", {}), found))
                note += " A band of the velocity is wider than its effect." if is_wide else ""
                note += " The flow in the straightened artery is not usable: use a finer grid." if poor else ""
                note += f" Mean sac velocity: {alone} by the devices, {straight} by straightening, {both} by both."
            notes.append(note)
    return tuple(notes)


def measure_treatment(anatomy: Anatomy, deployed: Mapping[str, Deployment]) -> dict[str, Any]:
    """Return the metrics of deployed implants, each and together, and the openings of the branches that they jail."""
    stents = [one.stent for one in deployed.values() if not isinstance(one.stent, Coils)]
    found: dict[str, Any] = {
        "implants": {id_: measure(anatomy, one) for id_, one in deployed.items()},
        "jailed_branches": list(jailed_branches(anatomy, stents)),
    }
    measured = list(found["implants"].values())
    return found | {"together": measure_together(anatomy, [one.stent for one in deployed.values()], measured)}


def _porosity(deployed: Mapping[str, Deployment], flow: FlowSettings | None) -> float:
    """Return blood's part of a sac in which coils are a porous region in the flow; 1 where there are none."""
    if flow is None or flow.numerics.wires == "resolved":
        return 1.0
    return 1.0 - sum(one.stent.density_fraction for one in deployed.values() if isinstance(one.stent, Coils))


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


def bands_of(anatomy: Anatomy, deployment: Deployment, measures: Measures, implant: Implant) -> dict[str, Any]:
    """Return the bands that the ranges of its device give to a deployment, and how sure the device is, as metrics.

    The band of the proposed size is among them where the implant has no given size.
    """
    is_proposed = implant.diameter_mm is None and implant.length_mm is None
    found = bands(on_path(anatomy, deployment.stent.path), deployment, measures, is_proposed=is_proposed)
    return found.metrics() | {"device": how_sure(deployment.stent.design)}


def _array(points_mm: Point | tuple[Point, ...] | None) -> Floats | None:
    """Return points as an array (3,) or (n, 3); None where none is given."""
    return None if points_mm is None else np.array(points_mm, dtype=np.float64)
