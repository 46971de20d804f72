"""Report as PDF: A4 pages with searchable text, the pictures, and every metric with its definition."""

import io
import textwrap
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Final

from vstent.reporting.definitions import OF_PULSE
from vstent.reporting.page import Contents, contents_of
from vstent.reporting.quantities import Change, Quantity

if TYPE_CHECKING:
    from vstent.reporting.figures import Picture
    from vstent.study.types import CaseResult

PAGE_IN: Final = (8.27, 11.69)
"""Width and height of an A4 page in inches."""
LEFT, RIGHT, TOP, FOOT = 0.75, 0.75, 0.85, 0.80
"""Margins in inches."""
WIDTH: Final = PAGE_IN[0] - LEFT - RIGHT
"""Width of the text in inches."""
_INK, _QUIET, _ACCENT, _LINE, _WARN = "#16262e", "#54666f", "#0b6473", "#d7dfe3", "#8a4b08"
"""Colors of text, secondary text, headings, rules and the statement at the foot."""
_CHARACTER: Final = 0.53
"""Mean width of a character as a fraction of the font size, for line breaks."""
BADGE: Final = "Research use only. Not a medical device."
"""Statement at the foot of every page."""


def report_pdf(case: "CaseResult") -> bytes:
    """Return the report of a case as PDF; it contains no field of a patient's record."""
    return as_pdf(contents_of(case))


def as_pdf(told: Contents) -> bytes:
    """Return a report laid out on A4 pages, as PDF."""
    from matplotlib import rc_context

    with rc_context({"pdf.fonttype": 42, "font.family": "DejaVu Sans"}):
        paper = _Paper(told.name)
        _summary(paper, told)
        for picture in told.pictures:
            paper.picture(picture)
        paper.heading("Anatomy")
        paper.table(_rows(told.vessel, 1), (0.66, 0.34))
        paper.heading("Openings")
        paper.table(told.openings, (0.25, 0.2, 0.2, 0.35), head=("Opening", "Diameter", "Area", "Center (LPS)"))
        _devices(paper, told)
        _flow(paper, told)
        _uncertainty(paper, told)
        _words(paper, told)
        return paper.done()


class _Paper:
    """Pages that are filled from top to bottom."""

    def __init__(self, name: str) -> None:
        from matplotlib.backends.backend_pdf import PdfPages

        self._stream = io.BytesIO()
        metadata = {"Title": f"{name}: vstent report", "Creator": "vstent", "CreationDate": None, "Producer": None}
        self._pages = PdfPages(self._stream, metadata=metadata)
        self._name, self._number = name, 0
        self._figure: Any = None
        self._y = 0.0
        self._turn()

    def _turn(self) -> None:
        """Begin a new page with its footer."""
        from matplotlib.figure import Figure

        self._close()
        self._number += 1
        self._figure = Figure(figsize=PAGE_IN, facecolor="white")
        self._y = PAGE_IN[1] - TOP
        self._put(LEFT, 0.45, self._name, 7.5, color=_QUIET)
        self._put(PAGE_IN[0] / 2, 0.45, BADGE, 7.5, color=_WARN, ha="center")
        self._put(PAGE_IN[0] - RIGHT, 0.45, str(self._number), 7.5, color=_QUIET, ha="right")

    def _close(self) -> None:
        """Write the current page to the document."""
        if self._figure is not None:
            self._pages.savefig(self._figure)

    def done(self) -> bytes:
        """Return all pages as PDF."""
        self._close()
        self._pages.close()
        return self._stream.getvalue()

    def _put(self, x: float, y: float, words: str, size: float, **more: Any) -> None:
        """Write text at a position in inches from the lower left corner; `size` is in points."""
        more.setdefault("color", _INK)
        self._figure.text(x / PAGE_IN[0], y / PAGE_IN[1], words, fontsize=size, parse_math=False, **more)

    def room(self, inches: float) -> None:
        """Begin a new page unless this many inches are left on the current one."""
        if self._y - inches < FOOT:
            self._turn()

    def title(self, words: str) -> None:
        """Write the title of the report."""
        self._put(LEFT, self._y, "vstent", 10, color=_ACCENT, weight="bold")
        self._y -= 0.36
        self._put(LEFT, self._y, words, 18, weight="bold")
        self._y -= 0.20

    def heading(self, words: str) -> None:
        """Write a heading; it starts a new page where the current one has no space for text below it."""
        self.room(1.2)
        self._y -= 0.38
        self._put(LEFT, self._y, words, 12.5, weight="bold", color=_ACCENT)
        self._y -= 0.16

    def text(self, words: str, size: float = 8.5, *, color: str = _INK, indent: float = 0.0) -> None:
        """Write a paragraph; `size` is in points, `indent` in inches."""
        step = 1.45 * size / 72
        for line in _wrapped(words, WIDTH - indent, size):
            self.room(step)
            self._y -= step
            self._put(LEFT + indent, self._y, line, size, color=color)
        self._y -= 0.05

    def table(self, rows: Iterable[Sequence[str]], widths: Sequence[float], *, head: Sequence[str] = ()) -> None:
        """Write a table: the first column is aligned left, the others right.

        Parameters
        ----------
        rows : cells of every row.
        widths : width of every column as a fraction of the text width.
        head : column titles; empty: none.
        """
        if head:
            self._row(head, widths, _QUIET, "bold")
        for row in rows:
            self._row(row, widths, _INK, "normal")

    def _row(self, cells: Sequence[str], widths: Sequence[float], color: str, weight: str) -> None:
        """Write one row of a table, with a line above it."""
        size, step = 8.0, 0.155
        bold = 1.1 if weight == "bold" else 1.0
        lines = [_wrapped(cell, WIDTH * w - 0.12, size * bold) for cell, w in zip(cells, widths, strict=True)]
        self.room(step * max(map(len, lines)) + 0.05)
        self._rule()
        for i, found in enumerate(lines):
            x = LEFT + WIDTH * (sum(widths[: i + 1]) if i else 0.0)
            for k, line in enumerate(found):
                y = self._y - step * (k + 1)
                self._put(x, y, line, size, color=color, weight=weight, ha="right" if i else "left")
        self._y -= step * max(map(len, lines)) + 0.05

    def _rule(self) -> None:
        """Draw a horizontal line across the text."""
        from matplotlib.lines import Line2D

        ends = [LEFT / PAGE_IN[0], 1 - RIGHT / PAGE_IN[0]]
        height = [(self._y - 0.01) / PAGE_IN[1]] * 2
        self._figure.add_artist(Line2D(ends, height, color=_LINE, linewidth=0.5))

    def picture(self, picture: "Picture") -> None:
        """Write a picture with title and caption, at most half a page high."""
        from matplotlib.image import imread

        image = imread(io.BytesIO(picture.png))
        height = WIDTH * image.shape[0] / image.shape[1]
        scale = min(1.0, 0.5 * PAGE_IN[1] / height)
        width, height = scale * WIDTH, scale * height
        self.room(height + 1.15)
        self.heading(picture.title)
        left = (LEFT + (WIDTH - width) / 2) / PAGE_IN[0]
        self._y -= height
        axes = self._figure.add_axes((left, self._y / PAGE_IN[1], width / PAGE_IN[0], height / PAGE_IN[1]))
        axes.imshow(image, interpolation="none")  # no resampling
        axes.set_axis_off()
        self.text(picture.caption, 8, color=_QUIET)


