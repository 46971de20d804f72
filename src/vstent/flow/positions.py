"""How much a flow's numbers depend on how the vessel lies on the grid: as it lies, and turned two ways."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from vstent.flow import simulate_case
from vstent.flow.indices import QUANTITIES, indices
from vstent.flow.types import FlowCase, FlowField
from vstent.kernels.arrays import Floats
from vstent.surface import Surface
from vstent.vessel import Vessel

POSITIONS: Final = {
    "as it lies": Rotation.identity(),
    "45 deg about x": Rotation.from_euler("x", 45, degrees=True),
    "45 deg about y": Rotation.from_euler("y", 45, degrees=True),
}
"""Turns of the vessel: a bend along two of the grid's axes lies between them in another position."""


@dataclass(frozen=True)
class Scatter:
    """One quantity of the same flow in every position."""

    values: tuple[float, ...]
    """In the order of `POSITIONS`."""
    mean: float
    """Of all positions."""
    uncertainty_fraction: float
    """Half the range, as a fraction of the mean."""


def scatter(values: tuple[float, ...]) -> Scatter:
    """Mean and half the range of a quantity in every position."""
    mean = float(np.mean(values))
    return Scatter(values, mean, float(np.ptp(values)) / 2 / max(abs(mean), 1e-300))


def positions(
    case: FlowCase,
    *,
    known: FlowField | None = None,
    folder: Path | None = None,
    told: Callable[[float, str], None] = lambda fraction, sentence: None,
) -> dict[str, Scatter]:
    """Compute a flow with the vessel in every position on the grid, and compare the indices.

    They differ by its error, which a sac beyond bends can magnify: grids that agree in one position may be wrong
    together.

    Parameters
    ----------
    case : without a stent.
    known : this flow as it lies, where it is there already.
    folder : where the engine may keep files of its own, a folder in it for every flow.
    told : told of every flow computed, with the fraction of all that is done.

    Raises
    ------
    FlowError
        When a flow cannot be computed.
    """
    found = []
    for k, (name, turn) in enumerate(POSITIONS.items()):
        lying = turned(case, turn)
        own = None if folder is None else folder / name.replace(" ", "-")
        field = known if k == 0 and known is not None else simulate_case(lying, folder=own)
        found.append(indices(field, lying.sac, lying.ostium))
        told(
            (k + 1) / len(POSITIONS), f"{name}: {len(field.cells)} cells, {field.steps} steps in {field.seconds:.0f} s."
        )
    keys = [key for key in QUANTITIES if key in found[0]]
    return {key: scatter(tuple(float(one[key]) for one in found)) for key in keys}


def turned(case: FlowCase, turn: Rotation) -> FlowCase:
    """Return a case without a stent with its vessel turned about the origin: the same flow, on other cells."""
    matrix = turn.as_matrix()
    return replace(
        case,
        vessel=_vessel(case.vessel, matrix),
        sac=None if case.sac is None else _surface(case.sac, matrix),
        ostium=None if case.ostium is None else _surface(case.ostium, matrix),
        screen=None,
        stent=None,
    )


def _vessel(vessel: Vessel, matrix: Floats) -> Vessel:
    openings = tuple(replace(o, center_mm=matrix @ o.center_mm, normal=matrix @ o.normal) for o in vessel.openings)
    lines = tuple(replace(line, points_mm=line.points_mm @ matrix.T) for line in vessel.centerlines)
    return replace(vessel, lumen=_surface(vessel.lumen, matrix), openings=openings, centerlines=lines)


def _surface(surface: Surface, matrix: Floats) -> Surface:
    return Surface(surface.vertices_mm @ matrix.T, surface.faces)
