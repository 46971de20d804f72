"""Print what OpenFOAM takes for the demo: bare on one process and on two, and with Silk's wires meshed.

Usage: python benchmarks/openfoam.py [--cell MM] [--struts-cell MM] [--cases FOLDER]

Meshing is part of it. The wires over neck and branch are meshed, two cells across each at least. Flows are steady, from
rest, with OpenFOAM's default layers; the second process takes part in the solver alone, for one meshes. Memory is the
largest process's. With --cases the case folders stay in that folder.
"""

import argparse
import resource
import sys
import time
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import vstent
from vstent import phantoms
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.errors import FlowError
from vstent.flow.case import FlowCase
from vstent.flow.engines import run
from vstent.flow.indices import indices
from vstent.flow.openfoam import program
from vstent.flow.openfoam.engine import OpenFoam
from vstent.flow.problem import flow_case
from vstent.flow.settings import FlowSettings
from vstent.geometry.vessel import Vessel


def row(name: str, case: FlowCase, cell_size_mm: float, processes: int, folder: Path) -> float:
    """Mesh and compute, print a row of the table; return the solver's seconds an iteration."""
    case = replace(case, numerics=replace(case.numerics, processes=processes))
    engine = OpenFoam(cell_size_mm, folder)
    began = time.perf_counter()
    cells = engine.init(case, None).bridge.n_cells
    mesh_s = time.perf_counter() - began
    field = run(engine, case)
    whole_s = time.perf_counter() - began
    iteration_s = cells / field.updates_per_s
    peak_GB = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024 / 1e9
    found = indices(field, case.sac, case.ostium)
    values = f"{found['neck_inflow_mL_s']:.4f} | {1e3 * found['mean_sac_velocity_m_s']:.2f}"
    times = f"{mesh_s:.0f} | {iteration_s:.2f} | {whole_s / 60:.1f} | {peak_GB:.1f}"
    print(f"| {name} | {processes} | {cells} | {field.steps} | {field.is_converged} | {times} | {values} |", flush=True)
    return iteration_s


def main(cell_mm: float, struts_cell_mm: float, folder: Path | None) -> int:
    try:
        program.find()
    except FlowError as error:
        print(f"Not measured: {error}.")
        return 0
    anatomy = restore(trim(trace(Vessel(phantoms.phantom_surface(phantoms.demo_phantom(), edge_mm=0.2)))))
    bare = flow_case(anatomy, (), FlowSettings())
    stented = flow_case(anatomy, (vstent.deploy(vstent.find_design("silk"), anatomy).stent,), FlowSettings())
    print(
        "| demo | processes | cells | iterations | settled | mesh s | an iteration s | together min | GB "
        f"| neck inflow mL/s | sac velocity mm/s |\n{11 * '|---'}|"
    )
    with nullcontext(folder) if folder is not None else TemporaryDirectory() as own:
        cases = Path(own)
        one, two = (row("bare", bare, cell_mm, count, cases / f"bare_{count}") for count in (1, 2))
        row("Silk, its wires meshed", stented, struts_cell_mm, 2, cases / "silk")
    print(f"\nTwo processes take {two / one:.2f} of one's time an iteration.")
    return 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--cell", type=float, default=0.15)
    parser.add_argument("--struts-cell", type=float, default=0.2)
    parser.add_argument("--cases", type=Path)
    given = parser.parse_args()
    sys.exit(main(given.cell, given.struts_cell, given.cases))
