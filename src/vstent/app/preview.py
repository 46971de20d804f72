"""Answer the page immediately, from the results that a case has so far."""

from collections.abc import Callable, Hashable, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import date
from functools import partial
from glob import escape
from pathlib import Path
from typing import Any, Final, Literal, TypeVar, cast

import numpy as np
from scipy.spatial import cKDTree

from vstent.anatomy.morphology import Measures, morphology
from vstent.anatomy.restore.paths import on_path
from vstent.angiography.history import History
from vstent.angiography.view import angles_of
from vstent.angiography.working_projection import working_projection
from vstent.app import necks, sheets
from vstent.app.cases import Case
from vstent.app.choices import Point
from vstent.app.cuts import cut
from vstent.app.films import films_message, kept_curves
from vstent.app.finished import kept_histories, shown_flows
from vstent.app.scans import LOCK
from vstent.app.yielding import Yielding
from vstent.deployment.basket import room_of
from vstent.deployment.contour import planes
from vstent.deployment.deploy import propose_landing
from vstent.deployment.measure import measure, measure_together
from vstent.deployment.method import laid_inside
from vstent.deployment.sketch import MeasuredWall, Sketch, measured_wall, sketch
from vstent.deployment.straightening import Straightening
from vstent.devices.catalogue import find_design
from vstent.devices.design import Basket, Coil
from vstent.devices.formulas import coverage_fraction, free_diameters_mm
from vstent.devices.stent import Coils, Deployment, Landing, Stent
from vstent.devices.treatment import BARE, Implant, Placing, Treatment, with_device
from vstent.errors import DeviceError, InputError, ReadError, VstentError
from vstent.flow.case import FlowField
from vstent.flow.domain import default_cell_size_mm
from vstent.flow.ends import ASSUMED
from vstent.flow.problem import vessel_case
from vstent.flow.settings import FlowSettings
from vstent.flow.simulation import foretell_cost
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import PARENT, Anatomy, Opening
from vstent.io.archive import load_data
from vstent.kernels import curves, triangles
from vstent.kernels.arrays import Floats
from vstent.plan.bands import gap_bands
from vstent.reporting import scene
from vstent.reporting.packing import message
from vstent.reporting.uncertainty import band_rows, how_sure
from vstent.study.folder import CACHE
from vstent.study.keys import ALONE, STRAIGHTENED, flow_stage, stage_name, study_keys
from vstent.study.stages import ask_for_aneurysm, bands_of, deploy_implant, landing_of, size_of
from vstent.study.store import Store

Colour = Literal["wall_gap", "coverage", "diameter"]
"""Quantity that colors the wires."""
Found = TypeVar("Found")

CACHED: Final = 40
"""Number of results cached per case."""
SECTION_REACH_MM: Final = 9.0
"""Distance from the axis within which a section shows surfaces, in mm."""
BESIDE_MM: Final = 8.0
"""Length of artery on each side of the neck that the profile view shows, in mm."""
NEIGHBOURS: Final = 3
"""Number of consecutive wire points that have the color of one node, the nearest to the first of them."""
NOT_PLACED: Final = "These coils are not placed yet. Place them in the step Deploy; it takes about a minute."
"""Why coils are not drawn."""
BELOW_MM: Final = 3.0
"""Largest depth of a basket's lower end below the middle of the neck to which it can be dragged, in mm."""
HEIGHT_STEP_MM: Final = 0.05
"""Step of the heights above the middle of the neck to which a basket can be dragged, in mm."""
OPENING_COLOURS: Final = (
    (0.00, 0.45, 0.70),
    (0.90, 0.62, 0.00),
    (0.00, 0.62, 0.45),
    (0.80, 0.47, 0.65),
    (0.34, 0.71, 0.91),
)
"""Okabe and Ito's colors, distinguishable with color vision deficiency; inlets have the first."""


