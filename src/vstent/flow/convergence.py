"""Sensitivity of the results to grid spacing, time step and position on the grid, from three computations of each."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from vstent.flow.case import FlowCase, FlowField
from vstent.flow.domain import default_cell_size_mm
from vstent.flow.indices import QUANTITIES, indices
from vstent.flow.settings import Numerics
from vstent.flow.simulation import engine_class, simulate_case
from vstent.geometry.surface import Surface

RATIO: Final = 2**0.5
"""Refinement ratio from one grid spacing, or time step, to the next."""
TOLERANCE: Final = 0.002
"""Convergence tolerance of every run in the study: small enough not to hide the differences between grids."""
SAFETY: Final = 1.25
"""Safety factor on the difference to the extrapolated value (Roache 1994, J. Fluids Eng. 116, 405, for three grids)."""
ORDERS: Final = (0.5, 2.0)
"""Lower and upper bound of the order used for extrapolation. An observed order outside is replaced by the nearer
bound, because an order above that of the scheme is a coincidence (Celik et al. 2008, J. Fluids Eng. 130, 078001)."""
POSITIONS: Final = {
    "as given": Rotation.identity(),
    "45 deg about x": Rotation.from_euler("x", 45, degrees=True),
    "45 deg about y": Rotation.from_euler("y", 45, degrees=True),
}
"""Rotations of the vessel by name; a bend along two of the grid's axes is diagonal to them in another position."""


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
class Scatter:
    """One quantity of the same flow in every position."""

    values: tuple[float, ...]
    """Values in the order of `POSITIONS`."""
    mean: float
    """Mean over all positions."""
    uncertainty_fraction: float
    """Half the range, as a fraction of the mean."""


@dataclass(frozen=True)
class Sensitivity:
    """Dependence of the results on numerical settings."""

    refinements: tuple[Refinement, ...]
    """Refinement of the grid spacing first, then of the engine's other settings."""
    positions: dict[str, Scatter]
    """Scatter of each index, by its name, when the vessel is rotated on the grid."""


def observed(values: tuple[float, float, float]) -> Convergence:
    """Return observed order, extrapolated value and uncertainty from three values, coarsest grid to finest."""
    coarse, middle, fine = values
    before, last = middle - coarse, fine - middle
    scale = max(abs(fine), 1e-300)
    if before * last <= 0:
        return Convergence(values, None, None, SAFETY * float(np.ptp(values)) / scale)
    order = float(np.log(before / last) / np.log(RATIO))
    error = last / (RATIO ** float(np.clip(order, *ORDERS)) - 1)
    return Convergence(values, order, fine + error, SAFETY * abs(error) / scale)


def scatter(values: tuple[float, ...]) -> Scatter:
    """Return the mean and half the range of a quantity over all positions."""
    mean = float(np.mean(values))
    return Scatter(values, mean, float(np.ptp(values)) / 2 / max(abs(mean), 1e-300))


def turned(case: FlowCase, turn: Rotation) -> FlowCase:
    """Return a case rotated about the origin with everything in it: the same flow on a different grid."""
    matrix, vessel, target = turn.as_matrix(), case.vessel, case.target

    def surface(one: Surface) -> Surface:
        return Surface(one.vertices_mm @ matrix.T, one.faces)

    def points(one: Any, *names: str) -> Any:
        return replace(one, **{name: getattr(one, name) @ matrix.T for name in names})

    return replace(
        case,
        vessel=replace(
            vessel,
            lumen=surface(vessel.lumen),
            openings=tuple(
                replace(one, center_mm=matrix @ one.center_mm, normal=matrix @ one.normal) for one in vessel.openings
            ),
            centerlines=tuple(points(line, "points_mm") for line in vessel.centerlines),
        ),
        target=target and replace(target, sac=surface(target.sac), ostium=target.ostium and surface(target.ostium)),
        media=tuple(points(one, "points_mm", "normals") for one in case.media),
        solids=tuple(points(one, "nodes_mm", "wire_points_mm") for one in case.solids),
    )


def convergence(
    case: FlowCase, *, folder: Path | None = None, told: Callable[[float, str], None] = lambda fraction, sentence: None
) -> Sensitivity:
    """Compute a flow with three grid spacings, three values of every other numerical setting, and in three positions.

    The grid spacing of the case is the finest. All runs but those with another grid spacing use the middle one. Every
    run has a subfolder for files of the engine. `told` is called after it with the completed fraction of the study and
    a sentence on the run.
    """
    cell_size, *others = engine_class(case.numerics, is_pulsatile=case.waveform is not None).refined_by
    given, done = case.numerics, 0
    numerics = replace(
        given, tolerance=min(TOLERANCE, given.tolerance), cycle_tolerance=min(TOLERANCE, given.cycle_tolerance)
    )

    def computed(case: FlowCase, name: str, start: FlowField | None = None) -> FlowField:
        nonlocal done
        own = None if folder is None else folder / name
        # With media, `start` would be taken for the flow without a device.
        field = simulate_case(case, start=start if not case.media else None, folder=own)
        done += 1
        said = f"{name}: {len(field.centers_mm)} cells, {field.steps} time steps, run time {field.seconds:.0f} s."
        told(done / (3 + 2 * len(others) + len(POSITIONS) - 1), said)
        return field

    def refined(name: str, coarsest: float, numerics: Numerics, fields: list[FlowField]) -> Refinement:
        """Compute a setting at three sizes; `fields` may have the flow at the coarsest, and gets the others."""
        sizes = (coarsest, coarsest / RATIO, coarsest / RATIO**2)
        for size in sizes[len(fields) :]:
            changed: dict[str, Any] = {name: size}
            refined_case = replace(case, numerics=replace(numerics, **changed))
            fields.append(computed(refined_case, f"{name}-{size:.4g}", fields[-1] if fields else None))
        coarse, middle, fine = (indices(field, case.sac, case.ostium) for field in fields)
        keys = [key for key in QUANTITIES if key in fine]
        values = {key: (float(coarse[key]), float(middle[key]), float(fine[key])) for key in keys}
        return Refinement(name, sizes, {key: observed(three) for key, three in values.items()})

    by_grid: list[FlowField] = []
    refinements = [refined(cell_size, RATIO**2 * default_cell_size_mm(case), numerics, by_grid)]
    numerics = replace(numerics, cell_size_mm=refinements[0].sizes[1])
    refinements += [refined(name, getattr(numerics, name), numerics, [by_grid[1]]) for name in others]
    in_positions = [indices(by_grid[1], case.sac, case.ostium)]
    for name, turn in list(POSITIONS.items())[1:]:
        rotated = turned(replace(case, numerics=numerics), turn)
        in_positions.append(indices(computed(rotated, name.replace(" ", "-")), rotated.sac, rotated.ostium))
    values = {key: tuple(float(one[key]) for one in in_positions) for key in QUANTITIES if key in in_positions[0]}
    return Sensitivity(tuple(refinements), {key: scatter(of_key) for key, of_key in values.items()})
