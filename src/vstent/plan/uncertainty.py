"""Uncertainty of a deployment: intervals of its results, and the share of each cause.

Four causes are varied, each uniformly within plus or minus its range and independently of the others: the threshold of
the scan (all diameters), the landing position, the manufactured diameter of the device, and the mean inflow. The
numbers of the device vary with them, each within its range in the catalogue (`vstent.devices.ranges`). In an artery
that yields, so does the stiffness of the device relative to wall and bed. Points are those of a Sobol sequence, each in
the middle of its stratum. Every cause alone is thus sampled evenly, and the same study gives the same result. Every
sample of coils has a seed of its own; of coils alone nothing else varies.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Final

import numpy as np

from vstent.deployment.coils import deploy_coils
from vstent.deployment.deploy import deploy
from vstent.deployment.measure import measure
from vstent.deployment.straightening import SETTINGS, Straightening, straighten
from vstent.devices.design import Design, Size
from vstent.devices.ranges import altered, values_at
from vstent.devices.stent import Coils, Deployment, Landing, Stent
from vstent.errors import DeviceError, InputError, LandingError
from vstent.flow.case import FlowField
from vstent.flow.indices import between_coils, indices, ratios
from vstent.flow.ostium import sac_surfaces
from vstent.flow.problem import flow_case
from vstent.flow.settings import FlowSettings
from vstent.flow.simulation import Checkpoint, simulate_case
from vstent.geometry.vessel import Anatomy
from vstent.kernels.arrays import Floats, freeze
from vstent.plan.ranges import STIFFNESS, Ranges
from vstent.plan.shares import INTERVAL, centered_points, first_order_shares
from vstent.plan.widening import widened

CAUSES: Final = ("threshold", "landing", "device", "inflow")
"""Varied causes, in the order of the columns of the points."""
RESULTS: Final = (
    "deployed_length_mm",
    "neck_to_proximal_end_mm",
    "neck_to_distal_end_mm",
    "apposed_fraction",
    "neck_metal_coverage_fraction",
    "neck_pore_density_per_mm2",
)
"""Measures of the deployment for which intervals are computed."""
COIL_RESULTS: Final = ("packing_density_fraction", "neck_density_fraction", "neck_covered_by_coils_fraction")
"""Measures of coils for which intervals are computed."""
FLOW_RESULTS: Final = (
    "neck_inflow_mL_s_ratio",
    "neck_inflow_in_sac_mL_s_ratio",
    "neck_inflow_in_artery_mL_s_ratio",
    "mean_sac_velocity_m_s_ratio",
    "mean_sac_wss_Pa_ratio",
)
"""Ratios of the flow with to the flow without the device for which intervals are computed."""
STRAIGHTENED: Final = ("straightened_rad", "bend_radius_after_mm")
"""Measures of the straightening for which intervals are computed."""
OF_EFFECTS: Final = ("neck_inflow_mL_s_ratio", "mean_sac_velocity_m_s_ratio")
"""Flow ratios that are computed in the artery that has yielded, relative to the artery as scanned without a device."""
EFFECTS: Final = "straightened_bare_", "straightened_"
"""What the names of these begin with: without and with the device."""
WIDEST_FRACTION: Final = 0.1
"""Fraction of the free diameter below which the range of the device's diameter must be."""


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Result of an uncertainty study."""

    ranges: Floats
    """(4 + d,) range of every cause to either side: `CAUSES` (mm, mm, mm, fraction), then `numbers`."""
    points: Floats
    """(n, 4 + d) value of every cause in its range, -1 to 1."""
    names: tuple[str, ...]
    """Names of the results."""
    values: Floats
    """(n, k) results; NaN if the device did not fit or the flow was not computed."""
    numbers: tuple[str, ...] = ()
    """(d) numbers of the device that were varied, then `STIFFNESS` where the artery yields by a range."""
    neck_mm2: tuple[float, float, float] | None = None
    """Area of the section by the neck plane, and the smallest and largest one by planes that separate the sac nearly as
    well; None without a neck plane."""

    def __post_init__(self) -> None:
        freeze(self, "ranges", np.float64, (len(self.causes),))
        freeze(self, "points", np.float64, (-1, len(self.causes)))
        freeze(self, "values", np.float64, (len(self.points), len(self.names)))

    @property
    def causes(self) -> tuple[str, ...]:
        """Names of all causes, in the order of the columns of the points."""
        return (*CAUSES, *self.numbers)

    @property
    def n_failed(self) -> int:
        """Number of samples in which the device did not fit the artery."""
        return int(np.isnan(self.values).all(axis=1).sum())

    def interval(self, name: str) -> tuple[float, float, float]:
        """Return the mean and the 2.5 % and 97.5 % quantiles of a result."""
        found = self._found(name)[1]
        low, high = np.quantile(found, INTERVAL)
        return float(found.mean()), float(low), float(high)

    def shares(self, name: str) -> dict[str, float]:
        """Return the share of each cause alone in a result's variance, and the rest; empty if samples are too few."""
        points, values = self._found(name)
        varied = np.flatnonzero(self.ranges > 0)
        if not len(varied):
            return {"rest": 1.0}  # seeds
        found = first_order_shares(points[:, varied], values)
        if found is None:
            return {}
        shares = {self.causes[cause]: float(share) for cause, share in zip(varied, found, strict=True)}
        return shares | {"rest": max(0.0, 1.0 - sum(shares.values())) if any(shares.values()) else 0.0}

    def _found(self, name: str) -> tuple[Floats, Floats]:
        """Return the points (m, 4 + d) and values (m,) of a result where it was computed."""
        column = self.values[:, self.names.index(name)]
        is_found = ~np.isnan(column)
        return self.points[is_found], column[is_found]

    def metrics(self) -> dict[str, Any]:
        """Return all results as numbers whose names end in their unit."""
        told = [name for name in self.names if len(self._found(name)[1]) > 1]
        intervals = {name: dict(zip(("mean", "low", "high"), self.interval(name), strict=True)) for name in told}
        shares = {name: {f"{cause}_fraction": share for cause, share in self.shares(name).items()} for name in told}
        if self.neck_mm2 is not None:
            intervals["neck_plane_area_mm2"] = dict(zip(("mean", "low", "high"), self.neck_mm2, strict=True))
            shares["neck_plane_area_mm2"] = {"neck_fraction": 1.0}
        ranges = dict(zip(("threshold_mm", "landing_mm", "device_mm", "inflow_fraction"), self.ranges, strict=False))
        return {
            "samples_count": len(self.points),
            "failed_count": self.n_failed,
            "ranges": {name: float(value) for name, value in ranges.items()},
            "numbers": ", ".join(self.numbers),
            "intervals": intervals,
            "shares": shares,
        }


