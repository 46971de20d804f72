"""Report of a cohort: counts of finished and failed cases, distributions of their metrics, and outliers."""

import base64
import math
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from markupsafe import Markup

from vstent.reporting.page import asset
from vstent.reporting.quantities import Quantity, format_value

Row = Mapping[str, Any]
"""One case with one treatment: column name to value."""

HEADLINES: Final = (
    *("vessel.sac_volume_mm3", "vessel.neck_max_diameter_mm", "vessel.parent_proximal_diameter_mm"),
    *("implant.deployed_length_mm", "implant.oversizing_fraction"),
    *("implant.apposed_fraction", "implant.max_wall_gap_mm"),
    *("implant.neck_metal_coverage_fraction", "implant.neck_pore_density_per_mm2"),
    "implant.p95_wire_stretch_fraction",
    *("change.neck_inflow_mL_s_ratio", "change.mean_sac_velocity_m_s_ratio"),
    *("change.mean_sac_wss_Pa_ratio", "change.turnover_time_s_ratio"),
    *("case_s", "peak_memory_MB"),
)
"""Keys of the table columns that are drawn and searched for outliers; the end of each key is its unit."""
UNDER_PICTURE: Final = ("implant.deployed_length_mm", "implant.neck_metal_coverage_fraction")
"""Keys of the metrics that stand under the picture of a patient."""
OUTLYING: Final = 3.5
"""Absolute modified z-score above which a value is an outlier.

Iglewicz and Hoaglin 1993, How to Detect and Handle Outliers.
"""
NORMAL: Final = 0.6745
"""Median absolute deviation of a normal distribution with standard deviation 1."""
WIDTH, HEIGHT, EDGE = 640, 34, 8
"""Width and height of a strip plot, and the margin at its ends, in SVG user units."""


class Distribution(NamedTuple):
    """Distribution of one metric of one treatment over all cases."""

    treatment: str
    """Name of the treatment."""
    n_cases: int
    """Number of cases that have the metric."""
    quantiles: tuple[str, ...]
    """Minimum, lower quartile, median, upper quartile and maximum as text with unit."""
    strip: str
    """Strip plot as SVG: one point per case."""


class Outlier(NamedTuple):
    """One value far from the median of its treatment."""

    case: str
    """Name of the case."""
    treatment: str
    """Name of the treatment."""
    name: str
    """Name of the metric."""
    value: str
    """Value as text with unit."""
    median: str
    """Median over the cases as text with unit."""
    score: float
    """Modified z-score, signed."""


def cohort_report(name: str, rows: Sequence[Row], pictures: Mapping[tuple[str, str], bytes]) -> str:
    """Return the report of a cohort as the text of one HTML file that loads nothing from a network.

    A row per case and treatment has ``case``, ``treatment``, ``outcome``, ``stage``, ``sentence`` and metrics; pictures
    of deployed treatments are WebP, by case and treatment.
    """
    from jinja2 import Environment, PackageLoader

    done = [row for row in rows if row["outcome"] == "done"]
    treatments = list(dict.fromkeys(row["treatment"] for row in rows))
    counts, patients = [], []
    for treatment in treatments:
        of_treatment = [row for row in rows if row["treatment"] == treatment]
        outcomes = [row["outcome"] for row in of_treatment]
        counts.append((treatment, *(outcomes.count(end) for end in ("done", "failed", "lost"))))
        shown = [
            (str(row["case"]), _caption(row), base64.b64encode(pictures[row["case"], treatment]).decode("ascii"))
            for row in of_treatment
            if (row["case"], treatment) in pictures
        ]
        if shown:
            patients.append((treatment, shown))
    distributions = [
        (_name(key), [distribution(done, one, key) for one in treatments if _values(done, one, key)])
        for key in HEADLINES
    ]
    environment = Environment(loader=PackageLoader("vstent.reporting", "assets"), autoescape=True)
    return environment.get_template("cohort.html.j2").render(
        name=name,
        style=Markup(asset("report.css")),
        counts=counts,
        patients=patients,
        n_cases=len({row["case"] for row in rows}),
        distributions=[(title, found) for title, found in distributions if found],
        outliers=[one for treatment in treatments for key in HEADLINES for one in outliers(done, treatment, key)],
        failures=[row for row in rows if row["outcome"] != "done"],
        limit=OUTLYING,
    )


