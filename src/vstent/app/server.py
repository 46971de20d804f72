"""Server: the files of the page and the REST interface, documented at /api/docs."""

import asyncio
import json
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from fastapi import APIRouter, Depends, FastAPI, Query, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, JSONResponse, Response, StreamingResponse
from pydantic import Field

from vstent.app import intake, workspace
from vstent.app.cases import Absent, Case, Conflict
from vstent.app.choices import NECK_HANDLES, Choices, Point, Strict
from vstent.app.security import REPORT_POLICY, Guard
from vstent.app.workspace import Workspace
from vstent.devices.treatment import Treatment
from vstent.errors import InputError, ReadError, VstentError

MEDIA: Final = {".html": "text/html; charset=utf-8", ".js": "text/javascript; charset=utf-8", ".css": "text/css"}
"""Media type of a file of the page by its suffix."""
SHARED: Final = ("viewer.js", "viewer.css")
"""Files that the page shares with the report."""
ASSETS: Final = ("index.html", "app.js", "app.css", "docs.html", "docs.js", *SHARED)
"""Files of the page."""
BEAT_S: Final = 15.0
"""Interval of keep-alive messages in a stream of events, in s."""

Finite = Annotated[float, Query(allow_inf_nan=False)]
"""A finite number in a query."""
Axis = Annotated[int, Query(ge=0, le=2)]
"""Voxel axis across a slice."""
Moment = Annotated[int | None, Query(ge=0)]
"""Number of a moment of a pulse or a film; None: the mean, or all of them."""
Revision = Annotated[int, Field(ge=0)]
"""Revision of a case."""


class Binary(Response):
    """A binary answer: a manifest and its arrays (`vstent.reporting.packing`)."""

    media_type = "application/octet-stream"


class NewCase(Strict):
    """A case to create."""

    name: str = Field(max_length=120, min_length=1)


class Change(Strict):
    """Changed choices, based on the revision that the client last read."""

    revision: Revision
    choices: Choices


class Seen(Strict):
    """The revision that the client last read."""

    revision: Revision


class ImplantWanted(Strict):
    """A treatment to draw, and the implant whose place is returned."""

    treatment: Treatment
    implant: str = Field(max_length=60)
    colour: Literal["wall_gap", "coverage", "diameter"] = "wall_gap"


class SketchWanted(ImplantWanted):
    """An implant at a position, to draw."""

    anchor: Literal["proximal", "center", "distal"] = "center"
    abscissa_mm: float | None = Field(default=None, ge=-1000, le=1000)


class OutlinesWanted(Strict):
    """A slice, and a treatment whose wires are drawn on it."""

    axis: int = Field(ge=0, le=2)
    index: int
    treatment: Treatment | None = None
    upright: bool = False


class SectionWanted(Strict):
    """A place on the parent axis, and a treatment that the section shows, with the diameters of one implant."""

    abscissa_mm: float = Field(ge=-1000, le=1000)
    treatment: Treatment | None = None
    implant: str | None = Field(default=None, max_length=60)


class ComparisonWanted(Strict):
    """Treatments to draw side by side."""

    treatments: tuple[Treatment, ...] = Field(min_length=1, max_length=4)
    colour: Literal["wall_gap", "coverage", "diameter"] = "wall_gap"


class NeckWanted(Strict):
    """A neck to draw, optionally with one handle moved to a point on the wall."""

    curve_mm: tuple[Point, ...] = Field(min_length=3, max_length=1000)
    handle: int | None = Field(default=None, ge=0, lt=NECK_HANDLES)
    to_mm: Point | None = None


def create(work: Workspace, *, token: str, hosts: tuple[str, ...]) -> Guard:
    """Return the server: the REST interface behind its guard, which accepts a secret token and host names with port."""

    @asynccontextmanager
    async def life(_: FastAPI) -> AsyncIterator[None]:
        threading.Thread(target=work.warm, daemon=True).start()
        yield
        work.close()

    app = FastAPI(
        title="vstent",
        version=version("vstent"),
        description="Plan a stent: from a scan to the blood flow before and after. Research use only.",
        docs_url=None,
        redoc_url=None,
        openapi_url="/api/openapi.json",
        lifespan=life,
    )
    app.add_exception_handler(VstentError, _refused)
    app.add_exception_handler(RequestValidationError, _refused)
    _add_page(app)
    api = APIRouter(dependencies=[Depends(work.load)])

    def of_case(case_id: str) -> Case:
        return work.cases.get(case_id)

    for add in (_add_cases, _add_case_list, _add_input, _add_jobs, _add_scenes, _add_planning):
        add(api, work, Depends(of_case))
    app.include_router(api)
    return Guard(app, token=token, hosts=hosts)


