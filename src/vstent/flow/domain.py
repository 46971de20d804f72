"""The blood's domain: the lumen with straight extensions on a regular grid, and every link that leaves it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

from vstent.errors import FlowError
from vstent.flow import sampling
from vstent.flow.case import Blood, FlowCase
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Opening, Vessel
from vstent.kernels import triangles, voxels
from vstent.kernels.arrays import Bools, Floats, Ints, freeze
from vstent.kernels.directions import VELOCITIES
from vstent.units import M_PER_MM, place

INLET_EXTENSION = 0.5
"""Length of the straight tube before an inlet, in its diameters: the imposed profile is developed already."""
OUTLET_EXTENSION = 1.5
"""Length of the straight tube behind an outlet, in outlet diameters: swirl and backflow decay in it."""
MIN_CELLS = 2_000
"""Fewer cells than this are no vessel."""
BRANCH_CELLS = 6.0
"""Cells across that a branch needs: tubes at an angle to the grid resist 2 to 70 % more than they should with six
(Re 10 to 340), 10 to 310 % with four, 1.4 to 15 times as much with three."""
WALL = 0
"""Patch number of the wall; opening k has k + 1."""
BEYOND = -1
"""Patch number of blood outside a window."""
BACK_TO_BACK = -0.5
"""Largest cosine between the normals of two walls that part two blood cells: a corner that a link clips parts nothing,
and blood sent back there turns a jet that leaves its edge (13 links, 3 % of the peak in the FDA's nozzle)."""


class CoarseGridError(FlowError):
    """The grid is too coarse to hold what is to be computed."""


@dataclass(frozen=True, eq=False)
class Domain:
    """Blood cells and the links that leave them."""

    cell_size_mm: float
    """Edge of a cell."""
    origin_mm: Floats
    """(3,) centre of the cell (0, 0, 0)."""
    cells: Ints
    """(n, 3) integer coordinates, sorted; a margin of one cell is free all round."""
    link_cell: Ints
    """(l,) cell that each link leaves."""
    link_direction: Ints
    """(l,) lattice velocity along which it leaves."""
    link_fraction: Floats
    """(l,) where it meets the surface, as a fraction of the link."""
    link_patch: Ints
    """(l,) what it meets: 0 the wall, k + 1 opening k; in a part of a vessel, more where blood goes on beyond it."""
    septum_cell: Ints
    """(s,) blood cell on one side of a wall thinner than a cell, whose neighbour is blood too."""
    septum_direction: Ints
    """(s,) lattice velocity towards the other side; every pair stands here once."""
    surface: Surface
    """The lumen with its extensions, closed."""
    sections: tuple[Floats, ...]
    """(k, 3) polygon of every opening at the end of its extension, mm."""

    def __post_init__(self) -> None:
        freeze(self, "origin_mm", np.float64, (3,))
        freeze(self, "cells", np.int32, (-1, 3))
        freeze(self, "link_cell", np.int32, (-1,))
        freeze(self, "link_direction", np.int32, self.link_cell.shape)
        freeze(self, "link_fraction", np.float64, self.link_cell.shape)
        freeze(self, "link_patch", np.int32, self.link_cell.shape)
        freeze(self, "septum_cell", np.int32, (-1,))
        freeze(self, "septum_direction", np.int32, self.septum_cell.shape)

    @cached_property
    def centers_mm(self) -> Floats:
        """(n, 3) cell centres."""
        return self.origin_mm + self.cells * self.cell_size_mm

    @cached_property
    def index(self) -> Ints:
        """(i, j, k) number of the cell at every grid point, -1 outside the blood."""
        return voxels.index_of(self.cells)

    @cached_property
    def depth_mm(self) -> Floats:
        """(n,) distance of every cell from the surface."""
        return self.surface.closest(self.centers_mm)[1]


@dataclass(frozen=True, eq=False)
class Window:
    """A part of the space to look for blood in."""

    origin_mm: Floats
    """(3,) centre of the cell (0, 0, 0)."""
    mask: Bools
    """(i, j, k) cells that belong to it; none at the border."""


def too_narrow(case: FlowCase, cell_size_mm: float) -> str:
    """Say which outlets take too little blood, being too narrow for cells of this size; nothing where none is.

    Where there is one outlet, or the split is given, what it takes does not hang on what it resists.
    """
    outlets = case.vessel.outlets
    narrow = [outlet for outlet in outlets if outlet.diameter_mm < BRANCH_CELLS * cell_size_mm]
    if len(outlets) < 2 or case.settings.outlets == "murray" or not narrow:
        return ""
    named = ", ".join(
        f"{outlet.role} ({outlet.diameter_mm:.2g} mm) has {outlet.diameter_mm / cell_size_mm:.1f}" for outlet in narrow
    )
    return (
        f" At a grid spacing of {cell_size_mm:.3g} mm, {named} across. With fewer than {BRANCH_CELLS:.0f} "
        "cells a branch resists too much and carries too little blood: use a finer grid spacing, or split the "
        "flow by Murray's law."
    )


def unreached(vessel: Vessel, grid: Domain) -> str:
    """Say which outlets no cell of a whole vessel's grid reaches; nothing where there is none."""
    closed = [opening for opening in _unlinked(vessel, grid.link_patch) if not opening.is_inlet]
    if not closed:
        return ""
    named = ", ".join(f"{outlet.role} ({outlet.diameter_mm:.2g} mm)" for outlet in closed)
    return (
        f" The grid of {grid.cell_size_mm:.3g} mm does not reach {named}, so no blood leaves there: use a "
        "finer grid spacing."
    )


def _unlinked(vessel: Vessel, link_patch: Ints) -> list[Opening]:
    """Openings that no link of a whole vessel's grid meets."""
    return [opening for k, opening in enumerate(vessel.openings) if not (link_patch == k + 1).any()]


def cells_of_sac(case: FlowCase, grid: Domain) -> Ints:
    """Cells of a case's sac in a grid, all cells where it has none.

    Raises
    ------
    CoarseGridError
        When no cell lies in the sac.
    """
    if case.sac is None:
        return np.arange(len(grid.cells), dtype=np.int32)
    cells = sampling.cells_inside(case.sac, grid.centers_mm, grid.cell_size_mm)
    if len(cells) == 0:
        raise CoarseGridError(
            f"no grid cell of {grid.cell_size_mm:.3g} mm is in the sac of {abs(case.sac.volume_mm3):.2g} mm3 "
            f"near {place(case.sac.vertices_mm.mean(axis=0))}: use a finer grid spacing"
        )
    return cells


def section_pressure_Pa(vessel: Vessel, grid: Domain, pressure_Pa: Floats) -> Floats:
    """Mean pressure (k,) of the cells on the plane of every opening itself, not of its extension's end; nan of none."""

    def mean_Pa(opening: Opening) -> float:
        offset = grid.centers_mm - opening.center_mm
        near = np.abs(offset @ opening.normal) < grid.cell_size_mm
        near &= np.linalg.norm(offset, axis=1) < 0.75 * opening.diameter_mm
        return float(pressure_Pa[near].mean()) if near.any() else float("nan")

    return np.array([mean_Pa(opening) for opening in vessel.openings])


def too_fast(grid: Domain, speed_m_s: Floats, blood: Blood, most: float) -> str:
    """Say where blood, its speed (n,) in every cell, is computed thicker than it is; nothing where none is.

    That is where speed x cell / viscosity is more than `most`.
    """
    cell_reynolds = speed_m_s * grid.cell_size_mm * M_PER_MM / blood.kinematic_viscosity_m2_s
    fastest = int(cell_reynolds.argmax())
    if cell_reynolds[fastest] <= most:
        return ""
    share = float((cell_reynolds > most).mean())
    return (
        f" Under-resolved: in {100 * share:.2g} % of the cells (spacing {grid.cell_size_mm:.3g} mm) the "
        f"effective viscosity is raised, up to {cell_reynolds[fastest] / most:.2g} times nominal (speeds up to "
        f"{speed_m_s[fastest]:.2g} m/s at {place(grid.centers_mm[fastest])}). Use a finer grid spacing to see "
        "what this changes."
    )


def default_cell_size_mm(case: FlowCase) -> float:
    """Edge of a cell: as set; else `cells_per_diameter` across the vessel, within the cell budget.

    That is across its mean diameter 4 V / A, or across its inlet where that is less: a large sac widens the mean.
    """
    settings = case.settings
    if settings.cell_size_mm is not None:
        return settings.cell_size_mm
    volume_mm3 = case.vessel.closed.volume_mm3
    across_mm = min(mean_diameter_mm(case.vessel), case.vessel.inlet.diameter_mm)
    by_diameter = across_mm / settings.cells_per_diameter
    by_budget = (volume_mm3 / settings.cell_budget) ** (1 / 3)
    return max(by_diameter, by_budget)


def mean_diameter_mm(vessel: Vessel) -> float:
    """Mean (hydraulic) diameter 4 V / A of a vessel, its sac included."""
    return 4 * abs(vessel.closed.volume_mm3) / vessel.lumen.area_mm2


def build(vessel: Vessel, cell_size_mm: float, window: Window | None = None) -> Domain:
    """Put the blood of a vessel on a grid, all of it or what is connected in a window.

    Raises
    ------
    CoarseGridError
        When no blood connects to the inlet, or far too few cells do, or none to another inlet.
    """
    surface, face_patch, sections = extend(vessel)
    origin_mm, shape = _box(surface, cell_size_mm) if window is None else (window.origin_mm, window.mask.shape)
    filled = voxels.fill((surface.corners_mm - origin_mm) / cell_size_mm, shape)
    if window is None:
        inside = _connected(filled, vessel, sections[0], origin_mm, cell_size_mm)
    else:
        inside = _largest(filled & window.mask)
    cells = np.argwhere(inside).astype(np.int32)
    if len(cells) < MIN_CELLS:
        raise CoarseGridError(
            f"only {len(cells)} cells of {cell_size_mm:.3g} mm connect to the inlet at "
            f"{place(vessel.inlet.center_mm)}, because the grid is too coarse for this vessel or the inlet is "
            "blocked: use a finer grid spacing"
        )
    index = np.full(inside.shape, -1, dtype=np.int32)
    index[inside] = np.arange(len(cells), dtype=np.int32)
    neighbour = neighbours(index, cells)
    is_beyond = filled & ~inside & (window is not None)
    links = _links(surface, face_patch, neighbour, cells, is_beyond, origin_mm, cell_size_mm)
    if window is None:
        _refuse_unreached_inlet(vessel, links[3], cell_size_mm)
    parted = septa(surface, neighbour, cells, origin_mm, cell_size_mm)
    return Domain(cell_size_mm, origin_mm, cells, *links, *parted, surface, sections)


def _refuse_unreached_inlet(vessel: Vessel, link_patch: Ints, cell_size_mm: float) -> None:
    """Refuse a grid in which less blood would enter than is to: an outlet without cells is told, see `unreached`."""
    for opening in _unlinked(vessel, link_patch):
        if opening.is_inlet:
            raise CoarseGridError(
                f"the grid of {cell_size_mm:.3g} mm does not reach the inlet {opening.role} "
                f"({opening.diameter_mm:.2g} mm wide at {place(opening.center_mm)}): use a finer grid spacing"
            )


def _box(surface: Surface, cell_size_mm: float) -> tuple[Floats, tuple[int, int, int]]:
    """Centre (3,) of the first cell, and the number of cells along each axis, of a grid around a surface."""
    # An odd offset keeps grid lines off the vertices and edges of analytic shapes.
    origin_mm = surface.vertices_mm.min(axis=0) - cell_size_mm * (2.0 + np.array([0.1327, 0.2171, 0.1733]))
    shape = np.ceil((surface.vertices_mm.max(axis=0) - origin_mm) / cell_size_mm).astype(int) + 3
    return origin_mm, (int(shape[0]), int(shape[1]), int(shape[2]))


def _largest(inside: Bools) -> Bools:
    """Keep the largest connected part."""
    label, _ = ndimage.label(inside)
    return np.asarray(label == 1 + np.bincount(label.ravel())[1:].argmax())


def _connected(
    inside: np.ndarray, vessel: Vessel, section: Floats, origin_mm: Floats, cell_size_mm: float
) -> np.ndarray:
    label, count = ndimage.label(inside)
    if count <= 1:
        return inside
    seeds = section.mean(axis=0) - vessel.inlet.normal * cell_size_mm * np.arange(0.5, 6.0)[:, None]
    index = np.clip(np.rint((seeds - origin_mm) / cell_size_mm).astype(int), 0, np.array(inside.shape) - 1)
    found = label[tuple(index.T)]
    found = found[found > 0]
    if len(found) == 0:
        at = place(vessel.inlet.center_mm)
        raise CoarseGridError(
            f"no cell of {cell_size_mm:.3g} mm is inside the inlet at {at}: check that the inlet is an open "
            "end, or use a finer grid spacing"
        )
    return label == np.bincount(found).argmax()


def extend(vessel: Vessel) -> tuple[Surface, Ints, tuple[Floats, ...]]:
    """Add a straight tube of the section's own shape to every opening and close the ends.

    Returns
    -------
    surface : closed.
    face_patch : (m,) 0 the wall, k + 1 the end of opening k.
    sections : for every opening the polygon (j, 3) of its end.
    """
    lumen, obstacles = vessel.lumen, [vessel.closed]
    vertices, faces = [lumen.vertices_mm], [lumen.faces]
    patch = [np.full(len(lumen.faces), WALL)]
    sections: dict[int, Floats] = {}
    count = len(lumen.vertices_mm)
    for loop in lumen.boundary_loops:
        k = _opening_of(vessel, lumen.vertices_mm[loop])
        if k is None or k in sections:
            ring, ring_ids = lumen.vertices_mm[loop], loop
            patch_id = WALL
        else:
            ring = _extruded(vessel, k, lumen.vertices_mm[loop], obstacles)
            obstacles.append(_tube(lumen.vertices_mm[loop], ring))
            ring_ids = np.arange(count, count + len(loop), dtype=np.int32)
            vertices.append(ring)
            faces.append(_strip(loop, ring_ids))
            patch.append(np.full(2 * len(loop), WALL))
            sections[k], patch_id = ring, k + 1
            count += len(loop)
        vertices.append(triangles.polygon_centroid(ring)[None])
        faces.append(np.stack([np.roll(ring_ids, -1), ring_ids, np.full_like(ring_ids, count)], axis=1))
        patch.append(np.full(len(loop), patch_id))
        count += 1
    missing = [vessel.openings[k].role for k in range(len(vessel.openings)) if k not in sections]
    if missing:
        raise FlowError(f"no open end of the lumen belongs to {', '.join(missing)}: trace the vessel again")
    surface = Surface(np.concatenate(vertices), np.concatenate(faces))
    return surface, np.concatenate(patch).astype(np.int32), tuple(sections[k] for k in range(len(vessel.openings)))


def extended_volume_mm3(vessel: Vessel) -> float:
    """Foretell the volume of a vessel with its extensions, none of which another wall cuts short."""
    ends = (opening.area_mm2 * _extension_mm(vessel, k) for k, opening in enumerate(vessel.openings))
    return abs(vessel.closed.volume_mm3) + sum(ends)


def _extension_mm(vessel: Vessel, k: int) -> float:
    opening = vessel.openings[k]
    return opening.diameter_mm * (INLET_EXTENSION if opening.is_inlet else OUTLET_EXTENSION)


def _opening_of(vessel: Vessel, ring: Floats) -> int | None:
    center = triangles.polygon_centroid(ring)
    distance = [np.linalg.norm(opening.center_mm - center) / opening.diameter_mm for opening in vessel.openings]
    nearest = int(np.argmin(distance))
    return nearest if distance[nearest] < 0.5 else None


def _extruded(vessel: Vessel, k: int, ring: Floats, obstacles: Sequence[Surface]) -> Floats:
    """Ring moved out along the opening's normal onto the plane where the extension ends, half-way to an obstacle."""
    opening = vessel.openings[k]
    ahead = (ring - opening.center_mm) @ opening.normal
    outer = float(ahead.max())
    rim = ring + (0.05 * opening.diameter_mm + outer - ahead)[:, None] * opening.normal
    middle = rim.mean(axis=0)
    starts = np.concatenate([rim, 0.5 * (rim + middle), middle[None]])
    ways = np.broadcast_to(opening.normal, starts.shape)
    free = min(float(obstacle.first_hit(starts, ways).min()) for obstacle in obstacles)
    length = outer + min(_extension_mm(vessel, k), 0.5 * free)
    return ring + (length - ahead)[:, None] * opening.normal


def _tube(inner_mm: Floats, outer_mm: Floats) -> Surface:
    """Tube between two rings (j, 3)."""
    inner = np.arange(len(inner_mm), dtype=np.int32)
    return Surface(np.concatenate([inner_mm, outer_mm]), _strip(inner, inner + len(inner)))


def _strip(inner: Ints, outer: Ints) -> Ints:
    """Side faces between a loop that runs with the faces beside it and its copy further out."""
    a, b, c, d = inner, np.roll(inner, -1), np.roll(outer, -1), outer
    return np.concatenate([np.stack([b, a, d], axis=1), np.stack([b, d, c], axis=1)]).astype(np.int32)


def _links(
    surface: Surface,
    face_patch: Ints,
    neighbour: Ints,
    cells: Ints,
    is_beyond: Bools,
    origin_mm: Floats,
    cell_size_mm: float,
) -> tuple[Ints, Ints, Floats, Ints]:
    """Links that leave the blood: their cell, direction, fraction to the surface and patch."""
    cell, direction = np.nonzero(neighbour < 0)
    starts = origin_mm + cells[cell] * cell_size_mm
    step_mm = VELOCITIES[direction] * cell_size_mm
    length_mm = np.linalg.norm(step_mm, axis=1)
    fraction = surface.first_hit(starts, step_mm / length_mm[:, None]) / length_mm
    is_missed = fraction > 1.0
    fraction = np.clip(np.where(is_missed, 0.5, fraction), 1e-3, 1.0)
    _, _, face = surface.closest(starts + fraction[:, None] * step_mm)
    goes_on = is_beyond[tuple((cells[cell] + VELOCITIES[direction]).T)]
    patch = np.where(is_missed, np.where(goes_on, BEYOND, WALL), face_patch[face])
    return cell.astype(np.int32), direction.astype(np.int32), fraction, patch.astype(np.int32)


def neighbours(index: Ints, cells: Ints) -> Ints:
    """Number (n, 19) of every cell's neighbours, -1 where these are no blood, by the `index` (i, j, k) of the grid."""
    return np.stack([index[tuple((cells + c).T)] for c in VELOCITIES], axis=1)


def septa(surface: Surface, neighbour: Ints, cells: Ints, origin_mm: Floats, cell_size_mm: float) -> tuple[Ints, Ints]:
    """Links between two blood cells with a wall between them: their cell and direction, each pair once.

    Parameters
    ----------
    surface : the blood's; neighbour : (n, 19) see `neighbours`.
    cells, origin_mm, cell_size_mm : as of a `Domain`.
    """
    is_edge = np.asarray((neighbour < 0).any(axis=1))
    candidate = is_edge[:, None] & (neighbour >= 0) & is_edge[neighbour]
    candidate[:, 0::2] = False
    cell, direction = np.nonzero(candidate)
    starts = origin_mm + cells[cell] * cell_size_mm
    crosses = surface.crosses(starts, starts + VELOCITIES[direction] * cell_size_mm)
    cell, direction, starts = cell[crosses], direction[crosses], starts[crosses]
    step_mm = VELOCITIES[direction] * cell_size_mm
    along = step_mm / np.linalg.norm(step_mm, axis=1)[:, None]
    this_side, that_side = surface.first_hits(starts, along)[1], surface.first_hits(starts + step_mm, -along)[1]
    parts = np.einsum("ij,ij->i", surface.normals[this_side], surface.normals[that_side]) < BACK_TO_BACK
    return cell[parts].astype(np.int32), direction[parts].astype(np.int32)
