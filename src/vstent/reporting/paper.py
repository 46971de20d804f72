"""A4 pages as PDF, filled from top to bottom with headings, text, tables and pictures."""

import io
import re
from collections.abc import Callable, Collection, Iterable, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from vstent.reporting.quantities import spoken

if TYPE_CHECKING:
    from vstent.reporting.figures import Picture

PAGE_IN: Final = (8.27, 11.69)
"""Width and height of an A4 page in inches."""
LEFT, RIGHT, TOP, FOOT = 0.75, 0.75, 0.85, 0.80
"""Margins in inches."""
INK, QUIET, ACCENT, LINE, WARN = "#16262e", "#54666f", "#0b6473", "#d7dfe3", "#8a4b08"
"""Colors of text, secondary text, headings, rules and the statement at the foot."""
FONT_POINTS: Final = 100
"""Font size at which the widths of characters are read."""
BOLD: Final = 1.1
"""Width of bold text in that of regular text."""
BESIDE_IN: Final = 0.25
"""Distance in inches between two columns of names and values."""
AROUND: Final = 1.15
"""Height of the title and caption of a picture in inches."""
SMALLEST: Final = 0.45
"""Smallest size of a picture that then fits on the current page, as a fraction of its usual one."""
SCALES: Final = (1.0, 0.92, 0.84, 0.77, 0.7)
"""Scales of a page that is to hold all of something, the largest first. Text has 8 points at scale 1."""
BADGE: Final = "Research use only. Not a medical device."
"""Statement at the foot of every page."""


class Paper:
    """Pages that are filled from top to bottom; the title has the name of the case and the kind of document.

    A scale below 1 makes everything smaller, so that more fits on a page. All inches below are before scaling.
    """

    def __init__(self, name: str, kind: str = "report", *, scale: float = 1.0) -> None:
        from matplotlib.backends.backend_pdf import PdfPages

        self._stream = io.BytesIO()
        metadata = {"Title": f"{name}: vstent {kind}", "Creator": "vstent", "CreationDate": None, "Producer": None}
        self._pages = PdfPages(self._stream, metadata=metadata)
        self._name, self._number = name, 0
        self._figure: Any = None
        self._y = 0.0
        self._scale = scale
        self.turn()

    @property
    def count(self) -> int:
        """Number of pages up to the current one."""
        return self._number

    @property
    def _page(self) -> tuple[float, float]:
        """Width and height of the page in inches before scaling."""
        return PAGE_IN[0] / self._scale, PAGE_IN[1] / self._scale

    @property
    def _width(self) -> float:
        """Width of the text in inches before scaling."""
        return self._page[0] - LEFT - RIGHT

    def turn(self, scale: float | None = None) -> None:
        """Begin a new page with its footer; without `scale` it has the scale of the page before."""
        from matplotlib.figure import Figure

        if self._figure is not None:
            self._pages.savefig(self._figure)
        self._number += 1
        self._scale = scale or self._scale
        self._figure = Figure(figsize=PAGE_IN, facecolor="white")
        self._y = self._page[1] - TOP
        self._put(LEFT, 0.45, self._name, 7.5, color=QUIET)
        self._put(self._page[0] / 2, 0.45, BADGE, 7.5, color=WARN, ha="center")
        self._put(self._page[0] - RIGHT, 0.45, str(self._number), 7.5, color=QUIET, ha="right")

    def done(self) -> bytes:
        """Return all pages as PDF."""
        self._pages.savefig(self._figure)
        self._pages.close()
        return self._stream.getvalue()

    def _put(self, x: float, y: float, words: str, size: float, **more: Any) -> None:
        """Write text at a position in inches from the lower left corner; `size` is in points."""
        more.setdefault("color", INK)
        width, height = self._page
        self._figure.text(x / width, y / height, words, fontsize=self._scale * size, parse_math=False, **more)

    def room(self, inches: float) -> None:
        """Begin a new page unless this many inches are left on the current one."""
        if self._y - inches < FOOT:
            self.turn()

    def title(self, words: str) -> None:
        """Write the title of the report."""
        self._put(LEFT, self._y, "vstent", 10, color=ACCENT, weight="bold")
        self._lines(words, 18, 0.36, INK)
        self._y -= 0.20

    def heading(self, words: str) -> None:
        """Write a heading; it starts a new page where the current one has no space for text below it."""
        self.room(1.2)
        self._y -= 0.16
        self._lines(words, 12.5, 0.22, ACCENT)
        self._y -= 0.16

    def _lines(self, words: str, size: float, step: float, color: str) -> None:
        """Write bold text of `size` in points, in lines `step` inches apart."""
        for line in wrapped(spoken(words), self._width, BOLD * size):
            self._y -= step
            self._put(LEFT, self._y, line, size, weight="bold", color=color)

    def text(self, words: str, size: float = 8.5, *, color: str = INK, indent: float = 0.0) -> None:
        """Write a paragraph; `size` is in points, `indent` in inches."""
        step = 1.45 * size / 72
        for line in wrapped(spoken(words), self._width - indent, size):
            self.room(step)
            self._y -= step
            self._put(LEFT + indent, self._y, line, size, color=color)
        self._y -= 0.05

    def table(
        self,
        rows: Iterable[Sequence[str]],
        widths: Sequence[float],
        *,
        head: Sequence[str] = (),
        names: Collection[int] = (0,),
    ) -> None:
        """Write a table with columns of a fraction of the text width, those of `names` aligned left, others right."""
        if head:
            self._row(head, widths, QUIET, "bold", names)
        for row in rows:
            self._row(row, widths, INK, "normal", names)

    def _row(
        self, cells: Sequence[str], widths: Sequence[float], color: str, weight: str, names: Collection[int]
    ) -> None:
        """Write one row of a table, with a line above it."""
        size, step = 8.0, 0.155
        bold = BOLD if weight == "bold" else 1.0
        columns = zip(map(spoken, cells), widths, strict=True)
        lines = [wrapped(cell, self._width * w - 0.12, size * bold) for cell, w in columns]
        self.room(step * max(map(len, lines)) + 0.05)
        self._rule()
        for i, found in enumerate(lines):
            x = (
                LEFT
                + self._width * sum(widths[:i] if i in names else widths[: i + 1])
                + BESIDE_IN * (i in names and i > 0)
            )
            for k, line in enumerate(found):
                y = self._y - step * (k + 1)
                self._put(x, y, line, size, color=color, weight=weight, ha="left" if i in names else "right")
        self._y -= step * max(map(len, lines)) + 0.05

    def _rule(self) -> None:
        """Draw a horizontal line across the text."""
        from matplotlib.lines import Line2D

        width, height = self._page
        ends = [LEFT / width, 1 - RIGHT / width]
        level = [(self._y - 0.01) / height] * 2
        self._figure.add_artist(Line2D(ends, level, color=LINE, linewidth=0.5))

    def picture(self, picture: "Picture", most: float = 0.36) -> None:
        """Write a picture with title and caption, at most a fraction `most` of the page high.

        It is smaller where it then fits on the current page.
        """
        image = picture.image
        height = self._width * image.shape[0] / image.shape[1]
        fit = min(1.0, most * self._page[1] / height)
        left = (self._y - FOOT - AROUND - 0.01) / height
        fit = left if SMALLEST * fit < left < fit else fit
        width, height = fit * self._width, fit * height
        self.room(height + AROUND)
        self.heading(picture.title)
        left = LEFT + (self._width - width) / 2
        self._y -= height
        place = np.array([left, self._y, width, height]) / np.tile(self._page, 2)
        axes = self._figure.add_axes(tuple(place))
        axes.imshow(image, interpolation="none")  # no resampling
        axes.set_axis_off()
        self.text(picture.caption, 8, color=QUIET)