def _caption(row: Row) -> str:
    """Return the values under the picture of a patient."""
    shown = [(key, row[key]) for key in UNDER_PICTURE if _is_number(row.get(key))]
    return ", ".join(f"{_name(key).lower()} {format_value(_leaf(key), float(value))}" for key, value in shown)


def modified_z_scores(values: Sequence[float]) -> list[float]:
    """Return the modified z-score of every value.

    It is the distance from the median divided by the median absolute deviation, scaled to the standard deviation of
    a normal distribution (Iglewicz and Hoaglin 1993).
    """
    if not len(values):
        return []
    array = np.asarray(values, dtype=np.float64)
    away = array - np.median(array)
    deviation = float(np.median(np.abs(away)))
    return (NORMAL * away / deviation).tolist() if deviation > 0 else [0.0] * len(array)


def outliers(rows: Sequence[Row], treatment: str, key: str) -> list[Outlier]:
    """Return the outliers of one metric of one treatment, the farthest from the median first."""
    found = _values(rows, treatment, key)
    scores = modified_z_scores([value for _, value in found])
    median = format_value(_leaf(key), float(np.median([value for _, value in found]))) if found else ""
    apart = [
        Outlier(case, treatment, _name(key), format_value(_leaf(key), value), median, score)
        for (case, value), score in zip(found, scores, strict=True)
        if abs(score) > OUTLYING
    ]
    return sorted(apart, key=lambda outlier: -abs(outlier.score))


def distribution(rows: Sequence[Row], treatment: str, key: str) -> Distribution:
    """Return the distribution of one metric of one treatment; the rows of all set the range of the strip plot."""
    found = _values(rows, treatment, key)
    values = [value for _, value in found]
    quantiles = np.quantile(values, (0.0, 0.25, 0.5, 0.75, 1.0))
    every = [float(row[key]) for row in rows if _is_number(row.get(key))]
    return Distribution(
        treatment,
        len(values),
        tuple(format_value(_leaf(key), float(value)) for value in quantiles),
        Markup(_strip(found, key, (min(every), max(every)))),
    )


def _strip(found: Sequence[tuple[str, float]], key: str, span: tuple[float, float]) -> str:
    """Return an SVG strip plot: a point per case on the range `span` of all treatments, a box over the quartiles."""
    low, high = span
    per_unit = (WIDTH - 2 * EDGE) / (high - low) if high > low else 0.0
    at = [EDGE + (value - low) * per_unit for _, value in found]
    left, middle, right = np.quantile(at, (0.25, 0.5, 0.75))
    scores = modified_z_scores([value for _, value in found])
    points = [
        f'<circle cx="{x:.1f}" cy="{HEIGHT / 2 + 6 * math.sin(7.0 * i):.1f}" r="3"'
        f"{' class=apart' if abs(score) > OUTLYING else ''}>"
        f"<title>{Markup.escape(case)}: {format_value(_leaf(key), value)}</title></circle>"
        for i, (x, (case, value), score) in enumerate(zip(at, found, scores, strict=True))
    ]
    box = (
        f'<rect x="{left:.1f}" y="4" width="{max(1.0, right - left):.1f}" height="{HEIGHT - 8}"/>'
        f'<line x1="{middle:.1f}" x2="{middle:.1f}" y1="4" y2="{HEIGHT - 4}"/>'
    )
    return f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img">{box}{"".join(points)}</svg>'


def _values(rows: Sequence[Row], treatment: str, key: str) -> list[tuple[str, float]]:
    """Return case name and value of one metric of one treatment, where the value is a finite number."""
    return [
        (str(row["case"]), float(row[key]))
        for row in rows
        if row["treatment"] == treatment and _is_number(row.get(key))
    ]


def _is_number(value: Any) -> bool:
    """Return whether a value is a finite number; booleans are not numbers."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _leaf(key: str) -> str:
    """Return the last part of a dotted key."""
    return key.rsplit(".", 1)[-1]


def _name(key: str) -> str:
    """Return the display name of a metric."""
    return Quantity((_leaf(key),), 0.0).name
