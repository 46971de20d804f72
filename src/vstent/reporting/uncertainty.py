"""Uncertainty in words: a row a result, with its interval and what makes its spread."""

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

from vstent.reporting.quantities import Quantity, format_value

CAUSES: Final = {
    "threshold": "all diameters",
    "landing": "landing",
    "device": "manufacturing tolerance",
    "inflow": "inflow",
    "rest": "interplay",
}
"""Names of the causes for people."""


class Interval(NamedTuple):
    """One result."""

    name: str
    mean: str
    low: str
    high: str
    shares: list[tuple[str, float]]
    """Causes and their shares, the largest first."""


class Varied(NamedTuple):
    """All results of a device."""

    title: str
    words: str
    rows: list[Interval]


def intervals(stent: Mapping[str, Any]) -> list[Interval]:
    """Return the rows of a device's metrics; none where nothing was varied."""
    varied = stent.get("uncertainty", {})
    return [_interval(key, ends, varied["shares"][key]) for key, ends in varied.get("intervals", {}).items()]


def _interval(key: str, ends: Mapping[str, float], shares: Mapping[str, float]) -> Interval:
    parts = [(CAUSES[cause.removesuffix("_fraction")], share) for cause, share in shares.items()]
    parts.sort(key=lambda part: -part[1])
    mean, low, high = (format_value(key, ends[end]) for end in ("mean", "low", "high"))
    return Interval(Quantity((key,), 0.0).name, mean, low, high, parts)


def uncertainty_of(metrics: Mapping[str, Any], titles: Mapping[str, str]) -> list[Varied]:
    """Return what was varied of every device; empty where nothing was."""
    found = []
    for name, stent in metrics.get("stents", {}).items():
        if "uncertainty" in stent:
            found.append(Varied(titles.get(name, name), _words(stent["uncertainty"]), intervals(stent)))
    return found


def _words(varied: Mapping[str, Any]) -> str:
    ranges = varied["ranges"]
    told = [
        f"{CAUSES[key.rsplit('_', 1)[0]]} ±{format_value(key, value)}" for key, value in ranges.items() if value > 0
    ]
    failed = f", of which {varied['failed_count']} did not fit the artery" if varied["failed_count"] else ""
    return f"{varied['samples_count']} deployments{failed}. Varied: {', '.join(told)}."
