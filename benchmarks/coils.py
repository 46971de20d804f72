"""Coils as a porous region beside resolved ones, in the sac of a small bend: write `coils.json`, print it as a table.

Usage: python benchmarks/coils.py [--walls MM] [--region MM ...] [DENSITY ...]

An artery 3 mm wide that bends by 6 mm has a sac of 5 mm on its outer side, which is filled to each density. The
flow is computed with the coils as walls of grids of `--walls` mm, 6 cells across a coil of 0.305 mm at 0.05 mm, and
with the porous region that stands for them on those of `--region`. All indices are those of the blood between the
coils. `solid_fraction` is what the coils take of the sac's volume as walls. Rows that the file has are not computed
again.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from struts import INDICES, computed

from vstent import phantoms
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.deployment.coils import deploy_coils
from vstent.devices.stent import Deployment
from vstent.flow import sampling
from vstent.flow.indices import between_coils
from vstent.flow.problem import flow_case
from vstent.geometry.vessel import Anatomy, Vessel

TABLE = Path(__file__).with_suffix(".json")
KEPT_MM = 7.0
"""Length of the artery on either side of the sac."""


def bend() -> Anatomy:
    """An artery 3 mm wide that bends by 6 mm, with a sac of 5 mm on a neck of 3.5 mm on its outer side."""
    artery = phantoms.torus_arc(bend_radius_mm=6.0, angle_rad=np.pi, radius_mm=1.5)
    phantom = phantoms.with_sac(artery, abscissa_mm=0.5 * artery.parent.length_mm, width_mm=5.0, neck_mm=3.5)
    whole = trace(Vessel(phantoms.phantom_surface(phantom, edge_mm=0.2)))
    return restore(trim(whole, upstream_mm=KEPT_MM, downstream_mm=KEPT_MM))


def row(anatomy: Anatomy, placed: Deployment | None, spacing_mm: float, *, walls: bool) -> dict[str, float]:
    """Indices of a flow, of the blood between the coils."""
    sac, porosity = anatomy.aneurysms[0].sac, 1.0 - (placed.stent.density_fraction if placed else 0.0)
    case = flow_case(anatomy, (placed.stent,) if placed else ())
    field, found = computed(case, None, cell_size_mm=spacing_mm, wires="resolved" if walls else "screen")
    found = found if walls else {key: round(value, 6) for key, value in between_coils(found, porosity).items()}
    blood_mm3 = len(sampling.field_cells_inside(field, sac)) * spacing_mm**3
    return found | {
        "density_fraction": round(1.0 - porosity, 4),
        "solid_fraction": round(1.0 - blood_mm3 / sac.volume_mm3, 4),
        "cells": len(field.finest.cells),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("densities", nargs="*", type=float, default=[0.15, 0.2, 0.25])
    parser.add_argument("--walls", type=float, nargs="*", default=[0.05])
    parser.add_argument("--region", type=float, nargs="*", default=[0.05, 0.1, 0.2])
    given = parser.parse_args()
    anatomy, rows = bend(), json.loads(TABLE.read_text()) if TABLE.exists() else {}
    grids = [(mm, True) for mm in given.walls] + [(mm, False) for mm in given.region]
    for density in [0.0, *given.densities]:
        placed = deploy_coils("coils", anatomy, density) if density else None
        for mm, walls in grids:
            name = f"{density:.0%} {'walls' if walls else 'region'} {mm:g} mm" if placed else f"bare {mm:g} mm"
            if name not in rows:
                rows[name] = row(anatomy, placed, mm, walls=walls)
                TABLE.write_text(json.dumps(rows, indent=2) + "\n")
    keys = INDICES
    print(f"\n| | {' | '.join(keys)} |\n{(len(keys) + 1) * '|---'}|")
    for name, row in rows.items():
        print(f"| {name} | {' | '.join(f'{row[key]:.4g}' for key in keys)} |")