def vary(
    anatomy: Anatomy,
    deployment: Deployment,
    ranges: Ranges,
    coils: Sequence[Stent] = (),
    *,
    flow: FlowSettings | None = None,
    straightening: str = "off",
    progress: Callable[[int, int], None] | None = None,
    checkpoint: Checkpoint | None = None,
) -> Uncertainty:
    """Repeat a deployment with its causes varied: artery, position of the middle row, size and numbers of the device.

    The same `coils` that it keeps in the sac are placed behind every sample, each time with another seed. The artery
    yields to the devices as `straightening` states (`straighten`), off: it is rigid.

    The first ``ranges.flow_samples`` samples are computed with a flow of these settings and stored in `checkpoint`, so
    that an interrupted study resumes after the last of them. `progress` is called with the number of finished samples
    and the number of all. An InputError says that the range of the threshold would close the artery, or that of the
    device is too large for its diameter.
    """
    spread, numbers = ranges.of(anatomy), ranges.numbers_of(deployment.stent.design)
    yields = (STIFFNESS,) if straightening in SETTINGS else ()
    points = centered_points(len(CAUSES) + len(numbers) + len(yields), ranges.samples)
    if 2 * spread[0] > anatomy.parent.section_radius_mm.min():
        raise InputError(
            f"diameters that vary by {spread[0]:.2g} mm would close the artery: give a smaller range of the threshold"
        )
    free_mm = deployment.stent.size.free_diameter_mm
    if ranges.device_mm >= WIDEST_FRACTION * free_mm:
        raise InputError(
            f"a device with a free diameter of {free_mm:.2f} mm is not made {ranges.device_mm:g} mm wider or "
            f"narrower: give a range below {WIDEST_FRACTION * free_mm:.2f} mm"
        )

    def sample(number: int, wanted: FlowSettings | None) -> dict[str, float]:
        offset, at, place = np.split(points[number], [len(CAUSES), len(CAUSES) + len(numbers)])
        how, made = (straightening, float(place.sum())), values_at(numbers, at)
        again = [replace(one, seed=one.seed + number) for one in coils if isinstance(one, Coils)]
        return _sample(anatomy, deployment.stent, offset * spread, made, again, wanted, how)

    names, values = _results(sample, len(points), ranges, flow, progress, checkpoint)
    half = [*(0.5 * (one.high - one.low) for one in numbers), *(1.0 for _ in yields)]
    told = *(one.name for one in numbers), *yields
    plane = anatomy.aneurysms[0].plane if anatomy.aneurysms else None
    neck_mm2 = None if plane is None else (plane.area_mm2, *plane.area_band_mm2)
    return Uncertainty(np.append(spread, half), points, names, values, told, neck_mm2)


