"""How much a flow's numbers depend on the grid, on the time step and on how the vessel lies: three of each."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from vstent.flow.case import FlowCase, FlowField, FlowSettings
from vstent.flow.domain import default_cell_size_mm
from vstent.flow.indices import QUANTITIES, indices
from vstent.flow.positions import POSITIONS, Scatter, scatter, turned
from vstent.flow.simulation import engine_class, simulate_case

RATIO: Final = 2**0.5
"""From one grid, or time step, to the next finer one."""
TOLERANCE: Final = 0.002
"""Flows settle to within this, so that the grid's part of a difference is not hidden."""
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


@dataclass(frozen=True)
class Sensitivity:
    """What a flow's numbers depend on that is not physics."""

    refinements: tuple[Refinement, ...]
    """The cells first, then what else the engine can make smaller."""
    positions: dict[str, Scatter]
    """The same flow with the vessel lying otherwise on the grid, by the name of the index."""


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
    case: FlowCase,
    *,
    folder: Path | None = None,
    told: Callable[[float, str], None] = lambda fraction, sentence: None,
) -> Sensitivity:
    """Compute a flow on three grids; on the middle one, with all other sizes made smaller twice and in other positions.

    Parameters
    ----------
    case : its cell size is the finest.
    folder : where the engine may keep files of its own, a folder in it for every flow.
    told : told of every flow computed, with the fraction of all that is done.

    Raises
    ------
    FlowError
        When a flow cannot be computed.
    """
    cell_size, *others = engine_class(case.settings).refined_by
    runs = _Runs(case, folder, told, 3 + 2 * len(others) + len(POSITIONS) - 1, [])
    given = case.settings
    settings = replace(
        given, tolerance=min(TOLERANCE, given.tolerance), cycle_tolerance=min(TOLERANCE, given.cycle_tolerance)
    )
    grids = runs.refine(cell_size, RATIO**2 * default_cell_size_mm(case), settings, None)
    middle, known = replace(settings, cell_size_mm=grids.sizes[1]), runs.done[1]
    further = (runs.refine(name, getattr(settings, name), middle, known) for name in others)
    return Sensitivity((grids, *further), runs.turn(middle, known))


@dataclass(frozen=True, eq=False)
class _Runs:
    """All flows of one case."""

    case: FlowCase
    folder: Path | None
    told: Callable[[float, str], None]
    count: int
    """Flows that there will be."""
    done: list[FlowField]

    def refine(self, name: str, coarsest: float, settings: FlowSettings, known: FlowField | None) -> Refinement:
        """Make one setting smaller twice; `known` is the flow with the coarsest, where there is one already."""
        sizes = (coarsest, coarsest / RATIO, coarsest / RATIO**2)
        fields = [] if known is None else [known]
        for size in sizes[len(fields) :]:
            start = fields[-1] if fields else None
            case = replace(self.case, settings=_changed(settings, name, size))
            fields.append(self._flow(case, f"{name}-{size:.4g}", start))
        return Refinement(name, sizes, _compared(self.case, fields))

    def turn(self, settings: FlowSettings, known: FlowField) -> dict[str, Scatter]:
        """Lay the vessel on the grid in other ways; `known` is the flow as it lies."""
        case = replace(self.case, settings=settings)
        found = [indices(known, case.sac, case.ostium)]
        for name, turn in list(POSITIONS.items())[1:]:
            lying = turned(case, turn)
            found.append(indices(self._flow(lying, name.replace(" ", "-"), None), lying.sac, lying.ostium))
        return {key: scatter(tuple(float(one[key]) for one in found)) for key in QUANTITIES if key in found[0]}

    def _flow(self, case: FlowCase, name: str, start: FlowField | None) -> FlowField:
        own = None if self.folder is None else self.folder / name
        # A stented flow takes its start for the bare one.
        field = simulate_case(case, start=start if case.screen is None else None, folder=own)
        self.done.append(field)
        said = f"{name}: {len(field.cells)} cells, {field.steps} steps in {field.seconds:.0f} s."
        self.told(len(self.done) / self.count, said)
        return field


def _changed(settings: FlowSettings, name: str, size: float) -> FlowSettings:
    values: dict[str, Any] = {name: size}
    return replace(settings, **values)


def _compared(case: FlowCase, fields: list[FlowField]) -> dict[str, Convergence]:
    coarse, middle, fine = (indices(field, case.sac, case.ostium) for field in fields)
    keys = [key for key in QUANTITIES if key in fine]
    return {key: observed((float(coarse[key]), float(middle[key]), float(fine[key]))) for key in keys}
