"""What a flow by OpenFOAM will cost, told before it is spent; what does not fit in the memory is refused."""

from typing import Final

from vstent.errors import FlowError
from vstent.flow.cost import free_memory_bytes
from vstent.flow.domain import extended_volume_mm3
from vstent.flow.types import FlowCase

CELLS_PER_CUBE: Final = 1.6
"""Cells of the mesh over the blood's volume in cells: layers and the refined neck (1.5 to 1.65 measured)."""
BYTES_PER_CELL: Final = 6_000
"""Peak memory a cell, that of snappyHexMesh (4,700 to 5,500 measured on 86,000 cells)."""
SECONDS_PER_CELL: Final = 1e-3
"""Time of one core a cell of a steady flow without struts, half of it for the mesh (0.8 to 1.1 ms measured)."""


def tell_cost(case: FlowCase, cell_size_mm: float) -> str:
    """Return a sentence on cells, memory and time of a steady bare flow.

    Raises
    ------
    FlowError
        When it does not fit in the free memory, naming the cell size that would.
    """
    cells = CELLS_PER_CUBE * extended_volume_mm3(case.vessel) / cell_size_mm**3
    needed, free = cells * BYTES_PER_CELL, free_memory_bytes()
    if needed > free:
        fitting_mm = cell_size_mm * (needed / free) ** (1 / 3) * 1.02
        raise FlowError(
            f"OpenFOAM's mesh of {cells / 1e6:.3g} million cells of {cell_size_mm:.3g} mm needs {needed / 1e9:.2g} GB, "
            f"but {free / 1e9:.2g} GB of memory are free: set a cell size of {fitting_mm:.2g} mm"
        )
    return (
        f"OpenFOAM: about {cells / 1e3:,.0f} thousand cells of {cell_size_mm:.3g} mm, {needed / 1e9:.2g} GB, "
        f"{cells * SECONDS_PER_CELL / 60:.2g} min of one core for a steady flow without struts."
    )
