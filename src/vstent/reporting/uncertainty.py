"""Uncertainty as text: bands of a deployment from the numbers of its device, and intervals of all results."""

import re
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

from vstent.plan.ranges import STIFFNESS
from vstent.reporting.quantities import Quantity, format_value

NUMBERS: Final = {
    "wire_count": "number of wires",
    "wire_diameter_um": "wire diameter",
    "braid_angle_rad": "braid angle",
    "n_columns": "number of cells around",
    "strut_width_um": "strut width",
    "strut_thickness_um": "strut thickness",
    "cell_angle_rad": "cell angle",
    "free_diameter_margin_mm": "free diameter",
    "label_length_mm": "length at the label diameter",
    STIFFNESS: "stiffness of the device relative to wall and bed",
}
"""Display names of the numbers of the catalogue."""
HEADLINES: Final = ("deployed_length_mm", "neck_metal_coverage_fraction")
"""Results that the sentence on a device names."""
CAUSES: Final = {
    "threshold": "all diameters",
    "landing": "landing",
    "device": "manufacturing tolerance",
    "inflow": "inflow",
    "neck": "choice of the neck plane",
    "rest": "interplay and chance",
}
"""Display names of the causes of uncertainty."""


class Row(NamedTuple):
    """Band of one result, as text."""

    name: str
    """Display name of the result."""
    value: str
    """Value with the numbers of the catalogue, with unit."""
    low: str
    """Lower end, with unit."""
    high: str
    """Upper end, with unit."""
    cause: str
    """Number of the device that contributes most, with its share of the variance; empty where there is none."""

    @property
    def band(self) -> str:
        """Both ends with the unit once."""
        return between(self.low, self.high)


def number_name(name: str) -> str:
    """Return the display name of a number of the catalogue; further groups of wires are counted."""
    group = re.fullmatch(r"wire_(\d+)_(\w+)", name)
    if group is None:
        return NUMBERS.get(name, name)
    ordinal = {"2": "second", "3": "third", "4": "fourth"}.get(group[1], f"{group[1]}th")
    return f"{NUMBERS[f'wire_{group[2]}']} of the {ordinal} kind of wire"


def band_rows(implant: Mapping[str, Any]) -> list[Row]:
    """Return the bands of the metrics of an implant; empty where they or the catalogue entry have none."""
    found = []
    for key, band in implant.get("bands", {}).get("results", {}).items():
        low, high = (format_value(key, band[end]) for end in ("low", "high"))
        cause = f"{number_name(band['cause'])} {100 * band['cause_fraction']:.0f}\u202f%" if "cause" in band else ""
        found.append(Row(Quantity((key,), 0.0).name, format_value(key, implant.get(key)), low, high, cause))
    return found


def between(low: str, high: str) -> str:
    """Return two values with their unit once, such as ``14.7 to 19.1 mm``; one value where they are alike."""
    number, *_ = low.split("\u202f")
    return low if low == high else f"{number} to {high}"


def ends(implant: Mapping[str, Any], key: str) -> str:
    """Return the band of one metric of an implant in brackets, such as ``(14.7 to 19.1 mm)``; empty without a width."""
    band = implant.get("bands", {}).get("results", {}).get(key)
    if band is None:
        return ""
    low, high = (format_value(key, band[end]) for end in ("low", "high"))
    return "" if low == high else f"({between(low, high)})"


def how_sure(implant: Mapping[str, Any], title: str = "", *, is_repeated: bool = False) -> str:
    """Return the sentences on how sure a device is; empty where the metrics of the implant do not state it.

    Where several implants are of one device, `title` tells them apart, and the sentence on the numbers of the device
    is left out where it is repeated.
    """
    bands = implant.get("bands", {})
    if not bands:
        return ""
    ranges = []
    for key in HEADLINES:
        if band := ends(implant, key):
            cause = bands["results"][key].get("cause")
            because = f" (mostly the {number_name(cause)})" if cause else ""
            ranges.append(f"{Quantity((key,), 0.0).name.lower()} {band[1:-1]}{because}")
    sentences = [] if is_repeated else [bands["device"]]
    if ranges:
        whose = "its" if is_repeated else "these"
        sentences.append(f"Within the ranges of {whose} numbers{f' ({title})' if title else ''}: {'; '.join(ranges)}.")
    sizes = bands.get("proposed_sizes", "")
    if " to " in sizes:
        sentences.append(f"The proposed size varies from {sizes}.")
    return " ".join(sentences)


class Interval(NamedTuple):
    """Uncertainty of one result, as text."""

    name: str
    """Display name of the result."""
    mean: str
    """Mean, with unit."""
    low: str
    """Lower end of the 95 % interval, with unit."""
    high: str
    """Upper end of the 95 % interval, with unit."""
    shares: list[tuple[str, float]]
    """Causes and their shares in the variance, the largest first."""

    @property
    def band(self) -> str:
        """Both ends with the unit once."""
        return between(self.low, self.high)


class Varied(NamedTuple):
    """Uncertainty of all results of one treatment."""

    title: str
    """Title of the treatment."""
    words: str
    """Number of deployments and the ranges that were varied, as text."""
    rows: list[Interval]
    """Uncertainty of every result."""


def intervals(treatment: Mapping[str, Any]) -> list[Interval]:
    """Return the uncertainty of every result in the metrics of a treatment; empty without an uncertainty study."""
    varied, found = treatment.get("uncertainty", {}), []
    for key, interval in varied.get("intervals", {}).items():
        names = [(cause.removesuffix("_fraction"), share) for cause, share in varied["shares"][key].items()]
        shares = [(CAUSES.get(cause) or number_name(cause), share) for cause, share in names]
        mean, low, high = (format_value(key, interval[end]) for end in ("mean", "low", "high"))
        found.append(Interval(Quantity((key,), 0.0).name, mean, low, high, sorted(shares, key=lambda part: -part[1])))
    return found


def uncertainty_of(metrics: Mapping[str, Any], titles: Mapping[str, str]) -> list[Varied]:
    """Return the uncertainty of all treatments, under their titles by name; empty without an uncertainty study."""
    found = []
    for name, treatment in metrics.get("treatments", {}).items():
        if "uncertainty" not in treatment:
            continue
        study = treatment["uncertainty"]
        ranges = [
            f"{CAUSES[key.rsplit('_', 1)[0]]} ±{format_value(key, value)}"
            for key, value in study["ranges"].items()
            if value > 0
        ]
        numbers = study.get("numbers", "").split(", ")
        if any(name not in ("", STIFFNESS) for name in numbers):
            ranges.append("the numbers of the device within their ranges in the catalogue")
        if STIFFNESS in numbers:
            ranges.append(f"the {number_name(STIFFNESS)} within its range")
        if "packing_density_fraction" in study["intervals"]:
            ranges.append("the seed, which places the catheter and turns the framing coil")
        failed = f", of which {study['failed_count']} did not fit the artery" if study["failed_count"] else ""
        words = f"{study['samples_count']} deployments{failed}. Varied: {', '.join(ranges)}."
        found.append(Varied(titles.get(name, name), words, intervals(treatment)))
    return found
