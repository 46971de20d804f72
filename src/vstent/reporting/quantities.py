"""Display name, unit, definition and formatted value of a metric, derived from its key."""

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

from vstent.devices.treatment import BARE
from vstent.geometry.vessel import Opening
from vstent.reporting.definitions import DEFINITIONS, WANTED, Definition

UNITS: dict[str, tuple[str, float]] = {
    "Pa_per_m_s": ("Pa/(m/s)", 1.0),
    "per_mm2": ("1/mm²", 1.0),
    "per_mm": ("1/mm", 1.0),
    "kg_m3": ("kg/m³", 1.0),
    "mL_min": ("mL/min", 1.0),
    "mL_s": ("mL/s", 1.0),
    "mg_mL": ("mg/mL", 1.0),
    "mm_s": ("mm/s", 1.0),
    "m_s": ("m/s", 1.0),
    "m2_s": ("m²/s", 1.0),
    "Pa_s": ("Pa·s", 1.0),
    "per_s": ("1/s", 1.0),
    "fraction": ("%", 100.0),
    "percent": ("%", 1.0),
    "ratio": ("", 1.0),
    "count": ("", 1.0),
    "mm3": ("mm³", 1.0),
    "mm2": ("mm²", 1.0),
    "um": ("µm", 1.0),
    "rad": ("°", 180 / math.pi),
    "deg": ("°", 1.0),
    "uJ": ("µJ", 1.0),
    "uW": ("µW", 1.0),
    "J": ("µJ", 1e6),
    **{unit: (unit, 1.0) for unit in ("mmHg", "mm", "mL", "kPa", "Pa", "ms", "mJ", "mW", "W", "MB", "s")},
}
"""Suffix of a key: its display unit and the factor that converts to it; a longer suffix precedes what it ends in.

Angles, fractions and energies are converted to degrees, percent and µJ for display only.
"""


NOTHING = 1e-9
"""Magnitude below which a value is shown as 0, because only rounding errors are that small."""
FINEST_MM = 0.1
"""Length below which micrometers are its last digit."""
LEAST_PERCENT = 1e-4
"""Percentage below which only its order is told."""
RATIO = "_ratio"
"""Suffix of the key of a ratio: value with the device over value without it."""
MOST_RATIO = 10.0
"""Largest ratio of values that is shown as a percentage; above it the first value is near zero."""
OPENING = re.compile(r"(inlet|outlet)_(\d+)_(\w+)")
"""Pattern of the key of a metric of one of several inlets or outlets."""
YIELDED = {"straightened_bare_": "straightened, without device", "straightened_": "straightened, with device"}
"""Prefixes of the keys of a flow in an artery that has yielded, and what is added to its name."""
PREVIEW = "contrast_preview_error_fraction"
"""Key of the error of a preview. It is listed with the numbers that it concerns, without a change."""
ERRORS = ("unsettled_fraction",)
"""Suffixes of keys that state the reliability of a result; their change with a device means nothing."""


@dataclass(frozen=True)
class Quantity:
    """One metric with its path in the nested metrics."""

    path: tuple[str, ...]
    """Keys from the top of the metrics."""
    value: Any
    """Measured value."""

    @property
    def key(self) -> str:
        """Last key that ends in a unit, else the last key that is not a number.

        In ``outlets_mL_s.outlet_1`` it is ``outlets_mL_s``.
        """
        names = [part for part in reversed(self.path) if not part.isdigit()]
        return next((part for part in names if split_unit(part)[1]), names[0] if names else "")

    @property
    def definition(self) -> Definition:
        """Name, meaning and source.

        A ratio or a metric of one of several openings has the definition of the metric it derives from.
        """
        key, more = base_of(self.key)
        if key in DEFINITIONS:
            return DEFINITIONS[key]._replace(name=DEFINITIONS[key].name + more)
        words = re.sub(r"^n ", "Number of ", split_unit(key)[0].replace("_", " ").strip())
        return Definition(words[:1].upper() + words[1:] + more, "")

    @property
    def name(self) -> str:
        """Display name, followed by the keys below the defining one: ``Outlet flow, outlet 1``."""
        index = len(self.path) - self.path[::-1].index(self.key) if self.key in self.path else len(self.path)
        return ", ".join([self.definition.name, *(part.replace("_", " ") for part in self.path[index:])])

    @property
    def place(self) -> tuple[str, ...]:
        """Keys above the defining one."""
        return self.path[: self.path.index(self.key)] if self.key in self.path else ()

    @property
    def unit(self) -> str:
        """Display unit; empty for a pure number."""
        return unit_of(self.key)

    @property
    def text(self) -> str:
        """Value with its unit."""
        return format_value(self.key, self.value)


class Change(NamedTuple):
    """One quantity without and with each device."""

    before: Quantity
    """Value without a device."""
    after: dict[str, Quantity]
    """Value with each device, by the name of the device."""
    hidden: frozenset[str] = frozenset()
    """Devices whose change is not shown, because the flow is not usable."""

    def of(self, name: str) -> str:
        """Return the change with a device: relative, or in percentage points for a percentage; a dash where hidden."""
        if name in self.hidden or self.before.key == PREVIEW:
            return "–"
        return format_change(self.before.value, self.after[name].value, self.before.key)

    def sense(self, name: str) -> str:
        """Return ``better`` or ``worse`` where that is defined for this quantity, else an empty string."""
        before, after = self.before.value, self.after[name].value
        wanted = WANTED.get(self.before.key, 0)
        if name in self.hidden or not wanted or before == after:
            return ""
        return "better" if (after - before) * wanted > 0 else "worse"


