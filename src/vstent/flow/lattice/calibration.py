"""Calibration of a screen in place: its resistance is that of the wires themselves, in a piece of the neck.

The wires of a *tile* of the device are walls on finer levels for a few milliseconds, and the flow begins from that with
the screen. Their pores settle long before the sac does. Force and velocity normal to the device, averaged over several
pores, are then compared with those of the screen in the same flow. What the wires resist per velocity hardly depends on
the flow begun from, so that two rounds are enough.

The resistance along the device keeps its ratio to that across it. The force along a dense braid says nothing about it:
the blood nearly stands still in it, so that a sixth less resistance changes the force by 1 %.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import log
from typing import Final

import numpy as np

from vstent.deployment.struts import part_of
from vstent.flow import sampling
from vstent.flow.case import FlowCase, FlowField
from vstent.flow.domain import default_cell_size_mm
from vstent.flow.lattice import stepping
from vstent.flow.lattice.cost import memory_bytes, seconds_of
from vstent.flow.lattice.engine import LatticeBoltzmann
from vstent.flow.lattice.levels import sizes_mm
from vstent.flow.lattice.pace import longest_step_s, peak_speed_m_s
from vstent.flow.lattice.reading import forces_N
from vstent.kernels import nearby
from vstent.kernels.arrays import Floats
from vstent.kernels.curves import lengths
from vstent.units import M_PER_MM

ROUNDS: Final = 2
"""Number of times that flow and resistance are computed in turn."""
TILE_MM: Final = 1.3
"""Radius of the piece of the device whose wires are walls."""
INNER_PART: Final = 0.9
"""Least distance of its middle from the wall, over its radius or, in a narrow neck, over the largest that there is."""
REACH_MM: Final = 0.6
"""Radius of the averages, and width of the rim of the tile that is not read: wires there border on the screen."""
WIDEST_PORES_MM: Final = 0.4
"""Largest distance between wires of a screen that is calibrated: an average spans several pores."""
SETTLED: Final = 0.2
"""Time of a run, in squared wire distances over kinematic viscosity; in its second half flow and force are read. Silk
settles within 3 ms, 0.15 of that time."""
READINGS: Final = 8
"""Number of readings, between which sound fades."""
SAMPLES: Final = 20_000
"""About the largest number of samples of the screen that are used."""
RESPONSE: Final = 0.8
"""Power of the screen's resistance with which the ratio of force and velocity grows: where it is large, more blood goes
through the edge of the averages (Silk, from half to the whole 0.81, from twice to the whole 0.77)."""
LIKE_FLOW: Final = 0.9
"""Least correlation of force and velocity with which the resistance counts as known."""
MOST_APART: Final = 1.3
"""Largest ratio of what the screen and the wires resist in the last round (arc, T and tee: 1.1). Where a device is
crumpled in a narrow artery, the averages contain blood that passes beside it."""


def suits(case: FlowCase) -> bool:
    """Return whether the screen of a case can be calibrated: wires over a neck, with pores small against a tile."""
    if not case.has_screen or case.ostium is None or not case.media or not len(_samples(case)[0]):
        return False
    return all(one.normals.any() and np.median(one.spacing_mm) < WIDEST_PORES_MM for one in case.media)


def tile(case: FlowCase, center_mm: Floats) -> FlowCase:
    """Return a case in which only the wires within `TILE_MM` of a point are walls, on the same grid."""
    solids = (part_of(one, lengths(one.wire_points_mm - center_mm) < TILE_MM) for one in case.solids)
    numerics = replace(case.numerics, wires="resolved", cell_size_mm=default_cell_size_mm(case))
    return replace(case, solids=tuple(solids), numerics=numerics)


def strongest_mm(case: FlowCase, flow: FlowField) -> Floats:
    """Return the middle (3,) of the tile through which most blood passes in a flow, in the mean square.

    It keeps away from the rim of the neck, where averages span wires beside it (see `INNER_PART`).
    """
    points_mm, normals, area_mm2 = _samples(case)
    through_m_s = np.einsum("pd,pd->p", sampling.values_at(flow, points_mm)[0], normals)
    strength = nearby.sums(points_mm, points_mm, (area_mm2 * through_m_s**2)[:, None], TILE_MM)
    depth_mm = -case.vessel.closed.signed_distance(points_mm)
    is_inner = depth_mm >= INNER_PART * min(TILE_MM, depth_mm.max())
    return np.asarray(points_mm[np.where(is_inner, strength[:, 0], 0.0).argmax()])


def read_off(
    case: FlowCase, walls: FlowCase, flow: FlowField, center_mm: Floats, told: Callable[[float], None] = lambda _: None
) -> tuple[float, float]:
    """Return what the screen of a steady case and the walls of a tile resist to a flow, up to a common constant.

    Both are 1 where force and velocity are no measure of a resistance (see `LIKE_FLOW`). `told` gets the part of the
    walls that is done.
    """
    cell_size_mm = default_cell_size_mm(walls)
    of_screen, _ = _resistance(case, flow, cell_size_mm, center_mm, lambda _: None)
    of_walls, likeness = _resistance(replace(walls, media=case.media), flow, cell_size_mm, center_mm, told)
    return (of_screen, of_walls) if likeness > LIKE_FLOW and min(of_screen, of_walls) > 0 else (1.0, 1.0)


def next_factor(rounds: Sequence[tuple[float, float, float]]) -> float:
    """Return the factor on a screen after rounds (factor, of screen, of walls), by the secant of their logarithms."""
    factor, of_screen, of_walls = rounds[-1]
    response = RESPONSE
    if len(rounds) > 1 and factor != rounds[-2][0]:
        response = min(max(log(of_screen / rounds[-2][1]) / log(factor / rounds[-2][0]), 0.5), 1.0)
    return float(factor * (of_walls / of_screen) ** (1 / response))


def is_known(rounds: Sequence[tuple[float, float, float]]) -> bool:
    """Return whether rounds (factor, of screen, of walls) ended near what the wires resist, read off at least once."""
    _, of_screen, of_walls = rounds[-1]
    was_read = any(screen != walls for _, screen, walls in rounds)
    return was_read and 1 / MOST_APART < of_walls / of_screen < MOST_APART


def scaled(case: FlowCase, factor: float) -> FlowCase:
    """Return a case whose screen resists `factor` times as much."""
    names = ("normal_resistance_Pa_s_m", "tangential_resistance_Pa_s_m", "inertial_loss")
    media = (replace(one, **{name: factor * getattr(one, name) for name in names}) for one in case.media)
    return replace(case, media=tuple(media))


def cost(case: FlowCase) -> tuple[float, float]:
    """Estimate the run time, s, of all tiles of a case, and the peak memory, bytes, of one."""
    assert case.ostium is not None
    walls = tile(case, case.ostium.vertices_mm.mean(axis=0))
    size_mm = default_cell_size_mm(walls)
    step_s = longest_step_s(case, sizes_mm(walls, size_mm)[-1], peak_speed_m_s(case, None))
    return ROUNDS * seconds_of(walls, size_mm, settling_s(case) / step_s), memory_bytes(walls)


def settling_s(case: FlowCase) -> float:
    """Return the time for which a tile is computed."""
    spacing_m = M_PER_MM * float(np.mean([np.median(one.spacing_mm) for one in case.media]))
    return SETTLED * spacing_m**2 / case.blood.kinematic_viscosity_m2_s


def _samples(case: FlowCase) -> tuple[Floats, Floats, Floats]:
    """Return samples (p, 3) of the screen in the ostium, their normals (p, 3) and areas (p,)."""
    assert case.ostium is not None
    found = np.concatenate([np.column_stack([one.points_mm, one.normals, one.area_mm2]) for one in case.media])
    found = found[case.ostium.closest(found[:, :3])[1] < REACH_MM]
    found = found[:: max(1, len(found) // SAMPLES)]
    return found[:, :3], found[:, 3:6], found[:, 6]


def _resistance(
    case: FlowCase, flow: FlowField, cell_size_mm: float, center_mm: Floats, told: Callable[[float], None]
) -> tuple[float, float]:
    """Return the resistance to flow through the middle of a tile, up to a constant, and the likeness of force and flow.

    It is the least-squares ratio of force and velocity, both along the normal and averaged over `REACH_MM`. The
    likeness is their correlation.
    """
    nodes_mm, normals, area_mm2 = _samples(case)
    is_read = lengths(nodes_mm - center_mm) < TILE_MM - REACH_MM
    nodes_mm, normals, area_mm2 = nodes_mm[is_read], normals[is_read], area_mm2[is_read]
    state = LatticeBoltzmann(cell_size_mm).init(case, flow)
    steps = 2 * max(1, round(settling_s(case) / state.scales.step_s / (2 * 2 * READINGS)))
    along = np.zeros((2, len(nodes_mm)))
    for reading in range(2 * READINGS):
        stepping.advance(state, steps)
        told((reading + 1) / (2 * READINGS))
        if reading >= READINGS:
            velocity_m_s = stepping.snapshots(state)[0].velocity_m_s.astype(np.float64)
            of_cells = (state.domain.centers_mm, velocity_m_s), forces_N(state.at_wires)
            sums = (nearby.sums(nodes_mm, *values, REACH_MM) for values in of_cells)
            along += np.stack([np.einsum("pd,pd->p", one, normals) for one in sums])
    ((through, both), (_, forces)) = (area_mm2 * along) @ along.T
    return float(both / through), float(both / np.sqrt(through * forces))