class Preview:
    """Results of one case, loaded or computed on demand, and cached."""

    def __init__(self, case: Case) -> None:
        self.case = case
        self.shown: tuple[Stent, ...] = ()  # the devices that were drawn last
        self._follow: Callable[[tuple[Stent, ...]], None] | None = None
        self._cache: dict[Hashable, Any] = {}

    def _cached(self, key: Hashable, compute: Callable[[], Found]) -> Found:
        """Return the cached result of a key; where there is none, compute and cache it."""
        with LOCK:
            if key not in self._cache:
                result = compute()
                while len(self._cache) >= CACHED:
                    self._cache.pop(next(iter(self._cache)))
                self._cache[key] = result
            return cast("Found", self._cache[key])

    def _loaded(self, path: Path, kind: type[Found]) -> Found:
        """Return the content of a file of a study, read again where the file has changed."""
        return self._cached((kind, path, path.stat().st_mtime_ns), lambda: load_data(path, kind))

    @property
    def anatomy(self) -> Anatomy:
        """Last anatomy found.

        Raises ReadError: there is no anatomy yet.
        """
        key = self.case.state.anatomy
        path = self.case.folder / CACHE / f"anatomy-{key}.npz"
        if not key:
            raise ReadError("The vessel has not been found yet. Run the first three steps.")
        return self._cached(("anatomy", key), lambda: load_data(path, Anatomy))

    def _wall(self, treatment: Treatment, implant: Implant) -> MeasuredWall:
        """Return the artery, with the implants inside which it opens, prepared for an implant of the chosen size."""
        path, asked = implant.placing.path, (implant.device, implant.diameter_mm, implant.length_mm)

        def prepare() -> MeasuredWall:
            anatomy = on_path(self.anatomy, path)
            inside = self._outer(treatment, implant)
            return measured_wall(find_design(implant.device), size_of(implant, anatomy), anatomy, inside)

        return self._cached(("wall", self.case.state.anatomy, path, *asked, *_before(treatment, implant)), prepare)

    def _outer(self, treatment: Treatment, implant: Implant) -> list[Stent]:
        """Return the deployed devices inside which an implant opens."""
        return [self.deployment(treatment, _implant(treatment, name)).stent for name in implant.inside]

    def _of_implant(self, what: str, treatment: Treatment, implant: Implant, compute: Callable[[], Found]) -> Found:
        """Return a cached result of a deployed implant; where there is none, compute and cache it."""
        return self._cached((what, self.case.state.anatomy, *_before(treatment, implant), implant), compute)

    def deployment(self, treatment: Treatment, implant: Implant) -> Deployment:
        """Return a deployed implant; those that it opens inside are deployed before it."""

        def deploy() -> Deployment:
            self._ask(treatment)
            if isinstance(find_design(implant.device), Coil):
                return self._stored(treatment, implant)
            return deploy_implant(implant, self.anatomy, self._outer(treatment, implant))

        return self._of_implant("deployment", treatment, implant, deploy)

    def _stored(self, treatment: Treatment, implant: Implant) -> Deployment:
        """Return coils as a job has placed them; a DeviceError says that none has, since the page does not wait."""
        settings = replace(self.case.state.settings(), treatments=(treatment,))
        stage = f"deploy {stage_name(treatment, implant)}"
        key = study_keys(self.case.state.source, settings)[stage]
        found = Store(self.case.folder / CACHE).load(stage, key, Deployment)
        if found is None:
            raise DeviceError(NOT_PLACED)
        return found

    def placed(self, treatment: Treatment) -> Treatment:
        """Return a treatment without the coils that are not placed yet."""
        there = []
        for implant in treatment.implants:
            try:
                if isinstance(find_design(implant.device), Coil):
                    self.deployment(treatment, implant)
                there.append(implant)
            except DeviceError:
                continue
        return replace(treatment, implants=tuple(there))

    def _ask(self, *treatments: Treatment) -> None:
        """Raise VesselError where there is no aneurysm, and a device would get a proposed place nevertheless."""
        ask_for_aneurysm(self.anatomy, replace(self.case.state.settings(), treatments=treatments))

    def deployed(self, treatment: Treatment) -> dict[str, Deployment]:
        """Return the deployed implants of a treatment by id."""
        return {implant.id: self.deployment(treatment, implant) for implant in treatment.implants}

    def stents(self, treatment: Treatment) -> tuple[Stent, ...]:
        """Return the devices of a deployed treatment in their order."""
        return tuple(one.stent for one in self.deployed(treatment).values())

    def _measures(self, treatment: Treatment, implant: Implant) -> Measures:
        """Return the measures of a deployed implant."""
        return self._of_implant(
            "measures", treatment, implant, lambda: measure(self.anatomy, self.deployment(treatment, implant))
        )

    def _metrics(self, treatment: Treatment, implant: Implant) -> dict[str, Any]:
        """Return the measures of a deployed implant with its bands, as in the metrics of a study."""

        def compute() -> dict[str, Any]:
            measures, deployment = self._measures(treatment, implant), self.deployment(treatment, implant)
            if isinstance(deployment.stent.design, Basket | Coil):
                return measures
            return measures | {"bands": bands_of(self.anatomy, deployment, measures, implant)}

        return self._of_implant("metrics", treatment, implant, compute)

    def _wires(self, pane: str, treatment: Treatment, colour: Colour) -> list[scene.LineLayer]:
        """Return the wires of the deployed implants of a treatment."""
        layers = []
        for implant in treatment.implants:
            found = self.deployment(treatment, implant)
            measured = partial(scene.node_coverage, found.stent)
            coverage = partial(self._of_implant, "coverage", treatment, implant, measured)
            layers.append(_wires(pane, found, colour, coverage))
        return layers

    def _drawn(self, pane: str, treatment: Treatment, colour: Colour) -> scene.Layers:
        """Return wires and contours of a deployed treatment in a pane."""
        meshes = [one for one in self.deployed(treatment).values() if not isinstance(one.stent, Coils)]
        contours = [scene.contour_layer(pane, one, self.anatomy) for one in meshes]
        return [*self._wires(pane, treatment, colour), *contours]

    def _sheets(self, treatment: Treatment) -> list[dict[str, Any]]:
        """Return the tables of the deployed implants of a treatment."""
        titles = scene.implant_titles(self.deployed(treatment))
        found = [sheets.device(titles[one.id], self._measures(treatment, one)) for one in treatment.implants]
        if len(found) > 1:
            key, stents = ("together", self.case.state.anatomy, treatment.implants), self.stents(treatment)
            measured = [self._measures(treatment, one) for one in treatment.implants]
            measures = self._cached(key, lambda: measure_together(self.anatomy, stents, measured))
            found.append(sheets.device("All devices together", measures))
        return found

    def bands_sheet(self, treatment: Treatment, implant: str, *, has_gaps: bool = False) -> dict[str, Any]:
        """Return the bands of a deployed implant as the page shows them; those of gaps take some seconds."""
        chosen = _implant(treatment, implant)
        told: dict[str, Any] = {"treatment": treatment.name, "implant": implant}
        if isinstance(find_design(chosen.device), Basket | Coil):
            return told | {"sentence": "No ranges are computed for devices in sacs.", "rows": []}
        with LOCK:
            metrics = self._metrics(treatment, chosen)
            anatomy, deployment = self.anatomy, self.deployment(treatment, chosen)
            gaps: dict[str, Any] = self._of_implant("gaps", treatment, chosen, dict)
        if has_gaps and not gaps:  # other processes deploy the device, so that the page is answered meanwhile
            found = gap_bands(anatomy, deployment, metrics, jobs=2)
            gaps |= {name: band.metrics() for name, band in found.items()}
        bands = metrics["bands"]
        metrics = metrics | {"bands": bands | {"results": bands["results"] | gaps}}
        return told | {"sentence": how_sure(metrics), "rows": band_rows(metrics)}

    def follow(self, take: Callable[[tuple[Stent, ...]], None] | None) -> None:
        """Hand the devices that are drawn, and all later ones, to the live flow; None: to nobody."""
        self._follow = take
        if take is not None and self.shown:
            take(self.shown)

    def _show(self, stents: tuple[Stent, ...]) -> None:
        """Note the devices that are drawn, and tell the live flow."""
        self.shown = stents
        if self._follow is not None:
            self._follow(stents)

    def _flow_layers(
        self, name: str, path: Path, moment: int | None, yielded: Straightening | None = None
    ) -> scene.Layers:
        """Return the layers of a flow, with its cut: of its mean, or of one moment of its last cycle.

        With an artery that has yielded come its wall and the devices in it.
        """

        def draw() -> scene.Layers:
            shown, anatomy = self._flow(path, moment), self.anatomy if yielded is None else yielded.anatomy
            own = [] if yielded is None else scene.own_layers(name, anatomy)
            wires = [] if yielded is None else [scene.wire_layer(name, one.stent) for one in yielded.deployed]
            return [*scene.flow_layers(name, shown, anatomy), cut(name, shown, self.anatomy), *own, *wires]

        return self._cached(("layers", path, path.stat().st_mtime_ns, self.case.state.anatomy, moment), draw)

    def _artery(self, name: str) -> Straightening:
        """Return the artery that has yielded to a treatment, as the last study has stored it."""
        (path,) = (self.case.folder / CACHE).glob(f"{escape(f'straighten {name}')}-*.npz")
        return self._loaded(path, Straightening)

    def _flow(self, path: Path, moment: int | None) -> FlowField:
        """Return the mean of a flow, or one moment of its last cycle."""
        flow = self._loaded(path, FlowField)
        return flow if moment is None or not flow.phases else flow.at_phase(flow.phases[moment % len(flow.phases)])

    def _yielded(self, pane: str, stents: Sequence[Stent], layers: scene.Layers) -> tuple[scene.Layers, dict[str, Any]]:
        """Return the layers of devices, in the artery that yields to them where it does, and what a message states."""
        setting, anatomy = self.case.state.choices.straightening, self.anatomy
        if setting == "off" or not stents:
            return layers, {}
        path = next((one.path for one in stents if one.path != PARENT), PARENT)
        key = ("yielding", self.case.state.anatomy, path)
        return self._cached(key, lambda: Yielding(on_path(anatomy, path))).drawn(pane, stents, layers, setting)

    def plan(self) -> bytes:
        """Return the plan of the chosen treatments as PDF, one page per implant.

        Raises InputError: no device is chosen, or one does not fit.
        """
        from vstent.reporting.plan_sheet import Planned, plan_pdf

        state, day = self.case.state, date.today().isoformat()
        chosen = state.choices.treatments
        if not chosen:
            raise InputError("No device is chosen. Choose one in the step Treatment.")
        with LOCK:
            found = {one.name: self.deployed(one) for one in chosen}
            metrics = {one.name: {part.id: self._metrics(one, part) for part in one.implants} for one in chosen}
            yields = {one.name: self._yielded(one.name, self.stents(one), [])[1] for one in chosen}
            notes = [f"{name}: {told['straightening']}" for name, told in yields.items() if told]
            anatomy = replace(self.anatomy, notes=(*notes, *self.anatomy.notes))
            return plan_pdf(Planned(state.name, anatomy, found, metrics, state.source, day))

    def _place(self, implant: Implant, stent: Stent, found: Sketch | Deployment | None) -> dict[str, Any]:
        """Return the position of a device on its path; where it has a preview, with bands of uncertainty.

        A path other than the parent artery comes with it.
        """
        if isinstance(stent, Coils):
            return {"device": stent.design.key, "size": stent.size.coil_label, "is_coils": True}
        ends = (stent.proximal_abscissa_mm, stent.distal_abscissa_mm)
        told = {
            "device": stent.design.key,
            "size": stent.size.label,
            "center_mm": stent.middle_abscissa_mm,
            "ends_mm": ends,
            "length_mm": stent.deployed_length_mm,
        }
        if isinstance(stent.design, Basket):
            room = room_of(self.anatomy.aneurysms[0], stent.nodes_mm.shape[1])
            heights_mm = np.arange(-BELOW_MM, room.height_mm, HEIGHT_STEP_MM)
            points_mm = room.origin_mm + heights_mm[:, None] * room.frame[0]
            width_mm = float(stent.row_diameter_mm.max())
            return told | {"is_basket": True, "width_mm": width_mm, "axis": _axis(points_mm, heights_mm)}
        if implant.placing.path != PARENT:
            anatomy = on_path(self.anatomy, implant.placing.path)
            span_mm = list(anatomy.parent.span_mm(anatomy.aneurysms[0])) if anatomy.aneurysms else []
            axis = anatomy.parent.axis
            told |= {"axis": _axis(axis.points_mm, axis.abscissa_mm), "neck": span_mm}
        told["profile"] = np.round(np.stack([stent.row_abscissa_mm, stent.row_diameter_mm], axis=1), 3).tolist()
        if not isinstance(found, Sketch):
            return told
        sketched = (found.stent.proximal_abscissa_mm, found.stent.distal_abscissa_mm)
        told["ends_band_mm"] = [
            [end + edge - middle for edge in sorted(band)]
            for end, middle, band in zip(ends, sketched, (found.proximal_band_mm, found.distal_band_mm), strict=True)
        ]
        lengths = sorted(b - a for a, b in zip(found.proximal_band_mm, found.distal_band_mm, strict=True))
        shift = stent.deployed_length_mm - (sketched[1] - sketched[0])
        return told | {"length_band_mm": [length + shift for length in lengths]}

    # -- messages for the page -----------------------------------------------------------------------------------------

    def anatomy_message(self) -> bytes:
        """Return vessel, openings, sac, neck, parent artery and axis with their numbers, as a message for the page."""
        anatomy = self.anatomy
        axis, openings = anatomy.parent.axis, anatomy.vessel.openings
        radius_mm = anatomy.parent.section_radius_mm
        span_mm = list(anatomy.parent.span_mm(anatomy.aneurysms[0])) if anatomy.aneurysms else []
        # The profile shows the artery around the neck, the view of the whole vessel is from the same side.
        profile, *others = scene.views_of(anatomy)
        low_mm, high_mm = span_mm or (0.0, axis.length_mm)
        is_near = (axis.abscissa_mm > low_mm - BESIDE_MM) & (axis.abscissa_mm < high_mm + BESIDE_MM)
        treated = np.concatenate([axis.points_mm[is_near], *(one.sac.vertices_mm for one in anatomy.aneurysms[:1])])
        whole = scene.view_of("whole", profile.axes, anatomy.vessel.lumen.vertices_mm)
        return message(
            [*scene.anatomy_layers(anatomy), *(_disc(k, opening) for k, opening in enumerate(openings))],
            views=[scene.view_of("profile", profile.axes, treated, 1.15), whole, *others],
            fade=1.2 * float(np.median(radius_mm)),
            axis=_axis(axis.points_mm, axis.abscissa_mm) | {"diameter": np.round(2 * radius_mm, 3).tolist()},
            own_mm=anatomy.parent.own_mm,
            is_oriented=anatomy.vessel.is_oriented,
            openings=[
                {
                    "role": opening.role,
                    "center_mm": opening.center_mm.tolist(),
                    "area_mm2": opening.area_mm2,
                    "diameter_mm": opening.diameter_mm,
                    "colour": [round(255 * part) for part in _opening_colour(opening)],
                }
                for opening in openings
            ],
            notes=[*anatomy.vessel.notes, *anatomy.notes],
            neck=span_mm,
            sacs=[
                {"center_mm": one.sac.vertices_mm.mean(axis=0).tolist(), "volume_mm3": one.sac.volume_mm3}
                for one in anatomy.aneurysms
            ],
            drawn=necks.told(necks.curve_of(anatomy)),
        )

    def neck_message(self, curve_mm: Sequence[Point], handle: int | None = None, to_mm: Point | None = None) -> bytes:
        """Return a neck with its area, optionally with one handle moved to a point of the wall."""
        with LOCK:
            curve = np.array(curve_mm, dtype=np.float64)
            if handle is not None and to_mm is not None:
                curve = necks.pulled(self.anatomy, curve, handle, np.array(to_mm, dtype=np.float64))
            return message([scene.closed_layer("neck", [curve], 0.08, scene.NECK_COLOUR)], neck=necks.told(curve))

    def anatomy_sheet(self) -> list[dict[str, Any]]:
        """Return the metrics of the anatomy."""
        measures = self._cached(("morphology", self.case.state.anatomy), lambda: morphology(self.anatomy))
        return sheets.anatomy(measures)

    def proposed(self) -> dict[str, Any]:
        """Return the values that the study proposes where none is chosen: inflow, grid spacing and device sizes."""
        devices = dict.fromkeys(key for one in self.case.state.choices.treatments for key in one.devices)

        def propose() -> dict[str, Any]:
            given = self.case.state.former_settings().flow or FlowSettings()
            numerics = replace(given.numerics, cell_size_mm=None)
            case = vessel_case(self.anatomy.vessel, replace(given, inflow_mL_s=None, numerics=numerics))
            sizes = {}
            for key in devices:
                with suppress(VstentError):
                    self._ask(with_device(key))
                    if not isinstance(find_design(key), Coil):  # which have a density instead
                        sizes[key] = size_of(Implant(key, key), self.anatomy).label
            return {
                "inflow_mL_s": case.inflow_mL_s,
                "inflow_source": ASSUMED,
                "cell_size_mm": default_cell_size_mm(case),
                "sizes": sizes,
            }

        is_without = self.case.state.choices.without_aneurysm
        found = self._cached(("proposed", self.case.state.anatomy, is_without, *devices), propose)
        try:
            cost = foretell_cost(vessel_case(self.anatomy.vessel, self.case.state.settings().flow or FlowSettings()))
        except VstentError as error:
            cost = str(error)
        return found | {"cost": cost}

    def _sketch(self, wall: MeasuredWall, implant: Implant) -> Sketch:
        """Return the preview of an implant at its place, or at the proposed one, on a wall that is measured for it."""
        anatomy = on_path(self.anatomy, implant.placing.path)
        landing = landing_of(implant, anatomy, wall.size)
        if landing is not None:
            return sketch(wall, landing)
        return laid_inside(partial(sketch, wall), propose_landing(wall.design, anatomy, wall.size))

    def sketch_message(self, treatment: Treatment, implant: str, landing: Landing | None, colour: Colour) -> bytes:
        """Return the wires of a treatment with one of its implants at a landing, or at its own place (None).

        The implant opens against the artery and the implants that it is inside of; those inside of it follow it.
        """
        self._ask(treatment)
        with LOCK:
            pane, followers = treatment.name, {implant}
            drawn: dict[str, Sketch | Deployment] = {}
            for one in self.placed(treatment).implants:
                is_moved, is_sketched = one.id == implant, _is_sketched(treatment, one)
                if is_moved and is_sketched:
                    drawn[one.id] = self._sketch(self._wall(treatment, one), _landed(one, landing))
                elif is_moved:
                    drawn[one.id] = self.deployment(treatment, _landed(one, landing))
                elif is_sketched and followers & set(one.inside):
                    followers.add(one.id)
                    anatomy, size = on_path(self.anatomy, one.placing.path), self.deployment(treatment, one).stent.size
                    inside = [drawn[name].stent for name in one.inside]
                    wall = measured_wall(find_design(one.device), size, anatomy, inside)
                    drawn[one.id] = self._sketch(wall, one)
                else:
                    drawn[one.id] = self.deployment(treatment, one)
            self._show(tuple(one.stent for one in drawn.values()))
            wires = [_wires(pane, one, colour, partial(_covered, one.stent)) for one in drawn.values()]
            layers, yields = self._yielded(pane, self.shown, [*wires])
            place = self._place(_implant(treatment, implant), drawn[implant].stent, drawn[implant])
            return message(
                layers, scene.scales_of(layers, self.anatomy), treatment=pane, implant=implant, **place, **yields
            )

    def deployment_message(self, treatment: Treatment, implant: str, colour: Colour) -> bytes:
        """Return a deployed treatment with its expansion and its metrics, and the place of one of its implants."""
        with LOCK:
            chosen, there = _implant(treatment, implant), self.placed(treatment)
            deployed = self.deployed(there)
            self._show(self.stents(there))
            layers, yields = self._yielded(treatment.name, self.shown, self._drawn(treatment.name, there, colour))
            told: dict[str, Any] = {"treatment": treatment.name, "implant": implant, **yields}
            told |= {
                "title": scene.treatment_title(deployed),
                "measures": self._sheets(there),
                "is_placed": there == treatment,
            }
            if implant not in deployed:
                told |= {"device": chosen.device, "is_coils": True, "advice": NOT_PLACED}
                return message(layers, scene.scales_of(layers, self.anatomy), **told)
            found, stent = deployed[implant], deployed[implant].stent
            sketched: Sketch | None = None
            if _is_sketched(treatment, chosen):
                landing = landing_of(chosen, on_path(self.anatomy, chosen.placing.path), stent.size)
                wall = self._wall(treatment, chosen)
                sketched = laid_inside(partial(sketch, wall), landing or Landing(stent.middle_abscissa_mm))
            return message(
                layers,
                scene.scales_of(layers, self.anatomy),
                **told,
                **self._place(chosen, stent, sketched),
                advice=found.advice,
            )

    def comparison_message(self, treatments: Sequence[Treatment], colour: Colour) -> bytes:
        """Return several deployed treatments, each in a pane of its own, on common color scales."""
        with LOCK:
            layers: scene.Layers = []
            told = []
            for number, treatment in enumerate(treatments):
                pane, title = f"compared {number}", scene.treatment_title(self.deployed(treatment))
                layers += self._drawn(pane, treatment, colour)
                told.append({"pane": pane, "title": title, "measures": self._sheets(treatment)})
            return message(layers, scene.scales_of(layers, self.anatomy), compared=told)

    def flow_message(self, moment: int | None, cut_mm: float | None = None) -> bytes:
        """Return wall shear stress, streamlines and a cut of every flow, or another cut alone, on common color scales.

        Raises ReadError: flows are missing.
        """
        with LOCK:
            paths = shown_flows(self.case.folder, self.case.state)
            if not paths:
                raise ReadError("Some flows of these results are missing. Run the step Flow.")
            arteries = {name: self._artery(name) for name in paths if _flow_name(name, STRAIGHTENED) in paths}
            aside = [_flow_name(name, end) for name in arteries for end in (ALONE, STRAIGHTENED)]
            both = {name: paths[_flow_name(name, STRAIGHTENED)] for name in arteries}
            paths = {name: both.get(name, path) for name, path in paths.items() if name not in aside}
            layers = [
                layer
                for name, path in paths.items()
                for layer in self._flow_layers(name, path, moment, arteries.get(name))
            ]
            of_scales, phases = layers, self._loaded(next(iter(paths.values())), FlowField).phases
            if cut_mm is not None:
                layers = [cut(name, self._flow(path, moment), self.anatomy, cut_mm) for name, path in paths.items()]
            if moment is not None and phases:  # all moments have the scales of that of the largest inflow
                most = max(range(len(phases)), key=lambda k: phases[k].inflow_mL_s)
                of_scales = self._flow_layers(BARE, paths[BARE], most)
            return message(
                layers,
                scene.scales_of(of_scales, self.anatomy),
                times_s=[phase.time_s for phase in phases],
                moment=moment if phases else None,
                panes=list(paths),
            )

    def films_message(self, direction: str, *, has_wires: bool = False, moment: int | None = None) -> bytes:
        """Return the films of every flow along one direction; empty: along the working projection.

        Raises ReadError: the angiogram has not been computed.
        """
        with LOCK:
            paths = kept_histories(self.case.folder)
            if not paths:
                raise ReadError("The angiogram has not been computed for these flows. Compute it in the step Flow.")
            histories = {name: self._loaded(path, History) for name, path in paths.items()}
            chosen = {one.name: one for one in self.case.state.choices.treatments if has_wires}
            stents = {name: self.stents(chosen[name]) for name in histories if name in chosen}
            key = ("direction", self.case.state.anatomy)
            proposed = partial(self._cached, key, lambda: working_projection(self.anatomy))
            angles = angles_of(direction) if direction else proposed()
            curves = kept_curves(self.case.folder) if moment is None else None
            return films_message(histories, angles, stents=stents, moment=moment, curves=curves)

    def section(self, treatment: Treatment | None, implant: str | None, abscissa_mm: float) -> dict[str, Any]:
        """Return the section by a plane across the parent axis: curves in the plane, in mm, and diameters.

        It shows a treatment, where one is given, with the diameters of one implant, or else of the first.
        """
        with LOCK:
            anatomy = self.anatomy
            across = self._cached(("planes", self.case.state.anatomy), lambda: planes(anatomy.parent.axis))
            at_mm = float(np.clip(abscissa_mm, 0.0, anatomy.parent.axis.length_mm))
            center, frame = (found[0] for found in across.at(np.array([at_mm])))
            radius_mm = float(np.interp(at_mm, anatomy.parent.axis.abscissa_mm, anatomy.parent.section_radius_mm))
            shown: dict[str, Any] = {
                "abscissa_mm": at_mm,
                "artery_diameter_mm": 2 * radius_mm,
                "lumen": _section(anatomy.vessel.lumen, center, frame),
                "landing": _section(anatomy.parent.landing_surface, center, frame),
            }
            deployed = {} if treatment is None else self.deployed(self.placed(treatment))
            if not deployed:
                return shown
            shown["rings"], shown_id = [], implant if implant in deployed else next(iter(deployed))
            for key, one in deployed.items():
                if (row := _row_at(one.stent, at_mm)) is None:
                    continue
                ring = (one.stent.nodes_mm[row] - center) @ frame[1:].T
                shown["rings"].append(np.round(np.append(ring, ring[:1], axis=0), 3).ravel().tolist())
                if key == shown_id:
                    shown |= {
                        "device_diameter_mm": float(one.stent.row_diameter_mm[row]),
                        "free_diameter_mm": float(free_diameters_mm(one.stent.design, one.stent.size)[row]),
                        "max_gap_mm": float(one.wall_gap_mm[row].max()),
                    }
            return shown


