"""Flow through a periodic cell of resolved wires, on which the resistance law of the screen model is calibrated.

The cell repeats in all three directions. Its wires are straight cylinders of solid grid cells, with the exact position
of their surface on every link. A body force drives the blood like a pressure gradient. In steady flow the total drag on
the wires equals the body force times the volume of the cell, so that no integration over their surface is needed.
"""

from dataclasses import dataclass

import numpy as np

from vstent.flow.lattice.kernels import d3q19, lanes
from vstent.flow.lattice.setup import linear_weights, quadratic_weights
from vstent.kernels import directions
from vstent.kernels.arrays import Bools, Floats, Ints

RELAXATION_STEPS = 1.0
"""Relaxation time of the stress, in time steps."""
ODD_RATE = 1 / (0.5 + 3 / 16 / (RELAXATION_STEPS - 0.5))
"""Relaxation rate of the odd populations at which half-way bounce-back places the wall exactly half-way between cells
(Ginzburg and d'Humieres 2003, Phys. Rev. E 68, 066614)."""
VISCOSITY = (RELAXATION_STEPS - 0.5) / 3
"""Kinematic viscosity in squared cells per time step."""
DEFER_PAIRS, DEFER_PART = 4, 0.3
"""Number of step pairs between updates of the quadratic wall correction, and the under-relaxation factor of each
update."""
CHECK_PAIRS = 50
"""Number of step pairs between checks of convergence."""
SETTLED = 3e-4
"""Relative change of the mean velocity between checks below which the flow has converged."""
MAX_CHECKS = 600
"""Maximum number of checks."""


@dataclass(frozen=True)
class Wires:
    """Straight cylinders in a periodic box; lengths in cells."""

    shape: tuple[int, int, int]
    """Size of the box."""
    points: tuple[tuple[float, float, float], ...]
    """(w, 3) a point on the axis of every wire."""
    directions: tuple[tuple[float, float, float], ...]
    """(w, 3) unit vector along every axis. Periodic images must join: a wire leaves the box where another one's image
    enters."""
    radius: float
    """Radius of all wires."""


@dataclass(frozen=True, eq=False)
class CellFlow:
    """Steady flow through a periodic cell, in lattice units."""

    velocity: Floats
    """(i, j, k, 3) velocity, zero inside the wires."""
    force: Floats
    """(3,) total drag on the wires under a pressure gradient equal to the body force. It is counted over the whole box,
    because a pressure gradient acts on the wires, too."""
    is_blood: Bools
    """(i, j, k) whether the cell is blood."""

    @property
    def superficial_velocity(self) -> Floats:
        """Return the mean velocity (3,) over blood and wires."""
        return self.velocity.mean(axis=(0, 1, 2))


def crossing_wires(across: int, along: int, height: int, diameter: float, apart: float = 1.0) -> Wires:
    """Return two families of wires along the diagonals of a box.

    Their angle to the first axis is atan(across / along). Their spacing is along * across / hypot(along, across).
    """
    length = float(np.hypot(along, across))
    up, down = (along / length, across / length, 0.0), (along / length, -across / length, 0.0)
    middle, shift = 0.5 * height, 0.5 * apart * diameter
    points = ((0.0, 0.0, middle - shift), (0.0, 0.0, middle + shift))
    return Wires((along, across, height), points, (up, down), 0.5 * diameter)


def row_of_wires(spacing: int, height: int, diameter: float) -> Wires:
    """Return one family of wires along the first axis, `spacing` cells apart; rows are `height` cells apart."""
    return Wires((4, spacing, height), ((0.0, 0.5 * spacing, 0.5 * height),), ((1.0, 0.0, 0.0),), 0.5 * diameter)


