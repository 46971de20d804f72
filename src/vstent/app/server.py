"""Server: the files of the page and the REST interface, documented at /api/docs."""

import asyncio
import json
import secrets
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from fastapi import APIRouter, Depends, FastAPI, Query, Request
from fastapi.responses import FileResponse, JSONResponse, Response, StreamingResponse
from pydantic import Field

from vstent.app import desk as desks
from vstent.app.cases import Absent
from vstent.app.choices import NECK_HANDLES, Choices, Point, Strict
from vstent.app.desk import Desk
from vstent.app.security import REPORT_POLICY, Guard
from vstent.devices.treatment import Treatment
from vstent.errors import ReadError, VstentError

MEDIA: Final = {".html": "text/html; charset=utf-8", ".js": "text/javascript; charset=utf-8", ".css": "text/css"}
"""Media type of a file of the page by its suffix."""
BINARY: Final = "application/octet-stream"
"""Media type of binary answers: a manifest and its arrays (`vstent.reporting.packing`)."""
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
Revision = Annotated[int, Field(ge=0)]
"""Revision of a case."""


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


class ComparisonWanted(Strict):
    """Treatments to draw side by side."""

    treatments: tuple[Treatment, ...] = Field(min_length=1, max_length=4)
    colour: Literal["wall_gap", "coverage", "diameter"] = "wall_gap"


class NeckWanted(Strict):
    """A neck to draw, optionally with one handle moved to a point on the wall."""

    curve_mm: tuple[Point, ...] = Field(min_length=3, max_length=1000)
    handle: int | None = Field(default=None, ge=0, lt=NECK_HANDLES)
    to_mm: Point | None = None


def create(desk: Desk, *, token: str, hosts: tuple[str, ...]) -> Guard:
    """Return the server: the REST interface behind its guard.

    Parameters
    ----------
    desk : cases and jobs.
    token : secret token.
    hosts : accepted host names with port.
    """

    @asynccontextmanager
    async def life(_: FastAPI) -> AsyncIterator[None]:
        threading.Thread(target=desk.warm, daemon=True).start()
        yield
        desk.close()

    app = FastAPI(
        title="vstent",
        version=version("vstent"),
        description="Plan a stent: from a scan to the blood flow before and after. Research use only.",
        docs_url=None,
        redoc_url=None,
        openapi_url="/api/openapi.json",
        lifespan=life,
    )
    app.add_exception_handler(VstentError, _said)
    _add_page(app)
    api = APIRouter(dependencies=[Depends(desk.load)])
    _add_cases(api, desk)
    _add_case_list(api, desk)
    _add_input(api, desk)
    _add_jobs(api, desk)
    _add_scenes(api, desk)
    _add_flows(api, desk)
    _add_planning(api, desk)
    app.include_router(api)
    return Guard(app, token=token, hosts=hosts)


def new_token() -> str:
    """Return a random token."""
    return secrets.token_urlsafe(24)


def _said(_: Request, error: Exception) -> JSONResponse:
    """Return an error as a JSON response."""
    return JSONResponse({"detail": str(error)}, desks.code_of(error))


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


