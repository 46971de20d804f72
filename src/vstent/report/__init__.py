"""The reports of a case and of a cohort: one HTML file each with every number, no network; of a case a PDF too."""

from pathlib import Path
from typing import TYPE_CHECKING

from vstent.io.files import atomic
from vstent.io.writers import write_text
from vstent.report.cohort import cohort_report
from vstent.report.page import as_html, contents_of, report
from vstent.report.pdf import as_pdf, report_pdf

if TYPE_CHECKING:
    from vstent.study import CaseResult

__all__ = ["cohort_report", "report", "report_pdf", "write_report"]


def write_report(case: "CaseResult", out: Path, *, is_printed: bool = False) -> None:
    """Write ``report.html`` into the case folder `out`, and ``report.pdf`` beside it where it is to be printed."""
    told = contents_of(case)
    write_text(out / "report.html", as_html(told))
    if is_printed:
        with atomic(out / "report.pdf") as partial:
            partial.write_bytes(as_pdf(told))