def flow_through(wires: Wires, force: Floats) -> CellFlow:
    """Compute the steady flow, with inertia, under a body force.

    Shapes: `force` (3,).

    Raises
    ------
    ValueError
        When the flow does not converge.
    """
    is_blood = _blood(wires)
    grid = _Grid(wires, is_blood)
    force = np.asarray(force, dtype=np.float64)
    before = np.zeros((wires.shape[2], 3))
    for _ in range(MAX_CHECKS):
        grid.advance(force)
        velocity = grid.velocity(force)
        mean = velocity.mean(axis=(0, 1))
        if np.abs(mean - before).max() < SETTLED * np.abs(mean).max():
            return CellFlow(velocity, force * is_blood.size, is_blood)
        before = mean
    raise ValueError(f"the flow through the cell {wires.shape} has not converged: use a smaller force")


def sheet_speed(flow: CellFlow, force: Floats) -> float:
    """Return the tangential speed at a thin sheet that has the same tangential drag as the wires.

    Sheets are a height h apart and blood crosses them at speed w, while a body force F accelerates it along the sheets.
    Steady advection and diffusion, w u' = F + nu u'', give u = u_0 + (F / w) (z - h (e^(w z / nu) - 1) / (e^(w h / nu)
    - 1)). The mean of u yields the speed u_0 at the sheet. It is negative where the wires have more drag than a sheet
    could have.

    Shapes: `force` (3,).
    """
    height = flow.velocity.shape[2]
    mean, _, through = flow.superficial_velocity
    crossing = through * height / VISCOSITY
    return float(mean - force[0] * height / through * (0.5 - 1 / crossing + 1 / np.expm1(crossing)))


def _blood(wires: Wires) -> Bools:
    """Return the cells (i, j, k) outside the wires, without gaps of a single cell between wires.

    Populations in such a gap bounce between its walls and accumulate the momentum of the body force.
    """
    blood = _signed_distance(wires, np.argwhere(np.ones(wires.shape, bool))).reshape(wires.shape) > 0
    while True:
        gap = np.zeros_like(blood)
        for axis in range(3):
            gap |= blood & ~np.roll(blood, 1, axis) & ~np.roll(blood, -1, axis)
        if not gap.any():
            return blood
        blood &= ~gap


def _images(wires: Wires) -> tuple[Floats, Floats]:
    """Return points and directions of all wires that can touch the box, periodic images included."""
    shifts = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3) * wires.shape
    points = (np.array(wires.points)[:, None] + shifts).reshape(-1, 3)
    return points, np.repeat(np.array(wires.directions), len(shifts), axis=0)


def _signed_distance(wires: Wires, at: Ints) -> Floats:
    """Return the distance (n,) of points (n, 3) from the surface of the nearest wire, negative inside."""
    nearest = np.full(len(at), np.inf)
    for point, direction in zip(*_images(wires), strict=True):
        offset = at - point
        away = offset - (offset @ direction)[:, None] * direction
        nearest = np.minimum(nearest, np.linalg.norm(away, axis=1))
    return nearest - wires.radius


def _fractions(wires: Wires, cells: Ints, steps: Ints) -> Floats:
    """Return the fraction (n,) of each link, from a cell (n, 3) along a step (n, 3), at which it first meets a wire."""
    first = np.ones(len(cells))
    for point, direction in zip(*_images(wires), strict=True):
        offset = cells - point
        offset = offset - (offset @ direction)[:, None] * direction
        step = steps - (steps @ direction)[:, None] * direction
        a, b = (step**2).sum(axis=1), (offset * step).sum(axis=1)
        inside = b**2 - a * ((offset**2).sum(axis=1) - wires.radius**2)
        root = (-b - np.sqrt(np.maximum(inside, 0.0))) / np.maximum(a, 1e-12)
        first = np.where((inside > 0) & (root > 0), np.minimum(first, root), first)
    return np.maximum(first, 1e-3)