def _add_cases(api: APIRouter, desk: Desk) -> None:
    """Add the routes of cases and their choices."""

    @api.get("/api/catalogue", summary="Devices and their sizes")
    def catalogue() -> list[dict[str, Any]]:
        return desks.devices()

    @api.get("/api/cases", summary="All cases, the latest first")
    def cases() -> dict[str, Any]:
        return {"cases": desk.listed(), "opened": desk.opened}

    @api.post("/api/cases", status_code=201, summary="Make a case")
    def create_case(wanted: NewCase) -> dict[str, Any]:
        return desk.view(desk.store.create(wanted.name))

    @api.post("/api/demo", status_code=201, summary="Make a case of a synthetic scan")
    def demo() -> dict[str, Any]:
        return desk.view(desk.demo())

    @api.get("/api/cases/{case_id}", summary="Choices and results; an interrupted job resumes")
    def case(case_id: str) -> dict[str, Any]:
        found = desk.store.get(case_id)
        desk.resume(found)
        return desk.view(found)

    @api.put("/api/cases/{case_id}/choices", summary="Change choices; 409 where the case was changed elsewhere")
    def choose(case_id: str, change: Change) -> dict[str, Any]:
        found = desk.store.get(case_id)
        found.change(change.revision, change.choices)
        return desk.view(found)

    @api.post("/api/cases/{case_id}/undo", summary="Undo the last change")
    def undo(case_id: str, seen: Seen) -> dict[str, Any]:
        found = desk.store.get(case_id)
        found.step_back(seen.revision)
        return desk.view(found)

    @api.post("/api/cases/{case_id}/redo", summary="Redo the last undone change")
    def redo(case_id: str, seen: Seen) -> dict[str, Any]:
        found = desk.store.get(case_id)
        found.step_back(seen.revision, forward=True)
        return desk.view(found)

    @api.get("/api/cases/{case_id}/events", summary="The state, sent again whenever it changes (server-sent events)")
    async def events(case_id: str) -> StreamingResponse:
        found = await asyncio.to_thread(desk.store.get, case_id)
        return StreamingResponse(_stream(desk, found), media_type="text/event-stream")


def _add_case_list(api: APIRouter, desk: Desk) -> None:
    """Add the routes of the list of cases: rename, delete, picture."""

    @api.delete("/api/cases/{case_id}", summary="Delete a case with its folder")
    def remove(case_id: str) -> dict[str, Any]:
        desk.remove(desk.store.get(case_id))
        return {"cases": desk.listed()}

    @api.put("/api/cases/{case_id}/name", summary="Change the displayed name of a case")
    def rename(case_id: str, wanted: NewCase) -> dict[str, Any]:
        desk.store.get(case_id).rename(wanted.name)
        return {"cases": desk.listed()}

    @api.put("/api/cases/{case_id}/picture", summary="Store the picture of a case in the list of cases (PNG)")
    async def keep_picture(case_id: str, request: Request) -> dict[str, Any]:
        found = await asyncio.to_thread(desk.store.get, case_id)
        await asyncio.to_thread(desks.keep_picture, found, await request.body())
        return {"kept": True}

    @api.get("/api/cases/{case_id}/picture", summary="Picture of a case (PNG)")
    def picture(case_id: str) -> Response:
        path = desk.store.get(case_id).folder / desks.PICTURE
        if not path.is_file():
            raise Absent("This case has no picture yet.")
        return FileResponse(path, media_type="image/png")


async def _stream(desk: Desk, case: Any) -> AsyncIterator[str]:
    """Yield the state of a case whenever it changes, as server-sent events."""
    event = case.listen()
    try:
        while not desk.is_closing:
            event.clear()
            yield f"data: {json.dumps(desk.view(case))}\n\n"
            try:
                await asyncio.wait_for(event.wait(), BEAT_S)
                await asyncio.sleep(0.05)  # messages in quick succession are sent together
            except TimeoutError:
                yield ": still here\n\n"
    finally:
        case.leave(event)


