"""Uncertainty: a deployment done again with what is not sure varied: intervals, and the share of each cause.

Four causes are varied, each uniformly within plus and minus its range and independently of the others: the threshold
of the scan (all diameters), where the device is landed, how wide it was made, and the mean inflow. Points are those of
Sobol's sequence (scipy.stats.qmc), each in the middle of its stratum, so that every cause alone is spread evenly and
the same question gets the same answer.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

import numpy as np

from vstent.deployment.deploy import deploy
from vstent.deployment.measure import measure
from vstent.devices.design import Design, Size
from vstent.devices.stent import Deployment, Landing, Stent
from vstent.errors import InputError, LandingError
from vstent.flow.case import FlowSettings
from vstent.flow.indices import compare, indices
from vstent.flow.ostium import ostium
from vstent.flow.simulation import Checkpoint, flow_case, simulate_case
from vstent.geometry.vessel import Anatomy
from vstent.kernels.arrays import Floats, freeze
from vstent.plan.shares import first_order_shares
from vstent.plan.widening import widened

CAUSES: Final = ("threshold", "landing", "device", "inflow")
"""What is varied, in the order of the columns of the points."""
RESULTS: Final = (
    "deployed_length_mm",
    "neck_to_proximal_end_mm",
    "neck_to_distal_end_mm",
    "apposed_fraction",
    "neck_metal_coverage_fraction",
    "neck_pore_density_per_mm2",
)
"""Measures of the deployment that get intervals."""
FLOW_RESULTS: Final = ("neck_inflow_mL_s_ratio", "mean_sac_velocity_m_s_ratio", "mean_sac_wss_Pa_ratio")
"""Ratios of the flow after to the flow before that get intervals."""
WIDEST_FRACTION: Final = 0.1
"""A device is made wider or narrower by less than this part of its free diameter."""
INTERVAL: Final = (0.025, 0.975)
"""Quantiles of an interval: 95 % of the cases lie in it."""


@dataclass(frozen=True)
class Ranges:
    """How far each cause goes to either side, and how often; the ranges are vstent's own where nothing is given."""

    samples: int = 32
    """Deployments; the next power of two is taken."""
    flow_samples: int = 0
    """Of them, so many get their flows computed too, before and after: as dear as so many studies."""
    threshold_mm: float | None = None
    """Change of every diameter; None: the vessel's own `threshold_band_mm`, 0 for a surface."""
    landing_mm: float = 1.0
    """Of the landing point along the axis."""
    device_mm: float = 0.1
    """Of the free diameter: a device as wide as it was made, braided of as many pieces of wire."""
    inflow_fraction: float = 0.2
    """Of the mean inflow, relative."""

    def __post_init__(self) -> None:
        if self.samples < 2 or self.flow_samples < 0:
            raise InputError(
                f"{self.samples} samples, {self.flow_samples} of them with flows, are too few for a spread: "
                "give at least 2 samples, and 0 or more flows"
            )
        for name in ("threshold_mm", "landing_mm", "device_mm", "inflow_fraction"):
            value = getattr(self, name)
            if value is not None and not 0 <= value < math.inf:
                raise InputError(f"{value:g} is not a range of {name}: give 0 or more, to either side")
        if self.inflow_fraction >= 1:
            raise InputError(
                f"an inflow that varies by a fraction of {self.inflow_fraction:g} could vanish: give less than 1"
            )

    def of(self, anatomy: Anatomy) -> Floats:
        """Return the ranges (4,) in the order of `CAUSES`."""
        band_mm = anatomy.vessel.threshold_band_mm if self.threshold_mm is None else self.threshold_mm
        return np.array([band_mm, self.landing_mm, self.device_mm, self.inflow_fraction])


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Result of an uncertainty study."""

    ranges: Floats
    """(4,) plus and minus of every cause, in the order of `CAUSES`: mm, mm, mm, fraction."""
    points: Floats
    """(n, 4) where in its range each cause was, -1 to 1."""
    names: tuple[str, ...]
    """The results."""
    values: Floats
    """(n, k) results; NaN where the device did not fit, or the flow was not computed."""

    def __post_init__(self) -> None:
        freeze(self, "ranges", np.float64, (len(CAUSES),))
        freeze(self, "points", np.float64, (-1, len(CAUSES)))
        freeze(self, "values", np.float64, (len(self.points), len(self.names)))

    @property
    def n_failed(self) -> int:
        """Deployments that did not fit the artery."""
        return int(np.isnan(self.values).all(axis=1).sum())

    def interval(self, name: str) -> tuple[float, float, float]:
        """Return mean, lower and upper end (2.5 and 97.5 %) of a result."""
        found = self._found(name)[1]
        low, high = np.quantile(found, INTERVAL)
        return float(found.mean()), float(low), float(high)

    def shares(self, name: str) -> dict[str, float]:
        """Return the part of a result's variance that each cause makes alone, and the rest; empty where too few."""
        points, values = self._found(name)
        varied = np.flatnonzero(self.ranges > 0)
        found = first_order_shares(points[:, varied], values)
        if found is None:
            return {}
        shares = {CAUSES[cause]: float(share) for cause, share in zip(varied, found, strict=True)}
        return shares | {"rest": max(0.0, 1.0 - sum(shares.values())) if any(shares.values()) else 0.0}

    def _found(self, name: str) -> tuple[Floats, Floats]:
        column = self.values[:, self.names.index(name)]
        is_found = ~np.isnan(column)
        return self.points[is_found], column[is_found]

    def metrics(self) -> dict[str, Any]:
        """Return everything as numbers whose names end in their unit."""
        told = [name for name in self.names if len(self._found(name)[1]) > 1]
        ranges = dict(zip(("threshold_mm", "landing_mm", "device_mm", "inflow_fraction"), self.ranges, strict=True))
        return {
            "samples_count": len(self.points),
            "failed_count": self.n_failed,
            "ranges": {name: float(value) for name, value in ranges.items()},
            "intervals": {name: dict(zip(("mean", "low", "high"), self.interval(name), strict=True)) for name in told},
            "shares": {
                name: {f"{cause}_fraction": share for cause, share in self.shares(name).items()} for name in told
            },
        }


