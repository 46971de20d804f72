"""Open cases and their jobs: everything that the routes of the server call."""

import json
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from vstent.app import intake
from vstent.app.cases import STATE, STEPS, Case, Cases, dependencies, failures, statuses
from vstent.app.choices import pulse_of
from vstent.app.finished import REPORT, are_flows_stored, kept_histories, lost_steps, reopened, shown_flows
from vstent.app.jobs import KINDS, RANKING, Jobs
from vstent.devices.catalogue import baskets, catalogue
from vstent.devices.treatment import BARE, Treatment
from vstent.errors import InputError, ReadError
from vstent.flow.settings import FlowSettings
from vstent.io.files import RAW_SUFFIXES, existing, is_surface_file, state_of, suffix, write_bytes
from vstent.study.folder import CACHE, RUN

PICTURE: Final = ".picture.png"
"""File of a case folder with its picture in the list of cases."""
INPUT_FACES: Final = 40_000
"""Number of triangles above which the surface of an input is decimated for the page."""


class Workspace:
    """Cases, jobs and immediate answers; `opened` names the case that the page opens first, empty: the list."""

    def __init__(self, cases: Cases) -> None:
        self.cases, self.opened = cases, ""
        self.jobs = Jobs()
        self.is_closing = False
        self._previews: dict[str, Any] = {}
        self._live_flows: dict[str, Any] = {}
        self._scans: dict[str, Any] = {}
        self._lock = threading.Lock()
        self._loading = threading.Lock()
        self._to_begin: tuple[Case, Path] | None = None

    # -- cases ---------------------------------------------------------------------------------------------------------

    def open(self, path: Path) -> None:
        """Open an input of the command line: a case of the page, one of `vstent run`, or a scan or surface.

        Raises ReadError: the path does not exist.
        """
        existing(path)
        if (path / STATE).is_file():
            self.opened = self.cases.adopt(path).id
        elif (path / RUN).is_file():
            self.opened = reopened(self.cases, path).id
        else:
            ending = suffix(path) if path.is_file() else ""
            case = self.cases.of_input(path) or self.cases.create(path.name[: len(path.name) - len(ending)])
            self.opened = case.id
            if not case.state.source:
                self._to_begin = (case, path)

    def listed(self) -> list[dict[str, Any]]:
        """Return every case with its title and progress."""
        found = []
        for case_id in self.cases.ids():
            try:
                case = self.cases.get(case_id)
                lost = lost_steps(case.folder, case.state)
                changed_s = (case.folder / STATE).stat().st_mtime
            except (ReadError, OSError):
                continue  # a folder of something else, a damaged one, or one that is being deleted
            steps, job = statuses(case.state, "", lost), self.jobs.running(case)
            found.append(
                {
                    "id": case_id,
                    "name": case.state.name,
                    "done": [step for step in STEPS if steps[step] == "done"],
                    "kept": [step for step in STEPS if steps[step] in ("done", "stale")],
                    "job": job.kind if job else "",
                    "failed": [step for step in STEPS if steps[step] == "failed"],
                    "changed_s": changed_s,
                    "has_picture": (case.folder / PICTURE).is_file(),
                }
            )
        return sorted(found, key=lambda one: -one["changed_s"])

    def remove(self, case: Case) -> None:
        """Stop everything that works on a case, and delete it with its folder."""
        self.jobs.stop(case)
        self.end_live_flow(case)
        self.cases.remove(case)
        with self._lock:
            self._previews.pop(case.id, None)
            self._scans.pop(case.id, None)

    def view(self, case: Case) -> dict[str, Any]:
        """Return the state of a case as clients read it."""
        state, job = case.state, self.jobs.running(case)
        flows = shown_flows(case.folder, state)
        return {
            "id": case.id,
            "name": state.name,
            "folder": str(case.folder),
            "revision": state.revision,
            "sent_s": time.monotonic(),
            "choices": state.choices.model_dump(mode="json"),
            "unseen": state.unseen() if state.former else [],
            "steps": statuses(state, job.step if job else "", lost_steps(case.folder, state)),
            "failed": failures(state),
            "can_undo": bool(state.undo),
            "can_redo": bool(state.redo),
            "has_input": bool(state.source),
            "is_scan": bool(state.source) and not _is_surface(case),
            "wants_grid": bool(state.source) and _wants_grid(case),
            "has_anatomy": bool(state.anatomy),
            "anatomy": state.anatomy,
            "has_report": (case.folder / REPORT).is_file(),
            "has_pdf": (case.folder / "report.pdf").is_file(),
            "has_ranking": (case.folder / RANKING).is_file(),
            "has_flow": bool(flows),
            "results": f"{' '.join(flows)} {state_of(case.folder / 'metrics.json')}",
            "has_angiogram": bool(kept_histories(case.folder)),
            "job": job.told() if job else None,
        }

    def changed(self, case: Case) -> dict[str, Any]:
        """Return the state after a change of the choices; those of an earlier run get its stored flows and a report."""
        if self.jobs.running(case) is None and are_flows_stored(case.folder, case.state):
            self.start(case, "flow")
        return self.view(case)

    def demo(self) -> Case:
        """Create a case of the synthetic scan."""
        from vstent.study.demo import write_scan

        case = self.cases.create("demo")
        write_scan(case.folder / intake.FOLDER / intake.SERIES)
        self.begin(case)
        return case

    def begin(self, case: Case, *, look_first: bool = False) -> None:
        """Find the vessel of a complete upload, unless a scan is to be looked at or described first."""
        self.point(case, intake.found(case.folder))
        if not _wants_grid(case) and not (look_first and not _is_surface(case)):
            self.start(case, "anatomy")

    def point(self, case: Case, path: str) -> None:
        """Set the path of the scan or surface."""
        from vstent.study.keys import hash_of

        source = hash_of(case.folder / path)
        case.update(input=path, source=source, revision=case.state.revision + 1)
        with self._lock:
            self._scans.pop(case.id, None)

    def start(self, case: Case, kind: str) -> None:
        """Start a job of a kind: anatomy, rank, place, flow or angiogram.

        Raises ReadError: there is no scan or surface, or it was moved.
        Raises InputError: no device is chosen, or the flow of an angiogram is not up to date.
        """
        if not case.input.exists():
            raise ReadError(f"The scan of {case.state.name} has been moved from {case.input}. Put it back there.")
        if kind != "anatomy" and not case.state.choices.treatments:
            raise InputError("No device is chosen. Choose one in the step Treatment.")
        if kind == "rank" and not case.state.choices.ranked:
            raise InputError(
                "Sizes of baskets and coils are not ranked. Choose a device for arteries in the step Treatment."
            )
        steps = statuses(case.state, "", lost_steps(case.folder, case.state))
        if kind == "angiogram" and not (case.state.choices.flow.is_wanted and steps["flow"] == "done"):
            raise InputError("The flow is out of date or not computed, and contrast moves with it. Run the step Flow.")
        with self._lock:  # the job has the cores of the live flows that compute although nobody watches
            for case_id in [name for name, one in self._live_flows.items() if one.is_preparing]:
                self._live_flows.pop(case_id).stop()
        self.jobs.start(case, kind)

    def resume(self, case: Case) -> None:
        """Resume the job that was running when the server was killed."""
        if case.state.job in KINDS and not self.jobs.has(case) and case.state.source:
            self.start(case, case.state.job)

    def note_deployed(self, case: Case, treatment: Treatment) -> None:
        """Mark the steps device and deploy as finished after a deployed treatment was sent to the page."""
        keys = dependencies(case.state)
        is_current = treatment in case.state.choices.treatments and case.state.done.get("sac") == keys["sac"]
        is_current = is_current and self.preview(case).placed(treatment) == treatment
        chosen = {step: keys[step] for step in ("device", "deploy")}
        if is_current and any(case.state.done.get(step) != key for step, key in chosen.items()):
            case.update(done=case.state.done | chosen)

    # -- immediate answers ---------------------------------------------------------------------------------------------

    def preview(self, case: Case) -> Any:
        """Return the object that answers immediately for a case."""
        from vstent.app.preview import Preview

        with self._lock:
            if case.id not in self._previews:
                self._previews[case.id] = Preview(case)
            return self._previews[case.id]

    def live_flow(self, case: Case) -> Any:
        """Return the live flow of a case; start it where it does not run, or runs for another anatomy or flow.

        Raises InputError: the vessel has no sac.
        """
        from vstent.app.live import BareFlowStore, LiveFlowProcess

        preview, state = self.preview(case), case.state
        given = state.settings().flow or FlowSettings()
        settings = replace(given, waveform=None, numerics=replace(given.numerics, refine=()))
        store = BareFlowStore.of(case.folder / CACHE, state.anatomy, settings)
        with self._lock:
            found = self._live_flows.get(case.id)
            if found is None or found.store != store:
                for one in self._live_flows.values():
                    one.stop()  # one at a time: each uses all cores
                self._live_flows = {case.id: LiveFlowProcess(preview.anatomy, settings, store)}
                preview.follow(self._live_flows[case.id].place)
            return self._live_flows[case.id]

    def prepare_live_flow(self, case: Case) -> bool:
        """Begin to compute the live flow without a device, so that numbers follow soon when it is switched on.

        Raises InputError: the vessel has no sac.
        """
        from vstent.app.live import FREE_BYTES
        from vstent.flow.memory import free_memory_bytes

        is_in_use = any(one.is_watched for one in tuple(self._live_flows.values()))
        if is_in_use or self.jobs.are_running or free_memory_bytes() < FREE_BYTES:
            return False
        self.live_flow(case)
        return True

    def end_live_flow(self, case: Case) -> None:
        """Stop the live flow of a case."""
        with self._lock:
            found = self._live_flows.pop(case.id, None)
            if case.id in self._previews:
                self._previews[case.id].follow(None)
        if found is not None:
            found.stop()

    def scan(self, case: Case) -> Any:
        """Return the scan of a case.

        Raises InputError: the case has a surface, or no input yet.
        """
        from vstent.app.scans import Scan
        from vstent.io.images import read_image

        if _is_surface(case):
            raise InputError("This case has no scan, because it began with a surface.")
        choices = case.state.choices
        grid, crop = (choices.spacing_mm, choices.shape), choices.crop_mm
        with self._lock:
            given, found = self._scans.get(case.id, (None, None))
            if given != (grid, crop):
                is_read = given is not None and given[0] == grid
                image = found.image if is_read else read_image(case.input, spacing_mm=grid[0], shape=grid[1])
                found = Scan(image, None if crop is None else np.array(crop, dtype=np.float64))
                self._scans[case.id] = (grid, crop), found
            return found

    def outlines(self, case: Case, treatment: Treatment | None, axis: int, index: int, *, is_upright: bool) -> bytes:
        """Return the outlines on a slice as a message for the page."""
        from vstent.app.outlines import outlines

        preview = self.preview(case)
        stents = [] if treatment is None else preview.stents(preview.placed(treatment))
        return outlines(self.scan(case).grid(is_upright=is_upright), preview.anatomy, stents, axis, index)

    def input_surface(self, case: Case) -> bytes:
        """Return the surface of the input as read, as a message for the page.

        Raises InputError: the case has a scan, or the surface cannot be read.
        """
        from vstent.io.surfaces import read_surface
        from vstent.reporting.packing import message
        from vstent.reporting.scene import FRONTAL, WALL_COLOUR, MeshLayer, view_of
        from vstent.reporting.thinning import thin_surface

        if not _is_surface(case):
            raise InputError("This case has a scan and not a surface.")
        choices = case.state.choices
        surface, _ = thin_surface(read_surface(case.input, units=choices.units, frame=choices.frame)[0], INPUT_FACES)
        layer = MeshLayer("input", "", WALL_COLOUR, surface)
        return message([layer], views=[view_of("whole", FRONTAL, surface.vertices_mm)])

    def numbers(self, case: Case) -> dict[str, Any]:
        """Return all results so far: anatomy, flow without and with devices, ranking of treatments, and uncertainty."""
        from vstent.app import sheets

        found: dict[str, Any] = {"anatomy": [], "flow": [], "uncertainty": [], "ranking": []}
        if case.state.anatomy:
            found["anatomy"] = self.preview(case).anatomy_sheet()
        path, job = case.folder / "metrics.json", self.jobs.running(case)
        if path.is_file() and not (job and job.kind == "flow" and path.stat().st_mtime < job.began):
            metrics = json.loads(path.read_text(encoding="utf-8"))
            titles = _titles(metrics, case)
            found |= {"flow": sheets.flow(metrics, titles), "uncertainty": sheets.uncertainty(metrics, titles)}
            found["ranking"] = metrics.get("ranking", [])
        return found

    def warm(self) -> None:
        """Start the case given on the command line, and load what the first request will need."""
        self.load()
        if self._to_begin is not None:
            case, path = self._to_begin
            self.point(case, str(path))
            self.start(case, "anatomy")
        devices()

    def load(self) -> None:
        """Import everything that answers need before the first request; a second caller waits.

        Two threads that import a package and one of its modules at the same time may get incomplete modules.
        """
        with self._loading:
            from vstent.app import outlines, preview, scans, sheets  # noqa: F401
            from vstent.devices import schema as device_schema  # noqa: F401
            from vstent.flow import waveform  # noqa: F401

    def close(self) -> None:
        """Stop all jobs, which are resumed later, and the live flow."""
        self.is_closing = True
        for one in self._live_flows.values():
            one.stop()
        self.jobs.abandon()


