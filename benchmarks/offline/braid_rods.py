"""An independent model of a braid in an artery: elastic Cosserat rods, pushed apart by their own springiness alone.

Run from the repository, offline, some minutes a case: ``pip install pyelastica``, then
``python benchmarks/offline/braid_rods.py``. The result is kept in ``tests/helpers/data/braid_rods.json`` and compared
with `vstent.deploy` by ``tests/deployment/test_braid_rods.py``. The rods are those of PyElastica (Gazzola et al. 2018,
R. Soc. Open Sci. 5:171628; MIT licence); nothing of vstent's deployment is used.

The model. Every wire is a rod that bends, twists, stretches and shears, made (heat-set) as a helix of the free
diameter; it weighs what makes the relaxation quick, for only its rest is asked for. The wall is stiff, smooth and one
sided: it pushes wires that are beyond it back along its normal and does nothing else. Wires that cross are held
together by stiff springs without moments, either where they cross in the free braid (``pinned``) or where their
curves pass nearest to each other, wherever that is (``sliding``, without friction). The braid starts narrow, is let
go, and the artery's axis is bent meanwhile. Nothing else holds it but a weak spring on the place of its middle row.

Reduced are the number of wires, 24 instead of 48, at the angle and the free diameter of Silk; their thickness, 100 um
for all, which says how stiff they are against stretching (of their rest, no more than that is seen); and the weave:
axes meet at crossings instead of passing one wire apart.
"""

import json
import sys
import time
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import elastica
import numpy as np
from elastica.timestepper.symplectic_steppers import PositionVerlet
from numba import njit

WIRES, FREE_DIAMETER_MM, ANGLE_RAD, LABEL_MM = 24, 4.2, 1.152, (4.0, 10.0)
STIFFNESS_DIAMETER_MM = 0.1
ELEMENTS = 3
"""Elements of a rod between crossings."""
START_DIAMETER_MM = 3.0
DAMPING = 0.003
COURANT = 0.3
STEPS = 1000
"""Steps between two looks at the braid."""
LOOKS, BENDING_LOOKS = 120, 25
AT_REST_MM = 3e-4
"""The braid is at rest when no node moves further than this from one look to the next."""
OUT = Path(__file__).parents[2] / "tests" / "helpers" / "data" / "braid_rods.json"


@dataclass(frozen=True)
class Case:
    """An artery of circular sections: straight, or bent over some length, its radius linear in the arc length."""

    radius_mm: float
    """Radius of the wall, less the distance that wires keep from it, where the arc length is zero."""
    slope: float = 0.0
    """Change of the radius per mm."""
    bend_mm: float = np.inf
    """Radius of the bend."""
    half_mm: float = 5.5
    """Half the length of the bend, about the arc length zero."""
    is_sliding: bool = False
    """Whether wires slide where they cross."""


CASES = {
    "tube": Case(1.85),
    "taper": Case(1.70, -0.5 / 32),
    "bend": Case(1.85, bend_mm=7.0),
    "tube, sliding": Case(1.85, is_sliding=True),
    "taper, sliding": Case(1.70, -0.5 / 32, is_sliding=True),
    "bend, sliding": Case(1.85, bend_mm=7.0, is_sliding=True),
}


@dataclass(frozen=True)
class Lattice:
    """A regular braid round a straight axis."""

    radius_mm: float
    """Radius of the braid."""

    @cached_property
    def piece_mm(self) -> float:
        """Length of wire between crossings."""
        return np.pi * FREE_DIAMETER_MM / np.sin(ANGLE_RAD) / WIRES

    @cached_property
    def spacing_mm(self) -> float:
        """Distance of rows of crossings."""
        return float(np.sqrt(self.piece_mm**2 - (2 * np.pi * self.radius_mm / WIRES) ** 2))

    @cached_property
    def rows(self) -> int:
        """Rows of crossings that make up the label's length at the label's diameter."""
        return round(LABEL_MM[1] / Lattice(0.5 * LABEL_MM[0]).spacing_mm) + 1

    def wire(self, number: int, hand: int) -> tuple[np.ndarray, np.ndarray]:
        """Return nodes (n, 3) of a wire and directions (n, 3) away from the axis, which is z."""
        row = np.arange((self.rows - 1) * ELEMENTS + 1) / ELEMENTS
        angle = 2 * np.pi / WIRES * (2 * number + hand * row)
        outward = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
        along_mm = self.spacing_mm * (row - 0.5 * (self.rows - 1))
        return self.radius_mm * outward + along_mm[:, None] * [0, 0, 1.0], outward


@njit(cache=True)
def foot(x: float, y: float, z: float, curvature: float, half_mm: float) -> tuple:
    """Arc length, point and tangent of the axis nearest to a point; a bend lies in y = 0, its middle at the origin."""
    if curvature == 0.0:
        return z, 0.0, z, 0.0, 1.0
    bend_mm = 1.0 / curvature
    angle = min(max(np.arctan2(z, bend_mm - x), -half_mm * curvature), half_mm * curvature)
    tx, tz = np.sin(angle), np.cos(angle)
    ax, az = bend_mm * (1 - tz), bend_mm * tx
    beyond = (x - ax) * tx + (z - az) * tz
    beyond = max(beyond, 0.0) if angle > 0 else min(beyond, 0.0)
    if abs(angle) < half_mm * curvature:
        beyond = 0.0
    return bend_mm * angle + beyond, ax + beyond * tx, az + beyond * tz, tx, tz


