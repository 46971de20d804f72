"""Setup of a lattice-Boltzmann run: memory layout of the populations, walls, openings and viscosity limits."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vstent.flow.case import FlowCase
from vstent.flow.domain import Domain
from vstent.flow.lattice.ends import Ends
from vstent.flow.lattice.kernels import d3q19, lanes
from vstent.flow.lattice.scales import Scales
from vstent.kernels import directions, voxels
from vstent.kernels.arrays import Bools, Floats, Ints

CELL_REYNOLDS_AT_END = 25.0
"""Grid Reynolds number (speed times grid spacing divided by viscosity) in the extensions of the openings above which
the viscosity is raised. Fast flow becomes unstable there first: runs failed at values of 30 to 50."""
CELL_REYNOLDS: Final = 75.0
"""Grid Reynolds number in the vessel above which the viscosity is raised. The systole of C0038 diverged with 100 at a
grid spacing of 0.4 mm and with 150 at 0.2 mm."""
PAGE, OFF_PAGE = 1024, 216
"""Number of float32 values in a page of 4096 bytes, and offset of the stride from whole pages. Addresses that are whole
pages apart share the same few places of a cache; nineteen populations stored so would make a run a quarter slower."""
REFILL_BLOCK = 2
"""Edge in cells of the blocks within which the mass lost at interpolated walls is redistributed."""
CURVE: Final = np.array([1.0, -2.0, 0.0, 1.0, 0.0], np.float32)
"""Coefficients of the second difference along a link, for the populations a, b, c, e and g (see `d3q19.defer`)."""


@dataclass(frozen=True, eq=False)
class Addressing:
    """Memory layout of the populations (see `vstent.flow.lattice.kernels.d3q19`)."""

    stride: int
    """Distance between two populations of a cell: the number of storage places plus padding (see `OFF_PAGE`)."""
    place: Ints
    """(n,) storage place of every cell."""
    length: Ints
    """(s,) number of cells of every segment."""
    first_cell: Ints
    """(s,) first cell of every segment."""
    address: Ints
    """(2, s, 19) address of the first population of every segment and direction, in an even and in an odd step."""
    link_address: Ints
    """(l, 6) addresses of the populations at every link (see `d3q19.paths`)."""
    link_has_one: NDArray[np.bool_]
    """(l,) whether the cell behind the link's cell is blood, with no septum between them."""
    link_has_two: NDArray[np.bool_]
    """(l,) whether the two cells behind the link's cell are blood, with no septum between them."""
    septa: Ints
    """(2, t) addresses of populations exchanged at septa (see `d3q19.update`), sorted by layer of their cell."""
    septum_cell: Ints
    """(t,) cell of every septum."""


@dataclass(frozen=True, eq=False)
class Crossings:
    """Links between two cells of blood of which the mass that passes is read (see `levels`)."""

    cell: Ints
    """(b,) cell on the side into which mass counts as positive."""
    address: Ints
    """(b, 2) addresses of the populations that enter it and that leave it, at home."""
    start: Ints
    """(g + 1,) first link of every group."""
    first: int
    """Address of what passed along the first link in the even step of the last pair; then those of the other links, and
    those in the odd step."""


