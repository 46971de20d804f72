"""Bands of a deployment as text: their ends, the number of the device that makes them, and how sure the device is."""

import re
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

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
}
"""Display names of the numbers of the catalogue."""
HEADLINES: Final = ("deployed_length_mm", "neck_metal_coverage_fraction")
"""Results that the sentence on a device names."""


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


def number_name(name: str) -> str:
    """Return the display name of a number of the catalogue; further groups of wires have their number."""
    group = re.fullmatch(r"wire_(\d+)_(\w+)", name)
    return f"{NUMBERS[f'wire_{group[2]}']}, group {group[1]}" if group else NUMBERS.get(name, name)


def rows(implant: Mapping[str, Any]) -> list[Row]:
    """Return the bands of an implant; empty where its metrics or its catalogue entry have none.

    Parameters
    ----------
    implant : metrics of the implant.
    """
    found = implant.get("bands", {}).get("results", {})
    return [_row(key, implant.get(key), band) for key, band in found.items()]


def _row(key: str, value: Any, band: Mapping[str, Any]) -> Row:
    """Return the band of one result as text."""
    low, high = (format_value(key, band[end]) for end in ("low", "high"))
    cause = f"{number_name(band['cause'])} {100 * band['cause_fraction']:.0f}\u202f%" if "cause" in band else ""
    return Row(Quantity((key,), 0.0).name, format_value(key, value), low, high, cause)


def ends(implant: Mapping[str, Any], key: str) -> str:
    """Return the band of one result in brackets, such as ``(14.7 to 19.1 mm)``; empty without a width.

    Parameters
    ----------
    implant : metrics of the implant.
    key : key of the result.
    """
    band = implant.get("bands", {}).get("results", {}).get(key)
    if band is None:
        return ""
    low, high = (format_value(key, band[end]) for end in ("low", "high"))
    number, _, unit = low.partition("\u202f")
    if low == high:
        return ""
    return f"({number if unit else low} to {high})"


def how_sure(implant: Mapping[str, Any]) -> str:
    """Return the sentences on how sure a device is; empty where its metrics do not state it.

    Parameters
    ----------
    implant : metrics of the implant.
    """
    told = implant.get("bands", {})
    if not told:
        return ""
    results = told.get("results", {})
    lies = [
        f"{Quantity((key,), 0.0).name.lower()} {ends(implant, key)[1:-1]}{_because(results[key])}"
        for key in HEADLINES
        if ends(implant, key)
    ]
    ranges = f" Within the ranges of these numbers: {'; '.join(lies)}." if lies else ""
    sizes = told.get("proposed_sizes", "")
    varies = f" The proposed size varies from {sizes}." if " to " in sizes else ""
    return f"{told['device']}{ranges}{varies}"


def _because(band: Mapping[str, Any]) -> str:
    """Return the main cause of a band in brackets, after a space; empty where there is none."""
    return f" (mostly the {number_name(band['cause'])})" if "cause" in band else ""
