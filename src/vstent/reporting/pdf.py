"""Report as PDF: A4 pages with searchable text, the pictures, and every metric with its definition."""

from collections.abc import Iterable

from vstent.reporting.definitions import OF_PULSE
from vstent.reporting.page import Contents
from vstent.reporting.paper import ACCENT, QUIET, Paper
from vstent.reporting.quantities import Change, Quantity


def as_pdf(told: Contents) -> bytes:
    """Return a report laid out on A4 pages, as PDF; it contains no field of a patient's record."""
    from matplotlib import rc_context

    with rc_context({"pdf.fonttype": 42, "font.family": "DejaVu Sans"}):
        paper = Paper(told.name)
        paper.title(told.name)
        paper.text(
            "Virtual stenting report. Blood flow without and with each device; change is with / without − 1, or the "
            "difference in percentage points."
        )
        if told.headlines:
            paper.heading("Before and after")
            _changes(paper, told, told.headlines)
            for one in told.qualities:
                paper.text(f"{one.sentence} {one.computation.capitalize()}.")
            if told.is_pulse:
                paper.text(OF_PULSE)
        else:
            paper.text("No blood flow was computed for this case.")
        for picture in told.pictures:
            paper.picture(picture)
        paper.heading("Anatomy")
        paper.table(_rows(told.vessel, 1), (0.66, 0.34))
        paper.heading("Openings")
        paper.table(told.openings, (0.25, 0.2, 0.2, 0.35), head=("Opening", "Diameter", "Area", "Center (LPS)"))
        _devices(paper, told)
        if told.changes:
            paper.heading("Blood flow")
            _changes(paper, told, told.changes)
        for varied in told.uncertainty:
            paper.heading(f"Uncertainty: {varied.title}")
            paper.text(varied.words)
            rows = [
                (
                    row.name,
                    row.mean,
                    f"{row.low} to {row.high}",
                    ", ".join(f"{c} {100 * s:.0f} %" for c, s in row.shares),
                )
                for row in varied.rows
            ]
            paper.table(
                rows, (0.27, 0.13, 0.24, 0.36), head=("Result", "Mean", "95 % lie between", "Share of each cause")
            )
        _words(paper, told)
        return paper.done()


def _rows(quantities: Iterable[Quantity], skip: int) -> list[tuple[str, str]]:
    """Return name and value of quantities; the first `skip` keys of their paths are left out of the names."""
    return [(_named(quantity, skip), quantity.text) for quantity in quantities]


def _named(quantity: Quantity, skip: int) -> str:
    """Return the name of a quantity after the keys that lead to it, without the first `skip` of them."""
    place = " · ".join(quantity.place[skip:]).replace("_", " ")
    return f"{place}: {quantity.name}" if place else quantity.name


def _changes(paper: Paper, told: Contents, rows: list[Change]) -> None:
    """Write a table of metrics without and with each device."""
    n = max(1, len(told.treatments))
    first = 0.40 if n < 3 else 0.31
    rest = (1 - first) / (1 + 1.5 * n)
    cells = []
    for row in rows:
        line = [_named(row.before, 0), row.before.text]
        for name, _ in told.treatments:
            after = row.after.get(name)
            line.append(f"{after.text}  {row.of(name)}" if after else "–")
        cells.append(line)
    head = ("", "Before", *(title for _, title in told.treatments))
    paper.table(cells, (first, rest, *[1.5 * rest] * len(told.treatments)), head=head)


def _devices(paper: Paper, told: Contents) -> None:
    """Write the section of every implant."""
    for implant in told.implants:
        paper.heading(implant["title"])
        paper.text(implant["words"])
        paper.text(implant["advice"])
        paper.table(_rows(implant["quantities"], 2), (0.66, 0.34))
        if implant["how_sure"]:
            paper.text(implant["how_sure"])
        if implant["bands"]:
            cells = [(row.name, row.value, f"{row.low} to {row.high}", row.cause) for row in implant["bands"]]
            paper.table(cells, (0.34, 0.13, 0.23, 0.30), head=("Result", "Value", "Band (95 %)", "Largest cause"))
        if implant["facts"]:
            paper.text("Sources of the device's numbers:", 8, color=QUIET)
            paper.table(implant["facts"], (0.26, 0.74))


def _words(paper: Paper, told: Contents) -> None:
    """Write notes, limits, definitions and provenance."""
    paper.heading("Notes and limits")
    for note in (*told.notes, *told.limits):
        paper.text(f"• {note}")
    paper.heading("Definitions")
    if told.changes:
        paper.text(OF_PULSE, 8)
    for definition, unit in told.definitions:
        source = f" ({definition.source})" if definition.source else ""
        paper.text(f"{definition.name}{f' [{unit}]' if unit else ''}: {definition.meaning}{source}", 8)
    paper.heading("Method")
    for title, lines in told.provenance:
        paper.text(title, 8.5, color=ACCENT)
        paper.table(lines, (0.34, 0.66))
