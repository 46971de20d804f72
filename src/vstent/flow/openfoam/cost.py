"""What a flow by OpenFOAM will cost, told before it is spent; what does not fit in the memory is refused."""

from typing import Final

import numpy as np

from vstent.errors import FlowError
from vstent.flow.case import LATTICE, FlowCase
from vstent.flow.domain import extended_volume_mm3
from vstent.flow.memory import free_memory_bytes
from vstent.flow.openfoam.case import strut_solids
from vstent.flow.openfoam.setup import FoamSetup

CELLS_PER_CUBE: Final = 1.6
"""Cells of the mesh over the blood's volume in cells: layers and the refined neck (1.5 to 1.65 measured)."""
CELLS_ALONG_WIRE: Final = 25.0, 13.0
"""Cells for every length of one along a wire, and more for each that lies across it (within a sixth of what is
measured: Silk's wires 2.7 and 5.4 cells across, Enterprise's 5.5)."""
BYTES_AT_LEAST: Final = 3e8
"""Memory that does not hang on the cells."""
BYTES_PER_CELL: Final = 2_000
"""Peak memory a cell besides: snappyHexMesh's (in all 0.43 GB on 86,000 cells, 1.0 on 339,000, 2.2 on 990,000)."""
WIDER, TRIED = 1.02, 100
"""So much wider are the cells that are tried next where the memory does not hold the mesh; the last are 7 times as
wide."""
SECONDS_PER_CELL: Final = 1e-3
"""Time of one core a cell of a steady bare flow, half of it for the mesh (0.8 to 1.1 ms measured)."""
SECONDS_PER_STRUT_CELL: Final = 1.7e-3
"""The same at struts (the demo with Silk, 990,000 cells)."""


def tell_cost(case: FlowCase, cell_size_mm: float) -> str:
    """Return a sentence on cells, memory and time of a steady flow, behind the struts of a case that has a stent.

    Raises
    ------
    FlowError
        When it does not fit in the free memory, naming the cell size that would.
    LandingError
        When no wire lies where blood passes it.
    """
    bare, at_struts = _cells(case, cell_size_mm)
    needed, free = _bytes(bare + at_struts), free_memory_bytes()
    if needed > free:
        raise FlowError(
            f"OpenFOAM's mesh of {(bare + at_struts) / 1e6:.3g} million cells of {cell_size_mm:.3g} mm and "
            f"less needs {needed / 1e9:.2g} GB, but {free / 1e9:.2g} GB of memory are free: "
            f"{_what_fits(case, cell_size_mm, free)}"
        )
    seconds = bare * SECONDS_PER_CELL + at_struts * SECONDS_PER_STRUT_CELL
    of_struts = f", {at_struts / 1e3:,.0f} thousand more at the wires" if at_struts else ""
    return (
        f"OpenFOAM: about {bare / 1e3:,.0f} thousand cells of {cell_size_mm:.3g} mm{of_struts}, memory "
        f"{needed / 1e9:.2g} GB, run time {seconds / 60:.2g} min of one core for a steady flow."
    )


def _cells(case: FlowCase, cell_size_mm: float) -> tuple[float, float]:
    """Cells of the bare vessel, and of the halved ones at the struts."""
    bare = CELLS_PER_CUBE * extended_volume_mm3(case.vessel) / cell_size_mm**3
    if case.stent is None:
        return bare, 0.0
    setup = FoamSetup(cell_size_mm, struts=strut_solids(case))
    small_mm = cell_size_mm / 2**setup.levels_at_struts
    base, more = CELLS_ALONG_WIRE
    return bare, case.stent.wire_length_mm / small_mm * (base + more * setup.strut_thickness_mm / small_mm)


def _what_fits(case: FlowCase, cell_size_mm: float, free_bytes: float) -> str:
    """What to do instead: take wider cells, or, where struts alone are too many, none."""
    for size_mm in cell_size_mm * WIDER ** np.arange(1, TRIED):
        if _bytes(sum(_cells(case, size_mm))) < free_bytes:
            return f"use a grid spacing of {size_mm:.2g} mm"
    return f"use the engine {LATTICE}, which needs no cells as small as the wires"


def _bytes(cells: float) -> float:
    return BYTES_AT_LEAST + BYTES_PER_CELL * cells
