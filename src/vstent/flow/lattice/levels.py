"""Nested levels: each grid is refined by a factor of two in a part of the vessel, and both grids are coupled both ways.

The coarsest level covers the whole vessel with its openings; a finer one lies inside the next coarser one. Both have
the same speeds in lattice units, so that a finer level makes two time steps for one. Populations are at home only after
a pair of steps. Levels therefore overlap and exchange once per coarse pair, in which the finer one makes two pairs. The
kernels of collision and streaming know nothing of levels.

Cells of the coarser grid in a refined part are counted in *layers* from its rim. At an exchange, populations of finer
cells in the layers `CARRIED_DOWN` are interpolated from the coarser grid, and those of coarser cells in the layers
`CARRIED_UP` from the finer one. What is wrong at the edge of a grid moves one cell per step, so that it is overwritten
before it reaches the layer between. Interpolation is cubic (Lagrava, Malaspinas, Latt and Chopard 2012, J. Comput.
Phys. 231, 4808), and a least-squares fit in which the velocity vanishes at the wall where that leaves gaps in the
stencil; the non-equilibrium is rescaled (`collision.carried`).

Interpolation alone does not keep mass. On the border between the third and fourth layer the mass that crosses it on
either grid is therefore compared, and what crossed on the finer grid counts for both: the difference is returned to the
coarser cells beside the border (Berger and Colella 1989, J. Comput. Phys. 82, 64). The volumetric scheme of Rohde et
al. 2006 keeps mass as well, but it needs an exchange in each step, and walls that agree on both grids.

The same flow rate has velocities on both grids that differ by some thousandths, because their cells fill a section
differently. Blood that is set anew in each exchange would have to be accelerated by that between two of them: a border
across a tube of six coarse cells would take the pressure that falls over two cells. Momentum normal to the border is
therefore added to the cells that are set. It is integrated from what remains: on the coarser grid the mass that crosses
too much, on the finer one the difference of pressure between both grids in the layer between. It is bounded
(`exchange.MOST_PUSHED`), because wires that cross a border keep such a difference. Where a refined part has a single
border, nothing flows through it in sum, and no momentum is added: beside a neck it would stir the sac.
"""

from dataclasses import dataclass, replace
from math import ceil, inf, log2, pi, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from vstent.deployment.struts import thickness_mm
from vstent.errors import FlowError
from vstent.flow import domain as domains
from vstent.flow.case import FlowCase, Sheet
from vstent.flow.domain import Domain, Window
from vstent.flow.drag import BREADTH
from vstent.flow.indices import neck_diameter_mm
from vstent.flow.lattice.kernels import d3q19
from vstent.flow.lattice.setup import Crossings, Grid, address, behind, thickest
from vstent.geometry.surface import Surface
from vstent.kernels import voxels
from vstent.kernels.arrays import Bools, Floats, Ints
from vstent.kernels.directions import VELOCITIES
from vstent.units import place

WIDTH: Final = 2
"""Ratio of the grid spacings of two levels, and of their time steps."""
CARRIED_DOWN: Final = (1, 2)
"""Layers in which the finer level is set from the coarser one."""
CARRIED_UP: Final = (4, 5)
"""Layers in which the coarser level is set from the finer one."""
CARRIED_CELLS: Final = float(len(CARRIED_DOWN) * WIDTH**3), float(len(CARRIED_UP))
"""Numbers of finer and of coarser cells that are set for each coarser cell of the layer between."""
OF_SHEAR: Final = np.float32(0.5 * (1 - 1 / WIDTH**2))
"""Part of the correction in shear flow with which densities on both grids are compared (see `collision.carried`)."""
OWN_LAYER: Final = 4
"""First layer in which the finer level counts: mass that crosses into it is compared."""
RIM: Final = 3
"""Number of layers added around the cells to be refined."""
OPENING_CELLS: Final = 2
"""Distance in cells to which a refined part approaches the end of an opening, which only the coarsest level has."""
UPSTREAM_DIAMETERS, DOWNSTREAM_DIAMETERS = 5.0, 1.0
"""Extent of the refined part from the sac towards the inlet and the outlets, in mean diameters 4 V / A of the vessel.
The flow into the sac forms upstream: beside the same spacing everywhere (0.14 mm) the demo's neck inflow is 2 % lower
with one diameter, 1 % lower with two, 3 % higher with three and 2 % higher with five."""
JET_DIAMETERS: Final = 5.0
"""Radius of the refined part around an inlet, in its diameters."""
BESIDE_NECK: Final = 0.5
"""Distance in neck diameters from the nearest wire outside the sac up to which wires are walls on finer levels. Beyond,
they are a screen. Neck inflow at a fork (T) is 2 % higher than with all wires as walls; with a quarter it is 5 %."""
MARGIN_CELLS: Final = 14.0
"""Distance in cells by which a refined part around wires exceeds the next finer one: with less, the distance kept from
the border and `RIM` leave no room for that along diagonals."""
FURTHER: Final = 2
"""Most levels below the grid spacing that narrow branches get."""
MOST_POINTS: Final = 1e8
"""Most grid points in the box around narrow branches on such a level: 1.5 GB (see `cost.BYTES_PER_BOX_POINT`)."""
SCREEN_CELLS: Final = 4.0
"""Distance in cells from a neck with a screen, which is spread over layers of cells, up to which a grid is refined."""
CHANGING: Final = ("crossed", "lack", "push")
"""Arrays of an `Interface` that change during a run."""
CHUNK: Final = 10_000
"""Number of cells whose stencils are computed at once."""
REACH: Final = 1.2
"""Standard deviation in cells of the weights of a fit beside a wall."""
RIDGE: Final = 1e-3
"""Weight with which the derivatives of such a fit are drawn to zero, where too few cells determine them."""