@njit(cache=True)
def push(x: Any, force: Any, is_wire: Any, artery: Any, stiffness: float, middle: Any, hold: float) -> None:
    """Add the wall's push and the weak spring on the arc length of the middle row to the forces (3, n) on nodes."""
    radius_mm, slope, curvature, half_mm = artery
    drift = 0.0
    for k in middle:
        drift += foot(x[0, k], x[1, k], x[2, k], curvature, half_mm)[0] / len(middle)
    for k in range(x.shape[1]):
        if not is_wire[k]:
            continue
        s, ax, az, tx, tz = foot(x[0, k], x[1, k], x[2, k], curvature, half_mm)
        force[0, k] -= hold * drift * tx
        force[2, k] -= hold * drift * tz
        dx, dy, dz = x[0, k] - ax, x[1, k], x[2, k] - az
        off = np.sqrt(dx * dx + dy * dy + dz * dz)
        deep = (off - radius_mm - slope * s) * stiffness
        if deep > 0:
            force[0, k] -= deep * (dx / off - slope * tx)
            force[1, k] -= deep * dy / off
            force[2, k] -= deep * (dz / off - slope * tz)


@njit(cache=True)
def tie(x: Any, force: Any, base: Any, place: Any, last: float, stiffness: float, is_sliding: bool) -> None:
    """Hold wires together: crossing j is at node `place[:, j]`, not whole, of the wires that begin at `base[:, j]`."""
    for j in range(base.shape[1]):
        i = np.zeros(2, dtype=np.int64)
        share = np.zeros(2)
        for w in range(2):
            i[w] = min(int(place[w, j]), last - 1)
            share[w] = place[w, j] - i[w]
        aa, ab, bb, da, db = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(3):
            a, b = base[0, j] + i[0], base[1, j] + i[1]
            ta, tb = x[k, a + 1] - x[k, a], x[k, b + 1] - x[k, b]
            gap = x[k, b] + share[1] * tb - x[k, a] - share[0] * ta
            aa, ab, bb, da, db = aa + ta * ta, ab + ta * tb, bb + tb * tb, da + gap * ta, db + gap * tb
            gap *= stiffness
            force[k, a] += (1 - share[0]) * gap
            force[k, a + 1] += share[0] * gap
            force[k, b] -= (1 - share[1]) * gap
            force[k, b + 1] -= share[1] * gap
        if is_sliding:
            det = aa * bb - ab * ab
            place[0, j] = min(max(place[0, j] + min(max((da * bb - db * ab) / det, -0.1), 0.1), 0.0), last)
            place[1, j] = min(max(place[1, j] + min(max((da * ab - db * aa) / det, -0.1), 0.1), 0.0), last)


class Surroundings(elastica.NoForces):
    """What wall and other wires do to the rods; applied once for all of them."""

    def __init__(self, forces: list) -> None:
        """Keep a list of functions, filled once all rods lie in one block."""
        self.forces = forces

    def apply_forces(self, system: object, time: float = 0.0) -> None:
        """Apply them."""
        for force in self.forces:
            force()


class Simulator(elastica.BaseSystemCollection, elastica.Forcing, elastica.Damping):
    """Rods, forces and damping."""


def directors(nodes_mm: np.ndarray, outward: np.ndarray) -> np.ndarray:
    """Frames (3, 3, n) of the elements: outward, sideways, along."""
    along = np.diff(nodes_mm, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    first = outward[1:] + outward[:-1]
    first -= np.einsum("ij,ij->i", first, along)[:, None] * along
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(along, first), along]).transpose(0, 2, 1).copy()


def rod(number: int, hand: int) -> elastica.CosseratRod:
    """Make a wire as a free helix and press it to the diameter at which the braid starts."""
    nodes_mm, outward = Lattice(0.5 * FREE_DIAMETER_MM).wire(number, hand)
    frame = directors(nodes_mm, outward)
    made = elastica.CosseratRod.straight_rod(
        len(nodes_mm) - 1,
        nodes_mm[0],
        frame[2, :, 0],
        frame[0, :, 0],
        float(np.linalg.norm(np.diff(nodes_mm, axis=0), axis=1).sum()),
        0.5 * STIFFNESS_DIAMETER_MM,
        1.0,
        youngs_modulus=1.0,
        shear_modulus=1 / 2.6,
        position=nodes_mm.T.copy(),
        directors=frame,
    )
    made.compute_internal_forces_and_torques(0.0)
    made.rest_kappa[:], made.rest_sigma[:] = made.kappa, made.sigma
    nodes_mm, outward = Lattice(0.5 * START_DIAMETER_MM).wire(number, hand)
    made.position_collection[:], made.director_collection[:] = nodes_mm.T, directors(nodes_mm, outward)
    return made


