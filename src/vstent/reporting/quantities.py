"""Numbers for people: a metric's key becomes a name, a unit, a definition and a formatted value."""

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

from vstent.geometry.vessel import Opening
from vstent.reporting.definitions import DEFINITIONS, Definition

UNITS: dict[str, tuple[str, float]] = {
    "Pa_per_m_s": ("Pa/(m/s)", 1.0),
    "per_mm2": ("1/mm²", 1.0),
    "per_mm": ("1/mm", 1.0),
    "kg_m3": ("kg/m³", 1.0),
    "mL_min": ("mL/min", 1.0),
    "mL_s": ("mL/s", 1.0),
    "mm_s": ("mm/s", 1.0),
    "m_s": ("m/s", 1.0),
    "m2_s": ("m²/s", 1.0),
    "Pa_s": ("Pa·s", 1.0),
    "per_s": ("1/s", 1.0),
    "fraction": ("%", 100.0),
    "percent": ("%", 1.0),
    "ratio": ("", 1.0),
    "count": ("", 1.0),
    "mmHg": ("mmHg", 1.0),
    "mm3": ("mm³", 1.0),
    "mm2": ("mm²", 1.0),
    "mm": ("mm", 1.0),
    "um": ("µm", 1.0),
    "mL": ("mL", 1.0),
    "kPa": ("kPa", 1.0),
    "Pa": ("Pa", 1.0),
    "rad": ("°", 180 / math.pi),
    "deg": ("°", 1.0),
    "ms": ("ms", 1.0),
    "uJ": ("µJ", 1.0),
    "mJ": ("mJ", 1.0),
    "uW": ("µW", 1.0),
    "mW": ("mW", 1.0),
    "J": ("µJ", 1e6),
    "W": ("W", 1.0),
    "MB": ("MB", 1.0),
    "s": ("s", 1.0),
}
"""End of a key -> unit for people, and the factor to it (degrees, percent and µJ: here only)."""


NOTHING = 1e-9
"""What is smaller is what rounding leaves of zero."""
RATIO = "_ratio"
"""End of the key of a quantity after over before."""
OPENING = re.compile(r"(inlet|outlet)_(\d+)_(\w+)")
"""Key of a quantity of one of several inlets or outlets."""
ERRORS = ("unsettled_fraction",)
"""How far numbers are to be relied on: that one changes says nothing of a device."""


@dataclass(frozen=True)
class Quantity:
    """One number of the metrics."""

    path: tuple[str, ...]
    """Keys from the top of the metrics."""
    value: Any
    """What was measured."""

    @property
    def key(self) -> str:
        """The last key that ends in a unit (``outlets_mL_s.outlet_1``: the first), else the last that is a name."""
        names = [part for part in reversed(self.path) if not part.isdigit()]
        return next((part for part in names if split_unit(part)[1]), names[0] if names else "")

    @property
    def definition(self) -> Definition:
        """Name, meaning and source: of a ratio, or of one of several openings, those of what that is of."""
        key, more = base_of(self.key)
        known = DEFINITIONS.get(key) or Definition(_spell(split_unit(key)[0]), "", "")
        return known._replace(name=known.name + more)

    @property
    def name(self) -> str:
        """Name for people, with what follows the key: ``Outlet flow, outlet 1``."""
        index = len(self.path) - self.path[::-1].index(self.key) if self.key in self.path else len(self.path)
        return ", ".join([self.definition.name, *(part.replace("_", " ") for part in self.path[index:])])

    @property
    def place(self) -> tuple[str, ...]:
        """The keys above the name."""
        return self.path[: self.path.index(self.key)] if self.key in self.path else ()

    @property
    def unit(self) -> str:
        """Unit for people; empty for a pure number."""
        return unit_of(self.key)

    @property
    def text(self) -> str:
        """The value with its unit."""
        return format_value(self.key, self.value)


class Change(NamedTuple):
    """One quantity before and after."""

    before: Quantity
    """Without a device."""
    after: dict[str, Quantity]
    """With each device, by its name."""


def base_of(key: str) -> tuple[str, str]:
    """Return the key that a key's definition stands under, and what it adds to that name."""
    if key in DEFINITIONS:
        return key, ""
    if key.endswith(RATIO):
        base, more = base_of(key.removesuffix(RATIO))
        return base, f"{more}, after / before"
    opening = OPENING.fullmatch(key)
    return (f"{opening[1]}_{opening[3]}", f", {opening[1]} {opening[2]}") if opening else (key, "")