@dataclass(frozen=True, eq=False)
class Stencil:
    """Interpolation from cells of one grid to cells of another."""

    place: Ints
    """(c,) storage places of the cells read."""
    start: Ints
    """(n + 1,) first entry of each target cell."""
    cell: Ints
    """(e,) number, among these cells, of the one read."""
    weight: NDArray[np.float32]
    """(e, 2) weights of the even and of the odd part of the populations."""
    target: Ints
    """(n,) storage places of the target cells."""
    limit: NDArray[np.float32]
    """(n,) largest grid Reynolds number there (see `setup.thickest`)."""
    group: Ints
    """(n,) group of each of them."""
    share: NDArray[np.float32]
    """(n, 3) what it gets of the momentum added to its group normal to the border, in proportion to the wall
    distance."""


@dataclass(frozen=True, eq=False)
class Interface:
    """Coupling of a grid and the next finer one; `crossed`, `lack` and `push` change in place during a run."""

    down: Stencil
    """From the coarser to the finer grid."""
    up: Stencil
    """From the finer to the coarser grid."""
    border: tuple[Crossings, Crossings]
    """What crosses the border on the coarser and on the finer grid."""
    beside: Ints
    """(c,) storage places of the cells of the coarser grid outside the border."""
    group: Ints
    """(c,) their groups."""
    share: Floats
    """(c,) part of each in what its group returns, in proportion to the wall distance."""
    crossed: Floats
    """(g,) mass that crossed on the finer grid since the last exchange and not on the coarser one, in coarse cells."""
    lack: Floats
    """(g,) mass taken from the cells beside the border before every pair of steps of the coarser grid."""
    between: tuple[Ints, Ints, Ints]
    """Cells of both grids in the layer that neither sets, where momentum is added (see `exchange.jumps`)."""
    push: Floats
    """(2, g) momentum into the finer grid that is added to the cells set on the finer and on the coarser grid."""
    is_trusted: Bools
    """(n,) whether each cell of the finer grid lies inside the border."""
    inner: tuple[Ints, Ints]
    """(i,) cells of the finer grid inside the border, and those of the coarser grid in which they lie."""

    def anew(self) -> "Interface":
        """Return the same coupling for another run."""
        return replace(self, **{name: np.zeros_like(getattr(self, name)) for name in CHANGING})

    def twin(self) -> "Interface":
        """Return the same coupling in its present state, for a run that goes its own way."""
        return replace(self, **{name: getattr(self, name).copy() for name in CHANGING})


def require_sac(case: FlowCase) -> Surface:
    """Return the sac of a case, around which the grid is refined; raise a `FlowError` where there is none."""
    if case.sac is None:
        raise FlowError("the grid cannot be refined in the sac, because this vessel has none: leave out --refine sac")
    return case.sac