def _refused(_: Request, error: Exception) -> JSONResponse:
    """Return an error as a JSON response."""
    if isinstance(error, RequestValidationError):
        # FastAPI would repeat the input, and a NaN in it is not JSON.
        return JSONResponse({"detail": [{"loc": one["loc"], "msg": one["msg"]} for one in error.errors()]}, 422)
    codes: dict[type[Exception], int] = {Conflict: 409, Absent: 404}
    code = codes.get(type(error), 422 if isinstance(error, InputError) else 500)
    return JSONResponse({"detail": str(error)}, code)


def asset(name: str) -> Response:
    """Return a file of the page."""
    folder = "reporting" if name in SHARED else "app"
    # Importing the reporting package here would delay the first page.
    text = files("vstent").joinpath(folder, "assets", name).read_bytes()
    return Response(text, media_type=MEDIA[Path(name).suffix])


def _add_page(app: FastAPI) -> None:
    """Add the routes of the page's files."""

    @app.get("/", include_in_schema=False)
    def page() -> Response:
        return asset("index.html")

    @app.get("/api/docs", include_in_schema=False)
    def docs() -> Response:
        return asset("docs.html")

    @app.get("/assets/{name}", include_in_schema=False)
    def one(name: str) -> Response:
        if name not in ASSETS:
            raise Absent("This file does not exist. The page is at /.")
        return asset(name)


def _add_cases(api: APIRouter, work: Workspace, of_case: Any) -> None:
    """Add the routes of cases and their choices."""

    @api.get("/api/catalogue", summary="Devices and their sizes")
    def catalogue() -> list[dict[str, Any]]:
        return workspace.devices()

    @api.get("/api/cases", summary="All cases, the latest first")
    def cases() -> dict[str, Any]:
        return {"cases": work.listed(), "opened": work.opened}

    @api.post("/api/cases", status_code=201, summary="Make a case")
    def create_case(wanted: NewCase) -> dict[str, Any]:
        return work.view(work.cases.create(wanted.name))

    @api.post("/api/demo", status_code=201, summary="Make a case of a synthetic scan")
    def demo() -> dict[str, Any]:
        return work.view(work.demo())

    @api.get("/api/cases/{case_id}", summary="Choices and results; an interrupted job resumes")
    def one(case: Case = of_case) -> dict[str, Any]:
        work.resume(case)
        return work.view(case)

    @api.put("/api/cases/{case_id}/choices", summary="Change choices; 409 where the case was changed elsewhere")
    def choose(change: Change, case: Case = of_case) -> dict[str, Any]:
        case.change(change.revision, change.choices)
        return work.changed(case)

    @api.post("/api/cases/{case_id}/undo", summary="Undo the last change")
    def undo(seen: Seen, case: Case = of_case) -> dict[str, Any]:
        case.step_back(seen.revision)
        return work.changed(case)

    @api.post("/api/cases/{case_id}/redo", summary="Redo the last undone change")
    def redo(seen: Seen, case: Case = of_case) -> dict[str, Any]:
        case.step_back(seen.revision, forward=True)
        return work.changed(case)

    @api.get("/api/cases/{case_id}/events", summary="The state, sent again whenever it changes (server-sent events)")
    async def events(case: Case = of_case) -> StreamingResponse:
        return StreamingResponse(_stream(work, case), media_type="text/event-stream")


def _add_case_list(api: APIRouter, work: Workspace, of_case: Any) -> None:
    """Add the routes of the list of cases: rename, delete, picture."""

    @api.delete("/api/cases/{case_id}", summary="Delete a case with its folder")
    def remove(case: Case = of_case) -> dict[str, Any]:
        work.remove(case)
        return {"cases": work.listed()}

    @api.put("/api/cases/{case_id}/name", summary="Change the displayed name of a case")
    def rename(wanted: NewCase, case: Case = of_case) -> dict[str, Any]:
        case.update(name=wanted.name)
        return {"cases": work.listed()}

    @api.put("/api/cases/{case_id}/picture", summary="Store the picture of a case in the list of cases (PNG)")
    async def keep_picture(request: Request, case: Case = of_case) -> dict[str, Any]:
        await asyncio.to_thread(workspace.keep_picture, case, await request.body())
        return {"kept": True}

    @api.get("/api/cases/{case_id}/picture", summary="Picture of a case (PNG)")
    def picture(case: Case = of_case) -> Response:
        path = case.folder / workspace.PICTURE
        if not path.is_file():
            raise Absent("This case has no picture yet.")
        return FileResponse(path, media_type="image/png")


