"""Write the report of a case as HTML, and optionally as PDF."""

import hashlib
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Final

from vstent.io.files import atomic
from vstent.io.writers import write_text
from vstent.reporting.drawing import Drawing
from vstent.reporting.films import kept_films
from vstent.reporting.page import as_html, contents_of, with_films
from vstent.reporting.pdf import as_pdf
from vstent.reporting.plan_sheet import Planned, plan_pdf
from vstent.study.folder import CACHE
from vstent.study.ledger import key_of
from vstent.study.repeat import SECONDS

if TYPE_CHECKING:
    from vstent.study.types import CaseResult

DRAWN: Final = "report.key"
"""File in the cache folder with the key of the results that the report shows."""


def write_plan(case: "CaseResult", out: Path, day: str) -> None:
    """Write ``plan.pdf`` into a case folder: one page per implant, without the flow.

    Parameters
    ----------
    case : the finished case.
    out : its case folder.
    day : date of the plan, ISO 8601.
    """
    metrics = {name: case.metrics["treatments"][name]["implants"] for name in case.implants}
    planned = Planned(case.name, case.anatomy, case.implants, metrics, case.provenance["input"]["sha256"], day)
    with atomic(out / "plan.pdf") as partial:
        partial.write_bytes(plan_pdf(planned))


def write_report(case: "CaseResult", out: Path, *, is_printed: bool = False, drawing: Drawing | None = None) -> None:
    """Write ``report.html`` into a case folder, and optionally ``report.pdf``, unless they are there for these results.

    Parameters
    ----------
    case : the finished case.
    out : its case folder.
    is_printed : whether to write the PDF too.
    drawing : the pictures of the case, if they are being drawn already.
    """
    drawn = out / CACHE / DRAWN
    key = key_of(
        version("vstent"), case.metrics, case.notes, {k: v for k, v in case.provenance.items() if k != SECONDS}
    )
    films = kept_films(out)
    if films is not None:
        shown = b"".join([*(one.image.tobytes() for one in films.pictures), films.animation])
        key = key_of(key, hashlib.sha256(shown).hexdigest())
    wanted = ["report.html"] + ["report.pdf"] * is_printed
    if all((out / name).is_file() for name in wanted) and _text(drawn) == key:
        return  # painting takes seconds, and would give the same pictures
    drawn.unlink(missing_ok=True)
    told = contents_of(case, drawing)
    told = told if films is None else with_films(told, films)
    write_text(out / "report.html", as_html(told))
    if is_printed:
        with atomic(out / "report.pdf") as partial:
            partial.write_bytes(as_pdf(told))
    if drawn.parent.is_dir():
        write_text(drawn, key)


def _text(path: Path) -> str:
    """Return the text of a file; empty where it cannot be read."""
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, ValueError):
        return ""