def near_sac(case: FlowCase, grid: Domain) -> Bools:
    """Return whether each cell (n,) lies in the sac or in the artery near it."""
    # The distances, mm, between neighbouring cells that are not separated by the wall.
    neighbour = grid.neighbours()
    is_open = neighbour >= 0
    is_open[:, 0::2] = False  # count every pair once
    is_open[grid.septum_cell, grid.septum_direction] = False
    cell, direction = np.nonzero(is_open)
    length_mm = grid.cell_size_mm * np.linalg.norm(VELOCITIES, axis=1)[direction]
    places = cell, neighbour[cell, direction]
    graph = csr_matrix(coo_matrix((length_mm, places), shape=(len(grid.cells),) * 2))
    distance_mm = dijkstra(graph, directed=False, indices=domains.cells_of_sac(case, grid), min_only=True)
    diameter_mm = domains.mean_diameter_mm(case.vessel)
    is_near = distance_mm <= DOWNSTREAM_DIAMETERS * diameter_mm
    piece = np.full(len(distance_mm), -1)
    piece[~is_near] = connected_components(graph[~is_near][:, ~is_near], directed=False)[1]
    leads_in = grid.link_cell[(grid.link_patch > 0) & (grid.link_patch <= len(case.vessel.inlets))]
    is_upstream = (piece >= 0) & np.isin(piece, piece[leads_in])
    return is_near | (is_upstream & (distance_mm <= UPSTREAM_DIAMETERS * diameter_mm))


def _balls(case: FlowCase, size_mm: float) -> Floats:
    """Return centers and radii (b, 4) of the balls to be refined, each wide enough for a cell of this size."""
    refine, inlets = case.numerics.refine, case.vessel.inlets
    jets = [(*one.center_mm, JET_DIAMETERS * one.diameter_mm) for one in inlets if "inlet" in refine]
    balls = np.array([*jets, *(one for one in refine if not isinstance(one, str))], dtype=float).reshape(-1, 4)
    away_mm = case.vessel.closed.signed_distance(balls[:, :3])
    for x, y, z, radius_mm in balls[away_mm >= balls[:, 3]]:
        raise FlowError(
            f"the ball of {radius_mm:.3g} mm around {place(np.array([x, y, z]))} in which the grid is to be refined "
            "holds no blood: move it into the vessel (--refine X,Y,Z,R)"
        )
    balls[:, 3] = np.maximum(balls[:, 3], np.maximum(away_mm, 0.0) + size_mm)
    return balls


def _narrow(case: FlowCase, size_mm: float) -> Floats:
    """Return centers and radii (m, 4) of spheres along branches too narrow for a grid, if their resistance matters."""
    lines = () if case.is_split_given else case.vessel.centerlines
    spheres = [np.column_stack([one.points_mm, 1.5 * one.inscribed_radius_mm]) for one in lines]
    found = np.concatenate([np.zeros((0, 4)), *spheres])
    return found[2 * found[:, 3] < 1.5 * domains.BRANCH_CELLS * size_mm]


def _spheres(case: FlowCase, size_mm: float, cell_size_mm: float) -> Floats:
    """Return centers and radii (m, 4) of balls, and along narrow branches, refined on a grid with this spacing."""
    parts = [_balls(case, size_mm)] if size_mm > cell_size_mm else []
    if size_mm > 1.5 * cell_size_mm / WIDTH ** further_levels(case, cell_size_mm):
        parts.append(_narrow(case, size_mm))
    return np.concatenate([np.zeros((0, 4)), *parts])


def _in(spheres: Floats, points_mm: Floats) -> Bools:
    """Return whether points (n, 3) lie in spheres (m, 4)."""
    result = np.zeros(len(points_mm), dtype=bool)
    for inside in cKDTree(points_mm).query_ball_point(spheres[:, :3], spheres[:, 3]) if len(spheres) else ():
        result[inside] = True
    return result


def further_levels(case: FlowCase, cell_size_mm: float) -> int:
    """Return the number of levels finer than the grid spacing that narrow branches get."""
    most = FURTHER if "branches" in case.numerics.refine else 0
    fits = (0 < box_points(case, cell_size_mm / WIDTH**count) < MOST_POINTS for count in range(most))
    return next((count for count, fits_too in enumerate(fits) if not fits_too), most)


def box_points(case: FlowCase, size_mm: float) -> float:
    """Return the number of points in the box of the finer grid in branches too narrow for a spacing; 0 without them."""
    at_mm, reach_mm = np.split(_narrow(case, size_mm), [3], axis=1)
    edges_mm = np.ptp([*at_mm - reach_mm, *at_mm + reach_mm], axis=0) if len(at_mm) else np.zeros(3)
    return float((edges_mm * WIDTH / size_mm).prod())


