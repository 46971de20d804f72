"""Compute an angiogram: carry an injection through a flow, and measure how it fills and leaves the sac."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vstent.anatomy.landing_zones import neck_span_mm
from vstent.angiography.bolus import Bolus, OverTime
from vstent.angiography.curves import Curves
from vstent.angiography.grid import Grid, grid_of
from vstent.angiography.network import Network, period_s
from vstent.angiography.transport import Frame, Transport
from vstent.angiography.view import check_range
from vstent.angiography.washout import MOMENTS_S, STAYED, Washout, wash_out
from vstent.errors import FlowError, InputError
from vstent.flow.case import FlowCase, FlowField
from vstent.flow.indices import on_sac, vertex_areas_mm2
from vstent.flow.memory import free_memory_bytes
from vstent.flow.problem import flow_case
from vstent.geometry.vessel import Anatomy
from vstent.kernels.arrays import Bools, Floats, Ints

BYTES_PER_CELL: Final = 1200
"""Peak memory per cell of the flow, in bytes."""
BYTES_PER_PHASE_AND_CELL: Final = 60
"""Memory per stored phase of a pulsatile flow and cell, in bytes: three faces a cell, twice while blocks are formed."""
PREVIEW_ERROR: Final = 0.084
"""Largest measured error of the retention of a preview, as a fraction: demo without a device at 0.28 mm."""
OF_PREVIEW: Final = (
    "the grid is twice as coarse; measured errors on the demo are -2 to +8 % (retention), -12 to +4 % (mean transit) "
    "and -7 to -27 % (mean age)."
)
"""Sentence on the errors of a preview: demo at 0.28 mm without a device, with Silk and with Enterprise."""
MOST_WASHOUT_S: Final = 20.0
"""Longest washout that is marched, in s."""

Watch = Callable[[Floats, Floats], Callable[[float, NDArray[np.float32]], None]]
"""Takes the cell centers (n, 3) in mm (LPS) and their edges (n,) in mm; returns a function that is called with the time
in s and the iodine concentration (n,) in mg/mL of every frame."""


@dataclass(frozen=True)
class AngiogramSettings:
    """Settings of an angiogram."""

    bolus: Bolus = field(default_factory=Bolus)
    """The injection."""
    window_s: float = 6.0
    """Time that is computed, from the start of the injection."""
    frames_per_s: float = 15.0
    """Frames per second."""
    diffusivity_mm2_s: float = 4e-4
    """Molecular diffusivity of the agent in blood; iohexol in water: 4e-10 m2/s in order of magnitude."""
    is_preview: bool = False
    """Whether the grid is twice as coarse, about ten times faster."""

    def __post_init__(self) -> None:
        """Raise InputError where a value cannot be used."""
        check_range("window", self.window_s, 0.1, 120, "s")
        check_range("frame rate", self.frames_per_s, 0.5, 120, "per second")
        check_range("diffusivity", self.diffusivity_mm2_s, 0, 1, "mm2/s")


@dataclass(frozen=True, eq=False)
class Angiogram:
    """Result of an angiogram."""

    curves: Curves
    """Time-density curves."""
    measures: dict[str, float]
    """Times, volumes and areas; the end of each key is its unit."""
    advice: str
    """Sentences on the grid and on what the window did not reach."""


@dataclass(frozen=True, eq=False)
class Injection:
    """An injection into a flow, ready to be marched: the grid and its frames."""

    grid: Grid
    """Cells and flow rates."""
    transport: Transport
    """The concentration."""
    settings: AngiogramSettings
    """Settings."""

    def frames(self) -> Iterator[Frame]:
        """March once, and yield time in s since the start of the waveform and iodine in mg/mL (n,) of every frame."""
        settings = self.settings
        return self.transport.frames(1 / settings.frames_per_s, settings.bolus.begin_s + settings.window_s)


def n_cells(field: FlowField) -> int:
    """Return the number of cells of a flow on one grid with its finest spacing."""
    return round(float(((field.sizes_mm / field.finest.cell_size_mm) ** 3).sum()))


def memory_bytes(field: FlowField) -> float:
    """Return the peak memory of an angiogram in bytes, beyond that of the flow."""
    return (BYTES_PER_CELL + BYTES_PER_PHASE_AND_CELL * len(field.phases)) * float(n_cells(field))


def entering(bolus: Bolus, field: FlowField) -> tuple[OverTime, float]:
    """Return the iodine concentration in mg/mL of the blood that enters a flow, over time in s, and its maximum."""
    if len(field.phases) < 2:
        return bolus.inflow([field.inflow_mL_s])
    times = [phase.time_s for phase in field.phases]
    return bolus.inflow([phase.inflow_mL_s for phase in field.phases], times, period_s(field))


def injection(case: FlowCase, field: FlowField, settings: AngiogramSettings) -> Injection:
    """Prepare an injection into a flow; one that does not fit in the free memory is refused."""
    need_bytes = memory_bytes(field)
    if need_bytes > free_memory_bytes():
        raise FlowError(
            f"an angiogram on {n_cells(field):,} cells needs {need_bytes / 1e9:.2g} GB of memory, more than is free: "
            "compute the flow with a wider grid spacing"
        )
    grid = grid_of(case, field, is_preview=settings.is_preview)
    inflow, most = entering(settings.bolus, field)
    march = Transport(grid.network, diffusivity_mm2_s=settings.diffusivity_mm2_s, inflow=inflow, upper=most)
    return Injection(grid, march, settings)


def angiogram(
    anatomy: Anatomy,
    field: FlowField,
    settings: AngiogramSettings | None = None,
    *,
    watch: Watch | None = None,
    progress: Callable[[float], None] | None = None,
) -> Angiogram:
    """Carry an injection of contrast through a flow, and measure how it fills and leaves the sac.

    Parameters
    ----------
    anatomy : Anatomy
        The patient's vessel and aneurysms.
    field : FlowField
        Flow without or with a device, steady or pulsatile.
    settings : AngiogramSettings, optional
        Injection, window and frame rate.
    watch : callable, optional
        Takes the cell centers and edges and returns a function that is called with every frame (see `Watch`).
    progress : callable, optional
        Called with the finished fraction.

    Raises
    ------
    InputError
        The window is too short for contrast to reach the sac.
    FlowError
        The flow does not fit in the free memory, or its flow rates cannot be balanced.
    """
    settings = settings or AngiogramSettings()
    case = flow_case(anatomy, ())
    tell = progress or (lambda _: None)
    ready = injection(case, field, settings)
    share = 1.0 if case.sac is None else 0.6
    curves = _curves(ready, anatomy, watch, lambda part: tell(share * part))
    measures = curves.measures()
    if not measures:
        raise InputError(
            f"no contrast reaches the {'vessel' if case.sac is None else 'sac'} within {settings.window_s:g} s: give a "
            "longer window"
        )
    measures |= {"contrast_balance_error_fraction": ready.transport.balance().error_fraction}
    if settings.is_preview:
        measures = {"contrast_preview_error_fraction": PREVIEW_ERROR} | measures
    network = ready.grid.network
    widths = " and ".join(f"{width:.3g}" for width in np.unique(network.width) * network.spacing_mm)
    said = (
        f"{len(network.cells):,} cells, grid spacing {widths} mm, fastest step "
        f"{1e3 * ready.transport.fastest_s:.2g} ms, memory {memory_bytes(field) / 1e9:.2g} GB; "
        f"the flow rates were corrected by {network.correction_fraction:.1%}."
    )
    if settings.is_preview:
        said = f"Preview: {OF_PREVIEW} {said}"
    if "washout_half_life_s" not in measures:
        said += (
            f" The sac keeps more than half of its peak to the end of the {settings.window_s:g} s: a longer window is "
            "needed for half-life and retention."
        )
    if case.sac is None:
        return Angiogram(curves, measures, said)
    near, in_sac = ready.grid.near
    washout = wash_out(
        near,
        in_sac,
        end_s=MOST_WASHOUT_S,
        diffusivity_mm2_s=settings.diffusivity_mm2_s,
        told=lambda part: tell(share + (1 - share) * part),
    )
    measures |= {"mean_sac_age_s": washout.mean_age_s, "sac_age_extrapolated_fraction": washout.tail_fraction}
    if washout.tail_fraction > 0.1:
        said += f" {washout.tail_fraction:.0%} of the mean age is extrapolated from the last seconds of the washout."
    return Angiogram(curves, measures | _unexchanged(washout, near, in_sac, case), said)


def _curves(ready: Injection, anatomy: Anatomy, watch: Watch | None, tell: Callable[[float], None]) -> Curves:
    """Return the curves of an injection; `watch` sees every frame."""
    volume = ready.grid.network.volume_mm3
    parts = ready.grid.sac, _parent_cells(ready.grid, anatomy)
    weights = [volume[part] / volume[part].sum() for part in parts]
    show = None if watch is None else watch(ready.grid.network.points_mm, ready.grid.network.edge_mm)
    rows, bolus = [], ready.settings.bolus
    for time_s, values in ready.frames():
        means = [float(w @ values[part]) for w, part in zip(weights, parts, strict=True)]
        rows.append([time_s - bolus.begin_s, *means])
        if show is not None:
            show(time_s, values)
        tell(time_s / (bolus.begin_s + ready.settings.window_s))
    table = np.array(rows)
    return Curves(*table[table[:, 0] >= -1e-9].T)


def _unexchanged(washout: Washout, near: Network, in_sac: Ints, case: FlowCase) -> dict[str, float]:
    """Return the volume and wall area of the sac without exchange after 1, 2 and 5 s."""
    assert case.sac is not None
    assert case.ostium is not None
    wall, sac = case.vessel.lumen, case.sac
    mine = np.flatnonzero(on_sac(wall, sac, case.ostium))
    area_mm2 = vertex_areas_mm2(wall)[mine]
    beside = cKDTree(near.points_mm[in_sac]).query(wall.vertices_mm[mine])[1]
    weight = near.volume_mm3[in_sac] / near.volume_mm3[in_sac].sum()
    result = {}
    for moment, values in zip(MOMENTS_S, washout.stayed, strict=False):
        is_old = values > STAYED
        result[f"unexchanged_after_{moment:g}s_volume_mm3"] = float(weight[is_old].sum()) * abs(sac.volume_mm3)
        result[f"unexchanged_after_{moment:g}s_area_mm2"] = float(area_mm2[is_old[beside]].sum())
    return result


def _parent_cells(grid: Grid, anatomy: Anatomy) -> Ints:
    """Return the cells of the parent artery over one diameter proximal to the neck, or next to the inlet."""
    axis = anatomy.parent.axis
    end_mm = neck_span_mm(anatomy)[0]
    place = int(np.argmin(np.abs(axis.abscissa_mm - end_mm)))
    diameter_mm = 2 * float(axis.inscribed_radius_mm[place])
    first_mm = max(end_mm - 1.5 * diameter_mm, 0.0)
    last_mm = max(end_mm - 0.5 * diameter_mm, first_mm + 0.5 * diameter_mm)
    chosen = (axis.abscissa_mm >= first_mm) & (axis.abscissa_mm <= last_mm)
    line, radius_mm = axis.points_mm[chosen], axis.inscribed_radius_mm[chosen]
    distance_mm, nearest = cKDTree(line).query(grid.network.points_mm)
    inside: Bools = distance_mm < 0.8 * radius_mm[nearest]
    inside[grid.sac] &= not anatomy.aneurysms
    return np.flatnonzero(inside)