async def _stream(work: Workspace, case: Case) -> AsyncIterator[str]:
    """Yield the state of a case whenever it changes, as server-sent events."""
    event = case.listen()
    try:
        while not work.is_closing:
            event.clear()
            yield f"data: {json.dumps(work.view(case))}\n\n"
            try:
                await asyncio.wait_for(event.wait(), BEAT_S)
                await asyncio.sleep(0.05)  # messages in quick succession are sent together
            except TimeoutError:
                yield ": still here\n\n"
    finally:
        case.leave(event)


def _add_input(api: APIRouter, work: Workspace, of_case: Any) -> None:
    """Add the routes of uploads and scans."""

    @api.put("/api/cases/{case_id}/input", summary="Upload a volume, a surface, a DICOM slice, or a ZIP of them")
    async def bring(
        request: Request, name: Annotated[str, Query(max_length=300)], case: Case = of_case
    ) -> dict[str, Any]:
        partial = await asyncio.to_thread(workspace.begin_upload, case, name)
        try:
            with partial.open("wb") as out:
                async for block in request.stream():
                    out.write(block)
            await asyncio.to_thread(intake.take, partial, name, case.folder)
        finally:
            partial.unlink(missing_ok=True)
        return {"taken": True}

    @api.post("/api/cases/{case_id}/input/done", summary="All files are uploaded: find the vessel, or wait")
    def done(look_first: bool = False, case: Case = of_case) -> dict[str, Any]:
        work.begin(case, look_first=look_first)
        return work.view(case)

    @api.get("/api/cases/{case_id}/input/surface", summary="The surface as read (binary)")
    def input_surface(case: Case = of_case) -> Response:
        return Binary(work.input_surface(case))

    @api.get("/api/cases/{case_id}/image", summary="Shape, spacing and intensities of the scan")
    def image(case: Case = of_case) -> dict[str, Any]:
        return work.scan(case).told()

    @api.get("/api/cases/{case_id}/image/threshold", summary="The proposed threshold of the scan")
    def threshold(case: Case = of_case) -> dict[str, float]:
        return {"proposed_threshold": work.scan(case).proposed_threshold}

    @api.get("/api/cases/{case_id}/image/slice", summary="One slice of the scan, or the maximum of a slab (binary)")
    def one_slice(
        axis: Axis, index: int, slab: Annotated[int, Query(ge=0)] = 0, upright: bool = False, case: Case = of_case
    ) -> Response:
        return Binary(work.scan(case).slice(axis, index, slab, is_upright=upright))

    @api.post("/api/cases/{case_id}/image/outlines", summary="Sections of vessel, sac, neck and wires (binary)")
    def outlines(wanted: OutlinesWanted, case: Case = of_case) -> Response:
        return Binary(work.outlines(case, wanted.treatment, wanted.axis, wanted.index, is_upright=wanted.upright))

    @api.get("/api/cases/{case_id}/image/surface", summary="The surface at a threshold (binary)")
    def surface(threshold: Finite, case: Case = of_case) -> Response:
        return Binary(work.scan(case).surface(threshold))


def _add_jobs(api: APIRouter, work: Workspace, of_case: Any) -> None:
    """Add the routes of jobs and results."""

    @api.post("/api/cases/{case_id}/jobs/{kind}", status_code=202, summary="Start a long stage")
    def start(kind: Literal["anatomy", "rank", "place", "flow", "angiogram"], case: Case = of_case) -> dict[str, Any]:
        work.start(case, kind)
        return work.view(case)

    @api.delete("/api/cases/{case_id}/jobs", summary="Stop it at once; finished results are kept")
    def stop(case: Case = of_case) -> dict[str, Any]:
        work.jobs.stop(case)
        return work.view(case)

    @api.get("/api/cases/{case_id}/ranking", summary="The ranking of all sizes of the chosen devices")
    def ranking(case: Case = of_case) -> dict[str, Any]:
        return workspace.ranking(case)

    @api.get("/api/cases/{case_id}/numbers", summary="Every result, with unit and definition")
    def numbers(case: Case = of_case) -> dict[str, Any]:
        return work.numbers(case)

    @api.get("/api/cases/{case_id}/files/{name}", summary="The files of a study")
    def one_file(
        name: Literal["metrics.json", "run.json", "report.html", "report.pdf"], case: Case = of_case
    ) -> Response:
        path = case.folder / name
        if not path.is_file():
            raise ReadError(f"{name} has not been written yet. Run the step Flow.")
        headers = {"content-security-policy": REPORT_POLICY} if name == "report.html" else {}
        return FileResponse(path, headers=headers)