def scale_of(page: Callable[[Paper], None]) -> float:
    """Return the largest of `SCALES` at which one page holds all of it; the smallest where none does."""

    def fits(scale: float) -> bool:
        draft = Paper("", scale=scale)
        page(draft)
        return draft.count == 1

    return next(filter(fits, SCALES), SCALES[-1])


def wrapped(words: str, width_in: float, size: float) -> list[str]:
    """Return text broken into lines of at most `width_in` inches; `size` is the font size in points."""
    most, lines = 72 * width_in / size, [""]
    for word in re.split("[ \n]+", words.strip()):  # a narrow space keeps a number and its unit together
        longer = f"{lines[-1]} {word}".lstrip()
        if _width(longer) <= most:
            lines[-1] = longer
            continue
        lines += [word] if lines[-1] else []
        lines[-1] = word
        while _width(lines[-1]) > most and len(lines[-1]) > 1:  # a word longer than a line
            ends = np.cumsum([_advance(character) for character in lines[-1]])
            fits = max(1, int(np.searchsorted(ends, most, side="right")))
            lines[-1:] = lines[-1][:fits], lines[-1][fits:]
    return lines


def _width(words: str) -> float:
    """Return the width of text in matplotlib's font as a fraction of the font size."""
    return sum(map(_advance, words))


@cache
def _advance(character: str) -> float:
    """Return the width of a character as a fraction of the font size."""
    from matplotlib.font_manager import FontProperties, findfont, get_font

    font = get_font(findfont(FontProperties()))
    font.set_size(FONT_POINTS, 72)
    return float(font.load_char(ord(character)).linearHoriAdvance) / 65536 / FONT_POINTS
