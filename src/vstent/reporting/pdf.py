"""Report as PDF on A4 pages: the answer, then flow, anatomy and devices, then an appendix on how they were found."""

from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any, Final

from vstent.flow.grade import GOOD
from vstent.reporting.definitions import OF_PULSE
from vstent.reporting.page import Contents
from vstent.reporting.paper import ACCENT, PAGE_IN, QUIET, Paper, scale_of
from vstent.reporting.quantities import Change, Quantity, format_change
from vstent.reporting.ranked import treatment_rows
from vstent.reporting.uncertainty import between, ends

ANSWERS: Final = ("neck_inflow_mL_s", "mean_sac_velocity_m_s", "mean_sac_wss_Pa")
"""Metrics of the flow on the first page."""
OF_DEVICE: Final = ("neck_metal_coverage_fraction", "deployed_length_mm")
"""Metrics of every implant on the first page."""
OF_RESULTS: Final = {
    "treatment": "",
    "anatomy": "Anatomy",
    "contour": "Devices",
    "coverage": "Devices",
    "wires": "Devices",
}
"""Section of a picture by its name; those of the flow are the others."""
BESIDE: Final = 3
"""Largest number of implants in one table."""


def as_pdf(told: Contents) -> bytes:
    """Return a report laid out on A4 pages, as PDF; it contains no field of a patient's record."""
    from matplotlib import rc_context

    with rc_context({"pdf.fonttype": 42, "font.family": "DejaVu Sans"}):
        answer = partial(_answer, told=told)
        paper = Paper(told.name, scale=scale_of(answer))
        answer(paper)
        paper.turn(1.0)
        _flow(paper, told)
        paper.heading("Anatomy")
        _pictures(paper, told, "Anatomy")
        _pairs(paper, [(_named(quantity, 1), quantity.text) for quantity in told.vessel])
        paper.heading("Openings")
        paper.table(told.openings, (0.25, 0.2, 0.2, 0.35), head=("Opening", "Diameter", "Area", "Center (LPS)"))
        _devices(paper, told)
        for varied in told.uncertainty:
            paper.heading(f"Uncertainty: {varied.title}")
            paper.text(varied.words)
            head = ("Result", "Mean", "95 % lie between", "Share of each cause")
            causes = [", ".join(f"{cause} {100 * share:.0f} %" for cause, share in row.shares) for row in varied.rows]
            rows = [(row.name, row.mean, row.band, cause) for row, cause in zip(varied.rows, causes, strict=True)]
            paper.table(rows, (0.27, 0.13, 0.24, 0.36), head=head)
        paper.heading("Notes and limits")
        for note in (*told.notes, *told.limits):
            paper.text(f"• {note}")
        _appendix(paper, told)
        return paper.done()


def _answer(paper: Paper, told: Contents) -> None:
    """Write the first page: picture, five numbers with bands and grades, warnings, date, case and input."""
    paper.title(told.name)
    paper.text(f"Virtual stenting report, {told.origin}")
    _pictures(paper, told, "")
    if told.changes:
        paper.heading("Before and after")
    _table(paper, told, [row for key in ANSWERS for row in told.changes if row.before.key == key], answers=True)
    if not told.changes:
        paper.text("No blood flow was computed for this case.")
    paper.heading("Fit and warnings")
    poor = [one.sentence for one in told.qualities if one.grade != GOOD]
    for sentence in (*poor, *(one["advice"] for one in told.implants)):
        paper.text(f"• {sentence}")
    paper.text(f"{len(told.notes) + len(told.limits)} notes and limits follow after the devices.", 8, color=QUIET)


def _flow(paper: Paper, told: Contents) -> None:
    """Write pictures and numbers of the flow, and the ranking of the treatments."""
    if not told.changes:
        return
    paper.heading("Blood flow")
    for one in told.qualities:
        paper.text(f"{one.sentence} {one.computation[0].upper()}{one.computation[1:]}.")
    if told.is_pulse:
        paper.text(OF_PULSE)
    _pictures(paper, told, "Blood flow")
    _table(paper, told, told.changes)
    if rows := told.metrics.get("ranking"):
        paper.heading("Treatments, the best first")
        head, cells = treatment_rows(rows)
        width = 0.74 / (len(head) - 2)
        paper.table(cells, (0.04, 0.22, *[width] * (len(head) - 2)), head=head, names=(0, 1))
        for row in rows:
            paper.text(f"• {row['treatment']}: {row['reason']}")


