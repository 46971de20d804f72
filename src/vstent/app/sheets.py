"""Metrics as the page lists them, each with its unit and its definition."""

from typing import Any, Final

from vstent.flow.grade import unusable
from vstent.reporting.definitions import HEADLINES
from vstent.reporting.quality import qualities
from vstent.reporting.quantities import Quantity, compare, flatten
from vstent.reporting.uncertainty import uncertainty_of

Sheet = dict[str, Any]
"""Title, treatments and rows of one table."""

FIRST: Final = {
    "anatomy": (
        *("sac_volume_mm3", "sac_height_mm", "neck_plane_area_mm2", "neck_max_diameter_mm"),
        *("aspect_ratio", "size_ratio", "undulation_index", "nonsphericity_index", "inflow_angle_rad"),
        *("parent_proximal_diameter_mm", "parent_distal_diameter_mm"),
    ),
    "device": (
        *("deployed_length_mm", "basket_width_mm", "basket_height_mm", "width_compression_fraction", "protrusion_mm"),
        *("neck_uncovered_fraction", "volume_ratio_fraction", "packing_density_fraction", "neck_covered_fraction"),
        *("neck_metal_coverage_fraction", "neck_union_coverage_fraction", "overlap_length_mm", "apposed_fraction"),
        *("max_wall_gap_mm", "neck_to_proximal_end_mm", "neck_to_distal_end_mm", "mean_diameter_mm"),
        "jailed_branches_count",
    ),
}
"""Metrics shown before the user expands a table."""


def anatomy(measures: dict[str, Any]) -> list[Sheet]:
    """Return the table of the vessel with its largest sac, and one of every other sac."""
    others = {key: value for key, value in measures.items() if isinstance(value, dict)}
    largest = {key: value for key, value in measures.items() if key not in others}
    titles = [f"Sac {number}" for number in range(1, len(others) + 2)]
    return [
        _plain(title, flatten(one), FIRST["anatomy"])
        for title, one in zip(titles, (largest, *others.values()), strict=True)
    ]


def device(title: str, measures: dict[str, Any]) -> Sheet:
    """Return the table of one deployed implant."""
    numbers = {key: value for key, value in measures.items() if not isinstance(value, str)}
    return _plain(title, flatten(numbers), FIRST["device"])


def flow(metrics: dict[str, Any], titles: dict[str, str]) -> list[Sheet]:
    """Return the table of the flow without a device, and with each device in the order of `titles`, with its change."""
    changes = compare(metrics, unusable(metrics))
    keys = [change.before.key for change in changes]
    first = {*HEADLINES} & {*keys} or {*keys[:8]}  # without a sac there is no headline
    rows = []
    for change in changes:
        cells, senses = [change.before.text], []
        for name in titles:
            after = change.after.get(name)
            of = "not usable" if name in change.hidden else change.of(name)
            cells += [after.text, of] if after else ["–", "–"]
            senses.append(change.sense(name) if after else "")
        row = _row(change.before, cells, is_first=change.before.key in first)
        rows.append(row | {"senses": senses})
    rows.sort(key=lambda row: HEADLINES.index(row["key"]) if row["key"] in HEADLINES else len(HEADLINES))
    words: Sheet = {"title": "Blood flow", "names": list(titles), "devices": list(titles.values())}
    words |= {"qualities": [one._asdict() | {"mark": one.mark} for one in qualities(metrics, titles)]}
    return [words | {"rows": rows}] if rows else []


def uncertainty(metrics: dict[str, Any], titles: dict[str, str]) -> list[dict[str, Any]]:
    """Return the uncertainty intervals of every treatment that has some, in the order of their titles by name."""
    ordered = {"treatments": {name: metrics["treatments"][name] for name in titles}}
    return [
        {"title": varied.title, "words": varied.words, "rows": [row._asdict() for row in varied.rows]}
        for varied in uncertainty_of(ordered, titles)
    ]


def _plain(title: str, quantities: list[Quantity], first: tuple[str, ...]) -> Sheet:
    """Return a table of values, those named `first` on top."""
    rows = [_row(quantity, [quantity.text], is_first=quantity.key in first) for quantity in quantities]
    rows.sort(key=lambda row: first.index(row["key"]) if row["key"] in first else len(first))
    return {"title": title, "names": [], "devices": [], "rows": rows}


def _row(quantity: Quantity, cells: list[str], *, is_first: bool) -> dict[str, Any]:
    """Return one row of a table with name, meaning and source of the metric."""
    meaning = quantity.definition
    words = {"key": quantity.key, "name": quantity.name, "meaning": meaning.meaning, "source": meaning.source}
    return words | {"cells": cells, "is_first": is_first}