def _reach_mm(case: FlowCase, size_mm: float, finest_mm: float) -> float:
    """Return the distance to which a grid with this spacing is refined around wires or a neck (see `_around`)."""
    if case.has_screen:
        own_mm = SCREEN_CELLS * size_mm
    else:
        assert case.walls is not None
        own_mm = thickness_mm(case.walls)
    return own_mm + MARGIN_CELLS * max(0.0, size_mm - WIDTH * finest_mm)


def _around(case: FlowCase) -> Surface:
    """Return what finer levels lie around: a neck with a screen, or wires that are walls.

    Walls are the wires in the sac and near its neck, and those of the side of a device that faces a neck at a fork from
    a distance. The neck is the same for all devices in a vessel, which share the grids.
    """
    if case.has_screen:
        assert case.ostium is not None
        return case.ostium
    walls = case.walls
    assert walls is not None
    if case.sac is None or case.ostium is None:
        return walls
    away_mm = case.sac.signed_distance(walls.corners_mm.mean(axis=1))
    nearest_mm = np.min(away_mm, where=away_mm > 0, initial=inf)  # coils in the sac are nearer than a device beside it
    is_near = away_mm <= nearest_mm + BESIDE_NECK * neck_diameter_mm(case.ostium)
    return Surface(walls.vertices_mm, walls.faces[is_near])


def beside_walls(case: FlowCase, blood_mm: Floats) -> FlowCase:
    """Return a case without the part of its media whose wires are walls of a grid with cells at (n, 3).

    The bands of wires reach beyond the border of a finer level, where they would resist once more.
    """
    wires, tree = case.walls, cKDTree(blood_mm)
    assert wires is not None

    def left(sheet: Sheet) -> Sheet:
        nearest_mm, away_mm, _ = wires.closest(sheet.points_mm)
        is_wall = tree.query(nearest_mm)[0] < thickness_mm(wires)
        is_own = away_mm < 0.5 * BREADTH * sheet.spacing_mm + thickness_mm(wires)
        is_region = ~sheet.normals.any(axis=1)
        return sheet.part(~(is_wall & (is_own | is_region)))

    return replace(case, media=tuple(left(one) for one in case.media))


def near_wires(case: FlowCase, grid: Domain, finest_mm: float) -> Bools:
    """Return whether each cell (n,) lies near the wires or the neck of a case, where the finest has this spacing."""
    around, reach_mm = _around(case), _reach_mm(case, grid.cell_size_mm, finest_mm)
    low, high = around.vertices_mm.min(axis=0) - reach_mm, around.vertices_mm.max(axis=0) + reach_mm
    result = ((grid.centers_mm > low) & (grid.centers_mm < high)).all(axis=1)
    result[result] = around.closest(grid.centers_mm[result])[1] < reach_mm
    return result


def volume_mm3(case: FlowCase, size_mm: float, cell_size_mm: float) -> float:
    """Estimate the volume of what is refined on a grid with this spacing (see `refined`)."""
    result, spheres, rim_mm = 0.0, _spheres(case, size_mm, cell_size_mm), 1.2 * RIM * size_mm
    if "sac" not in case.numerics.refine and size_mm == cell_size_mm * WIDTH**case.numerics.coarser_levels:
        spheres[:, 3] += rim_mm  # elsewhere rims lie in the border of the level before, or in the artery near the sac
    if size_mm > cell_size_mm and "sac" in case.numerics.refine:
        diameter_mm = domains.mean_diameter_mm(case.vessel)
        neck_mm2 = 0.0 if case.ostium is None else case.ostium.area_mm2
        stretch_mm = (UPSTREAM_DIAMETERS + DOWNSTREAM_DIAMETERS) * diameter_mm + sqrt(4 / pi * neck_mm2)
        result += abs(require_sac(case).volume_mm3) + pi / 4 * diameter_mm**2 * (stretch_mm + 2 * RIM * size_mm)
    elif size_mm > around_wires_mm(case):
        reach_mm = _reach_mm(case, size_mm, cell_size_mm / WIDTH ** wire_levels(case, cell_size_mm)) + rim_mm
        at = np.unique(np.rint(_around(case).corners_mm.mean(axis=1) / (0.25 * reach_mm)), axis=0) * 0.25 * reach_mm
        spheres = np.concatenate([spheres, np.column_stack([at, np.full(len(at), reach_mm)])])
    if len(spheres):
        low_mm = (spheres[:, :3] - spheres[:, 3:]).min(axis=0)
        edges_mm = (spheres[:, :3] + spheres[:, 3:]).max(axis=0) - low_mm
        step_mm = max(size_mm, 0.01 * float(np.cbrt(edges_mm.prod())))  # at most a million points
        x, y, z = np.ceil(edges_mm / step_mm).astype(int)
        blood = np.argwhere(voxels.fill((domains.extend(case.vessel)[0].corners_mm - low_mm) / step_mm, (x, y, z)))
        result += float(_in(spheres, low_mm + step_mm * blood).sum()) * step_mm**3
    return min(result, domains.extended_volume_mm3(case.vessel))