def _wrapped(words: str, width_in: float, size: float) -> list[str]:
    """Return text broken into lines of at most `width_in` inches; `size` is the font size in points."""
    count = max(6, int(width_in * 72 / (_CHARACTER * size)))
    return textwrap.wrap(words, count, break_long_words=True, break_on_hyphens=False) or [""]


def _rows(quantities: Iterable[Quantity], skip: int) -> list[tuple[str, str]]:
    """Return name and value of quantities; the first `skip` keys of their paths are left out of the names."""
    return [(_named(quantity, skip), quantity.text) for quantity in quantities]


def _named(quantity: Quantity, skip: int) -> str:
    """Return the name of a quantity after the keys that lead to it, without the first `skip` of them."""
    place = " · ".join(quantity.place[skip:]).replace("_", " ")
    return f"{place}: {quantity.name}" if place else quantity.name


def _summary(paper: _Paper, told: Contents) -> None:
    """Write the title and the headline metrics."""
    paper.title(told.name)
    paper.text(
        "Virtual stenting report. Blood flow without and with each device; change is with / without − 1, or the "
        "difference in percentage points."
    )
    if told.headlines:
        paper.heading("Before and after")
        for one in told.qualities:
            paper.text(f"{one.sentence} {one.computation.capitalize()}.")
        _changes(paper, told, told.headlines)
        if told.is_pulse:
            paper.text(OF_PULSE)
    else:
        paper.text("No blood flow was computed for this case.")


def _changes(paper: _Paper, told: Contents, rows: list[Change]) -> None:
    """Write a table of metrics without and with each device."""
    n = max(1, len(told.devices))
    first = 0.40 if n < 3 else 0.31
    rest = (1 - first) / (1 + 1.5 * n)
    cells = []
    for row in rows:
        line = [_named(row.before, 0), row.before.text]
        for name, _ in told.devices:
            after = row.after.get(name)
            line.append(f"{after.text}  {row.of(name)}" if after else "–")
        cells.append(line)
    head = ("", "Before", *(title for _, title in told.devices))
    paper.table(cells, (first, rest, *[1.5 * rest] * len(told.devices)), head=head)


def _devices(paper: _Paper, told: Contents) -> None:
    """Write the section of every device."""
    for stent in told.stents:
        paper.heading(stent["title"])
        paper.text(stent["words"])
        paper.text(stent["advice"])
        paper.table(_rows(stent["quantities"], 3), (0.66, 0.34))
        paper.text("Sources of the device's numbers:", 8, color=_QUIET)
        paper.table(stent["facts"], (0.26, 0.74))


def _flow(paper: _Paper, told: Contents) -> None:
    """Write the section on blood flow where there is one."""
    if told.changes:
        paper.heading("Blood flow")
        _changes(paper, told, told.changes)


def _uncertainty(paper: _Paper, told: Contents) -> None:
    """Write the uncertainty intervals of every device."""
    for varied in told.uncertainty:
        paper.heading(f"Uncertainty: {varied.title}")
        paper.text(varied.words)
        rows = [
            (row.name, row.mean, f"{row.low} to {row.high}", ", ".join(f"{c} {100 * s:.0f} %" for c, s in row.shares))
            for row in varied.rows
        ]
        paper.table(rows, (0.27, 0.13, 0.24, 0.36), head=("Result", "Mean", "95 % lie between", "Share of each cause"))


def _words(paper: _Paper, told: Contents) -> None:
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
        paper.text(title, 8.5, color=_ACCENT)
        paper.table(lines, (0.34, 0.66))