def base_of(key: str) -> tuple[str, str]:
    """Return the key that defines a metric, and the text to append to its name."""
    if key in DEFINITIONS:
        return key, ""
    for before, what in YIELDED.items():
        if key.startswith(before):
            base, more = base_of(key.removeprefix(before))
            return base, f"{more}, {what}"
    if key.endswith(RATIO):
        base, more = base_of(key.removesuffix(RATIO))
        return base, f"{more}, after / before"
    opening = OPENING.fullmatch(key)
    return (f"{opening[1]}_{opening[3]}", f", {opening[1]} {opening[2]}") if opening else (key, "")


def unit_of(key: str) -> str:
    """Return the display unit of a key; empty for a pure number."""
    return UNITS.get(split_unit(key)[1], ("", 1.0))[0]


def split_unit(key: str) -> tuple[str, str]:
    """Return a key without its unit, and the unit; the unit is empty where the key ends in none."""
    for unit in UNITS:
        if key == unit:
            return "", unit
        if key.endswith(f"_{unit}"):
            return key[: -len(unit) - 1], unit
    return key, ""


def spoken(words: str) -> str:
    """Return a sentence of the program as a page says it: no options, openings by name, signs of typography."""
    words = re.sub(r" \((?:without )?--[^)]*\)", "", words)
    words = re.sub(r"\b((?:in|out)let)_(?=\d)", r"\1 ", words)
    words = re.sub(r"(\d|\d mm) x (?=\d)", r"\1 × ", words)
    return re.sub(r"(?<=\d)%", "\u202f%", re.sub(r"(?<![\w.\-])-(?=\d)", "−", words))


def format_value(key: str, value: Any) -> str:
    """Return a value with the unit in which its key ends: ``0.412 mL/s``; values of a list are parted by commas."""
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
    number = (f"{value:.0f}" if whole else format_number(value * factor)).removeprefix("-")
    if unit == "mm" and abs(value) < FINEST_MM:
        number = f"{abs(value):.3f}".rstrip("0").rstrip(".")
    number = f"−{number}" if value < 0 and number != "0" else number
    if unit == "%" and NOTHING <= abs(value) * factor < LEAST_PERCENT:
        number = f"below {LEAST_PERCENT:g}"
    return f"{number}\u202f{unit}" if unit else number


def format_number(value: float) -> str:
    """Return a number with three significant digits, and with all digits before the point: 0.0412, 3.14, 1520."""
    if abs(value) < NOTHING:
        return "0"
    magnitude = math.floor(math.log10(abs(value)))
    if magnitude < -4 or magnitude > 6:
        return f"{value:.2e}"
    return f"{value:.{max(0, 2 - magnitude)}f}"


def format_change(before: Any, after: Any, key: str = "") -> str:
    """Return a relative change in percent, such as ``−35 %``; a dash where it is undefined.

    The change of a percentage is a difference, such as ``+1.2 percentage points``. The change from zero, or
    to more than ten times the value, is a difference with the unit in which the key ends, such as ``+39.8 mm³``.
    """
    if not all(isinstance(value, (int, float)) and math.isfinite(value) for value in (before, after)):
        return "–"
    if unit_of(key) == "%":
        return f"{_signed(100 * (after - before))} percentage points"
    if abs(after) > MOST_RATIO * abs(before):
        return f"{'+' if after > before else ''}{format_value(key, after - before)}".replace("-", "−") if key else "–"
    if before == 0:
        return "–"
    return f"{_signed(100 * (after / before - 1))}\u202f%"


def _signed(percent: float) -> str:
    """Return a percentage with its sign, and one decimal below 10; without a sign where it rounds to 0."""
    text = f"{percent:+.{0 if abs(percent) >= 10 else 1}f}".replace("-", "−")
    return text[1:] if text[1:] == "0.0" else text


def flatten(metrics: Any, path: tuple[str, ...] = ()) -> list[Quantity]:
    """Return every value of nested metrics with its path, begun with `path`; a list of plain values is one value."""
    if isinstance(metrics, dict):
        return [quantity for key, value in metrics.items() for quantity in flatten(value, (*path, str(key)))]
    if isinstance(metrics, (list, tuple)) and any(isinstance(value, dict) for value in metrics):
        return [quantity for i, value in enumerate(metrics) for quantity in flatten(value, (*path, str(i + 1)))]
    return [Quantity(path, metrics)]


def opening_rows(openings: Iterable[Opening]) -> list[tuple[str, str, str, str]]:
    """Return role, diameter, area and center (LPS) of every opening as text.

    Flow metrics refer to an opening by its role.
    """
    return [
        (
            opening.role.replace("_", " "),
            format_value("diameter_mm", opening.diameter_mm),
            format_value("area_mm2", opening.area_mm2),
            ", ".join(f"{x:.1f}" for x in opening.center_mm) + "\u202fmm",
        )
        for opening in openings
    ]


def compare(metrics: dict[str, Any], hidden: frozenset[str] = frozenset()) -> list[Change]:
    """Return the flow metrics of the bare artery and with each treatment (``treatments.NAME.flow``), in order.

    Metrics that state the reliability of a result are left out.
    """
    treatments = metrics.get("treatments", {})
    flows = {name: flatten(one.get("flow", {})) for name, one in treatments.items()}
    after = {name: {quantity.path: quantity for quantity in found} for name, found in flows.items() if name != BARE}
    rows = []
    for quantity in flows.get(BARE, []):
        found = {name: values[quantity.path] for name, values in after.items() if quantity.path in values}
        is_number = isinstance(quantity.value, (int, float)) and not isinstance(quantity.value, bool)
        if found and is_number and quantity.key not in ERRORS:
            rows.append(Change(quantity, found, hidden))
    return rows
