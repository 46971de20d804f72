"""The computational domain: the lumen with straight extensions on a regular grid, and its boundary links."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import floor, log2

import numpy as np
from scipy import ndimage

from vstent.deployment.struts import thickness_mm
from vstent.errors import FlowError
from vstent.flow import sampling
from vstent.flow.case import Cells, FlowCase
from vstent.flow.settings import LATTICE, Blood
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Opening, Vessel
from vstent.kernels import triangles, voxels
from vstent.kernels.arrays import Bools, Floats, Ints, freeze
from vstent.kernels.directions import VELOCITIES
from vstent.units import M_PER_MM, place

INLET_EXTENSION = 0.5
"""Length of the straight extension of an inlet, in inlet diameters. Short, because the prescribed profile is already
developed."""
OUTLET_EXTENSION = 1.5
"""Length of the straight extension of an outlet, in outlet diameters: swirl and backflow decay in it."""
MIN_CELLS = 2_000
"""Minimum number of cells of a vessel."""
BRANCH_CELLS = 6.0
"""Number of cells across that a branch needs. Tubes at an angle to the grid have 2 to 70 % too much resistance with
six cells across (Re 10 to 340), 10 to 310 % with four, and 1.4 to 15 times the right one with three."""
LEAST_ACROSS = 2.3
"""Number of cells that a wire taken as a wall needs across. The error in the drag of rows of wires, by their
position on the grid, is -20 to +6 % with two cells across, -8 to +2 % with three and -4 to +2 % with four."""
LEAST_OF_OPEN = 0.6
"""Least part of itself to which an open grid spacing is reduced for wires that are walls. Below, the whole vessel costs
more than walls that are finer than needed."""
WALL = 0
"""Patch number of the wall; opening k has patch number k + 1."""
LEAST_PIECE = 64
"""Number of cells of the smallest separate piece of a window that is computed."""
BACK_TO_BACK = -0.5
"""Largest cosine between the normals of two walls that separate two blood cells. A corner that a link only clips
does not separate them: bounce-back there would deflect a jet that leaves the edge (13 links, 3 % of the peak
velocity in the FDA nozzle)."""
CLIPPED = 0.15
"""Least fraction of a link between two blood cells that lies in a wire which separates them."""


class CoarseGridError(FlowError):
    """The grid is too coarse for the vessel."""


@dataclass(frozen=True, eq=False)
class Domain(Cells):
    """Blood cells of a regular grid and the links that leave them."""

    link_cell: Ints
    """(l,) index of the cell that each link leaves."""
    link_direction: Ints
    """(l,) index of the lattice velocity along the link."""
    link_fraction: Floats
    """(l,) position where the link meets the surface, as a fraction of its length."""
    link_patch: Ints
    """(l,) patch that the link meets: 0 wall, k + 1 opening k."""
    septum_cell: Ints
    """(s,) blood cell on one side of a wall thinner than a cell, with a blood cell on the other side."""
    septum_direction: Ints
    """(s,) index of the lattice velocity towards the other side; every pair is listed once."""
    link_is_wire: Bools
    """(l,) whether the link meets a wire, or a gap at one that is closed (see `between_wires`)."""
    closed_gaps: int
    """Number of cells in these gaps."""
    surface: Surface
    """Closed surface of the lumen with its extensions."""
    sections: tuple[Floats, ...]
    """For every opening the polygon (k, 3) at the end of its extension, in mm."""

    def __post_init__(self) -> None:
        super().__post_init__()
        freeze(self, "link_cell link_direction link_patch", np.int32, (len(self.link_cell),))
        freeze(self, "link_fraction", np.float64, (len(self.link_cell),))
        freeze(self, "link_is_wire", np.bool_, (len(self.link_cell),))
        freeze(self, "septum_cell septum_direction", np.int32, (len(self.septum_cell),))

    @cached_property
    def depth_mm(self) -> Floats:
        """Distance (n,) of every cell centre from the surface."""
        return self.surface.closest(self.centers_mm)[1]


@dataclass(frozen=True, eq=False)
class Window:
    """A part of space to which the domain is restricted."""

    origin_mm: Floats
    """(3,) centre of the cell (0, 0, 0)."""
    mask: Bools
    """(i, j, k) cells that belong to the window; none on the border of the grid."""


def too_narrow(case: FlowCase, cell_size_mm: float) -> str:
    """Return a warning about outlets too narrow for the grid spacing, or an empty string.

    Such outlets carry too little flow. There is no warning for a single outlet or a prescribed split, where the flow
    does not depend on the branch's resistance.
    """
    outlets = case.vessel.outlets
    narrow = [outlet for outlet in outlets if outlet.diameter_mm < BRANCH_CELLS * cell_size_mm]
    if case.is_split_given or not narrow:
        return ""
    named = ", ".join(
        f"{outlet.role} ({outlet.diameter_mm:.2g} mm) has {outlet.diameter_mm / cell_size_mm:.1f}" for outlet in narrow
    )
    return (
        f" Under-resolved branches: at a grid spacing of {cell_size_mm:.3g} mm, {named} cells across. With fewer than "
        f"{BRANCH_CELLS:.0f} a branch has too much resistance and carries too little flow: refine them "
        "(--refine branches), use a finer grid spacing, or give the outlets resistances or fixed shares."
    )


def unreached(vessel: Vessel, grid: Domain) -> str:
    """Return a warning about outlets that no cell of a whole vessel's grid reaches, or an empty string."""
    patches = enumerate(vessel.openings, start=1)
    closed = [one for patch, one in patches if not one.is_inlet and patch not in grid.link_patch]
    if not closed:
        return ""
    named = ", ".join(f"{outlet.role} ({outlet.diameter_mm:.2g} mm)" for outlet in closed)
    return (
        f" At a grid spacing of {grid.cell_size_mm:.3g} mm no cell reaches {named}, so no blood leaves there: use a "
        "finer grid spacing."
    )


