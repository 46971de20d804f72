"""Flow through a periodic box of resolved wires: the referee of the laws of screens, meshes and coils.

The box repeats in all three directions. Its wires are walls of the flow grid, as those of a device in a vessel are (see
`vstent.flow.domain`). A body force drives the blood like a pressure gradient. In steady flow the drag on the wires
equals the body force times the volume of the blood. Lengths are in cells and all values in lattice units.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from vstent.flow.case import Cells
from vstent.flow.domain import WALL, Domain, between_wires, septa
from vstent.flow.lattice.kernels import d3q19, lanes
from vstent.flow.lattice.reading import exchanged
from vstent.flow.lattice.scales import odd_rate
from vstent.flow.lattice.setup import Addressing, address, wall_weights
from vstent.geometry.surface import Surface, joined
from vstent.kernels import directions
from vstent.kernels.arrays import Bools, Floats, Ints

RELAXATION_STEPS = 1.0
"""Relaxation time of the stress in creeping flow, in time steps."""
VISCOSITY = (RELAXATION_STEPS - 0.5) / 3
"""Kinematic viscosity in squared cells per time step."""
DEFER_PAIRS, DEFER_PART = 4, 0.3
"""Number of step pairs between updates of the wall correction, and the under-relaxation factor of each update."""
CHECK_PAIRS = 50
"""Number of step pairs between checks of convergence."""
SETTLED = 3e-4
"""Relative change of the mean velocity between checks below which the flow has converged."""
MAX_CHECKS = 600
"""Maximum number of checks."""
NO_LIMIT = 1e9
"""Grid Reynolds number above which the viscosity would be raised."""
SIDES = 32
"""Number of sides of a round wire."""


@dataclass(frozen=True, eq=False)
class BoxFlow:
    """Steady flow through a periodic box."""

    velocity: Floats
    """(i, j, k, 3) velocity, zero inside the wires."""
    drag: Floats
    """(w, 3) force on every solid under a body force on the blood alone."""
    is_blood: Bools
    """(i, j, k) whether the cell is blood."""
    closed_gaps: int
    """Number of cells in closed gaps."""

    @property
    def superficial_velocity(self) -> Floats:
        """Return the mean velocity (3,) over blood and wires."""
        return self.velocity.mean(axis=(0, 1, 2))


UPWARDS = np.array([0.0, 0.0, 1.0])
"""The third axis of a box."""


def swept(axis: Floats, section: Floats, side: Floats = UPWARDS) -> Surface:
    """Return the solid of a section (s, 2), counter-clockwise, swept along a polyline (n, 3).

    The first axis of the section is `side` (3,) across the polyline, and turns as little as possible along it.
    """
    tangent = np.gradient(axis, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    rings = []
    for point, along in zip(axis, tangent, strict=True):
        side = side - (side @ along) * along
        side /= np.linalg.norm(side)
        rings.append(point + section @ np.stack([side, np.cross(along, side)]))
    n, s = len(axis), len(section)
    here = s * np.arange(n - 1)[:, None] + np.arange(s)
    beside = s * np.arange(n - 1)[:, None] + np.roll(np.arange(s), -1)
    fan = np.array([[0, i, i + 1] for i in range(1, s - 1)])
    quads = [np.stack([here, beside, beside + s], axis=-1), np.stack([here, beside + s, here + s], axis=-1)]
    faces = [part.reshape(-1, 3) for part in quads] + [fan[:, ::-1], s * (n - 1) + fan]
    return Surface(np.concatenate(rings), np.concatenate(faces).astype(np.int32))


def circle(diameter: float) -> Floats:
    """Return the corners (s, 2) of a polygon with the area of a circle."""
    angle = 2 * np.pi * np.arange(SIDES) / SIDES
    radius = 0.5 * diameter * np.sqrt(2 * np.pi / SIDES / np.sin(2 * np.pi / SIDES))
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def wire(point: Iterable[float], direction: Iterable[float], diameter: float, length: float) -> Surface:
    """Return a straight round wire of a length, with its middle at a point."""
    middle, along = np.asarray(point, float), np.asarray(direction, float)
    along = along / np.linalg.norm(along)
    side = np.eye(3)[np.abs(along).argmin()]
    return swept(middle + length * np.array([[-0.5], [0.5]]) * along, circle(diameter), side)


def crossing_wires(across: int, along: int, height: int, diameter: float, apart: float = 1.0) -> tuple[Surface, ...]:
    """Return two families of wires along the diagonals of a box (along, across, height), `apart` diameters apart.

    Their angle to the first axis is atan(across / along). Their spacing is along * across / hypot(along, across).
    """
    shift = 0.5 * apart * diameter
    length = 3.0 * np.hypot(along, across)
    ways = ((1.0, -shift), (-1.0, shift))
    return tuple(wire((0.0, 0.0, 0.5 * height + z), (along, way * across, 0.0), diameter, length) for way, z in ways)


def row_of_wires(spacing: int, height: int, diameter: float) -> tuple[Surface, ...]:
    """Return one family of wires along the first axis of a box (4, spacing, height), in its middle."""
    return (wire((0.0, 0.5 * spacing, 0.5 * height), (1.0, 0.0, 0.0), diameter, 40.0),)


def flow_through(
    shape: tuple[int, int, int],
    wires: Iterable[Surface],
    force: Floats,
    *,
    relaxation_steps: float = RELAXATION_STEPS,
    settled: float = SETTLED,
) -> BoxFlow:
    """Compute the steady flow, with inertia, under a body force (3,) in a box with solids, which may overlap.

    Raises
    ------
    ValueError
        When the flow does not converge.
    """
    box = _Box(shape, tuple(wires), relaxation_steps)
    force = np.asarray(force, dtype=np.float64)
    before = np.zeros((shape[2], 3))
    for _ in range(MAX_CHECKS):
        box.advance(force)
        velocity = box.velocity(force)
        mean = velocity.mean(axis=(0, 1))
        if np.abs(mean - before).max() < settled * np.abs(mean).max():
            return BoxFlow(velocity, box.drag(force), box.is_blood, box.domain.closed_gaps)
        before = mean
    raise ValueError(f"the flow through the box {shape} has not converged: use a smaller force")


def sheet_speed(flow: BoxFlow, force: Floats) -> float:
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


def periodic_domain(shape: tuple[int, int, int], solids: Sequence[Surface]) -> tuple[Domain, Bools, Ints]:
    """Return the blood between solids in a box, its mask, and the solid (l,) that each link meets.

    Images of the solids on all sides are added.
    """
    wires = joined(solids)
    shifts = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3) * shape
    low, high = wires.vertices_mm.min(axis=0), wires.vertices_mm.max(axis=0)
    reaches = ((high + shifts > -3) & (low + shifts < np.array(shape) + 3)).all(axis=1)
    images = joined([Surface(wires.vertices_mm + shift, wires.faces) for shift in shifts[reaches]])
    is_blood, closed_gaps = between_wires(np.ones(shape, dtype=bool), images.corners_mm)
    cells = np.argwhere(is_blood).astype(np.int32)
    grid = Cells(cells, np.zeros(3), 1.0)
    number = np.full(shape, -1, dtype=np.int32)
    number[is_blood] = np.arange(len(cells))
    neighbour = np.stack([number[tuple(((cells + c) % shape).T)] for c in directions.VELOCITIES], axis=1)
    cell, direction = np.nonzero(neighbour < 0)
    step = directions.VELOCITIES[direction].astype(float)
    length = np.linalg.norm(step, axis=1)
    distance, _ = images.first_hits(cells[cell].astype(float), step / length[:, None])
    fraction = np.where(distance <= length, np.maximum(distance / length, 1e-3), 0.5)
    face = images.closest(cells[cell] + fraction[:, None] * step)[2] % len(wires.faces)
    solid = np.searchsorted(np.cumsum([len(solid.faces) for solid in solids]), face, side="right")
    links = cell, direction, fraction, np.full(len(cell), WALL)
    parted = septa(images, neighbour, grid, of_wires=True)
    is_wire = np.ones(len(cell), dtype=bool)
    domain = Domain(cells, np.zeros(3), 1.0, *links, *parted, is_wire, closed_gaps, images, ())
    return domain, is_blood, solid.astype(np.int32)


class _Box:
    """The populations of a periodic box."""

    def __init__(self, shape: tuple[int, int, int], solids: Sequence[Surface], relaxation_steps: float) -> None:
        self.domain, self.is_blood, self._solid = periodic_domain(shape, solids)
        self._relaxation_steps, self._odd_rate = relaxation_steps, odd_rate(relaxation_steps)
        count = len(self.domain.cells)
        self._addressing: Addressing = address(self.domain, np.full(count, NO_LIMIT, np.float32), shape)
        order = np.arange(len(self.domain.link_cell))
        weight, correction, _ = wall_weights(self.domain, self._addressing, order, relaxation_steps, self._odd_rate)
        self._path, self._weight = d3q19.paths(self._addressing.link_address, weight)
        self._correction = correction.astype(np.float32)
        self._source = np.zeros(len(order), np.float32)
        self._f = np.zeros(19 * self._addressing.stride + lanes.COUNT, np.float32)

    def advance(self, force: Floats) -> None:
        """Make `CHECK_PAIRS` step pairs; the force acts as an impulse before each pair."""
        a = self._addressing
        segments = len(a.length)
        limit = np.full(segments, NO_LIMIT, np.float32)
        relaxation = np.float32(self._relaxation_steps), np.zeros(4, np.float32), limit, np.float32(self._odd_rate)
        cells = a.address, a.length, relaxation, d3q19.no_screen(segments)
        back = self._path, self._weight, self._source, *d3q19.NO_LINKS[3:6], a.septa
        bands, shares = d3q19.undivided(segments, len(self._source))
        bands[1, 4] = a.septa.shape[1]
        lost = np.empty_like(self._source)  # not used: the lost mass is not replaced here
        for pair in range(CHECK_PAIRS):
            self._kick(2.0 * force)
            d3q19.update(self._f, cells, back, bands, shares)
            if pair % DEFER_PAIRS == 0:
                d3q19.defer(self._f, a.link_address, self._correction, self._source, lost, np.float32(DEFER_PART))

    def _kick(self, impulse: Floats) -> None:
        """Add an impulse (3,) to the populations of every cell."""
        kick = (3 * d3q19.WEIGHTS * (directions.VELOCITIES @ impulse)).astype(np.float32)
        for q in range(1, 19):
            self._f[q * self._addressing.stride + self._addressing.place] += kick[q]

    def drag(self, force: Floats) -> Floats:
        """Return the force (w, 3) on each solid, of which there must be at least one.

        The links are read after the second step of a pair. The first one takes more, because the impulse meets the
        links at once. Together the solids bear the body force; what the reading lacks of it is shared out as the
        impulse that meets the links is.
        """
        address, direction = self._addressing.link_address, self.domain.link_direction
        way = directions.VELOCITIES[direction]
        impulse = (d3q19.WEIGHTS[direction] * (way @ force))[:, None] * way
        solids = [self._solid == solid for solid in range(self._solid.max() + 1)]
        read = np.stack([exchanged(self._f, address[own], direction[own]).sum(axis=0) for own in solids])
        met = np.stack([impulse[own].sum(axis=0) for own in solids])
        lacking = force * self.is_blood.sum() - read.sum(axis=0)
        return read + met * (lacking @ force) / (met.sum(axis=0) @ force)

    def velocity(self, force: Floats) -> Floats:
        """Return the velocity (i, j, k, 3), with half of the next impulse added."""
        result = np.zeros((*self.is_blood.shape, 3))
        result[self.is_blood] = d3q19.moments(self._f, self._addressing.stride, self._addressing.place)[:, 1:] + force
        return result