def vary(
    anatomy: Anatomy,
    deployment: Deployment,
    ranges: Ranges,
    *,
    flow: FlowSettings | None = None,
    progress: Callable[[int, int], None] | None = None,
    checkpoint: Checkpoint | None = None,
) -> Uncertainty:
    """Deploy a device again and again with the causes varied.

    Parameters
    ----------
    anatomy : the artery.
    deployment : the device as it lies; its size and where its middle row lies are what is varied about.
    ranges : how far.
    flow : how the flow is computed, for ``ranges.flow_samples`` of the deployments.
    progress : told how many of how many are done.
    checkpoint : keeps every sample whose flow is done, so that varying again goes on after it.

    Raises
    ------
    InputError
        When the range of the threshold would close the artery, or that of the device makes another device of it.
    FlowError
        When a flow cannot be computed.
    """
    spread, points = ranges.of(anatomy), _points(ranges)
    if 2 * spread[0] > anatomy.section_radius_mm.min():
        raise InputError(
            f"diameters that vary by {spread[0]:.2g} mm would close the artery: give a smaller range of the threshold"
        )
    stent = deployment.stent
    free_mm = stent.size.free_diameter_mm
    if ranges.device_mm >= WIDEST_FRACTION * free_mm:
        raise InputError(
            f"a device with a free diameter of {free_mm:.2f} mm is not made {ranges.device_mm:g} mm wider or "
            f"narrower: give a range below {WIDEST_FRACTION * free_mm:.2f} mm"
        )
    middle_mm = float(stent.row_abscissa_mm[(len(stent.row_abscissa_mm) - 1) // 2])
    rows = []
    for number, offset in enumerate(points * spread):
        wanted = flow if number < ranges.flow_samples else None
        sample = partial(_sample, anatomy, stent, middle_mm, offset, wanted)
        # without its flow a sample is done again sooner than it is read back
        rows.append(sample() if wanted is None or checkpoint is None else _once(sample, checkpoint, f"sample-{number}"))
        if progress is not None:
            progress(number + 1, len(points))
    names = tuple(name for name in (*RESULTS, *FLOW_RESULTS) if any(name in row for row in rows))
    values = np.array([[row.get(name, np.nan) for name in names] for row in rows], dtype=np.float64)
    return Uncertainty(spread, points, names, values.reshape(len(points), len(names)))


def _points(ranges: Ranges) -> Floats:
    """Sobol's points (n, 4), -1 to 1, each in the middle of its stratum."""
    from scipy.stats import qmc

    power = int(np.ceil(np.log2(ranges.samples)))
    unit = qmc.Sobol(len(CAUSES), scramble=False).random_base2(power)
    return 2 * (unit + 0.5 / len(unit)) - 1


def made_wider(design: Design, size: Size, by_mm: float) -> Size:
    """A size as it came out of the machine: wider, of as many pieces, each longer in proportion."""
    factor = 1 + by_mm / size.free_diameter_mm
    return replace(
        size,
        diameter_mm=size.diameter_mm * factor,
        length_mm=size.length_mm * factor,
        free_diameter_mm=size.free_diameter_mm * factor,
    )


def _once(sample: Callable[[], dict[str, float]], checkpoint: Checkpoint, name: str) -> dict[str, float]:
    """Return a sample's results: those kept, or found now and kept."""
    kept = checkpoint.load(name)
    if kept is not None:
        return {result: float(value) for result, value in kept.items()}
    found = sample()
    checkpoint.save(name, {result: np.array(value) for result, value in found.items()})
    return found


def _sample(
    anatomy: Anatomy, stent: Stent, middle_mm: float, offset: Floats, flow: FlowSettings | None
) -> dict[str, float]:
    """Results with the causes off by `offset` (4,); empty where the device does not fit."""
    diameter_mm, along_mm, wider_mm, inflow_fraction = (float(value) for value in offset)
    other = widened(anatomy, diameter_mm) if diameter_mm else anatomy
    size = made_wider(stent.design, stent.size, wider_mm)
    try:
        deployed = deploy(stent.design, other, size=size, landing=Landing(middle_mm + along_mm))
    except LandingError:
        return {}
    measures = measure(other, deployed)
    found: dict[str, float] = {name: float(measures[name]) for name in RESULTS if name in measures}
    if flow is None or not other.aneurysms:
        return found
    inflow_mL_s = flow_case(anatomy, None, flow).inflow_mL_s * (1 + inflow_fraction)
    return found | _flow_ratios(other, deployed.stent, replace(flow, inflow_mL_s=inflow_mL_s))


def _flow_ratios(anatomy: Anatomy, stent: Stent, flow: FlowSettings) -> dict[str, float]:
    sac = anatomy.aneurysms[0]
    shapes = sac.sac, ostium(sac, anatomy.vessel.lumen)
    bare = simulate_case(flow_case(anatomy, None, flow))
    after = simulate_case(flow_case(anatomy, stent, flow), start=bare)
    ratios = compare(indices(bare, *shapes), indices(after, *shapes))
    return {name: ratios[name] for name in FLOW_RESULTS if name in ratios}
