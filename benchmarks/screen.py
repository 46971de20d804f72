"""Calibrate the screen on resolved crossing wires: write `benchmarks/screen.json`, print it beside the laws.

Usage: python benchmarks/screen.py [--quick]

Every row is a periodic cell of two families of wires, one lying on the other, with blood driven straight through (see
`vstent.flow.crossing_cell`). `crossing_factor` is the viscous resistance over the sum of two rows of cylinders (Tamada
and Fujikawa 1957), `inertial_loss` what is left over rho U^2 / 2 at the wire Reynolds number.
"""

import json
import sys
from pathlib import Path

import numpy as np

from vstent.flow.crossing_cell import VISCOSITY, Wires, crossing_wires, flow_through
from vstent.flow.screen import drag_per_length, inertial_loss

TABLE = Path(__file__).with_suffix(".json")
CELLS = ((24, 24, 4), (34, 34, 4), (36, 36, 6), (48, 28, 4), (48, 28, 6), (66, 24, 4))
"""Cells of the box across and along the stent, and the wire's diameter."""
REYNOLDS = (1.0, 2.0)
"""Wire Reynolds numbers beside creeping flow."""
CREEPING = 1e-6
"""Body force of the creeping flow."""


def resistance(wires: Wires, force: float) -> tuple[float, float]:
    """Pressure drop over velocity, and the velocity (lattice units)."""
    velocity = float(flow_through(wires, np.array([0.0, 0.0, force])).superficial_velocity[2])
    return force * wires.shape[2] / velocity, velocity


def row(across: int, along: int, diameter: float) -> dict[str, float | list[float]]:
    spacing = along * across / float(np.hypot(along, across))
    wires = crossing_wires(across, along, max(44, round(1.3 * spacing)), diameter)
    viscous, slow = resistance(wires, CREEPING)
    law = 2 * VISCOSITY * float(drag_per_length(diameter, spacing)) / spacing
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
        "crossing_factor": viscous / law,
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