def window(grid: Domain, is_wanted: Bools, is_outer: Bools | None = None) -> tuple[Window, Ints]:
    """Return the part of a grid to be refined around wanted cells (n,), and the layer of every point of the grid.

    It keeps away from the cells (n,) of the grid that are outside the border with a coarser one, and of those carried.
    The layer is 0 outside the part; `CARRIED_UP` and deeper ones have the same number.
    """
    full, shape = np.ones((3, 3, 3), dtype=bool), grid.index.shape
    blood, within, ends = grid.index >= 0, np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
    within[tuple(grid.cells[is_wanted].T)] = True
    ends[tuple(grid.cells[grid.link_cell[grid.link_patch > 0]].T)] = True
    within = ndimage.binary_dilation(within, full, RIM, mask=blood)
    within &= ~ndimage.binary_dilation(ends, full, OPENING_CELLS)
    if is_outer is not None:
        ends[:] = False
        ends[tuple(grid.cells[is_outer].T)] = True
        within &= ~ndimage.binary_dilation(ends, full, WIDTH * len(CARRIED_UP) + 1)
    if not within.any():
        raise domains.CoarseGridError(
            f"a grid of {grid.cell_size_mm:.3g} mm has no cell that can be refined: use a finer grid spacing"
        )
    front = blood & ~within
    within |= ndimage.binary_dilation(within, full) & ~blood  # finer cells may lie between coarser ones and the wall
    layer = np.where(within, CARRIED_UP[-1] + 1, 0)
    for number in range(1, CARRIED_UP[-1] + 1):
        front = ndimage.binary_dilation(front, full) & (layer > CARRIED_UP[-1])
        layer[front] = number
    outside, _ = ndimage.label(blood & (layer < OWN_LAYER), full)
    behind_wall = (outside > 0) & ~np.isin(outside, outside[layer == 0])
    layer[behind_wall | (ndimage.binary_dilation(behind_wall, full) & within & ~blood)] = CARRIED_UP[-1] + 1
    low, high = np.argwhere(within).min(axis=0) - 1, np.argwhere(within).max(axis=0) + 2
    part = np.pad(within, 1)[tuple(slice(a, b) for a, b in zip(low + 1, high + 1, strict=True))]
    fine = part.repeat(WIDTH, axis=0).repeat(WIDTH, axis=1).repeat(WIDTH, axis=2)
    size_mm = grid.cell_size_mm / WIDTH
    return Window(grid.origin_mm + low * grid.cell_size_mm - 0.5 * (grid.cell_size_mm - size_mm), fine), layer


def sizes_mm(case: FlowCase, cell_size_mm: float) -> tuple[float, ...]:
    """Return the grid spacings of the levels of a case, coarse to fine, where `cell_size_mm` is wanted.

    One is coarser where it is wanted in a part of the vessel; those around wires and in narrow branches are finer.
    Where there is no such part a `FlowError` is raised.
    """
    if "sac" in case.numerics.refine:
        require_sac(case)
    _balls(case, cell_size_mm)
    finer = max(wire_levels(case, cell_size_mm), further_levels(case, cell_size_mm))
    return tuple(cell_size_mm / WIDTH**k for k in range(-case.numerics.coarser_levels, finer + 1))


def wire_levels(case: FlowCase, cell_size_mm: float) -> int:
    """Return the number of levels finer than the grid spacing around wires or a neck with a screen."""
    return ceil(log2(max(1.0, cell_size_mm / around_wires_mm(case))))


