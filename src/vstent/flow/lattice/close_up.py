"""Refined region: a finer grid in and near the sac, inside a flow computed on a coarser grid in the whole vessel.

A stent changes the flow at the neck, whereas the artery upstream needs no finer grid than its velocity profile. The
whole vessel is therefore computed on a coarser grid first. The sac and a piece of the artery are then computed on the
fine grid, with velocity and pressure of the coarser flow at the cuts where the region ends (one-way nesting; Davies
1976, Q. J. R. Meteorol. Soc. 102, 405). The flow rate through every cut is exact: it equals that of the openings beyond
it.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from math import pi, sqrt

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from vstent.errors import FlowError
from vstent.flow import domain as domains
from vstent.flow import sampling
from vstent.flow.case import FlowCase, FlowField, Phase
from vstent.flow.domain import BEYOND, Domain, Window
from vstent.geometry.surface import Surface
from vstent.kernels import sampling as lattice_sampling
from vstent.kernels.arrays import Bools, Floats, Ints
from vstent.kernels.directions import VELOCITIES

WIDTH = 2
"""Ratio of the grid spacing elsewhere to that in the refined region."""
UPSTREAM_DIAMETERS, DOWNSTREAM_DIAMETERS = 3.0, 1.0
"""Extent of the refined region from the sac towards the inlet and the outlets, in mean diameters 4 V / A of the vessel.
The flow into the sac forms upstream: with one diameter the demo's neck inflow is 9 % too low, with two 2.4 %."""
STRETCH = 4 / 3
"""Ratio of the time step of a steady flow in the refined region to that in a whole vessel. Longer steps are possible
because the flow rates at the ends of the region are imposed; in a whole vessel they would lose flow (0.3 % in a
bifurcation). With shorter steps the means of C0038's sac and neck, bare and with Silk and Enterprise, change by at most
0.4 %, the demo's by 0.5 %. In a pulse the ratio is 1: with longer steps C0038 diverged at 0.2 mm."""
SHARE_WITHIN = 1 / 4
"""Maximum fraction of a steady flow's time steps that the refined region may take. It is small because the region
starts from the coarser flow. An unsteady flow needs the most steps, but only its last checks are averaged
(`settling.LATEST`): C0038 without a device is known within 12 % after a sixth, and within 3 % soon after."""
SHARE_AROUND = 1 / 2
"""Maximum fraction of a steady flow's time steps that the coarser flow may take; the sac is computed again
afterwards."""
RIM_CELLS = 4
"""Width in coarse cells of the rim of the refined region where the wall shear stress is taken from the coarser flow."""


@dataclass(frozen=True, eq=False)
class CloseUp:
    """A part of the vessel to be computed on a finer grid, and the flow around it.

    The rest of the vessel falls into *parts*: connected pieces, each joined to the region at a cut.
    """

    outer: FlowField
    """Flow in the whole vessel on the coarser grid."""
    depth_mm: Floats
    """(n,) distance, through the blood, from each coarse cell to the outside of the region."""
    part: Ints
    """(n,) part of the vessel in which each coarse cell lies; -1 within the region."""
    part_of_opening: Ints
    """(k,) part in which each opening lies; -1 within the region."""

    @cached_property
    def inflow_mL_s(self) -> Floats:
        """Return the flow rate (p,) from each part into the region."""
        through_mL_s = np.r_[self.outer.inlets_mL_s, -self.outer.outlets_mL_s]
        leads_out = self.part_of_opening >= 0
        return np.bincount(self.part_of_opening[leads_out], through_mL_s[leads_out]).astype(np.float64)

    def at_phase(self, phase: Phase) -> "CloseUp":
        """Return the same region with the surrounding flow at one phase of the cycle."""
        return replace(self, outer=self.outer.at_phase(phase))

    @cached_property
    def _sharpened_m_s(self) -> Floats:
        """Return the velocity (n, 3) of the coarse cells, corrected so that linear interpolation has no mean error.

        The error of linear interpolation is h^2 t (1 - t) / 2 times the second derivative, on average h^2 / 12 times
        it.
        """
        outer = self.outer.finest
        speed, curve = outer.velocity_m_s, np.zeros((len(outer.cells), 3))
        for step in np.eye(3, dtype=np.int32):
            ahead, behind = (outer.index[tuple((outer.cells + sign * step).T)] for sign in (1, -1))
            inner = (ahead >= 0) & (behind >= 0)
            curve[inner] += speed[ahead[inner]] + speed[behind[inner]] - 2 * speed[inner]
        return np.asarray(speed - curve / 12)

    def velocity_m_s(self, points_mm: Floats, surface: Surface) -> Floats:
        """Return the velocity (m, 3) of the surrounding flow at points (m, 3).

        Next to the wall, `surface` with the extensions of the openings, the ratio of velocity to wall distance is
        interpolated instead of the velocity.
        """
        outer = self.outer.finest
        cells, weights = lattice_sampling.stencils(outer.index, outer.places(points_mm))
        share = np.where(cells >= 0, weights, 0.0)
        result = np.einsum("mk,mkd->md", share, self._sharpened_m_s[cells])
        beside = np.flatnonzero((cells < 0).any(axis=1))
        of, place = np.unique(cells[beside], return_inverse=True)
        depth_mm = np.maximum(surface.closest(outer.centers_mm[of])[1], 0.1 * outer.cell_size_mm)
        ratio = (outer.velocity_m_s[of] / depth_mm[:, None])[place.reshape(cells[beside].shape)]
        total = np.maximum(share[beside].sum(axis=1), 1e-9)
        mean = np.einsum("mk,mkd->md", share[beside], ratio) / total[:, None]
        result[beside] = mean * surface.closest(points_mm[beside])[1][:, None]
        return result


