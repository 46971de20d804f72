"""Calibrate the screen on resolved crossing wires: write `benchmarks/screen.json`, print it beside the laws.

Usage: python benchmarks/screen.py [--quick]

Every row is a periodic cell of two families of wires, one lying on the other, with blood driven straight through (see
`vstent.flow.crossing_cell`). `crossing_factor` is the viscous resistance over the sum of two rows of such wires, each
computed alike; `row_over_law` is such a row's over that of Tamada and Fujikawa (1957): what the grid gets wrong.
`inertial_loss` is what is left over rho U^2 / 2 at the wire Reynolds number. `passing_over_spacing` is the speed of
blood behind the wires over the shear rate of blood that flows along them before, over the spacing; `passing_law` is
what the screen's tangential resistance makes of it.
"""

import json
import sys
from pathlib import Path

import numpy as np

from vstent.flow.crossing_cell import VISCOSITY, Wires, crossing_wires, flow_through, passing, row_of_wires
from vstent.flow.screen import crossing_factor, drag_per_length, inertial_loss, tangential_share

TABLE = Path(__file__).with_suffix(".json")
CELLS = ((24, 24, 4), (34, 34, 4), (36, 36, 6), (44, 44, 4), (48, 28, 4), (48, 28, 6), (54, 54, 2.5))
"""Cells of the box across and along the stent, and the wire's diameter."""
REYNOLDS = (1.0, 2.0)
"""Wire Reynolds numbers beside creeping flow."""
CREEPING = 1e-6
"""Body force of the creeping flow."""


def resistance(wires: Wires, force: float) -> tuple[float, float]:
    """Pressure drop over velocity, and the velocity (lattice units)."""
    velocity = float(flow_through(wires, np.array([0.0, 0.0, force])).superficial_velocity[2])
    return force * wires.shape[2] / velocity, velocity


def row_law(diameter: float, spacing: float) -> float:
    """Resistance of a row of cylinders (lattice units)."""
    return VISCOSITY * float(drag_per_length(np.float64(diameter), np.float64(spacing))) / spacing


def row(across: int, along: int, diameter: float) -> dict[str, float | list[float]]:
    spacing = along * across / float(np.hypot(along, across))
    height = max(44, round(1.3 * spacing))
    wires = crossing_wires(across, along, height, diameter)
    tall = crossing_wires(across, along, 2 * round(min(1.8 * spacing, 60.0)), diameter)
    ratio = np.float64(diameter / spacing)
    normal_law = 2 * row_law(diameter, spacing) * float(crossing_factor(ratio, np.float64(1.0)))
    viscous, slow = resistance(wires, CREEPING)
    of_row = resistance(row_of_wires(round(spacing), height, diameter), CREEPING)[0] / row_law(diameter, round(spacing))
    losses, reached = [], []
    for number in REYNOLDS:
        wanted = number * VISCOSITY / diameter
        total, velocity = resistance(wires, CREEPING * wanted / slow)
        losses.append((total - viscous) * 2 / velocity)
        reached.append(velocity * diameter / VISCOSITY)
    open_fraction = (1 - diameter / spacing) ** 2
    return {
        "diameter_over_spacing": diameter / spacing,
        "angle_deg": float(np.degrees(np.arctan2(across, along))),
        "cells_per_wire": diameter,
        "row_over_law": of_row,
        "crossing_factor": viscous / (2 * row_law(diameter, spacing)) / of_row,
        "passing_over_spacing": passing(tall, CREEPING) / spacing,
        "passing_law": VISCOSITY / (tangential_share(ratio) * normal_law) / spacing,
        "wire_reynolds": reached,
        "inertial_loss": losses,
        "inertial_loss_law": float(inertial_loss(np.float64(open_fraction))),
    }


if __name__ == "__main__":
    rows = []
    for cell in CELLS[1:3] if "--quick" in sys.argv else CELLS:
        rows.append(row(*cell))
        print(json.dumps(rows[-1]), flush=True)
    if "--quick" not in sys.argv:
        TABLE.write_text(json.dumps(rows, indent=2) + "\n")