def cells_of_sac(case: FlowCase, grid: Domain) -> Ints:
    """Return the indices of the cells in a case's sac, or of all cells if it has none."""
    if case.sac is None:
        return np.arange(len(grid.cells), dtype=np.int32)
    cells = sampling.cells_inside(case.sac, grid.centers_mm, grid.cell_size_mm)
    if len(cells) == 0:
        raise CoarseGridError(
            f"at a grid spacing of {grid.cell_size_mm:.3g} mm no cell is inside the sac of "
            f"{abs(case.sac.volume_mm3):.2g} mm3 near {place(case.sac.vertices_mm.mean(axis=0))}: use a finer grid "
            "spacing"
        )
    return cells


def section_pressure_Pa(vessel: Vessel, grid: Cells, pressure_Pa: Floats) -> Floats:
    """Return the mean pressure (k,) over the section of every opening, nan where no cell is near it.

    The section is that of the opening, not the end of its extension.
    """
    means_Pa = []
    for opening in vessel.openings:
        offset = grid.centers_mm - opening.center_mm
        near = np.abs(offset @ opening.normal) < grid.cell_size_mm
        near &= np.linalg.norm(offset, axis=1) < 0.75 * opening.diameter_mm
        means_Pa.append(float(pressure_Pa[near].mean()) if near.any() else float("nan"))
    return np.array(means_Pa)


def too_fast(grid: Domain, speed_m_s: Floats, blood: Blood, most: float) -> str:
    """Return a warning about cells in which the viscosity is raised for stability, or an empty string."""
    cell_reynolds = speed_m_s * grid.cell_size_mm * M_PER_MM / blood.kinematic_viscosity_m2_s
    fastest = int(cell_reynolds.argmax())
    if cell_reynolds[fastest] <= most:
        return ""
    share = float((cell_reynolds > most).mean())
    return (
        f" Under-resolved: in {100 * share:.2g} % of the cells the grid Reynolds number exceeds {most:.3g}, so the "
        f"viscosity is raised there, up to {cell_reynolds[fastest] / most:.3g} times nominal. The fastest blood has "
        f"{speed_m_s[fastest]:.2g} m/s at {place(grid.centers_mm[fastest])}; use a grid spacing finer than "
        f"{grid.cell_size_mm:.3g} mm to check the effect."
    )


def default_cell_size_mm(case: FlowCase) -> float:
    """Return the grid spacing of a case: as set, else from `cells_per_diameter` and `cell_budget`.

    The cells are counted across the mean diameter 4 V / A of the vessel, or across its inlet where that is narrower,
    because a large sac increases the mean. Where wires are walls, an open spacing is reduced so that repeated halving
    gives the largest one that suits the wires.
    """
    numerics, size_mm = case.numerics, case.numerics.cell_size_mm
    if size_mm is None:
        across_mm = min(mean_diameter_mm(case.vessel), case.vessel.inlet.diameter_mm)
        by_diameter = across_mm / numerics.cells_per_diameter
        size_mm = max(by_diameter, (case.vessel.closed.volume_mm3 / numerics.cell_budget) ** (1 / 3))
        if numerics.engine == LATTICE and case.walls is not None:
            at_walls_mm = 0.99 * around_walls_mm(case.walls)  # so that the spacing as it is reported suits them too
            suited_mm = at_walls_mm * 2.0 ** max(1, floor(log2(size_mm / at_walls_mm)))
            return suited_mm if LEAST_OF_OPEN * size_mm < suited_mm < size_mm else size_mm
    return size_mm


