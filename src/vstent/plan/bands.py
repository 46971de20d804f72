"""Bands of a deployment: how far its results move when the numbers of the device lie elsewhere in their ranges.

Makers publish few numbers, so the catalogue states a range for each (`vstent.devices.ranges`). All numbers of a device
are sampled together, each uniformly in its range and independently of the others. The band of a result contains 95 % of
the samples and the result itself. A reduced model (`vstent.plan.reduced`) stands for the deployments, except for gaps:
these come from deployments, which take a few seconds. ``benchmarks/ranges.py`` compares both with more deployments.
"""

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from vstent.anatomy.morphology import Measures
from vstent.deployment.deploy import deploy, propose_size
from vstent.deployment.measure import apposition
from vstent.devices.design import Design, Range, Size
from vstent.devices.ranges import altered, altered_size, uncertain, values_at
from vstent.devices.stent import Deployment, Landing, Stent
from vstent.errors import DeviceError, LandingError
from vstent.geometry.vessel import Anatomy
from vstent.kernels.arrays import Floats
from vstent.plan.bends import NECK, crowding, shortening
from vstent.plan.reduced import Reduced
from vstent.plan.shares import INTERVAL, centered_points, first_order_shares
from vstent.plan.workers import spread

LENGTH: Final = "deployed_length_mm"
"""Name of the deployed length."""
GAPS: Final = ("apposed_fraction", "max_wall_gap_mm")
"""Measures of gaps that have a band."""
SAMPLES: Final = 128
"""Number of samples; a power of two."""
FEW_SAMPLES: Final = 32
"""Number of samples for the band of the deployed length alone, and number of deployments for those of the gaps; a power
of two."""


@dataclass(frozen=True)
class Band:
    """Band of one result."""

    low: float
    """Lower end."""
    high: float
    """Upper end."""
    shares: dict[str, float]
    """Share of each number alone in the variance, the largest first; numbers without effect are left out."""

    def metrics(self) -> dict[str, Any]:
        """Return the ends, and the number that contributes most with its share."""
        causes = ({"cause": name, "cause_fraction": share} for name, share in self.shares.items())
        return {"low": self.low, "high": self.high} | next(causes, {})


@dataclass(frozen=True)
class Bands:
    """Bands of a deployed device."""

    results: dict[str, Band]
    """Bands by the name of the measure."""
    sizes: tuple[Size, ...] = ()
    """Sizes that would be proposed at the short and at the long end of the band of the deployed length."""

    def metrics(self) -> dict[str, Any]:
        """Return all bands as plain values: ``results`` by the name of the measure, and the proposed sizes."""
        found: dict[str, Any] = {"results": {name: band.metrics() for name, band in self.results.items()}}
        return found | ({"proposed_sizes": " to ".join(size.label for size in self.sizes)} if self.sizes else {})


def bands(anatomy: Anatomy, deployment: Deployment, measures: Measures, *, is_proposed: bool = False) -> Bands:
    """Compute the bands of a deployment from the ranges of its device, without those of its gaps (`gap_bands`).

    Its middle row stays where it is. With `is_proposed` the sizes are found that would be proposed at both ends of the
    band of the deployed length. There are no bands without ranges.
    """
    design, ranges = deployment.stent.design, uncertain(deployment.stent.design)
    if not ranges:
        return Bands({})
    points, model = centered_points(len(ranges), SAMPLES), Reduced(anatomy, deployment)
    devices = _devices(deployment.stent, ranges, points)
    if design.follows_bends:
        model = replace(model, shortening=shortening(anatomy, deployment.stent, ranges, model.landing))
    samples = model.results(measures, devices)
    if not design.follows_bends and NECK[0] in measures:
        crowded = crowding(anatomy, deployment.stent, measures, ranges, model.landing)
        at = [crowded(other) for other, _ in devices]
        samples |= {name: np.array([one[name] for one in at]) for name in at[0]}
    results = {name: _band(points, values, float(measures[name]), ranges) for name, values in samples.items()}
    sizes: dict[Size, None] = {}
    if is_proposed:
        order = np.argsort(samples[LENGTH])
        for end in order[[round(quantile * (len(points) - 1)) for quantile in INTERVAL]]:
            with suppress(DeviceError, LandingError):
                values = values_at(ranges, points[end])
                originals = {altered_size(size, values): size for size in design.sizes}
                sizes[originals[propose_size(design.altered(values, tuple(originals)), anatomy)]] = None
    return Bands(results, tuple(sizes))


def gap_bands(anatomy: Anatomy, deployment: Deployment, measures: Measures, *, jobs: int = 1) -> dict[str, Band]:
    """Compute the bands of a deployment's gaps from deployments at places in the ranges, on `jobs` processes.

    With `jobs` above 1 no compiled loop runs in this process, and the others yield to it. Devices that cannot be made
    or do not fit the artery are left out.
    """
    stent, ranges = deployment.stent, uncertain(deployment.stent.design)
    if not ranges or GAPS[0] not in measures:
        return {}
    points = centered_points(len(ranges), FEW_SAMPLES)
    common = anatomy, stent, Reduced(anatomy, deployment).landing
    tasks = [values_at(ranges, point) for point in points]
    rows = list(spread(_gaps, common, tasks, jobs=jobs, niceness=10))
    is_found = np.array([GAPS[0] in row for row in rows])
    if not is_found.any():
        return {}
    samples = {name: np.array([float(row[name]) for row in rows if name in row]) for name in GAPS}
    return {name: _band(points[is_found], samples[name], float(measures[name]), ranges) for name in GAPS}


def _gaps(common: tuple[Anatomy, Stent, Landing], values: Mapping[str, float]) -> Measures:
    """Return the apposition of a device with other values of its numbers; empty where it is not deployed."""
    anatomy, stent, landing = common
    with suppress(DeviceError, LandingError):
        design, size = altered(stent.design, stent.size, values)
        return apposition(anatomy, deploy(design, anatomy, size=size, landing=landing))
    return {}


def length_band(anatomy: Anatomy, deployment: Deployment, measures: Measures) -> Band | None:
    """Compute the band of the deployed length alone, from fewer samples and without further deployments."""
    ranges = uncertain(deployment.stent.design)
    if not ranges:
        return None
    points = centered_points(len(ranges), FEW_SAMPLES)
    samples = Reduced(anatomy, deployment).results(measures, _devices(deployment.stent, ranges, points))
    return _band(points, samples[LENGTH], float(measures[LENGTH]), ranges)


def _devices(stent: Stent, ranges: tuple[Range, ...], points: Iterable[Floats]) -> list[tuple[Design, Size]]:
    """Return the altered device and its size at every point (n, d) of its ranges."""
    return [altered(stent.design, stent.size, values_at(ranges, point)) for point in points]


def interval(samples: Floats, value: float) -> tuple[float, float]:
    """Return the ends of the shortest interval that contains the middle 95 % of samples (n,) and the value itself."""
    low, high = np.quantile(samples, INTERVAL)
    return min(float(low), value), max(float(high), value)


def _band(points: Floats, values: Floats, value: float, ranges: tuple[Range, ...]) -> Band:
    """Return the band of one result from its samples."""
    low, high = interval(values, value)
    shares = first_order_shares(points, values)
    named = zip((one.name for one in ranges), [] if shares is None else shares.tolist(), strict=False)
    return Band(low, high, dict(sorted(((k, v) for k, v in named if v > 0), key=lambda kv: -kv[1])))