@dataclass(frozen=True, eq=False)
class Grid:
    """A grid and what depends on it alone; flows in the same vessel share it."""

    domain: Domain
    """Cells and links."""
    limit: NDArray[np.float32]
    """(n,) largest grid Reynolds number of every cell (see `thickest`)."""
    addressing: Addressing
    """Memory layout of the populations."""
    crossings: tuple[Crossings, ...] = ()
    """Borders with a finer and with a coarser grid."""
    side: Ints | None = None
    """(n,) side of these borders on which each cell lies; None without any."""

    @cached_property
    def link_order(self) -> Ints:
        """Order (l,) of links that reads memory in sequence: ends by cell, then the wall by layer and direction."""
        domain = self.domain
        is_wall = domain.link_patch == 0
        patch = np.where(is_wall, domain.link_patch.max(initial=0) + 1, domain.link_patch)
        keys = domain.link_direction, domain.cells[domain.link_cell, 0]
        return np.lexsort((domain.link_cell, *(np.where(is_wall, key, 0) for key in keys), patch))

    @cached_property
    def of_ends(self) -> int:
        """Number of links of the ends, which are the first."""
        return int((self.domain.link_patch > 0).sum())

    @cached_property
    def by_layer(self) -> tuple[Ints, Ints]:
        """Links (o,) of the ends and crossings, sorted by layer of their cell, and these cells (o,)."""
        of_ends = self.domain.link_cell[self.link_order[: self.of_ends]]
        cell = np.concatenate([of_ends, *(crossing.cell for crossing in self.crossings)])
        number = np.arange(len(cell))
        number[self.of_ends :] += len(self.domain.link_cell) - self.of_ends
        order = np.argsort(cell, kind="stable")
        return number[order].astype(np.int32), cell[order]

    @cached_property
    def bands(self) -> Ints:
        """Bands (b + 1, 5) for `d3q19.update`: the layers of cells across the first axis of the grid."""
        a, of_walls = self.addressing, self.domain.link_cell[self.link_order[self.of_ends :]]
        cells = a.first_cell, np.unique(of_walls), of_walls, self.by_layer[1], a.septum_cell
        layer = self.domain.cells[:, 0]
        edges = np.arange(layer.min(), layer.max() + 2)
        bands = np.stack([np.searchsorted(layer[ordered], edges) for ordered in cells], axis=1)
        bands[:, 2] += self.of_ends
        return bands.astype(np.int32)

    @cached_property
    def groups(self) -> tuple[Ints, tuple[Ints, Ints, Ints, Ints]]:
        """`Refill.place` and `Refill.groups`: the groups of wall cells within which the lost mass is redistributed."""
        cell = self.domain.link_cell[self.link_order[self.of_ends :]]
        wall_cell, of_link = np.unique(cell, return_inverse=True)
        block = self.domain.cells[wall_cell] // REFILL_BLOCK
        if self.side is not None:
            block = np.column_stack([block, self.side[wall_cell]])
        group = np.unique(block, axis=0, return_inverse=True)[1].ravel()
        return self.addressing.place[wall_cell], (*_grouped(group[of_link]), *_grouped(group))


@dataclass(frozen=True, eq=False)
class Links:
    """Coefficients of all links that reflect populations: first those of the ends, then those of the wall.

    `path`, `weight` and `source` have further links at their end: those that write what passes at `Grid.crossings`
    behind the populations.

    The ends are the openings of the vessel, which only the coarsest level has. `source` and `openings` change in place
    during a run.
    """

    patch: Ints
    """(k,) patch number of every end (see `Domain.link_patch`)."""
    address: Ints
    """(l, 6) addresses of the populations at every link (see `d3q19.paths`)."""
    path: Ints
    """(2, l, 3) populations that a link reads and writes, after an even and after an odd step (see `d3q19.update`)."""
    weight: NDArray[np.float32]
    """(l, 2) weights of linearly interpolated bounce-back (see `d3q19.update`)."""
    correction: NDArray[np.float32]
    """(l, 5) weights of the deferred correction to parabolic interpolation (see `d3q19.defer`)."""
    viscous: NDArray[np.float32]
    """(l,) multiple of `CURVE` that viscosity subtracts from `correction`."""
    source: NDArray[np.float32]
    """(l,) source term of every link."""
    openings: Floats
    """(k, d3q19.OPENING) condition and state of every end (see `d3q19.drive`)."""
    start: Ints
    """(k + 1,) first link of every end, and of the wall."""
    by_layer: Ints
    """Links of the ends and of crossings, sorted by layer of their cell."""
    place: Ints
    """(o,) storage place of the cell of every link of the ends."""
    direction: Ints
    """(o,) lattice direction of every link of the ends."""
    wanted: Floats
    """(k,) speed imposed at every end at mean flow, in lattice units."""
    course: Floats
    """(m, k) speed or density to add to it, at m equally spaced times of a cycle."""
    shape: Floats
    """(m, o, 2) profile coefficients at the same times (see `d3q19.drive`)."""
    of_wires: Ints
    """(w,) links that meet wires."""
    wire_direction: Ints
    """(w,) lattice direction of each of them."""

    @property
    def is_inflow(self) -> Bools:
        """Whether blood is sent in through each end (k,)."""
        return np.asarray(self.openings[:, d3q19.KIND] == d3q19.INFLOW)

    def stretched(self, stretch: float) -> "Links":
        """Return the same links for time steps `stretch` times as long; arrays that change in place are shared."""
        is_inflow = np.repeat(self.is_inflow, np.diff(self.start))
        return replace(
            self,
            correction=self.correction - np.outer(np.float32(stretch - 1) * self.viscous, CURVE),
            wanted=stretch * self.wanted,
            course=stretch * self.course,
            shape=np.where(is_inflow, 1.0, stretch**2)[:, None] * self.shape,
        )