def _add_input(api: APIRouter, desk: Desk) -> None:
    """Add the routes of uploads and scans."""

    @api.put("/api/cases/{case_id}/input", summary="Upload a volume, a surface, a DICOM slice, or a ZIP of them")
    async def bring(case_id: str, request: Request, name: Annotated[str, Query(max_length=300)]) -> dict[str, Any]:
        found = await asyncio.to_thread(desk.store.get, case_id)
        partial = await asyncio.to_thread(desks.begin_upload, found, name)
        try:
            with partial.open("wb") as out:
                async for block in request.stream():
                    out.write(block)
            await asyncio.to_thread(desks.end_upload, found, partial, name)
        finally:
            partial.unlink(missing_ok=True)
        return {"taken": True}

    @api.post("/api/cases/{case_id}/input/done", summary="All files are uploaded: find the vessel")
    def done(case_id: str) -> dict[str, Any]:
        found = desk.store.get(case_id)
        desk.begin(found)
        return desk.view(found)

    @api.get("/api/cases/{case_id}/input/surface", summary="The surface as read (binary)")
    def input_surface(case_id: str) -> Response:
        return Response(desk.input_surface(desk.store.get(case_id)), media_type=BINARY)

    @api.get("/api/cases/{case_id}/image", summary="Shape, spacing and intensities of the scan")
    def image(case_id: str) -> dict[str, Any]:
        return desk.scan(desk.store.get(case_id)).told()

    @api.get("/api/cases/{case_id}/image/threshold", summary="The proposed threshold of the scan")
    def threshold(case_id: str) -> dict[str, float]:
        return {"proposed_threshold": desk.scan(desk.store.get(case_id)).proposed_threshold}

    @api.get("/api/cases/{case_id}/image/slice", summary="One slice of the scan, or the maximum of a slab (binary)")
    def one_slice(
        case_id: str, axis: Axis, index: int, slab: Annotated[int, Query(ge=0)] = 0, upright: bool = False
    ) -> Response:
        scan = desk.scan(desk.store.get(case_id))
        return Response(scan.slice(axis, index, slab, is_upright=upright), media_type=BINARY)

    @api.get("/api/cases/{case_id}/image/outlines", summary="Sections of vessel, sac, neck and wires (binary)")
    def outlines(case_id: str, axis: Axis, index: int, treatment: str | None = None, upright: bool = False) -> Response:
        found = desk.store.get(case_id)
        return Response(desk.outlines(found, treatment, axis, index, is_upright=upright), media_type=BINARY)

    @api.get("/api/cases/{case_id}/image/surface", summary="The surface at a threshold (binary)")
    def surface(case_id: str, threshold: Finite) -> Response:
        return Response(desk.surface(desk.store.get(case_id), threshold), media_type=BINARY)


def _add_jobs(api: APIRouter, desk: Desk) -> None:
    """Add the routes of jobs and results."""

    @api.post("/api/cases/{case_id}/jobs/{kind}", status_code=202, summary="Start a long stage")
    def start(case_id: str, kind: Literal["anatomy", "rank", "flow", "angiogram"]) -> dict[str, Any]:
        found = desk.store.get(case_id)
        desk.start(found, kind)
        return desk.view(found)

    @api.delete("/api/cases/{case_id}/jobs", summary="Stop it at once; finished results are kept")
    def stop(case_id: str) -> dict[str, Any]:
        found = desk.store.get(case_id)
        desk.jobs.stop(found)
        return desk.view(found)

    @api.get("/api/cases/{case_id}/ranking", summary="The ranking of all sizes of the chosen devices")
    def ranking(case_id: str) -> dict[str, Any]:
        return desks.ranking(desk.store.get(case_id))

    @api.get("/api/cases/{case_id}/numbers", summary="Every result, with unit and definition")
    def numbers(case_id: str) -> dict[str, Any]:
        return desk.numbers(desk.store.get(case_id))

    @api.get("/api/cases/{case_id}/files/{name}", summary="The files of a study")
    def one_file(case_id: str, name: Literal["metrics.json", "run.json", "report.html", "report.pdf"]) -> Response:
        path = desk.store.get(case_id).folder / name
        if not path.is_file():
            raise ReadError(f"{name} has not been written yet. Run the step Flow.")
        headers = {"content-security-policy": REPORT_POLICY} if name == "report.html" else {}
        return FileResponse(path, headers=headers)