def _flow_name(name: str, end: str) -> str:
    """Return the name of a flow in an artery that has yielded to a treatment, among stored ones."""
    return flow_stage(f"{name}{end}").removeprefix("flow ")


def _implant(treatment: Treatment, name: str) -> Implant:
    """Return an implant of a treatment by its id; ReadError is raised where it has none."""
    for implant in treatment.implants:
        if implant.id == name:
            return implant
    raise ReadError(f"{name} is not among the implants of {treatment.name}.")


def _before(treatment: Treatment, implant: Implant) -> tuple[Implant, ...]:
    """Return the implants on which the deployment of an implant depends: it is inside of them, or they are."""
    inside = [_implant(treatment, name) for name in implant.inside]
    return tuple(found for one in inside for found in (*_before(treatment, one), one))


def _axis(points_mm: Floats, abscissa_mm: Floats) -> dict[str, list[float]]:
    """Return a curve as the page takes it: points (n, 3) and arc lengths (n,), in mm."""
    return {"points": np.round(points_mm, 3).ravel().tolist(), "abscissa": np.round(abscissa_mm, 3).tolist()}


def _opening_colour(opening: Opening) -> tuple[float, float, float]:
    """Return the color of an opening."""
    number = 0 if opening.is_inlet else int(opening.role.rpartition("_")[2])
    return OPENING_COLOURS[number] if number < len(OPENING_COLOURS) else (0.45, 0.50, 0.54)


