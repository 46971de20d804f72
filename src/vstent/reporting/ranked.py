"""Ranked treatments as rows of text, for terminal and report."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from vstent.reporting.quantities import spoken

COLUMNS: Final = (
    ("neck inflow", "neck_inflow_change_fraction", "{:+.0%}"),
    ("sac velocity", "sac_velocity_change_fraction", "{:+.0%}"),
    ("sac velocity, straightened", "straightened_sac_velocity_change_fraction", "{:+.0%}"),
    ("neck covered", "neck_coverage_fraction", "{:.0%}"),
    ("metal in artery", "metal_in_artery_mm2", "{:.0f} mm²"),
    ("gap to wall", "mean_wall_gap_mm", "{:.2f} mm"),
    ("stands out", "protrusion_mm", "{:.1f} mm"),
)
"""Columns of measures: title, key and number format."""


def treatment_rows(ranked: Sequence[Mapping[str, Any]]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return titles, and a row for every treatment, with the jailed branches by name and the change of their flow."""
    rows, columns = [], [one for one in COLUMNS if any(row.get(one[1]) is not None for row in ranked)]
    for number, row in enumerate(ranked, start=1):
        cells = ["" if row.get(key) is None else spoken(form.format(row[key])) for _, key, form in columns]
        jailed = ", ".join(spoken(f"{role} {change:+.0%}") for role, change in row["jailed_branches"].items())
        score = f"{100 * row['score']:.0f}" if row["is_suitable"] else "out" if any(cells) else "none"
        rows.append((str(number), row["treatment"], score, *cells, jailed or ("none" if any(cells) else "")))
    return ("", "treatment", "score", *(title for title, _, _ in columns), "jailed branches"), rows