def _add_scenes(api: APIRouter, desk: Desk) -> None:
    """Add the routes of 3-D scenes."""

    @api.get("/api/cases/{case_id}/anatomy", summary="Vessel, sac, neck and parent artery (binary)")
    def anatomy(case_id: str) -> Response:
        return Response(desk.live(desk.store.get(case_id)).anatomy_message(), media_type=BINARY)

    @api.get("/api/cases/{case_id}/proposed", summary="Values that are proposed where none is chosen")
    def proposed(case_id: str) -> dict[str, Any]:
        found: dict[str, Any] = desk.live(desk.store.get(case_id)).proposed()
        return found

    @api.post("/api/cases/{case_id}/neck", summary="The neck with a handle moved, and its area (binary)")
    def neck(case_id: str, wanted: NeckWanted) -> Response:
        return Response(desk.neck(desk.store.get(case_id), *wanted.model_dump().values()), media_type=BINARY)

    @api.post("/api/cases/{case_id}/sketch", summary="The expected position of an implant (binary)")
    def sketch(case_id: str, wanted: SketchWanted) -> Response:
        live = desk.live(desk.store.get(case_id))
        landing = desks.landing(wanted.abscissa_mm, wanted.anchor)
        return Response(
            live.sketch_message(wanted.treatment, wanted.implant, landing, wanted.colour), media_type=BINARY
        )

    @api.post("/api/cases/{case_id}/deployment", summary="A deployed treatment: expansion and numbers (binary)")
    def deployment(case_id: str, wanted: ImplantWanted) -> Response:
        found = desk.store.get(case_id)
        answer = desk.live(found).deployment_message(wanted.treatment, wanted.implant, wanted.colour)
        desk.note_deployed(found, wanted.treatment)
        return Response(answer, media_type=BINARY)

    @api.post("/api/cases/{case_id}/bands", summary="Bands of a deployed implant from the ranges of its numbers")
    def bands(case_id: str, wanted: ImplantWanted) -> dict[str, Any]:
        return desk.live(desk.store.get(case_id)).bands_sheet(wanted.treatment, wanted.implant)

    @api.get("/api/cases/{case_id}/section", summary="The section by a plane across the parent axis")
    def section(
        case_id: str, abscissa_mm: Finite, treatment: str | None = None, implant: str | None = None
    ) -> dict[str, Any]:
        return desk.live(desk.store.get(case_id)).section(treatment, implant, abscissa_mm)


def _add_flows(api: APIRouter, desk: Desk) -> None:
    """Add the routes of computed flows and their films."""

    @api.get("/api/cases/{case_id}/flow", summary="Wall shear stress, streamlines and a cut, on one scale (binary)")
    def flow(case_id: str, moment: Annotated[int | None, Query(ge=0)] = None) -> Response:
        return Response(desk.live(desk.store.get(case_id)).flow_message(moment), media_type=BINARY)

    @api.get("/api/cases/{case_id}/angiogram", summary="Films of every flow along a C-arm direction (binary)")
    def angiogram(
        case_id: str,
        view: Annotated[str, Query(max_length=60)] = "",
        wires: bool = False,
        moment: Annotated[int | None, Query(ge=0)] = None,
    ) -> Response:
        found = desk.live(desk.store.get(case_id))
        return Response(found.films_message(view, has_wires=wires, moment=moment), media_type=BINARY)

    @api.get("/api/waveform", summary="The waveforms that can be chosen: the published one, or the case's own")
    def waveform(case_id: str | None = None) -> dict[str, Any]:
        return desks.pulse(None if case_id is None else desk.store.get(case_id))


def _add_planning(api: APIRouter, desk: Desk) -> None:
    """Add the routes of the live flow, of comparisons and of the plan."""

    @api.get("/api/cases/{case_id}/preview", summary="Live flow around the device that is drawn; starts it (binary)")
    def preview(case_id: str, seen: Annotated[int, Query(ge=0)] = 0) -> Response:
        return Response(desk.preview(desk.store.get(case_id)).message(seen), media_type=BINARY)

    @api.post("/api/cases/{case_id}/preview", summary="Prepare the live flow at low priority; it answers sooner then")
    def prepare_preview(case_id: str) -> dict[str, Any]:
        return {"is_begun": desk.prepare_preview(desk.store.get(case_id))}

    @api.delete("/api/cases/{case_id}/preview", summary="End the live flow")
    def end_preview(case_id: str) -> dict[str, Any]:
        desk.end_preview(desk.store.get(case_id))
        return {"is_on": False}

    @api.post("/api/cases/{case_id}/comparison", summary="Up to four treatments, deployed, on one scale (binary)")
    def comparison(case_id: str, wanted: ComparisonWanted) -> Response:
        live = desk.live(desk.store.get(case_id))
        return Response(live.comparison_message(wanted.treatments, wanted.colour), media_type=BINARY)

    @api.get("/api/cases/{case_id}/plan.pdf", summary="The plan of the chosen treatments, one page per implant")
    def plan(case_id: str) -> Response:
        return Response(desk.live(desk.store.get(case_id)).plan(), media_type="application/pdf")