@dataclass(frozen=True, eq=False)
class Refill:
    """Redistribution of the mass lost at interpolated walls (see `d3q19.balance`); `refill` changes in place."""

    place: Ints
    """(w,) storage place of every wall cell."""
    groups: tuple[Ints, Ints, Ints, Ints]
    """Links and wall cells of every group (see `d3q19.balance`); a group is a block of `REFILL_BLOCK` cells."""
    lost: NDArray[np.float32]
    """(l,) mass lost at every wall link (see `d3q19.defer`)."""
    refill: NDArray[np.float32]
    """(w,) mass added to every wall cell in every step."""


def thickest(case: FlowCase, domain: Domain) -> NDArray[np.float32]:
    """Return the largest grid Reynolds number (n,) of every cell, above which the viscosity is raised."""
    beyond = np.zeros(len(domain.cells), dtype=bool)  # in the extension of an opening
    for opening, section in zip(case.vessel.openings, domain.sections, strict=True):
        offset_mm = domain.centers_mm - opening.center_mm
        ahead_mm = offset_mm @ opening.normal
        length_mm = float(((section - opening.center_mm) @ opening.normal).max())
        beside_mm = np.linalg.norm(offset_mm - ahead_mm[:, None] * opening.normal, axis=1)
        beyond |= (ahead_mm > 0) & (ahead_mm < length_mm) & (beside_mm < opening.diameter_mm)
    limit = np.where(beyond, CELL_REYNOLDS_AT_END, CELL_REYNOLDS)
    return limit.astype(np.float32)


