"""Sensitivity of the results to grid spacing, time step and position on the grid, from three computations of each."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from vstent.flow.case import FlowCase, FlowField
from vstent.flow.domain import default_cell_size_mm
from vstent.flow.indices import QUANTITIES, indices
from vstent.flow.positions import POSITIONS, Scatter, scatter, turned
from vstent.flow.settings import Numerics
from vstent.flow.simulation import engine_class, simulate_case

RATIO: Final = 2**0.5
"""Refinement ratio from one grid spacing, or time step, to the next."""
TOLERANCE: Final = 0.002
"""Convergence tolerance of every run in the study: small enough not to hide the differences between grids."""
SAFETY: Final = 1.25
"""Safety factor on the difference to the extrapolated value (Roache 1994, J. Fluids Eng. 116, 405, for three grids)."""
ORDERS: Final = (0.5, 2.0)
"""Lower and upper bound of the order used for extrapolation. An observed order outside is replaced by the nearer
bound, because an order above that of the scheme is a coincidence (Celik et al. 2008, J. Fluids Eng. 130, 078001)."""


@dataclass(frozen=True)
class Convergence:
    """One quantity computed on three grids, or with three time steps."""

    values: tuple[float, float, float]
    """Values from the coarsest to the finest."""
    order: float | None
    """Observed order of convergence; None where the three values are not monotonic."""
    extrapolated: float | None
    """Value extrapolated to size zero (Richardson 1911, Phil. Trans. A 210, 307); None without an order."""
    uncertainty_fraction: float
    """Estimated error of the finest value, as a fraction of it (grid convergence index; Roache 1994)."""


@dataclass(frozen=True)
class Refinement:
    """Results of refining one setting twice."""

    name: str
    """Name of the setting: ``cell_size_mm``, or ``lattice_speed`` (proportional to the time step)."""
    sizes: tuple[float, float, float]
    """Values of the setting from the coarsest to the finest."""
    quantities: dict[str, Convergence]
    """Convergence of each index, by its name."""


@dataclass(frozen=True)
class Sensitivity:
    """Dependence of the results on numerical settings."""

    refinements: tuple[Refinement, ...]
    """Refinement of the grid spacing first, then of the engine's other settings."""
    positions: dict[str, Scatter]
    """Scatter of each index, by its name, when the vessel is rotated on the grid."""


def observed(values: tuple[float, float, float], ratio: float = RATIO) -> Convergence:
    """Return observed order, extrapolated value and uncertainty from three values.

    Parameters
    ----------
    values : values from the coarsest to the finest grid.
    ratio : refinement ratio between consecutive grids.
    """
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
    """Compute a flow with three grid spacings, three values of every other numerical setting, and in three positions.

    All runs but those with another grid spacing use the middle one.

    Parameters
    ----------
    case : the flow; its grid spacing is the finest.
    folder : folder for files of the engine, with a subfolder for every run.
    told : called after every run with the completed fraction of the study and a sentence on the run.

    Raises
    ------
    FlowError
        A flow cannot be computed.
    """
    cell_size, *others = engine_class(case.numerics, is_pulsatile=case.waveform is not None).refined_by
    runs = _Runs(case, folder, told, 3 + 2 * len(others) + len(POSITIONS) - 1, [])
    given = case.numerics
    numerics = replace(
        given, tolerance=min(TOLERANCE, given.tolerance), cycle_tolerance=min(TOLERANCE, given.cycle_tolerance)
    )
    grids = runs.refine(cell_size, RATIO**2 * default_cell_size_mm(case), numerics, None)
    middle, known = replace(numerics, cell_size_mm=grids.sizes[1]), runs.done[1]
    further = (runs.refine(name, getattr(numerics, name), middle, known) for name in others)
    return Sensitivity((grids, *further), runs.turn(middle, known))


@dataclass(frozen=True, eq=False)
class _Runs:
    """All runs of one case, and a record of those that are done."""

    case: FlowCase
    folder: Path | None
    told: Callable[[float, str], None]
    count: int
    """Total number of runs planned."""
    done: list[FlowField]

    def refine(self, name: str, coarsest: float, numerics: Numerics, known: FlowField | None) -> Refinement:
        """Compute the flow with a setting at three sizes; `known` is the flow at the coarsest size, if available."""
        sizes = (coarsest, coarsest / RATIO, coarsest / RATIO**2)
        fields = [] if known is None else [known]
        for size in sizes[len(fields) :]:
            start = fields[-1] if fields else None
            case = replace(self.case, numerics=_changed(numerics, name, size))
            fields.append(self._flow(case, f"{name}-{size:.4g}", start))
        return Refinement(name, sizes, _compared(self.case, fields))

    def turn(self, numerics: Numerics, known: FlowField) -> dict[str, Scatter]:
        """Compute the flow with the vessel rotated on the grid; `known` is the flow in the original position."""
        case = replace(self.case, numerics=numerics)
        found = [indices(known, case.sac, case.ostium)]
        for name, turn in list(POSITIONS.items())[1:]:
            lying = turned(case, turn)
            found.append(indices(self._flow(lying, name.replace(" ", "-"), None), lying.sac, lying.ostium))
        return {key: scatter(tuple(float(one[key]) for one in found)) for key in QUANTITIES if key in found[0]}

    def _flow(self, case: FlowCase, name: str, start: FlowField | None) -> FlowField:
        """Compute one flow, record it and report it."""
        own = None if self.folder is None else self.folder / name
        # With media, `start` would be taken for the flow without a device.
        field = simulate_case(case, start=start if not case.media else None, folder=own)
        self.done.append(field)
        said = f"{name}: {len(field.centers_mm)} cells, {field.steps} time steps, run time {field.seconds:.0f} s."
        self.told(len(self.done) / self.count, said)
        return field


def _changed(numerics: Numerics, name: str, size: float) -> Numerics:
    """Return the settings with one of them set to `size`."""
    values: dict[str, Any] = {name: size}
    return replace(numerics, **values)


def _compared(case: FlowCase, fields: list[FlowField]) -> dict[str, Convergence]:
    """Return the convergence of every index from three fields, coarse to fine."""
    coarse, middle, fine = (indices(field, case.sac, case.ostium) for field in fields)
    keys = [key for key in QUANTITIES if key in fine]
    return {key: observed((float(coarse[key]), float(middle[key]), float(fine[key]))) for key in keys}
