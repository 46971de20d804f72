"""Write the report of a case as HTML, and optionally as PDF."""

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from vstent.io.files import write_bytes
from vstent.io.writers import write_text
from vstent.reporting.drawing import Drawing
from vstent.reporting.films import KeptFilms, kept_films
from vstent.reporting.page import as_html, contents_of
from vstent.reporting.pdf import as_pdf
from vstent.reporting.plan_sheet import Planned, plan_pdf
from vstent.study.folder import CACHE
from vstent.study.keys import key_of
from vstent.study.repeat import SECONDS
from vstent.study.stages import straightening_notes
from vstent.study.store import Store

if TYPE_CHECKING:
    from vstent.study.pipeline import CaseResult

ASSETS: Final = Path(__file__).with_name("assets")
"""Folder of the report's templates, styles and scripts."""


def write_plan(case: "CaseResult", out: Path, day: str) -> None:
    """Write ``plan.pdf`` of a finished case, dated in ISO 8601, into its folder: one page per implant, no flow."""
    metrics = {name: case.metrics["treatments"][name]["implants"] for name in case.implants}
    anatomy = replace(case.anatomy, notes=(*straightening_notes(case.metrics), *case.anatomy.notes))
    planned = Planned(case.name, anatomy, case.implants, metrics, case.provenance["input"]["sha256"], day)
    write_bytes(out / "plan.pdf", plan_pdf(planned))


def write_report(case: "CaseResult", out: Path, *, is_printed: bool = False, drawing: Drawing | None = None) -> None:
    """Write ``report.html`` into a case folder, and optionally ``report.pdf``, unless they are there for these results.

    Parameters
    ----------
    case : the finished case.
    out : its case folder.
    is_printed : whether to write the PDF too.
    drawing : the pictures of the case, if they are being drawn already.
    """
    films = kept_films(out)
    provenance = {name: value for name, value in case.provenance.items() if name != SECONDS}
    shown = [] if films is None else [*(one.image.tobytes() for one in films.pictures), films.animation]
    files = [*shown, *(file.read_bytes() for file in sorted(ASSETS.iterdir()))]
    digests = [hashlib.sha256(one).hexdigest() for one in files]
    key = key_of(f"{__name__}:_write", list(case.keys.values()), case.metrics, case.notes, provenance, digests)
    names = ["report.html"] + ["report.pdf"] * is_printed
    Store(out / CACHE).write_once("report", key, out, names, lambda: _write(case, out, names, drawing, films))


def _write(case: "CaseResult", out: Path, names: list[str], drawing: Drawing | None, films: KeptFilms | None) -> str:
    """Write the report in the files named; return a sentence."""
    told = contents_of(case, drawing)
    if films is not None:
        told = replace(told, pictures=(*told.pictures, *films.pictures), film=films.animation)
    write_text(out / "report.html", as_html(told))
    if "report.pdf" in names:
        write_bytes(out / "report.pdf", as_pdf(told))
    return ""