def _disc(number: int, opening: Opening) -> scene.MeshLayer:
    """Return a disc with the area of an opening, slightly outside it."""
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    first = curves.any_perpendicular(opening.normal)
    second = np.cross(opening.normal, first)
    ring = np.outer(np.cos(angle), first) + np.outer(np.sin(angle), second)
    center = opening.center_mm + 0.05 * opening.normal
    points = np.concatenate([center[None], center + 0.5 * opening.diameter_mm * ring])
    around = np.arange(40)
    faces = np.stack([np.zeros(40, int), 1 + around, 1 + (around + 1) % 40], axis=1)
    return scene.MeshLayer(f"opening {number}", "", _opening_colour(opening), Surface(points, faces))


def _wires(name: str, found: Sketch | Deployment, colour: Colour, coverage: Callable[[], Floats]) -> scene.LineLayer:
    """Return the wires of a device, colored by the values at the nearest nodes (rows, columns)."""
    stent, gap_mm = found.stent, found.wall_gap_mm
    if isinstance(stent, Coils):
        return scene.wires_of("wires", name, stent)
    of_node = gap_mm
    if colour == "coverage":
        of_node = 100 * coverage()
    elif colour == "diameter":
        of_node = np.broadcast_to(stent.row_diameter_mm[:, None], gap_mm.shape)
    some = stent.wire_points_mm[::NEIGHBOURS]
    near = cKDTree(stent.nodes_mm.reshape(-1, 3)).query(some)[1]
    values = np.repeat(of_node.ravel()[near], NEIGHBOURS)[: len(stent.wire_points_mm)]
    return scene.wires_of("wires", name, stent, scale=colour, values=values)