def unit_of(key: str) -> str:
    """Return the unit for people that a key ends in; empty for a pure number."""
    return UNITS.get(split_unit(key)[1], ("", 1.0))[0]


def split_unit(key: str) -> tuple[str, str]:
    """Split a key into its words and the unit it ends in (empty where it ends in none)."""
    for unit in UNITS:
        if key == unit:
            return "", unit
        if key.endswith(f"_{unit}"):
            return key[: -len(unit) - 1], unit
    return key, ""


def format_value(key: str, value: Any) -> str:
    """Return a value with the unit of its key: ``0.412 mL/s``; several values are separated by commas."""
    if isinstance(value, (list, tuple)):
        return ", ".join(format_value(key, one) for one in value) or "–"
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, str):
        return value
    unit, factor = UNITS.get(split_unit(key)[1], ("", 1.0))
    whole = factor == 1.0 and (isinstance(value, int) or key.endswith("_count"))
    number = f"{value:.0f}" if whole else format_number(value * factor)
    return f"{number}\u202f{unit}" if unit else number


def format_number(value: float) -> str:
    """Return a number with three significant digits, and no fewer than all before the point: 0.0412, 3.14, 1520."""
    if abs(value) < NOTHING:
        return "0"
    magnitude = math.floor(math.log10(abs(value)))
    if magnitude < -4 or magnitude > 6:
        return f"{value:.2e}"
    return f"{value:.{max(0, 2 - magnitude)}f}"


def format_change(before: Any, after: Any) -> str:
    """Return by how much a number changed, in percent: ``−35 %``; a dash where that means nothing."""
    numbers = all(isinstance(value, (int, float)) and math.isfinite(value) for value in (before, after))
    if not numbers or before == 0:
        return "–"
    percent = 100 * (after / before - 1)
    digits = 0 if abs(percent) >= 10 else 1
    return f"{percent:+.{digits}f}\u202f%".replace("-", "−")


def flatten(metrics: Any, path: tuple[str, ...] = ()) -> list[Quantity]:
    """Return every value of nested metrics with its path, in order; lists of plain values stay whole."""
    if isinstance(metrics, dict):
        return [quantity for key, value in metrics.items() for quantity in flatten(value, (*path, str(key)))]
    if isinstance(metrics, (list, tuple)) and any(isinstance(value, dict) for value in metrics):
        return [quantity for i, value in enumerate(metrics) for quantity in flatten(value, (*path, str(i + 1)))]
    return [Quantity(path, metrics)]


def opening_rows(openings: Iterable[Opening]) -> list[tuple[str, str, str, str]]:
    """Return role, diameter, area and center (LPS) of every opening: by its role the numbers of the flow go."""
    return [
        (
            opening.role.replace("_", " "),
            format_value("diameter_mm", opening.diameter_mm),
            format_value("area_mm2", opening.area_mm2),
            ", ".join(f"{x:.1f}" for x in opening.center_mm) + "\u202fmm",
        )
        for opening in openings
    ]


def compare(metrics: dict[str, Any]) -> list[Change]:
    """Return the numbers that were measured before (``bare``) and after (``stents.NAME.flow``), in order; no errors."""
    after = {name: dict(_flow(stent)) for name, stent in metrics.get("stents", {}).items()}
    rows = []
    for quantity in flatten(metrics.get("bare", {})):
        found = {name: values[quantity.path] for name, values in after.items() if quantity.path in values}
        if found and _is_compared(quantity):
            rows.append(Change(quantity, found))
    return rows


def _is_compared(quantity: Quantity) -> bool:
    is_number = isinstance(quantity.value, (int, float)) and not isinstance(quantity.value, bool)
    return is_number and quantity.key not in ERRORS


def _flow(stent: dict[str, Any]) -> list[tuple[tuple[str, ...], Quantity]]:
    return [(quantity.path, quantity) for quantity in flatten(stent.get("flow", {}))]


def _spell(words: str) -> str:
    text = re.sub(r"^n ", "Number of ", words.replace("_", " ").strip())
    return text[:1].upper() + text[1:]