def around_wires_mm(case: FlowCase) -> float:
    """Return the largest grid spacing that suits the wires of a case; inf without wires, or where it was chosen.

    Walls need cells across a wire, and a screen `cells_across_neck`.
    """
    numerics = case.numerics
    if case.walls is not None:
        return domains.around_walls_mm(case.walls)
    if case.has_screen and case.ostium is not None and numerics.cell_size_mm is None:
        return neck_diameter_mm(case.ostium) / max(numerics.cells_across_neck, 1e-9)
    return inf


def refined(case: FlowCase, coarse: Grid, cell_size_mm: float) -> tuple[Grid, Grid, Interface]:
    """Return a grid of a case with a grid spacing, the next finer one in it, and the coupling of both.

    A grid coarser than the spacing is refined where the settings say; all are around wires and in narrow branches.
    Wires are walls of the finer grid where they are thick enough for it.
    """
    wide = coarse.domain
    wanted = _in(_spheres(case, wide.cell_size_mm, cell_size_mm), wide.centers_mm)
    if wide.cell_size_mm > cell_size_mm and "sac" in case.numerics.refine:
        wanted |= near_sac(case, wide)
    if wide.cell_size_mm > around_wires_mm(case):
        wanted |= near_wires(case, wide, cell_size_mm / WIDTH ** wire_levels(case, cell_size_mm))
    part, layer = window(wide, wanted, None if coarse.side is None else coarse.side % 2 == 0)
    size_mm = wide.cell_size_mm / WIDTH
    domain = domains.build(case.vessel, size_mm, part, domains.wires_of(case, size_mm))
    limit = thickest(case, domain)
    addressing = address(domain, limit)
    layers: Ints = layer[tuple(np.rint(wide.places(domain.centers_mm)).astype(int).T)]
    # What is deferred at a wall would outlast the exchange that overwrites the cells at the rim.
    is_kept = addressing.link_has_two & (layers > CARRIED_DOWN[-1])[domain.link_cell]
    fine = Grid(domain, limit, replace(addressing, link_has_two=is_kept))
    return _coupled(coarse, fine, layer[tuple(wide.cells.T)], layers)


def _coupled(coarse: Grid, fine: Grid, layer_of_wide: Ints, layer_of_fine: Ints) -> tuple[Grid, Grid, Interface]:
    """Return two grids with their border, and their coupling, from the layer of every cell (see `window`)."""
    wide = coarse.domain
    sides = layer_of_wide >= OWN_LAYER, layer_of_fine >= OWN_LAYER
    links = [_crossing(grid, is_own) for grid, is_own in zip((coarse, fine), sides, strict=True)]
    beside = np.unique(links[0][1])
    near = cKDTree(wide.cells[beside]).query_pairs(1.8, output_type="ndarray")
    joins = coo_matrix((np.ones(len(near)), near.T), shape=(len(beside),) * 2)
    count, group = connected_components(joins, directed=False)
    groups = max(1, count)
    nearest = cKDTree(wide.centers_mm[beside]) if len(beside) else None

    def group_at(places_mm: Floats) -> Ints:
        return group[nearest.query(places_mm)[1]] if nearest else np.zeros(len(places_mm), np.int32)

    grids, border = [], []
    for grid, is_own, (inside, outside, crossed) in zip((coarse, fine), sides, links, strict=True):
        # Links that cross between the same two points share a group: along the border they carry mass to and fro.
        of_link = group_at(0.5 * (grid.domain.centers_mm[inside] + grid.domain.centers_mm[outside]))
        order = np.argsort(of_link, kind="stable")
        start = np.searchsorted(of_link[order], np.arange(groups + 1)).astype(np.int32)
        first = behind(grid.addressing) + 2 * sum(len(one.cell) for one in grid.crossings)
        border.append(Crossings(inside[order], crossed[order], start, first))
        side = is_own + 2 * (0 if grid.side is None else grid.side)
        grids.append(replace(grid, crossings=(*grid.crossings, border[-1]), side=side.astype(np.int32)))
        ahead_mm = grid.domain.centers_mm[inside] - grid.domain.centers_mm[outside]
    size_mm = np.bincount(of_link, np.linalg.norm(ahead_mm, axis=1), groups)
    total_mm = np.stack([np.bincount(of_link, along_mm, groups) for along_mm in ahead_mm.T], axis=1)
    normal = total_mm / np.maximum(size_mm, 1e-300)[:, None]
    normal[_is_alone(wide, sides[0], links[0][0], group[np.searchsorted(beside, links[0][1])], groups)] = 0.0

    def carried(read: Grid, written: Grid, target: Ints) -> Stencil:
        of_cell = group_at(written.domain.centers_mm[target])
        share = _shares(of_cell, written.domain.depth_mm[target], groups)[:, None] * normal[of_cell]
        return stencil(read, written, target, of_cell, share)

    in_wide = wide.cells_at(fine.domain.centers_mm)
    corner = fine.domain.cell_size_mm * (np.indices((WIDTH,) * 3).reshape(3, -1).T - 0.5)
    middle: Ints = np.flatnonzero(layer_of_wide == OWN_LAYER - 1)
    middle = middle[normal[group_at(wide.centers_mm[middle])].any(axis=1)]
    finer = np.stack([fine.domain.cells_at(wide.centers_mm[middle] + offset) for offset in corner], axis=1)
    middle, finer = middle[(finer >= 0).all(axis=1)], finer[(finer >= 0).all(axis=1)]
    coupling = Interface(
        carried(coarse, fine, np.flatnonzero(np.isin(layer_of_fine, CARRIED_DOWN))),
        carried(fine, coarse, np.flatnonzero(np.isin(layer_of_wide, CARRIED_UP))),
        (border[0], border[1]),
        coarse.addressing.place[beside],
        group,
        _shares(group, wide.depth_mm[beside], groups),
        np.zeros(groups),
        np.zeros(groups),
        (coarse.addressing.place[middle], fine.addressing.place[finer], group_at(wide.centers_mm[middle])),
        np.zeros((2, groups)),
        sides[1],
        (inner := np.flatnonzero(sides[1] & (in_wide >= 0)), in_wide[inner]),
    )
    return grids[0], grids[1], coupling