def _devices(paper: Paper, told: Contents) -> None:
    """Write pictures and numbers of all implants side by side, with bands where there are any."""
    if told.implants:
        paper.room(0.3 * PAGE_IN[1])
        paper.heading("Devices and deployment")
    _pictures(paper, told, "Devices")
    for implant in told.implants:
        paper.text(f"{implant['title']}: {implant['words']} {implant['how_sure']}")
    for k in range(0, len(told.implants), BESIDE):
        beside = told.implants[k : k + BESIDE]
        values = [
            {_named(one, 2): _banded(one, implant["bands"]) for one in implant["quantities"]} for implant in beside
        ]
        names = dict.fromkeys(name for one in values for name in one)
        rows = [(name, *(one.get(name, "–") for one in values)) for name in names]
        width = 0.64 / len(beside)
        paper.table(rows, (0.36, *[width] * len(beside)), head=("", *(one["title"] for one in beside)))


def _appendix(paper: Paper, told: Contents) -> None:
    """Write method, definitions, sources and settings."""
    paper.room(0.3 * PAGE_IN[1])
    paper.heading("Appendix: method")
    for picture in told.of_method:
        paper.picture(picture, most=0.22)
    paper.heading("Appendix: definitions")
    if told.changes:
        paper.text(OF_PULSE, 8)
    for definition, unit in told.definitions:
        source = f" ({definition.source})" if definition.source else ""
        paper.text(f"{definition.name}{f' [{unit}]' if unit else ''}: {definition.meaning}{source}", 8)
    for implant in told.implants:
        if implant["facts"]:
            paper.heading(f"Appendix: sources of the numbers of {implant['title']}")
            paper.table(implant["facts"], (0.26, 0.74))
        if causes := [(row.name, row.cause) for row in implant["bands"] if row.cause]:
            paper.text("Largest cause of each band (95 %):", 8, color=QUIET)
            paper.table(causes, (0.5, 0.5))
    paper.heading("Appendix: settings and versions")
    for title, lines in told.provenance:
        paper.text(title, color=ACCENT)
        _pairs(paper, [line for line in lines if line[1] not in ("–", "")])


def _pictures(paper: Paper, told: Contents, section: str) -> None:
    """Write the pictures of a section."""
    for picture in told.pictures:
        if OF_RESULTS.get(picture.id, "Blood flow") == section:
            paper.picture(picture)


def _pairs(paper: Paper, rows: Sequence[tuple[str, str]]) -> None:
    """Write names and values in two columns."""
    half = -(-len(rows) // 2)
    beside = [*rows[half:], *[("", "")] * (2 * half - len(rows))]
    paper.table(
        [(*one, *other) for one, other in zip(rows[:half], beside, strict=True)], (0.3, 0.18, 0.34, 0.18), names=(0, 2)
    )


def _named(quantity: Quantity, skip: int) -> str:
    """Return the name of a quantity after the keys that lead to it, without the first `skip` of them."""
    place = " · ".join(quantity.place[skip:]).replace("_", " ")
    return f"{place}: {quantity.name}" if place else quantity.name


def _banded(quantity: Quantity, bands: Iterable[Any]) -> str:
    """Return the value of a quantity, with its band where it has one."""
    band = next((row.band for row in bands if row.name == quantity.name), quantity.text)
    return quantity.text if band == quantity.text else f"{quantity.text} ({band})"


def _table(paper: Paper, told: Contents, rows: list[Change], *, answers: bool = False) -> None:
    """Write a table of metrics without and with each treatment; among the answers are bands, grades and devices."""
    n = max(1, len(told.treatments))
    first = 0.40 if n < 3 else 0.31
    rest = (1 - first) / (1 + 1.5 * n)
    cells = []
    for row in rows:
        line = [_named(row.before, 0), row.before.text]
        for name, _ in told.treatments:
            band = _change_band(told, name, row.before.key) if answers else ""
            after = row.after.get(name)
            line.append(f"{after.text}  {row.of(name)}{band}" if after else "–")
        cells.append(line)
    if answers:
        implants = {name: one.get("implants", {}) for name, one in told.metrics.get("treatments", {}).items()}
        for key in OF_DEVICE:
            found = [
                ", ".join(
                    f"{Quantity((key,), one[key]).text} {ends(one, key)}".strip()
                    for one in implants.get(name, {}).values()
                    if key in one
                )
                for name, _ in told.treatments
            ]
            if any(found):
                cells.append([Quantity((key,), 0).name, "–", *(one or "–" for one in found)])
        grades = {one.name: f"{one.mark} {one.grade}" for one in told.qualities}
        if grades:
            cells.append(["Grade of the flow", *(grades.get(name, "–") for name in ("bare", *dict(told.treatments)))])
    if cells:
        head = ("", "Before", *(title for _, title in told.treatments))
        paper.table(cells, (first, rest, *[1.5 * rest] * len(told.treatments)), head=head)


def _change_band(told: Contents, name: str, key: str) -> str:
    """Return the 95 % interval of a change in brackets, where an uncertainty study has computed it."""
    study = told.metrics["treatments"][name].get("uncertainty", {})
    interval = study.get("intervals", {}).get(f"{key}_ratio")
    return "" if interval is None else f" ({between(*(format_change(1.0, interval[end]) for end in ('low', 'high')))})"