def vary_seeds(
    anatomy: Anatomy,
    coils: Coils,
    ranges: Ranges,
    *,
    flow: FlowSettings | None = None,
    progress: Callable[[int, int], None] | None = None,
    checkpoint: Checkpoint | None = None,
) -> Uncertainty:
    """Place the same coils with other seeds; all else is as in `vary`, and nothing else varies."""

    @cache
    def bare(settings: FlowSettings) -> FlowField:
        return simulate_case(flow_case(anatomy, (), settings))

    def sample(number: int, wanted: FlowSettings | None) -> dict[str, float]:
        placed = deploy_coils(coils.design.key, anatomy, coils.coils, seed=coils.seed + number)
        found = _found(anatomy, placed)
        if wanted is None:
            return found
        changes = ratios(*_flows(anatomy, [placed], wanted, bare(wanted)))
        return found | {name: changes[name] for name in FLOW_RESULTS if name in changes}

    names, values = _results(sample, ranges.samples, ranges, flow, progress, checkpoint)
    return Uncertainty(np.zeros(len(CAUSES)), np.zeros((len(values), len(CAUSES))), names, values)


def _results(
    sample: Callable[[int, FlowSettings | None], dict[str, float]],
    count: int,
    ranges: Ranges,
    flow: FlowSettings | None,
    progress: Callable[[int, int], None] | None,
    checkpoint: Checkpoint | None,
) -> tuple[tuple[str, ...], Floats]:
    """Return the names (k) and values (n, k) of the results of samples; those with a flow are stored."""
    rows: list[Mapping[str, Floats]] = []
    for number in range(count):
        wanted = flow if number < ranges.flow_samples else None
        store = checkpoint if wanted is not None else None  # others are computed faster than they are read back
        stored = None if store is None else store.load(f"sample-{number}")
        if stored is None:
            stored = {result: np.array(value) for result, value in sample(number, wanted).items()}
            if store is not None:
                store.save(f"sample-{number}", stored)
        rows.append(stored)
        if progress is not None:
            progress(number + 1, count)
    of_effects = (f"{effect}{name}" for name in OF_EFFECTS for effect in EFFECTS)
    known = *RESULTS, *COIL_RESULTS, *STRAIGHTENED, *FLOW_RESULTS, *of_effects
    names = tuple(name for name in known if any(name in row for row in rows))
    values = np.array([[row.get(name, np.nan) for name in names] for row in rows], dtype=np.float64)
    return names, values.reshape(count, len(names))