def _is_alone(wide: Domain, is_own: Bools, inside: Ints, of_link: Ints, groups: int) -> Bools:
    """Return whether each group is the only border of its refined part, through which nothing flows in sum.

    `is_own` (n,) are the cells of the grid in refined parts, `inside` (l,) those at links across borders, and `of_link`
    (l,) the groups of these links.
    """
    refined_parts = np.zeros(wide.index.shape, dtype=bool)
    refined_parts[tuple(wide.cells[is_own].T)] = True
    number, _ = ndimage.label(refined_parts, np.ones((3, 3, 3)))
    part = np.zeros(groups, dtype=int)
    part[of_link] = number[tuple(wide.cells[inside].T)]
    return np.asarray(np.bincount(part)[part] == 1)


def _shares(group: Ints, size: Floats, groups: int) -> Floats:
    """Return the part (c,) of each cell in the total size of its group."""
    return size / np.bincount(group, size, groups)[group]


def _crossing(grid: Grid, is_own: Bools) -> tuple[Ints, Ints, Ints]:
    """Return cells inside (l,) and outside (l,) of a part (n,) of a grid, and addresses (l, 2) as in `Crossings`."""
    domain, addressing = grid.domain, grid.addressing
    ahead = domain.neighbours()
    crosses = (ahead >= 0) & is_own[:, None] & ~is_own[ahead]
    first, direction = domain.septum_cell, domain.septum_direction
    crosses[first, direction] = False
    crosses[ahead[first, direction], d3q19.OPPOSITE[direction]] = False
    inside, q = np.nonzero(crosses)
    outside = ahead[inside, q]
    enters = d3q19.OPPOSITE[q] * addressing.stride + addressing.place[inside]
    leaves = q * addressing.stride + addressing.place[outside]
    return inside, outside, np.column_stack([enters, leaves]).astype(np.int32)


def stencil(read: Grid, written: Grid, target: Ints, group: Ints, share: Floats) -> Stencil:
    """Return the interpolation from cells of one grid to cells `target` (n,) of another (see `Stencil`).

    Those with no cell of the first grid near them are left out.
    """
    pieces = np.split(target, np.arange(CHUNK, len(target), CHUNK))
    parts = [_weights(read.domain, written.domain, piece) for piece in pieces]
    counts, cell = (np.concatenate([part[k] for part in parts]) for k in range(2))
    weight = np.concatenate([part[2] for part in parts])
    is_near = counts > 0
    target, group, share = target[is_near], group[is_near], share[is_near]
    is_read = np.zeros(len(read.domain.cells), dtype=bool)
    is_read[cell] = True
    number = np.cumsum(is_read, dtype=np.int32) - 1
    return Stencil(
        read.addressing.place[is_read],
        np.r_[0, np.cumsum(counts[is_near])].astype(np.int32),
        number[cell],
        weight,
        written.addressing.place[target],
        written.limit[target],
        group,
        share.astype(np.float32),
    )


