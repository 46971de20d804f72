"""Estimate run time and memory of an OpenFOAM flow; refuse one that does not fit in the free memory."""

from typing import Final

import numpy as np

from vstent.deployment.struts import thickness_mm
from vstent.devices.stent import Coils
from vstent.errors import FlowError
from vstent.flow.case import FlowCase
from vstent.flow.domain import extended_volume_mm3
from vstent.flow.memory import free_memory_bytes
from vstent.flow.openfoam.case import strut_solids
from vstent.flow.openfoam.setup import FoamSetup
from vstent.flow.settings import LATTICE
from vstent.units import duration

CELLS_PER_CUBE: Final = 1.6
"""Number of mesh cells over the blood's volume in cubic grid spacings: more than 1 because of layers and the refined
neck (measured: 1.5 to 1.65)."""
CELLS_ALONG_WIRE: Final = 25.0, 13.0
"""Number of cells per cell length of wire: a constant, and the increase per cell across the wire. Within a sixth of
measurements (Silk's wires 2.7 and 5.4 cells across, Enterprise's 5.5)."""
BYTES_AT_LEAST: Final = 3e8
"""Memory that does not depend on the number of cells, bytes."""
BYTES_PER_CELL: Final = 2_000
"""Additional peak memory per cell, bytes, reached by snappyHexMesh (measured in all: 0.43 GB for 86,000 cells, 1.0
GB for 339,000, 2.2 GB for 990,000)."""
WIDER, TRIED = 1.02, 100
"""Ratio between the grid spacings tried when the memory is too small, and their number plus one; the largest is 7
times the original."""
SECONDS_PER_CELL: Final = 1e-3
"""Run time of one core per cell of a steady flow without a device, s, half of it for the mesh (measured: 0.8 to 1.1
ms)."""
SECONDS_PER_STRUT_CELL: Final = 1.7e-3
"""The same for cells at struts (the demo with Silk, 990,000 cells)."""


def tell_cost(case: FlowCase, cell_size_mm: float) -> str:
    """Return a sentence on cells, memory and run time of a steady flow, including struts if the case has solids.

    A case that does not fit in the free memory is refused with a grid spacing that does.
    """
    (bare, at_struts), free = _cells(case, cell_size_mm), free_memory_bytes()
    needed = BYTES_AT_LEAST + BYTES_PER_CELL * (bare + at_struts)
    if needed > free:
        advice = f"choose the engine {LATTICE}, which does not have to resolve the device's wires"
        for size_mm in (float(f"{wider:.2g}") for wider in cell_size_mm * WIDER ** np.arange(1, TRIED)):
            if memory_bytes(case, size_mm) < free:
                advice = f"set a grid spacing of {size_mm:g} mm"
                break
        raise FlowError(
            f"OpenFOAM's mesh of {(bare + at_struts) / 1e6:.3g} million cells at a grid spacing of {cell_size_mm:.3g} "
            f"mm needs {needed / 1e9:.2g} GB of memory, but only {free / 1e9:.2g} GB are free: {advice}"
        )
    seconds = bare * SECONDS_PER_CELL + at_struts * SECONDS_PER_STRUT_CELL
    of_struts = f", {at_struts / 1e3:,.0f} thousand more at the struts" if at_struts else ""
    return (
        f"OpenFOAM: about {bare / 1e3:,.0f} thousand cells at a grid spacing of {cell_size_mm:.3g} mm{of_struts}, "
        f"{needed / 1e9:.2g} GB of memory, {duration(seconds)} on one core for a steady flow."
    )


def memory_bytes(case: FlowCase, cell_size_mm: float) -> float:
    """Return the estimated peak memory of a flow, including struts if the case has solids."""
    return BYTES_AT_LEAST + BYTES_PER_CELL * sum(_cells(case, cell_size_mm))


def _cells(case: FlowCase, cell_size_mm: float) -> tuple[float, float]:
    """Return the number of cells of the bare vessel, and of the refined ones at the struts."""
    bare = CELLS_PER_CUBE * extended_volume_mm3(case.vessel) / cell_size_mm**3
    struts = strut_solids(case) if case.solids else None
    if struts is None:
        return bare, 0.0
    setup = FoamSetup(cell_size_mm, struts=struts)
    small_mm = cell_size_mm / 2**setup.levels_at_struts
    base, more = CELLS_ALONG_WIRE
    length_mm = sum(one.wire_length_mm for one in case.solids if not isinstance(one, Coils))
    return bare, length_mm / small_mm * (base + more * thickness_mm(struts) / small_mm)