def made_wider(design: Design, size: Size, by_mm: float) -> Size:
    """Return a size made wider by `by_mm`, in mm, with the same number of pieces, each longer in proportion."""
    factor = 1 + by_mm / size.free_diameter_mm
    return replace(
        size,
        diameter_mm=size.diameter_mm * factor,
        length_mm=size.length_mm * factor,
        free_diameter_mm=size.free_diameter_mm * factor,
        free_profile_mm=tuple((where, diameter_mm * factor) for where, diameter_mm in size.free_profile_mm),
    )


def _sample(
    anatomy: Anatomy,
    stent: Stent,
    offset: Floats,
    made: Mapping[str, float],
    coils: Sequence[Coils],
    flow: FlowSettings | None,
    how: tuple[str, float],
) -> dict[str, float]:
    """Return the results with causes changed by `offset` (4,) and numbers `made`; empty if a device does not fit.

    `how` states how the artery yields: `setting` and `place` of `straighten`.
    """
    diameter_mm, along_mm, wider_mm, inflow_fraction = (float(value) for value in offset)
    other = widened(anatomy, diameter_mm) if diameter_mm else anatomy
    try:
        design, size = altered(stent.design, stent.size, made)
        size = made_wider(design, size, wider_mm)
        placed = [deploy(design, other, size=size, landing=Landing(stent.middle_abscissa_mm + along_mm))]
        inside = [placed[0].stent]
        placed += [deploy_coils(one.design.key, other, one.coils, inside=inside, seed=one.seed) for one in coils]
    except (DeviceError, LandingError):
        return {}
    found = {name: value for one in placed for name, value in _found(other, one).items()}
    yielded: Straightening | None = None
    if how[0] != "off":
        with suppress(InputError):  # such as an angle that this artery does not reach
            yielded = straighten(other, placed, *how)
            found |= {name: yielded.metrics()[name] for name in STRAIGHTENED}
    if flow is None or not other.aneurysms:
        return found
    inflow_mL_s = flow_case(anatomy, (), flow).inflow_mL_s * (1 + inflow_fraction)
    flow = replace(flow, inflow_mL_s=inflow_mL_s, inlet_speed_m_s=None)
    bare, after = _flows(other, placed, flow)
    changes = ratios(bare, after)
    found |= {name: changes[name] for name in FLOW_RESULTS if name in changes}
    if yielded is not None:
        for effect, one in zip(EFFECTS, _flows(yielded.anatomy, yielded.deployed, flow), strict=True):
            changes = ratios(bare, one)
            found |= {f"{effect}{name}": changes[name] for name in OF_EFFECTS if name in changes}
    return found


def _found(anatomy: Anatomy, placed: Deployment) -> dict[str, float]:
    """Return the measures of a deployment for which intervals are computed."""
    measures, names = measure(anatomy, placed), COIL_RESULTS if isinstance(placed.stent, Coils) else RESULTS
    return {name: float(measures[name]) for name in names if name in measures}


def _flows(
    anatomy: Anatomy, placed: Sequence[Deployment], flow: FlowSettings, bare: FlowField | None = None
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the indices of the flow without devices, which is computed where it is not given, and with them."""
    shapes, stents = sac_surfaces(anatomy), [one.stent for one in placed]
    bare = bare or simulate_case(flow_case(anatomy, (), flow))
    after = indices(simulate_case(flow_case(anatomy, stents, flow), start=bare), *shapes)
    density = sum(one.density_fraction for one in stents if isinstance(one, Coils))
    after = after if flow.numerics.wires == "resolved" else between_coils(after, 1.0 - density)
    return indices(bare, *shapes), after