def keep_picture(case: Case, data: bytes) -> None:
    """Store the picture of a case.

    Raises InputError: it is not a PNG file.
    """
    if not data.startswith(b"\x89PNG\r\n\x1a\n"):
        raise InputError("The picture of a case must be a PNG file.")
    write_bytes(case.folder / PICTURE, data)


def begin_upload(case: Case, name: str) -> Path:
    """Return a file to write an upload to.

    Raises InputError: the case already has its input, or the name is that of neither a scan nor a surface.
    """
    if case.state.source:
        raise InputError(f"{case.state.name} already has its scan or surface. Make another case for {name}.")
    intake.checked_name(name)
    folder = case.folder / intake.FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    handle = tempfile.NamedTemporaryFile(prefix=".part-", dir=folder, delete=False)
    handle.close()
    return Path(handle.name)


def devices() -> list[dict[str, Any]]:
    """Return the catalogue with baskets and coils as the page lists it."""
    return [
        {
            "key": key,
            "name": design.name,
            "maker": design.maker,
            "use": design.use,
            "sizes": [[size.diameter_mm, size.length_mm] for size in design.sizes],
            "n_cited": sum(fact.confidence == "cited" for fact in design.facts),
            "n_facts": len(design.facts),
        }
        for key, design in (catalogue() | baskets()).items()
    ]