def address(domain: Domain, limit: NDArray[np.float32], period: tuple[int, int, int] | None = None) -> Addressing:
    """Return the memory layout of the populations of a domain; each segment has one `limit` (see `thickest`).

    A domain with a `period` in cells repeats in all directions, and all its cells lie in one band.
    """
    cells = domain.cells
    shape: Ints = cells.max(axis=0) + 3 if period is None else np.array(period)

    def at(places: Ints) -> tuple[Ints, ...]:
        return tuple((places % shape).T)

    inside = np.zeros(shape, dtype=bool)
    inside[at(cells)] = True
    stored = voxels.dilate(inside, directions.VELOCITIES[1:])
    number = np.full(inside.shape, -1, dtype=np.int32)
    # The padding between layers keeps two threads from writing to the same line of the cache.
    number[stored] = np.arange(stored.sum()) + lanes.COUNT * np.nonzero(stored)[0]
    count = int(number.max()) + lanes.COUNT
    stride = count + (OFF_PAGE - count) % PAGE
    place = number[at(cells)]
    is_new = (np.diff(cells, axis=0) != (0, 0, 1)).any(axis=1) | (np.diff(limit) != 0)
    is_new |= (cells[1:, 2] == 1) | (cells[1:, 2] == shape[2] - 1)  # the neighbours of a period's end are apart
    first: Ints = np.flatnonzero(np.r_[True, is_new])
    length = np.diff(np.r_[first, len(cells)])
    pieces = -(-length // d3q19.SEGMENT)
    owner = np.repeat(np.arange(len(first)), pieces)
    offset = d3q19.SEGMENT * (np.arange(len(owner)) - np.repeat(np.cumsum(pieces) - pieces, pieces))
    first, length = first[owner] + offset, np.minimum(length[owner] - offset, d3q19.SEGMENT)
    behind = [number[at(cells[first] - c)] for c in directions.VELOCITIES]
    q, cell = domain.septum_direction, cells[domain.septum_cell]
    here, ahead = number[at(cell)], number[at(cell + directions.VELOCITIES[q])]
    septa = np.stack([d3q19.OPPOSITE[q] * stride + here, q * stride + ahead]).astype(np.int32)
    q, cell = domain.link_direction, cells[domain.link_cell]
    p, c = d3q19.OPPOSITE[q], directions.VELOCITIES[q]
    here, beyond, behind_one, behind_two = (number[at(cell + n * c)] for n in (0, 1, -1, -2))
    has_one = inside[at(cell - c)] & ~np.isin(q * stride + here, septa)
    has_two = has_one & inside[at(cell - 2 * c)] & ~np.isin(q * stride + behind_one, septa)
    rows = [
        p * stride + here,
        p * stride + behind_one,
        q * stride + here,
        q * stride + beyond,
        p * stride + np.where(has_two, behind_two, here),
        q * stride + behind_one,
    ]
    return Addressing(
        stride,
        place,
        length.astype(np.int32),
        first.astype(np.int32),
        d3q19.addresses(place[first], behind, stride),
        np.stack(rows, axis=1).astype(np.int32),
        has_one,
        has_two,
        septa,
        domain.septum_cell,
    )


def build_links(case: FlowCase, grid: Grid, scales: Scales) -> Links:
    """Return the links of the wall (interpolated bounce-back) and of the ends (imposed flow or pressure)."""
    domain, addressing, order = grid.domain, grid.addressing, grid.link_order
    patch = domain.link_patch[order]
    patches = np.unique(patch[patch > 0])
    of_ends = patch[: grid.of_ends]
    start: Ints = np.asarray(np.searchsorted(of_ends, np.r_[patches, patch.max(initial=0) + 1]), dtype=np.int32)
    weight, correction, viscous = wall_weights(domain, addressing, order, scales.relaxation_steps, scales.odd_rate)
    correction[: start[-1]], viscous[: start[-1]], weight[: start[-1]] = 0.0, 0.0, (-1.0, 0.0, 0.0)
    opening_links = order[: start[-1]]
    ends = Ends(case, domain, scales)
    openings, wanted, course, shape = ends.imposed(patches, np.split(opening_links, start[1:-1])[: len(patches)])
    weight[: start[-1]][np.repeat(openings[:, d3q19.KIND] == d3q19.INFLOW, np.diff(start))] = (1.0, 0.0, 0.0)
    path, both = d3q19.paths(addressing.link_address[order], weight)
    enters, leaves = np.concatenate([np.zeros((0, 2), np.int32), *(one.address for one in grid.crossings)]).T
    slots = [one.first + np.arange(2 * len(one.cell)).reshape(2, -1) for one in grid.crossings]
    slot = np.concatenate([np.zeros((2, 0), np.int32), *slots], axis=1)
    crossing = np.stack([np.stack([leaves, enters, slot[0]], axis=1), np.stack([enters, leaves, slot[1]], axis=1)])
    return Links(
        patches,
        addressing.link_address[order],
        np.ascontiguousarray(np.concatenate([path, crossing], axis=1), dtype=np.int32),
        np.concatenate([both, np.tile(np.array([1.0, -1.0], np.float32), (len(enters), 1))]),
        correction.astype(np.float32),
        viscous.astype(np.float32),
        np.zeros(len(order) + len(enters), dtype=np.float32),
        openings,
        start,
        grid.by_layer[0],
        addressing.place[domain.link_cell[opening_links]],
        domain.link_direction[opening_links],
        wanted,
        course,
        shape,
        of_wires := np.flatnonzero(domain.link_is_wire[order]).astype(np.int32),
        domain.link_direction[order[of_wires]],
    )


def behind(addressing: Addressing) -> int:
    """Return the first address behind the populations, up to which `d3q19.update` may read without effect."""
    return 19 * addressing.stride + lanes.COUNT


def wall_weights(
    domain: Domain, addressing: Addressing, order: Ints, relaxation_steps: float, odd_rate: float
) -> tuple[Floats, Floats, Floats]:
    """Return the linear weights (l, 3) of walls, their correction (l, 5) and its viscous part (l,), for ordered links.

    Where fewer than two cells of blood lie behind a link there is no correction.
    """
    fraction = domain.link_fraction[order]
    weight = linear_weights(fraction, addressing.link_has_one[order])
    correction, viscous = parabolic_weights(fraction, relaxation_steps, odd_rate)
    correction[:, :3] -= weight
    is_plain = ~addressing.link_has_two[order]
    correction[is_plain], viscous[is_plain] = 0.0, 0.0
    return weight, correction, viscous


def linear_weights(fraction: Floats, has_one: NDArray[np.bool_]) -> Floats:
    """Return the weights (l, 3) of linearly interpolated bounce-back for populations a, b and c (see `d3q19.paths`).

    A link whose wall is nearer than half-way needs the cell behind. Where that is not blood, half-way bounce-back is
    used.

    References
    ----------
    Bouzidi, Firdaouss and Lallemand 2001, Phys. Fluids 13, 3452, eq. 5.
    """
    zero = np.zeros_like(fraction)
    near = np.stack([2 * fraction, 1 - 2 * fraction, zero], axis=1)
    far = np.stack([0.5 / fraction, zero, 1 - 0.5 / fraction], axis=1)
    weight = np.where(fraction[:, None] < 0.5, near, far)
    weight[~has_one & (fraction < 0.5)] = (1.0, 0.0, 0.0)
    return weight


def quadratic_weights(fraction: Floats) -> Floats:
    """Return the weights (l, 5) of quadratically interpolated bounce-back for a, b, c, e and g (see `d3q19.defer`).

    References
    ----------
    Lallemand and Luo 2003, J. Comput. Phys. 184, 406, eq. 10.
    """
    x, zero = fraction, np.zeros_like(fraction)
    near = np.stack([x * (1 + 2 * x), 1 - 4 * x**2, zero, -x * (1 - 2 * x), zero], axis=1)
    far = np.stack([1 / (x * (2 * x + 1)), zero, (2 * x - 1) / x, zero, (1 - 2 * x) / (1 + 2 * x)], axis=1)
    return np.where(x[:, None] < 0.5, near, far)


def parabolic_weights(fraction: Floats, relaxation_steps: float, odd_rate: float) -> tuple[Floats, Floats]:
    """Return the weights of bounce-back that is exact for a parabolic velocity along the link.

    Quadratic interpolation alone leaves a slip velocity of up to an eighth of the squared grid spacing times the flow's
    curvature. The reason is that the populations carry, beside the velocity, second differences and the part that the
    odd relaxation rate has not yet relaxed. The second difference a - 2 b + e compensates for both. Its viscous part is
    a compromise between a plane channel and a tube; determining it from the populations would be wrong where the force
    of a screen meets the wall.

    References
    ----------
    Ginzburg and d'Humieres 2003, Phys. Rev. E 68, 066614, sec. III.
    """
    x, even, odd = fraction, relaxation_steps - 0.5, 1 / odd_rate - 0.5
    per = 1 / np.maximum(1, x * (2 * x + 1))
    viscous = even * (odd + np.abs(x - 0.5)) * per
    return quadratic_weights(fraction) + np.outer(x * (1 - x) * per - viscous, CURVE), viscous


def _grouped(group: Ints) -> tuple[Ints, Ints]:
    """Return the start (g + 1,) of each group and the order (n,) that sorts items by their group (n,)."""
    order = np.argsort(group, kind="stable")
    starts = np.searchsorted(group[order], np.arange(group.max(initial=-1) + 2))
    return starts.astype(np.int32), order.astype(np.int32)