def require_sac(case: FlowCase) -> Surface:
    """Return the sac of a case, around which the grid is refined; raise a `FlowError` where there is none."""
    if case.sac is None:
        raise FlowError(
            "the grid cannot be refined in the sac, because this vessel has none: switch that off (--refine-sac)"
        )
    return case.sac


def close_up(case: FlowCase, outer: FlowField) -> CloseUp:
    """Choose the refined region of a case inside a flow in the whole vessel; without a sac raise a `FlowError`."""
    surface, _, sections = domains.extend(case.vessel)
    grid = outer.finest
    # The distances, mm, between neighbouring cells that are not separated by the wall.
    neighbour = grid.neighbours()
    is_open = neighbour >= 0
    is_open[:, 0::2] = False  # count every pair once
    is_open[domains.septa(surface, neighbour, grid)] = False
    cell, direction = np.nonzero(is_open)
    length_mm = grid.cell_size_mm * np.linalg.norm(VELOCITIES, axis=1)[direction]
    places = cell, neighbour[cell, direction]
    graph = csr_matrix(coo_matrix((length_mm, places), shape=(len(grid.cells),) * 2))
    sac = sampling.cells_inside(require_sac(case), grid.centers_mm, grid.cell_size_mm)
    distance_mm = dijkstra(graph, directed=False, indices=sac, min_only=True)
    diameter_mm = domains.mean_diameter_mm(case.vessel)
    ends = np.asarray(cKDTree(grid.centers_mm).query([section.mean(axis=0) for section in sections])[1])
    whole_mm = np.full(len(distance_mm), np.inf)
    part = _parts(graph, distance_mm > DOWNSTREAM_DIAMETERS * diameter_mm, ends)
    near = CloseUp(outer, whole_mm, part, part[ends])
    is_upstream = np.isin(part, np.flatnonzero(near.inflow_mL_s > 0))
    part = _parts(graph, (part >= 0) & ~(is_upstream & (distance_mm <= UPSTREAM_DIAMETERS * diameter_mm)), ends)
    beyond = np.flatnonzero(part >= 0)
    depth_mm = dijkstra(graph, directed=False, indices=beyond, min_only=True) if len(beyond) else whole_mm
    return CloseUp(outer, depth_mm, part, part[ends])


def volume_mm3(case: FlowCase) -> float:
    """Estimate the volume of a case's refined region, the sac and a piece of the artery; it is about 15 % too high."""
    sac, diameter_mm = require_sac(case), domains.mean_diameter_mm(case.vessel)
    neck_mm2 = 0.0 if case.ostium is None else case.ostium.area_mm2
    stretch_mm = (UPSTREAM_DIAMETERS + DOWNSTREAM_DIAMETERS) * diameter_mm + sqrt(4 / pi * neck_mm2)
    return min(abs(sac.volume_mm3) + pi / 4 * diameter_mm**2 * stretch_mm, abs(case.vessel.closed.volume_mm3))


def _parts(graph: csr_matrix, is_beyond: Bools, ends: Ints) -> Ints:
    """Return the part (n,) of each cell beyond the region, -1 within; a recess that leads to no end is not a part."""
    beyond = np.flatnonzero(is_beyond)
    part = np.full(len(is_beyond), -1, dtype=np.int32)
    part[beyond] = connected_components(graph[beyond][:, beyond], directed=False)[1]
    through = np.unique(part[ends][part[ends] >= 0])
    return np.where(np.isin(part, through), np.searchsorted(through, part), -1).astype(np.int32)