def ranking(case: Case) -> dict[str, Any]:
    """Return the stored ranking, and whether it belongs to the present choices."""
    path = case.folder / RANKING
    if not path.is_file():
        return {"rows": [], "is_current": False}
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    names = case.state.choices.ranked
    is_current = found.get("anatomy") == case.state.anatomy and found.get("devices") == names
    return found | {"is_current": is_current}


def pulse(case: Case | None) -> dict[str, Any]:
    """Return times in s and flow over mean flow of the waveform that can be chosen.

    It is the published waveform, or that of the study that the case was opened from.
    """
    former = None if case is None else case.state.former_settings().flow
    waveform = pulse_of(former or FlowSettings())
    time_s = np.linspace(0.0, waveform.period_s, 101)
    return {"time_s": time_s.tolist(), "factor": waveform.factor(time_s).tolist()}


def _titles(metrics: dict[str, Any], case: Case) -> dict[str, str]:
    """Return the titles of the treatments, devices with their sizes, in the order in which they were chosen."""
    chosen = {one.name: [implant.id for implant in one.implants] for one in case.state.choices.treatments}
    titles = {}
    for name in sorted(sorted(metrics["treatments"].keys() - {BARE}), key=lambda name: [*chosen, name].index(name)):
        implants = metrics["treatments"][name]["implants"]
        ordered = sorted(implants, key=lambda key: [*chosen.get(name, ()), key].index(key))
        titles[name] = " + ".join(f"{implants[key]['device']} {implants[key]['size']}" for key in ordered)
    return titles


def _is_surface(case: Case) -> bool:
    """Return whether the input of a case is a surface."""
    return is_surface_file(case.input)


def _wants_grid(case: Case) -> bool:
    """Return whether number and spacing of the voxels must be given before the scan can be read."""
    choices = case.state.choices
    return suffix(case.input) in RAW_SUFFIXES and (choices.shape is None or choices.spacing_mm is None)