def _weights(source: Domain, other: Domain, target: Ints) -> tuple[Ints, Ints, NDArray[np.float32]]:
    """Return the number (m,) of cells of `source` read for each cell `target` of another grid, them, and weights."""
    at = source.places(other.centers_mm[target])
    corner = np.floor(at).astype(int)
    offset = np.indices((4, 4, 4)).reshape(3, -1).T - 1
    around = corner[:, None] + offset
    index = np.pad(source.index, 4, constant_values=-1)
    limit: Ints = np.array(index.shape) - 1
    cell = index[tuple(np.moveaxis(np.clip(around + 4, 0, limit), -1, 0))]
    of_septa = np.zeros(len(source.cells) + 1, dtype=bool)
    of_septa[source.septum_cell] = True
    t = (at - corner)[..., None]
    nodes = np.array([-1, 0, 1, 2])
    others = np.array([[0, 1, 2], [-1, 1, 2], [-1, 0, 2], [-1, 0, 1]])
    cubic = (t[..., None] - others).prod(axis=3) / (nodes[:, None] - others).prod(axis=1)  # Lagrange's polynomials
    linear = np.maximum(0.0, 1.0 - np.abs(nodes - t))
    # Exact for cubic functions with half the cells of the product of three polynomials.
    mixed = [[cubic[:, k] if k == axis else linear[:, k] for k in range(3)] for axis in range(3)]
    even = sum((_product(*one) for one in mixed), -2.0 * _product(*np.moveaxis(linear, 1, 0)))
    odd = even.copy()
    is_whole = (((cell >= 0) & ~of_septa[cell]) | (even == 0)).all(axis=1)
    beside = np.flatnonzero(~is_whole)
    if len(beside):
        away = offset - (at - corner)[beside][:, None]
        even[beside], odd[beside] = _beside_wall(source, other, target[beside], cell[beside], away)
    is_used = (cell >= 0) & (even != 0)
    weight = np.stack([even[is_used], odd[is_used]], axis=1).astype(np.float32)
    return is_used.sum(axis=1), cell[is_used], weight


def _product(along_x: Floats, along_y: Floats, along_z: Floats) -> Floats:
    """Return the products (m, 64) of weights (m, 4) along the three axes."""
    return np.einsum("ma,mb,mc->mabc", along_x, along_y, along_z).reshape(-1, 64)


def _beside_wall(source: Domain, other: Domain, target: Ints, cell: Ints, away: Floats) -> tuple[Floats, Floats]:
    """Return the weights (m, 64) of a fit to cells (m, 64) of `source`, -1 for none, at cells `target` (m,).

    The even part of the populations is fitted as linear, the odd part as the wall distance times a quadratic function.
    `away` (m, 64, 3) is the distance of the cells from the target in cells. Cells behind a wall do not count.
    """
    is_blood = cell >= 0
    row, column = np.nonzero(is_blood)
    from_mm = other.centers_mm[target]
    hidden = source.surface.crosses(from_mm[row], source.centers_mm[cell[row, column]])
    is_blood[row[hidden], column[hidden]] = False
    depth_mm = source.depth_mm[cell]
    x, y, z = np.moveaxis(away, 2, 0)
    basis = np.stack([np.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, x * z, y * z], axis=2)
    trust = is_blood * np.exp(-0.5 * (away**2).sum(axis=2) / REACH**2)
    own_mm = other.depth_mm[target]
    return _fitted(trust, basis[:, :, :4]), _fitted(trust, basis * depth_mm[:, :, None]) * own_mm[:, None]


def _fitted(trust: Floats, basis: Floats) -> Floats:
    """Return the weights (m, k) with which values give the first coefficient of a fit with a basis (m, k, b)."""
    matrix = np.einsum("mk,mki,mkj->mij", trust, basis, basis)
    size = matrix[:, :1, 0] + 1e-12
    terms = np.arange(matrix.shape[1])
    matrix[:, terms[1:], terms[1:]] += RIDGE * size
    matrix[:, 0, 0] += 1e-9
    unit = np.broadcast_to(np.eye(len(terms))[0][:, None], (len(matrix), len(terms), 1))
    return np.asarray(trust * np.einsum("mki,mi->mk", basis, np.linalg.solve(matrix, unit)[..., 0]))
