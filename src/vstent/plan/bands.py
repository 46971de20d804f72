"""Bands of a deployment: how far its results move when the numbers of the device lie elsewhere in their ranges.

Makers publish few numbers, so the catalogue states a range for each (`vstent.devices.ranges`). All numbers of a device
are sampled together, each uniformly in its range and independently of the others. The band of a result contains 95 % of
the samples and the result itself. Full deployments of all samples would take a minute; a reduced model
(`vstent.plan.reduced`) takes a fraction of a second. ``benchmarks/ranges.py`` compares the two.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from vstent.anatomy.morphology import Measures
from vstent.deployment.deploy import APPOSED_GAP_MM, propose_size
from vstent.devices.design import Design, LaserCut, Range, Size
from vstent.devices.ranges import altered, altered_size, uncertain, values_at
from vstent.devices.stent import Deployment
from vstent.errors import DeviceError, LandingError
from vstent.geometry.vessel import Anatomy
from vstent.kernels.arrays import Floats
from vstent.plan.cells_in_bends import GAPS, NECK, plane
from vstent.plan.reduced import Changed, Reduced
from vstent.plan.shares import centered_points, first_order_shares
from vstent.plan.shortening import shortening

LENGTH: Final = "deployed_length_mm"
"""Name of the deployed length."""
BANDED: Final[tuple[str, ...]] = (
    LENGTH,
    "proximal_end_abscissa_mm",
    "distal_end_abscissa_mm",
    "neck_to_proximal_end_mm",
    "neck_to_distal_end_mm",
    "mesh_length_mm",
    *NECK,
    *GAPS,
)
"""Measures of a deployment that have a band."""
SAMPLES: Final = 128
"""Number of samples; a power of two."""
FEW_SAMPLES: Final = 32
"""Number of samples for the band of the deployed length alone; a power of two."""
INTERVAL: Final = (0.025, 0.975)
"""Quantiles at the ends of a band: 95 % of the samples lie in it."""


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
    """Compute the bands of a deployment from the ranges of its device.

    Parameters
    ----------
    deployment : the deployed device. Its middle row stays where it is.
    measures : results of `vstent.deployment.measure.measure`.
    is_proposed : whether to find also the sizes that would be proposed at both ends of the band of the deployed
        length.

    Returns bands of the results in `BANDED` that are measured; none for a device without ranges.
    """
    stent = deployment.stent
    ranges = uncertain(stent.design)
    if not ranges:
        return Bands({})
    points = centered_points(len(ranges), SAMPLES)
    samples = _samples(anatomy, deployment, measures, _devices(deployment, ranges, points))
    results: dict[str, Band] = {
        name: _band(points, samples[name], float(measures[name]), ranges) for name in BANDED if name in samples
    }
    if not is_proposed:
        return Bands(results)
    order = np.argsort(samples[LENGTH])
    ends = order[[round(quantile * (len(points) - 1)) for quantile in INTERVAL]]
    sizes = (_proposed(stent.design, anatomy, values_at(ranges, points[end])) for end in ends)
    return Bands(results, tuple(dict.fromkeys(size for size in sizes if size is not None)))


def length_band(anatomy: Anatomy, deployment: Deployment, measures: Measures) -> Band | None:
    """Compute the band of the deployed length alone, from fewer samples and without further deployments."""
    ranges = uncertain(deployment.stent.design)
    if not ranges:
        return None
    points = centered_points(len(ranges), FEW_SAMPLES)
    samples = _reduced(Reduced(anatomy, deployment), measures, _devices(deployment, ranges, points))
    return _band(points, samples[LENGTH], float(measures[LENGTH]), ranges)


def _devices(deployment: Deployment, ranges: tuple[Range, ...], points: Floats) -> list[tuple[Design, Size]]:
    """Return the altered device and its size at every point (n, d) of its ranges."""
    stent = deployment.stent
    return [altered(stent.design, stent.size, values_at(ranges, point)) for point in points]


def _samples(
    anatomy: Anatomy, deployment: Deployment, measures: Measures, devices: list[tuple[Design, Size]]
) -> dict[str, Floats]:
    """Return the results (n,) of altered devices by name."""
    stent, ranges = deployment.stent, uncertain(deployment.stent.design)
    model = Reduced(anatomy, deployment)
    if not isinstance(stent.design, LaserCut):
        model = replace(model, shortening=shortening(anatomy, stent, ranges, model.landing).change)
    found = _reduced(model, measures, devices)
    if isinstance(stent.design, LaserCut) and GAPS[0] in measures:
        fit = plane(anatomy, stent, measures, ranges, model.landing)
        fitted = [fit.at(design) for design, _ in devices if isinstance(design, LaserCut)]
        found |= {name: np.array([one[name] for one in fitted]) for name in fit.names}
    return found


def _reduced(model: Reduced, measures: Measures, devices: list[tuple[Design, Size]]) -> dict[str, Floats]:
    """Return the results (n,) of altered devices by name, from the reduced model alone."""
    stent = model.deployment.stent
    nominal = model.changed(stent.design, stent.size)
    moved = [_moved(measures, nominal, model.changed(*device)) for device in devices]
    return {name: np.array([one[name] for one in moved]) for name in moved[0]}


def _moved(measures: Measures, nominal: Changed, other: Changed) -> dict[str, float]:
    """Return the measured results, changed as the reduced model changes."""
    first_mm, last_mm = other.first_mm - nominal.first_mm, other.last_mm - nominal.last_mm
    moves = {
        LENGTH: last_mm - first_mm,
        "proximal_end_abscissa_mm": first_mm,
        "distal_end_abscissa_mm": last_mm,
        "neck_to_proximal_end_mm": nominal.mesh_first_mm - other.mesh_first_mm,
        "neck_to_distal_end_mm": other.mesh_last_mm - nominal.mesh_last_mm,
    }
    moves["mesh_length_mm"] = moves["neck_to_proximal_end_mm"] + moves["neck_to_distal_end_mm"]
    factors = {
        NECK[0]: other.coverage_fraction / nominal.coverage_fraction,
        NECK[1]: other.pore_density_per_mm2 / nominal.pore_density_per_mm2,
    }
    found = {name: float(measures[name]) + move for name, move in moves.items() if name in measures}
    found |= {name: float(measures[name]) * by for name, by in factors.items() if name in measures and by == by}
    if GAPS[0] in measures:
        is_apposed = other.gap_mm < APPOSED_GAP_MM
        found |= {GAPS[0]: float(is_apposed.mean()), GAPS[1]: float(other.gap_mm.max())}
    return found


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


def _proposed(design: Design, anatomy: Anatomy, values: Mapping[str, float]) -> Size | None:
    """Return the size of the catalogue that is proposed for a device with other numbers; None where none fits."""
    with suppress(DeviceError, LandingError):
        original = {altered_size(size, values): size for size in design.sizes}
        return original[propose_size(design.altered(values, tuple(original)), anatomy)]
    return None