def around_walls_mm(wires: Surface) -> float:
    """Return the largest grid spacing on which wires can be walls."""
    return thickness_mm(wires) / LEAST_ACROSS


def wires_of(case: FlowCase, cell_size_mm: float) -> Surface | None:
    """Return the wires that are walls on a grid of this spacing; None where the media stand for them."""
    walls = case.walls
    return walls if walls is not None and cell_size_mm <= around_walls_mm(walls) else None


def mean_diameter_mm(vessel: Vessel) -> float:
    """Return the mean (hydraulic) diameter 4 V / A of a vessel, including its sac."""
    return 4 * abs(vessel.closed.volume_mm3) / vessel.lumen.area_mm2


def build(vessel: Vessel, cell_size_mm: float, window: Window | None = None, wires: Surface | None = None) -> Domain:
    """Discretize the blood of a vessel on a regular grid: all that is connected to the inlet, or what is in a window.

    `wires` are closed solids in it, which may overlap. A grid too coarse for the vessel, or to reach another inlet, is
    refused.
    """
    surface, face_patch, sections = extend(vessel)
    if window is None:
        # An irregular offset avoids grid lines exactly through vertices and edges of analytic shapes.
        origin_mm = surface.vertices_mm.min(axis=0) - cell_size_mm * (2.0 + np.array([0.1327, 0.2171, 0.1733]))
        i, j, k = np.ceil((surface.vertices_mm.max(axis=0) - origin_mm) / cell_size_mm).astype(int) + 3
        shape = int(i), int(j), int(k)
    else:
        origin_mm, shape = window.origin_mm, window.mask.shape
    lumen = voxels.fill((surface.corners_mm - origin_mm) / cell_size_mm, shape)
    filled, closed_gaps = lumen, 0
    if wires is not None:
        filled, closed_gaps = between_wires(lumen, (wires.corners_mm - origin_mm) / cell_size_mm)
    if window is None:
        inside = _connected(filled, vessel, sections[0], origin_mm, cell_size_mm)
    else:
        label, _ = ndimage.label(filled & window.mask)
        inside = (np.bincount(label.ravel()) >= LEAST_PIECE)[label] & (label > 0)
    cells = np.argwhere(inside).astype(np.int32)
    if window is None and len(cells) < MIN_CELLS:
        raise CoarseGridError(
            f"at a grid spacing of {cell_size_mm:.3g} mm only {len(cells)} cells are connected to the inlet at "
            f"{place(vessel.inlet.center_mm)}, so the grid is too coarse or the inlet is blocked: use a finer grid "
            "spacing (a part given by --refine doubles it elsewhere), or check the inlet"
        )
    grid = Cells(cells, origin_mm, cell_size_mm)
    neighbour = grid.neighbours()
    is_beyond = filled & (False if window is None else ~window.mask)
    links = _links(surface, face_patch, neighbour, grid, is_beyond, wires, lumen & ~filled)
    for patch, opening in enumerate(vessel.openings, start=1):
        # An outlet without cells only causes a warning (see `unreached`).
        if window is None and opening.is_inlet and patch not in links[3]:
            raise CoarseGridError(
                f"at a grid spacing of {cell_size_mm:.3g} mm no cell reaches {opening.role} "
                f"({opening.diameter_mm:.2g} mm wide at {place(opening.center_mm)}), so no blood can enter there: use "
                "a finer grid spacing"
            )
    parted = [np.stack(septa(surface, neighbour, grid))]
    if wires is not None:
        parted.append(np.stack(septa(wires, neighbour, grid, of_wires=True)))
    both = np.unique(np.concatenate(parted, axis=1), axis=1)  # a link may cross a wire and the vessel's wall
    return Domain(
        cells, origin_mm, cell_size_mm, *links[:4], both[0], both[1], links[4], closed_gaps, surface, sections
    )