def _covered(stent: Stent) -> Floats:
    """Return the metal coverage (rows, columns) by the formula, from the diameter of every row."""
    of_row = [coverage_fraction(stent.design, stent.size, float(d)) for d in stent.row_diameter_mm]
    return np.broadcast_to(np.array(of_row)[:, None], stent.nodes_mm.shape[:2])


def _is_sketched(treatment: Treatment, implant: Implant) -> bool:
    """Return whether an implant has a preview: it is a stent whose artery no implant on another path narrows."""
    if isinstance(find_design(implant.device), Basket | Coil) or implant.placing.beside:
        return False
    return all(_implant(treatment, name).placing.path == implant.placing.path for name in implant.inside)


def _landed(implant: Implant, landing: Landing | None) -> Implant:
    """Return an implant at a landing; None leaves it where it is."""
    if landing is None:
        return implant
    if isinstance(find_design(implant.device), Basket):
        return replace(implant, placing=replace(implant.placing, shift_mm=landing.abscissa_mm))
    there = Placing(implant.placing.path, landing.abscissa_mm, landing.anchor, beside=implant.placing.beside)
    return replace(implant, placing=there)


def _section(surface: Surface, center: Floats, frame: Floats) -> list[float]:
    """Return the section of a surface near the axis as segments x1, y1, x2, y2 in the plane."""
    near = np.linalg.norm(surface.corners_mm[:, 0] - center, axis=1) < SECTION_REACH_MM
    offset = surface.vertices_mm - center
    segments = triangles.section(offset, surface.faces[near], offset @ frame[0])
    return np.round(segments @ frame[1:].T, 3).ravel().tolist()


def _row_at(stent: Stent, at_mm: float) -> int | None:
    """Return the row of a device nearest to a plane across the parent axis; None where it is not there."""
    is_there = stent.path == PARENT and not isinstance(stent.design, Basket | Coil)
    is_there = is_there and stent.proximal_abscissa_mm <= at_mm <= stent.distal_abscissa_mm
    return int(np.argmin(np.abs(stent.row_abscissa_mm - at_mm))) if is_there else None
