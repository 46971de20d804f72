"""Resistance of two parallel meshes, and of coils, in periodic boxes: write `meshes.json`, print it.

Usage: python benchmarks/meshes.py [coils | packed | meshes ...]

Tables that are not named stay as they are.

Meshes: two families of wires 30 um thick and 0.25 mm apart at 45 degrees to the axis, one mesh `gap_mm` above another
that is turned by an angle or moved by half a pore. `normal` is the resistance to blood driven straight through, over
that of one mesh, in creeping flow and at a pore Reynolds number (superficial speed times spacing over viscosity) of 10.
Two resistances that add give 2. `along` is the flow rate of blood driven along one mesh and along both in creeping
flow, over that between thin solid plates in their place, one spacing of the box apart.

Coils: wires of 0.3 mm along the three axes, none of which touch. `permeability_mm2` is that of creeping flow, and
`c` is its Kozeny constant: K = e^3 / (c S^2) with porosity e and S = 4 (1 - e) / d. Straight capillaries have 2, random
fibres 6 to 7 (Jackson and James 1986, Can. J. Chem. Eng. 64, 364). `inertia` is the resistance at a pore Reynolds
number (superficial speed times wire diameter over viscosity) of 10 over that of creeping flow.

Packed: a cube of 3.4 mm out of the middle of coils of 0.305 mm placed in a sac of 6 mm, repeated in all directions.
`permeability_mm2` is the mean over the three axes, and `winding` the mean speed over that along the axis.
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vstent.deployment.coils import deploy_coils
from vstent.geometry.surface import Surface

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "deployment"))
from periodic_box import UPWARDS, circle, flow_through, swept, wire
from test_basket import ball

TABLE = Path(__file__).with_suffix(".json")
WIRE_MM, SPACING_MM = 0.03, 0.25
CELLS, COIL_CELLS = 3.0, 8.0
"""Cells across a wire of a mesh, and of a coil."""
CUBE_MM, CUBE_CELL_MM = 3.4, 0.05
"""Width of the cube of placed coils, and its grid spacing."""
HEIGHT = 54
"""Height of the boxes of meshes, in cells: two spacings."""
CREEPING, FAST = 0.1, 10.0
SETTLED = 2e-4
SLOW_STEPS, FAST_STEPS = 1.0, 0.65
"""Relaxation time of the stress in creeping flow and in the other one, in time steps."""


def mesh(side: int, height: float, *, is_turned: bool = False, is_moved: bool = False) -> list[Surface]:
    """Wires of one mesh in a square box, at a height: along both diagonals, or along both sides where it is turned."""
    if is_turned:
        count = round(side / (SPACING_MM / WIRE_MM * CELLS))
        at = side * (np.arange(count) + 0.25) / count
        over = [wire((0.0, y, height - 0.5 * CELLS), (1, 0, 0), CELLS, 3.0 * side) for y in at]
        return over + [wire((x, 0.0, height + 0.5 * CELLS), (0, 1, 0), CELLS, 3.0 * side) for x in at]
    count = round(side / (np.sqrt(2) * SPACING_MM / WIRE_MM * CELLS))
    at = side * (np.arange(count) + (0.5 if is_moved else 0.0)) / count
    families = ((1, 1, -0.5 * CELLS), (1, -1, 0.5 * CELLS))
    return [
        wire((x, 0.0, height + z), (along, across, 0), CELLS, 5.0 * side) for along, across, z in families for x in at
    ]


def resistance(box: tuple[int, int, int], wires: Sequence[Surface], reynolds: float, size: float) -> float:
    """Pressure drop over viscosity and speed of blood driven through (lattice units), at about a Reynolds number."""
    steps = SLOW_STEPS if reynolds == CREEPING else FAST_STEPS
    viscosity = (steps - 0.5) / 3
    force = 1e-6
    for _ in range(1 if reynolds == CREEPING else 2):
        flow = flow_through(box, wires, force * UPWARDS, settled=SETTLED, relaxation_steps=steps)
        through = float(flow.superficial_velocity[2])
        result = force * box[2] / through / viscosity
        force *= reynolds * viscosity / size / through
    return result


def flow_along(box: tuple[int, int, int], wires: Sequence[Surface]) -> float:
    """Flow rate along meshes over that between plates without thickness."""
    force, viscosity = 5e-6, (SLOW_STEPS - 0.5) / 3
    flow = flow_through(box, wires, force * np.eye(3)[0], settled=5 * SETTLED, relaxation_steps=SLOW_STEPS)
    return float(flow.superficial_velocity[0]) / (force * box[2] ** 2 / (12 * viscosity))


def meshes() -> list[dict[str, object]]:
    """Rows of the table of two meshes."""
    rows: list[dict[str, object]] = []
    spacing = SPACING_MM / WIRE_MM * CELLS
    for side, second in ((36, "same"), (36, "moved"), (72, "turned by 45 degrees")):
        box = (side, side, HEIGHT)
        first = mesh(side, 0.4 * HEIGHT)
        alone = [resistance(box, first, reynolds, spacing) for reynolds in (CREEPING, FAST)]
        along = flow_along(box, first)
        for gap_mm in (0.0, 0.1):
            height = 0.4 * HEIGHT + 2 * CELLS + gap_mm / WIRE_MM * CELLS
            other = mesh(side, height, is_turned=second.startswith("turned"), is_moved=second == "moved")
            both = [*first, *other]
            normal = [resistance(box, both, reynolds, spacing) for reynolds in (CREEPING, FAST)]
            rows.append(
                {
                    "second": second,
                    "gap_mm": gap_mm,
                    "normal": [round(two / one, 3) for two, one in zip(normal, alone, strict=True)],
                    "along": [round(along, 3), round(flow_along(box, both), 3)],
                }
            )
            print(json.dumps(rows[-1]), flush=True)
    return rows


def coils() -> list[dict[str, float]]:
    """Rows of the table of packed wires."""
    rows = []
    for density in (0.15, 0.20, 0.25, 0.30):
        diameter = COIL_CELLS
        side = round(diameter * np.sqrt(3 * np.pi / 4 / density))
        length = 3.0 * side
        axes = ((0.0, 0.25, 0.25), (0.25, 0.0, 0.75), (0.75, 0.75, 0.0))
        wires = [wire(side * np.array(at), np.eye(3)[k], diameter, length) for k, at in enumerate(axes)]
        true = 3 * np.pi / 4 * diameter**2 / side**2
        creeping = resistance((side, side, side), wires, CREEPING, diameter)
        fast = resistance((side, side, side), wires, FAST, diameter)
        permeability = side / creeping * (0.3 / diameter) ** 2
        specific = 4 * true / 0.3
        rows.append(
            {
                "density": round(float(true), 4),
                "permeability_mm2": round(float(permeability), 6),
                "c": round(float((1 - true) ** 3 / (permeability * specific**2)), 3),
                "inertia": round(fast / creeping, 3),
            }
        )
        print(json.dumps(rows[-1]), flush=True)
    return rows


def packed() -> list[dict[str, object]]:
    """Rows of the table of placed coils."""
    rows: list[dict[str, object]] = []
    count, wound_mm, force = round(CUBE_MM / CUBE_CELL_MM), 0.305, 1e-6
    sac = ball(3.0, 1.5)
    vertices_mm = sac.aneurysms[0].sac.vertices_mm
    low_mm = 0.5 * (vertices_mm.min(axis=0) + vertices_mm.max(axis=0)) - 0.5 * count * CUBE_CELL_MM
    for filled in (0.15, 0.20, 0.25, 0.30):
        placed = deploy_coils("coils", sac, filled, seed=1).stent
        wires, length = [], 0.0
        for first, last in zip(placed.wire_starts[:-1], placed.wire_starts[1:], strict=True):
            points = (placed.wire_points_mm[first:last] - low_mm) / CUBE_CELL_MM
            inner = np.flatnonzero(((points > 0) & (points < count)).all(axis=1))
            for part in np.split(inner, np.flatnonzero(np.diff(inner) > 1) + 1):
                if len(part) > 2:
                    axis = points[part]
                    side = np.eye(3)[np.abs(axis[1] - axis[0]).argmin()]
                    wires.append(swept(axis, circle(wound_mm / CUBE_CELL_MM), side))
                    length += np.linalg.norm(np.diff(axis, axis=0), axis=1).sum()
        density = np.pi / 4 * (wound_mm / CUBE_CELL_MM) ** 2 * length / count**3
        box, found = (count, count, count), []
        for k in range(3):
            flow = flow_through(box, wires, force * np.eye(3)[k], settled=1e-3, relaxation_steps=SLOW_STEPS)
            along, speed = flow.superficial_velocity[k], np.linalg.norm(flow.velocity, axis=-1).mean()
            found.append((along * (SLOW_STEPS - 0.5) / 3 / force * CUBE_CELL_MM**2, speed / along))
        permeability, winding = np.mean(found, axis=0)
        specific = 4 * density / wound_mm
        rows.append(
            {
                "density": round(float(density), 4),
                "permeability_mm2": round(float(permeability), 6),
                "c": round(float((1 - density) ** 3 / (permeability * specific**2)), 3),
                "winding": round(float(winding), 3),
            }
        )
        print(json.dumps(rows[-1]), flush=True)
    return rows


if __name__ == "__main__":
    tables = json.loads(TABLE.read_text())
    for make in (coils, packed, meshes):
        if make.__name__ in (sys.argv[1:] or ("coils", "packed", "meshes")):
            tables[make.__name__] = make()
    TABLE.write_text(json.dumps(tables, indent=2) + "\n")