def _add_scenes(api: APIRouter, work: Workspace, of_case: Any) -> None:
    """Add the routes of 3-D scenes."""

    @api.get("/api/cases/{case_id}/anatomy", summary="Vessel, sac, neck and parent artery (binary)")
    def anatomy(case: Case = of_case) -> Response:
        return Binary(work.preview(case).anatomy_message())

    @api.get("/api/cases/{case_id}/proposed", summary="Values that are proposed where none is chosen")
    def proposed(case: Case = of_case) -> dict[str, Any]:
        return dict(work.preview(case).proposed())

    @api.post("/api/cases/{case_id}/neck", summary="The neck with a handle moved, and its area (binary)")
    def neck(wanted: NeckWanted, case: Case = of_case) -> Response:
        return Binary(work.preview(case).neck_message(**wanted.model_dump()))

    @api.post("/api/cases/{case_id}/sketch", summary="The expected position of an implant (binary)")
    def sketch(wanted: SketchWanted, case: Case = of_case) -> Response:
        from vstent.devices.stent import Landing

        landing = None if wanted.abscissa_mm is None else Landing(wanted.abscissa_mm, wanted.anchor)
        return Binary(work.preview(case).sketch_message(wanted.treatment, wanted.implant, landing, wanted.colour))

    @api.post("/api/cases/{case_id}/deployment", summary="A deployed treatment: expansion and numbers (binary)")
    def deployment(wanted: ImplantWanted, case: Case = of_case) -> Response:
        answer = work.preview(case).deployment_message(wanted.treatment, wanted.implant, wanted.colour)
        work.note_deployed(case, wanted.treatment)
        return Binary(answer)

    @api.post("/api/cases/{case_id}/bands", summary="Bands of a deployed implant from the ranges of its numbers")
    def bands(wanted: ImplantWanted, case: Case = of_case, gaps: bool = False) -> dict[str, Any]:
        return dict(work.preview(case).bands_sheet(wanted.treatment, wanted.implant, has_gaps=gaps))

    @api.post("/api/cases/{case_id}/section", summary="The section by a plane across the parent axis")
    def section(wanted: SectionWanted, case: Case = of_case) -> dict[str, Any]:
        return dict(work.preview(case).section(wanted.treatment, wanted.implant, wanted.abscissa_mm))

    @api.get("/api/cases/{case_id}/flow", summary="Wall shear stress, streamlines and a cut, on one scale (binary)")
    def flow(moment: Moment = None, cut_mm: Finite | None = None, case: Case = of_case) -> Response:
        return Binary(work.preview(case).flow_message(moment, cut_mm))

    @api.get("/api/cases/{case_id}/angiogram", summary="Films of every flow along a C-arm direction (binary)")
    def angiogram(
        view: Annotated[str, Query(max_length=60)] = "",
        wires: bool = False,
        moment: Moment = None,
        case: Case = of_case,
    ) -> Response:
        return Binary(work.preview(case).films_message(view, has_wires=wires, moment=moment))


def _add_planning(api: APIRouter, work: Workspace, of_case: Any) -> None:
    """Add the routes of the waveform, of the live flow, of comparisons and of the plan."""

    @api.get("/api/waveform", summary="The waveforms that can be chosen: the published one, or the case's own")
    def waveform(case_id: str | None = None) -> dict[str, Any]:
        return workspace.pulse(None if case_id is None else work.cases.get(case_id))

    @api.get("/api/cases/{case_id}/preview", summary="Live flow around the device that is drawn; starts it (binary)")
    def live_flow(seen: Annotated[int, Query(ge=0)] = 0, case: Case = of_case) -> Response:
        return Binary(work.live_flow(case).message(seen))

    @api.post("/api/cases/{case_id}/preview", summary="Prepare the live flow at low priority; it answers sooner then")
    def prepare_live_flow(case: Case = of_case) -> dict[str, Any]:
        return {"is_begun": work.prepare_live_flow(case)}

    @api.delete("/api/cases/{case_id}/preview", summary="End the live flow")
    def end_live_flow(case: Case = of_case) -> dict[str, Any]:
        work.end_live_flow(case)
        return {"is_on": False}

    @api.post("/api/cases/{case_id}/comparison", summary="Up to four treatments, deployed, on one scale (binary)")
    def comparison(wanted: ComparisonWanted, case: Case = of_case) -> Response:
        return Binary(work.preview(case).comparison_message(wanted.treatments, wanted.colour))

    @api.get("/api/cases/{case_id}/plan.pdf", summary="The plan of the chosen treatments, one page per implant")
    def plan(case: Case = of_case) -> Response:
        return Response(work.preview(case).plan(), media_type="application/pdf")