def between_wires(blood: Bools, corners: Floats) -> tuple[Bools, int]:
    """Return a mask of blood without closed triangles (m, 3, 3), in grid units, and the number of cells in gaps closed.

    A gap of a single cell between wires, or between a wire and the wall, is closed: its populations would bounce
    between the walls. The mask may be periodic; else none of its border is blood.
    """
    taken = blood & voxels.fill(corners, blood.shape)
    blood, closed = blood & ~taken, 0
    while True:
        gap = np.zeros_like(blood)
        for axis in range(3):
            beside = [(np.roll(blood, step, axis), np.roll(taken, step, axis)) for step in (1, -1)]
            gap |= blood & ~beside[0][0] & ~beside[1][0] & (beside[0][1] | beside[1][1])
        if not gap.any():
            return blood, closed
        blood, taken, closed = blood & ~gap, taken | gap, closed + int(gap.sum())


def _connected(
    inside: np.ndarray, vessel: Vessel, section: Floats, origin_mm: Floats, cell_size_mm: float
) -> np.ndarray:
    """Return the mask of the part connected to the inlet."""
    label, count = ndimage.label(inside)
    if count <= 1:
        return inside
    seeds = section.mean(axis=0) - vessel.inlet.normal * cell_size_mm * np.arange(0.5, 6.0)[:, None]
    index = np.clip(np.rint((seeds - origin_mm) / cell_size_mm).astype(int), 0, np.array(inside.shape) - 1)
    parts = label[tuple(index.T)]
    parts = parts[parts > 0]
    if len(parts) == 0:
        at = place(vessel.inlet.center_mm)
        raise CoarseGridError(
            f"at a grid spacing of {cell_size_mm:.3g} mm there is no blood next to the inlet at {at}: check that the "
            "inlet is an open end, or use a finer grid spacing"
        )
    return label == np.bincount(parts).argmax()


def extend(vessel: Vessel) -> tuple[Surface, Ints, tuple[Floats, ...]]:
    """Return the lumen closed, with a straight extension of the section's own shape at every opening.

    Patches of its faces (m,) are 0 for the wall and k + 1 for the end of opening k; sections are the polygons (j, 3)
    of these ends in mm.
    """
    lumen, obstacles = vessel.lumen, [vessel.closed]
    vertices, faces = [lumen.vertices_mm], [lumen.faces]
    patch = [np.full(len(lumen.faces), WALL)]
    sections: dict[int, Floats] = {}
    count = len(lumen.vertices_mm)
    for loop in lumen.boundary_loops:
        rim, n = lumen.vertices_mm[loop], len(loop)
        center = triangles.polygon_centroid(rim)
        apart = [np.linalg.norm(opening.center_mm - center) / opening.diameter_mm for opening in vessel.openings]
        k = int(np.argmin(apart))
        ring, ring_ids, patch_id = rim, loop, WALL
        if apart[k] < 0.5 and k not in sections:
            ring, ring_ids, patch_id = _extruded(vessel, k, rim, obstacles), np.arange(n, dtype=np.int32) + count, k + 1
            own = np.arange(n, dtype=np.int32)
            obstacles.append(Surface(np.concatenate([rim, ring]), _strip(own, own + n)))
            vertices.append(ring)
            faces.append(_strip(loop, ring_ids))
            patch.append(np.full(2 * n, WALL))
            sections[k] = ring
            count += n
        vertices.append(triangles.polygon_centroid(ring)[None])
        faces.append(np.stack([np.roll(ring_ids, -1), ring_ids, np.full_like(ring_ids, count)], axis=1))
        patch.append(np.full(n, patch_id))
        count += 1
    missing = [opening.role for k, opening in enumerate(vessel.openings) if k not in sections]
    if missing:
        raise FlowError(f"no open end of the lumen matches {', '.join(missing)}: trace the vessel again")
    surface = Surface(np.concatenate(vertices), np.concatenate(faces))
    return surface, np.concatenate(patch).astype(np.int32), tuple(sections[k] for k in range(len(vessel.openings)))


def extended_volume_mm3(vessel: Vessel) -> float:
    """Return the expected volume of a vessel with its extensions at full length."""
    ends = sum(opening.area_mm2 * _extension_mm(opening) for opening in vessel.openings)
    return abs(vessel.closed.volume_mm3) + ends


def _extension_mm(opening: Opening) -> float:
    """Return the full length of the extension of an opening."""
    return opening.diameter_mm * (INLET_EXTENSION if opening.is_inlet else OUTLET_EXTENSION)


