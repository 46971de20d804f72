"""Calibrate the screen on resolved crossing wires: write `benchmarks/screen.json`, print it beside the laws.

Usage: python benchmarks/screen.py [--quick]

Every row is a periodic cell of two families of wires (`tests/helpers/periodic_box.py`). `crossing_factor` is the
viscous resistance to blood driven straight through, over the sum of two rows of such wires, each computed alike;
`row_over_law` is such a row's over that of Tamada and Fujikawa (1957): what the grid gets wrong. The others are of
blood that passes at an angle, some three times as fast along the wires as through them, at a wire Reynolds number of a
half, the mean of wires that lie one on the other and of wires in one plane, for woven ones do either:
`normal_over_tangential`, what resists it through the wires over what resists it along, as a thin sheet would; and
`inertial_loss`, what resists it through the wires besides viscosity, over rho |u| u_n / 2 of the sheet's velocity.
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vstent.flow.drag import crossing_factor, drag_per_length, inertial_loss, tangential_share
from vstent.geometry.surface import Surface

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))
from periodic_box import VISCOSITY, crossing_wires, flow_through, row_of_wires, sheet_speed

TABLE = Path(__file__).with_suffix(".json")
CELLS = (
    (24, 24, 4),
    (36, 36, 6),
    (34, 34, 4),
    (44, 44, 4),
    (54, 54, 2.5),
    (48, 28, 4),
    (62, 36, 3),
    (48, 38, 3.3),
    (38, 48, 3.3),
    (36, 62, 3),
    (28, 48, 4),
)
"""Cells of the box across and along the stent, and the wire's diameter."""
REYNOLDS, SLANT = 0.5, 3.0
"""Wire Reynolds number of the blood that passes at an angle, and about how much faster it is along than through."""
CREEPING = 1e-6
"""Body force of the creeping flow."""


def viscous_resistance(box: tuple[int, int, int], wires: Sequence[Surface]) -> float:
    """Pressure drop over velocity, straight through (lattice units)."""
    force = np.array([0, 0, CREEPING])
    return CREEPING * box[2] / float(flow_through(box, wires, force).superficial_velocity[2])


def row_law(diameter: float, spacing: float) -> float:
    """Resistance of a row of cylinders (lattice units)."""
    return VISCOSITY * float(drag_per_length(np.float64(diameter), np.float64(spacing))) / spacing


def at_an_angle(box: tuple[int, int, int], wires: Sequence[Surface], diameter: float) -> tuple[float, float, float]:
    """Viscous resistance, it over the tangential one, and inertial loss, of blood that passes at an angle."""
    height, viscous = box[2], viscous_resistance(box, wires)
    wanted = REYNOLDS * VISCOSITY / diameter
    along = SLANT * viscous / (1 + 0.5 * viscous / wanted)
    force = np.array([along, 0.0, viscous]) * wanted / height
    flow = flow_through(box, wires, force)
    through, in_sheet = float(flow.superficial_velocity[2]), sheet_speed(flow, force)
    lost = force[2] * height - viscous * through
    return viscous, viscous * in_sheet / (force[0] * height), 2 * lost / (np.hypot(through, in_sheet) * through)


def row(across: int, along: int, diameter: float) -> dict[str, float]:
    spacing = along * across / float(np.hypot(along, across))
    height = 2 * round(min(1.5 * spacing, 60.0))
    of_row = viscous_resistance((4, round(spacing), height), row_of_wires(round(spacing), height, diameter))
    of_row /= row_law(diameter, round(spacing))
    box = along, across, height
    one_on_the_other, in_one_plane = (
        at_an_angle(box, crossing_wires(across, along, height, diameter, apart), diameter) for apart in (1.0, 0.0)
    )
    ratio, lengthwise = np.float64(diameter / spacing), np.float64(along**2 / (along**2 + across**2))
    return {
        "diameter_over_spacing": diameter / spacing,
        "angle_deg": float(np.degrees(np.arctan2(across, along))),
        "cells_per_wire": diameter,
        "row_over_law": of_row,
        "crossing_factor": one_on_the_other[0] / (2 * row_law(diameter, spacing)) / of_row,
        "crossing_factor_law": float(crossing_factor(ratio, np.float64(1.0))),
        "normal_over_tangential": 0.5 * (one_on_the_other[1] + in_one_plane[1]),
        "normal_over_tangential_one_on_the_other": one_on_the_other[1],
        "normal_over_tangential_law": float(1 / tangential_share(ratio, lengthwise)),
        "inertial_loss": 0.5 * (one_on_the_other[2] + in_one_plane[2]),
        "inertial_loss_law": float(inertial_loss(ratio)),
    }


if __name__ == "__main__":
    rows = []
    for cell in CELLS[:2] if "--quick" in sys.argv else CELLS:
        rows.append({name: round(float(value), 4) for name, value in row(*cell).items()})
        print(json.dumps(rows[-1]), flush=True)
    if "--quick" not in sys.argv:
        TABLE.write_text(json.dumps(rows, indent=2) + "\n")