class _Grid:
    """The populations of a periodic box and their addresses (see `vstent.flow.lattice.kernels.d3q19`)."""

    def __init__(self, wires: Wires, is_blood: Bools) -> None:
        self._shape, self._is_blood = wires.shape, is_blood
        self._stride = int(np.prod(wires.shape))
        self._f = np.zeros(19 * self._stride + lanes.COUNT, np.float32)
        cells = np.argwhere(is_blood)
        self._place = self._number(cells)
        self._address(cells)
        self._link(wires, cells)

    def _number(self, cells: Ints) -> Ints:
        """Return the storage place of cells (n, 3), wrapped periodically."""
        i, j, k = np.moveaxis(cells % np.array(self._shape), -1, 0)
        return ((i * self._shape[1] + j) * self._shape[2] + k).astype(np.int32)

    def _address(self, cells: Ints) -> None:
        """Set the addresses of segments; rows end at the periodic border, so that their neighbours are contiguous."""
        last = self._shape[2] - 1
        follows = (np.diff(cells, axis=0) == (0, 0, 1)).all(axis=1)
        follows &= (cells[1:, 2] != 1) & (cells[1:, 2] != last)
        first = np.flatnonzero(np.r_[True, ~follows])
        self._length = np.diff(np.r_[first, len(cells)]).astype(np.int32)
        if self._length.max() > d3q19.SEGMENT:
            raise ValueError(f"a cell may be at most {d3q19.SEGMENT} high")
        start = cells[first]
        behind = [self._number(start - c) for c in directions.VELOCITIES]
        self._populations = d3q19.addresses(self._place[first], behind, self._stride)

    def _link(self, wires: Wires, cells: Ints) -> None:
        """Set the links from blood to wires and their bounce-back weights."""
        blood = self._is_blood.ravel()
        ahead = np.stack([blood[self._number(cells + c)] for c in directions.VELOCITIES], axis=1)
        cell, q = np.nonzero(~ahead)
        here, c = cells[cell], directions.VELOCITIES[q]
        fraction = _fractions(wires, here, c)
        has_one = blood[self._number(here - c)]
        has_two = has_one & blood[self._number(here - 2 * c)]
        weight = linear_weights(fraction, has_one)
        correction = quadratic_weights(fraction)
        correction[:, :3] -= weight
        correction[~has_two] = 0.0
        at, after, before = (self._number(here + n * c) for n in (0, 1, -1))
        further = np.where(has_two, self._number(here - 2 * c), at)
        out, back = q * self._stride, d3q19.OPPOSITE[q] * self._stride
        rows = [back + at, back + before, out + at, out + after, back + further, out + before]
        self._links = np.stack(rows, axis=1).astype(np.int32)
        self._path, self._weight = d3q19.paths(self._links, weight)
        self._correction = correction.astype(np.float32)
        self._source = np.zeros(len(q), np.float32)

    def advance(self, force: Floats) -> None:
        """Make `CHECK_PAIRS` step pairs; the force acts as an impulse before each pair."""
        segments = len(self._length)
        limit = np.full(segments, np.inf, np.float32)
        relaxation = np.float32(RELAXATION_STEPS), np.zeros(4, np.float32), limit, np.float32(ODD_RATE)
        cells = self._populations, self._length, relaxation, d3q19.no_screen(segments)
        back = self._path, self._weight, self._source, *d3q19.NO_LINKS[3:]
        bands = d3q19.undivided(segments, len(self._source))
        lost = np.empty_like(self._source)  # not used: the lost mass is not replaced here
        for pair in range(CHECK_PAIRS):
            self._kick(2.0 * force)
            d3q19.update(self._f, cells, back, *bands)
            if pair % DEFER_PAIRS == 0:
                d3q19.defer(self._f, self._links, self._correction, self._source, lost, np.float32(DEFER_PART))

    def _kick(self, impulse: Floats) -> None:
        """Add an impulse (3,) to the populations of every blood cell."""
        kick = 3 * d3q19.WEIGHTS * (directions.VELOCITIES @ impulse)
        populations = self._f[: 19 * self._stride].reshape(19, -1)
        populations += (kick[:, None] * self._is_blood.ravel()).astype(np.float32)

    def velocity(self, force: Floats) -> Floats:
        """Return the velocity (i, j, k, 3), with half of the next impulse added."""
        result = np.zeros((self._stride, 3))
        result[self._place] = d3q19.moments(self._f, self._stride, self._place)[:, 1:] + force
        return result.reshape(*self._shape, 3)
