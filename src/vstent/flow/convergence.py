"""How much a flow's numbers depend on the grid and on the time step: three of each, observed order, extrapolation."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from vstent.flow import simulate_case
from vstent.flow.domain import default_cell_size_mm
from vstent.flow.indices import indices
from vstent.flow.types import FlowCase, FlowField

RATIO: Final = 2**0.5
"""From one grid, or time step, to the next finer one."""
TOLERANCE: Final = 0.002
"""Flows settle to within this, so that the grid's part of a difference is not hidden."""
QUANTITIES: Final = (
    "neck_inflow_mL_s",
    "mean_sac_velocity_m_s",
    "mean_sac_wss_Pa",
    "mean_wss_Pa",
    "pressure_drop_Pa",
)
"""Indices that are followed, as far as the vessel has them."""
SAFETY: Final = 1.25
"""Factor on the difference to the extrapolated value (Roache 1994, J. Fluids Eng. 116, 405: three grids)."""
ORDERS: Final = (0.5, 2.0)
"""Observed orders outside are drawn to the nearer of these when extrapolating (as Celik et al. 2008 advise, J. Fluids
Eng. 130, 078001): an order above the scheme's own is chance."""


@dataclass(frozen=True)
class Convergence:
    """One quantity on three grids, or with three time steps."""

    values: tuple[float, float, float]
    """From coarse to fine."""
    order: float | None
    """Observed order; None where the three values do not go one way."""
    extrapolated: float | None
    """Value at size zero (Richardson 1911, Phil. Trans. A 210, 307); None without an order."""
    uncertainty_fraction: float
    """Estimated error of the finest value, as a fraction of it (grid convergence index; Roache 1994)."""


@dataclass(frozen=True)
class Refinement:
    """One size made smaller twice."""

    name: str
    """``cell_size_mm``, or ``lattice_speed`` (proportional to the time step)."""
    sizes: tuple[float, float, float]
    """From coarse to fine."""
    quantities: dict[str, Convergence]
    """By the name of the index."""


def observed(values: tuple[float, float, float], ratio: float = RATIO) -> Convergence:
    """Order, extrapolated value and uncertainty from values on three grids, each `ratio` finer than the one before."""
    coarse, middle, fine = values
    before, last = middle - coarse, fine - middle
    scale = max(abs(fine), 1e-300)
    if before * last <= 0:
        return Convergence(values, None, None, SAFETY * float(np.ptp(values)) / scale)
    order = float(np.log(before / last) / np.log(ratio))
    kept = float(np.clip(order, *ORDERS))
    error = last / (ratio**kept - 1)
    return Convergence(values, order, fine + error, SAFETY * abs(error) / scale)


def convergence(
    case: FlowCase, *, told: Callable[[str], None] = lambda sentence: None
) -> tuple[Refinement, Refinement]:
    """Compute a flow on three grids and, on the middle one, with three time steps.

    Parameters
    ----------
    case : its cell size is the finest.
    told : told of every flow computed.

    Raises
    ------
    FlowError
        When a flow cannot be computed.
    """
    finest_mm, speed = default_cell_size_mm(case), case.settings.lattice_speed
    sizes_mm = (finest_mm * RATIO**2, finest_mm * RATIO, finest_mm)
    speeds = (speed, speed / RATIO, speed / RATIO**2)
    fields: list[FlowField] = []
    for size_mm in sizes_mm:
        fields.append(_flow(case, size_mm, speed, fields[-1] if fields else None))
        told(f"{len(fields[-1].cells)} cells of {size_mm:.3g} mm in {fields[-1].seconds:.0f} s.")
    slower = [fields[1]]
    for lattice_speed in speeds[1:]:
        slower.append(_flow(case, sizes_mm[1], lattice_speed, fields[1]))
        told(f"{slower[-1].steps} time steps at lattice speed {lattice_speed:.3g} in {slower[-1].seconds:.0f} s.")
    return (
        Refinement("cell_size_mm", sizes_mm, _compared(case, fields)),
        Refinement("lattice_speed", speeds, _compared(case, slower)),
    )


def _flow(case: FlowCase, cell_size_mm: float, lattice_speed: float, start: FlowField | None) -> FlowField:
    changed = replace(
        case.settings,
        cell_size_mm=cell_size_mm,
        lattice_speed=lattice_speed,
        tolerance=min(TOLERANCE, case.settings.tolerance),
    )
    # A stented flow takes its start for the bare one.
    return simulate_case(replace(case, settings=changed), start=start if case.screen is None else None)


def _compared(case: FlowCase, fields: list[FlowField]) -> dict[str, Convergence]:
    coarse, middle, fine = (indices(field, case.sac, case.ostium) for field in fields)
    keys = [key for key in QUANTITIES if key in fine]
    return {key: observed((float(coarse[key]), float(middle[key]), float(fine[key]))) for key in keys}
