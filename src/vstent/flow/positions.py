"""Sensitivity of the results to the vessel's position on the grid: original, and rotated in two ways."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from vstent.flow.case import FlowCase
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Vessel
from vstent.kernels.arrays import Floats

POSITIONS: Final = {
    "as given": Rotation.identity(),
    "45 deg about x": Rotation.from_euler("x", 45, degrees=True),
    "45 deg about y": Rotation.from_euler("y", 45, degrees=True),
}
"""Rotations of the vessel by name; a bend along two of the grid's axes is diagonal to them in another position."""


@dataclass(frozen=True)
class Scatter:
    """One quantity of the same flow in every position."""

    values: tuple[float, ...]
    """Values in the order of `POSITIONS`."""
    mean: float
    """Mean over all positions."""
    uncertainty_fraction: float
    """Half the range, as a fraction of the mean."""


def scatter(values: tuple[float, ...]) -> Scatter:
    """Return the mean and half the range of a quantity over all positions."""
    mean = float(np.mean(values))
    return Scatter(values, mean, float(np.ptp(values)) / 2 / max(abs(mean), 1e-300))


def turned(case: FlowCase, turn: Rotation) -> FlowCase:
    """Return a case rotated about the origin with everything in it: the same flow on a different grid."""
    matrix, target, ostium = turn.as_matrix(), case.target, case.ostium
    return replace(
        case,
        vessel=_vessel(case.vessel, matrix),
        target=target and replace(target, sac=_surface(target.sac, matrix), ostium=ostium and _surface(ostium, matrix)),
        media=tuple(
            replace(one, points_mm=one.points_mm @ matrix.T, normals=one.normals @ matrix.T) for one in case.media
        ),
        solids=tuple(
            replace(one, nodes_mm=one.nodes_mm @ matrix.T, wire_points_mm=one.wire_points_mm @ matrix.T)
            for one in case.solids
        ),
    )


def _vessel(vessel: Vessel, matrix: Floats) -> Vessel:
    """Return a rotated vessel."""
    openings = tuple(replace(o, center_mm=matrix @ o.center_mm, normal=matrix @ o.normal) for o in vessel.openings)
    lines = tuple(replace(line, points_mm=line.points_mm @ matrix.T) for line in vessel.centerlines)
    return replace(vessel, lumen=_surface(vessel.lumen, matrix), openings=openings, centerlines=lines)


def _surface(surface: Surface, matrix: Floats) -> Surface:
    """Return a rotated surface."""
    return Surface(surface.vertices_mm @ matrix.T, surface.faces)
