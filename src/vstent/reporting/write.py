"""Write the report of a case as HTML, and optionally as PDF."""

from pathlib import Path
from typing import TYPE_CHECKING

from vstent.io.files import atomic
from vstent.io.writers import write_text
from vstent.reporting.page import as_html, contents_of
from vstent.reporting.pdf import as_pdf
from vstent.reporting.plan_sheet import Planned, plan_pdf

if TYPE_CHECKING:
    from vstent.study.types import CaseResult


def write_plan(case: "CaseResult", out: Path, day: str) -> None:
    """Write ``plan.pdf`` into a case folder: one page per device, without the flow.

    Parameters
    ----------
    case : the finished case.
    out : its case folder.
    day : date of the plan, ISO 8601.
    """
    measures = {name: case.metrics["stents"][name]["deployment"] for name in case.deployments}
    planned = Planned(case.name, case.anatomy, case.deployments, measures, case.provenance["input"]["sha256"], day)
    with atomic(out / "plan.pdf") as partial:
        partial.write_bytes(plan_pdf(planned))


def write_report(case: "CaseResult", out: Path, *, is_printed: bool = False) -> None:
    """Write ``report.html`` into a case folder, and optionally ``report.pdf``.

    Parameters
    ----------
    case : the finished case.
    out : its case folder.
    is_printed : whether to write the PDF too.
    """
    told = contents_of(case)
    write_text(out / "report.html", as_html(told))
    if is_printed:
        with atomic(out / "report.pdf") as partial:
            partial.write_bytes(as_pdf(told))