def build(case: FlowCase, cell_size_mm: float, chosen: CloseUp, wires: Surface | None = None) -> Domain:
    """Return the fine grid of a refined region, with `wires` as walls in it (see `domain.build`).

    Links that leave the region through a cut have the patch number of their part: part p has the last opening's patch
    number plus p + 1.
    """
    # Grid points in coarse cells within the region, or next to one at the wall.
    outer = chosen.outer.finest
    inner = outer.cells[chosen.part < 0]
    low = inner.min(axis=0) - 2
    within, outside = np.zeros((2, *(inner.max(axis=0) - low + 3)), dtype=bool)
    within[tuple((inner - low).T)] = True
    others = outer.cells[chosen.part >= 0] - low
    outside[tuple(others[((others >= 0) & (others < outside.shape)).all(axis=1)].T)] = True
    within |= ndimage.binary_dilation(within, np.ones((3, 3, 3), dtype=bool)) & ~outside
    fine = within.repeat(WIDTH, axis=0).repeat(WIDTH, axis=1).repeat(WIDTH, axis=2)
    corner_mm = outer.origin_mm + low * outer.cell_size_mm - 0.5 * (outer.cell_size_mm - cell_size_mm)
    grid = domains.build(case.vessel, cell_size_mm, Window(corner_mm, fine), wires)
    leads_beyond = grid.link_patch == BEYOND
    ahead_mm = cell_size_mm * VELOCITIES[grid.link_direction[leads_beyond]]
    beyond = np.flatnonzero(chosen.part >= 0)
    nearest = cKDTree(outer.centers_mm[beyond])
    nearest_beyond = beyond[nearest.query(grid.centers_mm[grid.link_cell[leads_beyond]] + ahead_mm)[1]]
    patch = grid.link_patch.copy()
    patch[leads_beyond] = len(case.vessel.openings) + 1 + chosen.part[nearest_beyond]
    return replace(grid, link_patch=patch)


def assembled(chosen: CloseUp, inner: FlowField) -> FlowField:
    """Return one field of both grids: the whole vessel on the coarser one, and the refined region."""
    outer, grid = chosen.outer, chosen.outer.finest
    behind_mm = inner.wall.vertices_mm - 0.5 * grid.cell_size_mm * inner.wall.vertex_normals
    # Vertices with fine cells all around.
    is_fine = chosen.depth_mm[cKDTree(grid.centers_mm).query(behind_mm)[1]] > RIM_CELLS * grid.cell_size_mm

    def of_wall(fine: Floats, wide: Floats) -> Floats:
        return np.asarray(np.where(is_fine if fine.ndim == 1 else is_fine[:, None], fine, wide))

    return replace(
        inner,
        levels=(*outer.levels, *inner.levels),
        wall_shear_stress_Pa=of_wall(inner.wall_shear_stress_Pa, outer.wall_shear_stress_Pa),
        wall_pressure_Pa=of_wall(inner.wall_pressure_Pa, outer.wall_pressure_Pa),
        mean_shear_Pa=None if inner.mean_shear_Pa is None else of_wall(inner.mean_shear_Pa, outer.shear_Pa),
        phases=tuple(
            replace(
                wide,
                velocity_m_s=(*wide.velocity_m_s, *fine.velocity_m_s),
                pressure_Pa=(*wide.pressure_Pa, *fine.pressure_Pa),
                wall_shear_stress_Pa=of_wall(fine.wall_shear_stress_Pa, wide.wall_shear_stress_Pa),
            )
            for fine, wide in zip(inner.phases, outer.phases, strict=True)
        ),
        inlets_mL_s=outer.inlets_mL_s,
        outlets_mL_s=outer.outlets_mL_s,
        inlet_pressure_Pa=outer.inlet_pressure_Pa,
        outlet_pressure_Pa=outer.outlet_pressure_Pa,
        common_pressure_Pa=outer.common_pressure_Pa,
        is_converged=inner.is_converged and outer.is_converged,
        unsettled_fraction=max(inner.unsettled_fraction, outer.unsettled_fraction),
        advice=(
            f"{inner.advice} The grid spacing is {inner.finest.cell_size_mm:.3g} mm in and near the sac and "
            f"{grid.cell_size_mm:.3g} mm elsewhere; there: {outer.advice}"
        ),
    )