@dataclass(frozen=True, eq=False)
class Crossings:
    """Where wires cross."""

    row: np.ndarray
    """(c,) lattice row."""
    column: np.ndarray
    """(c,) lattice column."""
    base: np.ndarray
    """(2, c) first nodes of the two wires in the block."""
    place: np.ndarray
    """(2, c) nodes of these wires, not whole where wires slide."""

    @staticmethod
    def of(rows: int, stride: int) -> "Crossings":
        """Crossings of the free braid; wires lie `stride` nodes apart in the block, one hand after the other."""
        half = WIRES // 2
        row, number = (part.ravel() for part in np.meshgrid(np.arange(rows), np.arange(half), indexing="ij"))
        base = np.stack([number, half + (number + row) % half]) * stride
        place = np.tile(row * float(ELEMENTS), (2, 1))
        return Crossings(row, (2 * number + row) % WIRES, base, place)

    def points_mm(self, x: np.ndarray) -> np.ndarray:
        """Return the places (c, 3) of the crossings among nodes (3, n)."""
        i = np.minimum(self.place.astype(int), self.place.max().astype(int) - 1)
        share = self.place - i
        return ((1 - share) * x[:, self.base + i] + share * x[:, self.base + i + 1]).mean(axis=1).T


def relaxed(case: Case) -> tuple[Crossings, np.ndarray, float]:
    """Let the braid open in an artery until it is at rest; return crossings, their places (c, 3) and the last move."""
    simulator, forces = Simulator(), []
    dt = COURANT * Lattice(0.5 * FREE_DIAMETER_MM).piece_mm / ELEMENTS
    rods = [rod(number, hand) for hand in (1, -1) for number in range(WIRES // 2)]
    for one in rods:
        simulator.append(one)
        simulator.dampen(one).using(elastica.AnalyticalLinearDamper, uniform_damping_constant=DAMPING, time_step=dt)
    simulator.add_forcing_to(rods[0]).using(Surroundings, forces)
    simulator.finalize()
    block = next(iter(simulator.final_systems()))
    x, force, nodes = block.position_collection, block.external_forces, rods[0].n_elems + 1
    crossings = Crossings.of(Lattice(0.5 * FREE_DIAMETER_MM).rows, nodes + 1)
    is_wire = np.arange(x.shape[1]) % (nodes + 1) < nodes
    stiffness = np.pi / 4 * STIFFNESS_DIAMETER_MM**2 / rods[0].rest_lengths[0]
    is_middle = crossings.row == crossings.row.max() // 2
    middle = (crossings.base + crossings.place.astype(int))[:, is_middle].ravel()
    artery = np.array([case.radius_mm, case.slope, 0.0, case.half_mm])
    forces.append(lambda: push(x, force, is_wire, artery, 0.3 * stiffness, middle, 0.02 * stiffness / len(rods)))
    forces.append(lambda: tie(x, force, crossings.base, crossings.place, nodes - 1.0, 0.5 * stiffness, case.is_sliding))
    stepper, now, before_mm, moved_mm = PositionVerlet(), 0.0, x.copy(), np.inf
    for look in range(LOOKS):
        for step in range(STEPS):
            artery[2] = min(1.0, (look * STEPS + step) / (BENDING_LOOKS * STEPS)) / case.bend_mm
            now = stepper.step(simulator, now, dt)
        moved_mm = float(np.linalg.norm(x - before_mm, axis=0)[is_wire].max())
        before_mm = x.copy()
        if look > BENDING_LOOKS and moved_mm < AT_REST_MM:
            break
    return crossings, crossings.points_mm(x), moved_mm


def length_mm(case: Case, crossings: Crossings, points_mm: np.ndarray) -> float:
    """Length along the axis between the mean arc lengths of the first and the last row."""
    s = np.array([foot(*point, 1 / case.bend_mm, case.half_mm)[0] for point in points_mm])
    return float(s[crossings.row == crossings.row.max()].mean() - s[crossings.row == 0].mean())


def main(names: list[str]) -> None:
    """Relax the braid in every case named and write where its crossings come to lie."""
    results = json.loads(OUT.read_text()) if OUT.exists() else {}
    for name in names:
        case, began = CASES[name], time.process_time()
        crossings, points_mm, moved_mm = relaxed(case)
        results[name] = {
            "radius_mm": case.radius_mm,
            "slope": case.slope,
            "bend_mm": case.bend_mm if np.isfinite(case.bend_mm) else 0.0,
            "half_mm": case.half_mm,
            "length_mm": round(length_mm(case, crossings, points_mm), 4),
            "last_move_mm": float(f"{moved_mm:.2g}"),
            "row": crossings.row.tolist(),
            "column": crossings.column.tolist(),
            "points_mm": np.round(points_mm, 3).tolist(),
        }
        OUT.write_text(json.dumps(results, separators=(",", ":")) + "\n")
        print(f"{name:16} length {results[name]['length_mm']:.3f} mm, {time.process_time() - began:.0f} s of CPU")


if __name__ == "__main__":
    main(sys.argv[1:] or list(CASES))