def _extruded(vessel: Vessel, k: int, ring: Floats, obstacles: Sequence[Surface]) -> Floats:
    """Return a ring (j, 3) moved out to the plane where the extension ends, at most half-way to an obstacle."""
    opening = vessel.openings[k]
    ahead = (ring - opening.center_mm) @ opening.normal
    outer = float(ahead.max())
    rim = ring + (0.05 * opening.diameter_mm + outer - ahead)[:, None] * opening.normal
    middle = rim.mean(axis=0)
    starts = np.concatenate([rim, 0.5 * (rim + middle), middle[None]])
    ways = np.broadcast_to(opening.normal, starts.shape)
    free = min(float(obstacle.first_hit(starts, ways).min()) for obstacle in obstacles)
    length = outer + min(_extension_mm(opening), 0.5 * free)
    return ring + (length - ahead)[:, None] * opening.normal


def _strip(inner: Ints, outer: Ints) -> Ints:
    """Return the side faces between a boundary loop and its copy further out, oriented like the wall's faces."""
    a, b, c, d = inner, np.roll(inner, -1), np.roll(outer, -1), outer
    return np.concatenate([np.stack([b, a, d], axis=1), np.stack([b, d, c], axis=1)]).astype(np.int32)


def _links(
    surface: Surface,
    face_patch: Ints,
    neighbour: Ints,
    grid: Cells,
    is_beyond: Bools,
    wires: Surface | None,
    is_taken: Bools,
) -> tuple[Ints, Ints, Floats, Ints, Bools]:
    """Return the links that leave the blood: cell, direction, fraction to a wall, patch, and whether that is a wire.

    The masks are the cells of blood beyond a window, to which no links lead, and those in wires and the gaps closed at
    them.
    """
    cell, direction = np.nonzero(neighbour < 0)
    starts, step_mm = grid.centers_mm[cell], VELOCITIES[direction] * grid.cell_size_mm
    length_mm = np.linalg.norm(step_mm, axis=1)
    along, ahead = step_mm / length_mm[:, None], tuple((grid.cells[cell] + VELOCITIES[direction]).T)
    to_lumen = surface.first_hit(starts, along) / length_mm
    to_wire = np.full(len(cell), np.inf) if wires is None else wires.first_hit(starts, along) / length_mm
    fraction = np.minimum(to_lumen, to_wire)
    is_missed = fraction > 1.0
    is_wire = np.where(is_missed, is_taken[ahead], to_wire < to_lumen)
    fraction = np.clip(np.where(is_missed, 0.5, fraction), 1e-3, 1.0)
    _, _, face = surface.closest(starts + fraction[:, None] * step_mm)
    patch = np.where(is_missed | is_wire, WALL, face_patch[face])
    ends = ~(is_missed & is_beyond[ahead])
    cell, direction, patch = (one[ends].astype(np.int32) for one in (cell, direction, patch))
    return cell, direction, fraction[ends], patch, is_wire[ends]


def septa(surface: Surface, neighbour: Ints, grid: Cells, *, of_wires: bool = False) -> tuple[Ints, Ints]:
    """Return cell and lattice direction (s,) of the links between two blood cells that a wall separates, each once.

    `neighbour` (n, 19) are the neighbours of the cells. A corner of the vessel that a link only clips does not separate
    them, nor does a wire with less than `CLIPPED` of the link in it.
    """
    is_edge = np.asarray((neighbour < 0).any(axis=1))
    candidate = is_edge[:, None] & (neighbour >= 0) & is_edge[neighbour]
    candidate[:, 0::2] = False
    cell, direction = np.nonzero(candidate)
    crosses = surface.crosses(grid.centers_mm[cell], grid.centers_mm[cell] + VELOCITIES[direction] * grid.cell_size_mm)
    cell, direction = cell[crosses], direction[crosses]
    starts, step_mm = grid.centers_mm[cell], VELOCITIES[direction] * grid.cell_size_mm
    length_mm = np.linalg.norm(step_mm, axis=1)
    along = step_mm / length_mm[:, None]
    (this_mm, this_side), (that_mm, that_side) = (
        surface.first_hits(starts, along),
        surface.first_hits(starts + step_mm, -along),
    )
    if of_wires:
        parts = this_mm + that_mm < (1 - CLIPPED) * length_mm
    else:
        parts = np.einsum("ij,ij->i", surface.normals[this_side], surface.normals[that_side]) < BACK_TO_BACK
    return cell[parts].astype(np.int32), direction[parts].astype(np.int32)
