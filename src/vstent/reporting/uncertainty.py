"""Uncertainty of results as table rows: mean, 95 % interval, and the share of each cause in the variance."""

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

from vstent.reporting.bands import number_name
from vstent.reporting.quantities import Quantity, format_value

CAUSES: Final = {
    "threshold": "all diameters",
    "landing": "landing",
    "device": "manufacturing tolerance",
    "inflow": "inflow",
    "neck": "choice of the neck plane",
    "rest": "interplay and chance",
}
"""Display names of the causes of uncertainty."""


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
    varied = treatment.get("uncertainty", {})
    return [_interval(key, ends, varied["shares"][key]) for key, ends in varied.get("intervals", {}).items()]


def _interval(key: str, ends: Mapping[str, float], shares: Mapping[str, float]) -> Interval:
    """Return the uncertainty of one result as text."""
    names = [(cause.removesuffix("_fraction"), share) for cause, share in shares.items()]
    parts = [(CAUSES.get(cause) or number_name(cause), share) for cause, share in names]
    parts.sort(key=lambda part: -part[1])
    mean, low, high = (format_value(key, ends[end]) for end in ("mean", "low", "high"))
    return Interval(Quantity((key,), 0.0).name, mean, low, high, parts)


def uncertainty_of(metrics: Mapping[str, Any], titles: Mapping[str, str]) -> list[Varied]:
    """Return the uncertainty of all treatments; empty without an uncertainty study.

    Parameters
    ----------
    metrics : metrics of the case.
    titles : titles of the treatments by name.
    """
    found = []
    for name, treatment in metrics.get("treatments", {}).items():
        if "uncertainty" in treatment:
            found.append(Varied(titles.get(name, name), _words(treatment["uncertainty"]), intervals(treatment)))
    return found


def _words(varied: Mapping[str, Any]) -> str:
    """Return the number of deployments and the ranges that were varied, as text."""
    ranges = varied["ranges"]
    told = [
        f"{CAUSES[key.rsplit('_', 1)[0]]} ±{format_value(key, value)}" for key, value in ranges.items() if value > 0
    ]
    if varied.get("numbers"):
        told.append("the numbers of the device within their ranges in the catalogue")
    failed = f", of which {varied['failed_count']} did not fit the artery" if varied["failed_count"] else ""
    return f"{varied['samples_count']} deployments{failed}. Varied: {', '.join(told)}."
