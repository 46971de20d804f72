"""What a flow will cost, told before it is spent; what does not fit in the memory is refused."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from time import perf_counter

import numba
import numpy as np

from vstent.errors import FlowError
from vstent.flow.case import PHASES, FlowCase
from vstent.flow.domain import default_cell_size_mm, extended_volume_mm3
from vstent.flow.lattice import close_up
from vstent.flow.lattice.gpu import free_gpu_bytes
from vstent.flow.lattice.kernels import d3q19, lanes
from vstent.flow.lattice.kernels.warm import keep_flow
from vstent.flow.lattice.pace import pace
from vstent.flow.memory import free_memory_bytes

BYTES_PER_CELL = 750
"""Peak memory per blood cell (measured on 0.3 to 0.8 million cells: 300 to build and step; 280 for the last checks and
the means of all; the rest is what other flows of the same study keep)."""
BYTES_PER_CELL_OF_RESULT = 130
"""Memory per cell that is only filled in from the wide ones around a close-up (measured on 0.5 million cells)."""
BYTES_PER_PHASE_AND_CELL = 32
"""Memory for every kept phase of a cycle and its cell, computed or only filled in."""
BYTES_PER_GRID_POINT = 6
"""Memory per point of the box around the vessel (3 measured)."""
MOST_CELLS = 1e8
"""Cells of blood whose 19 populations still have numbers of 32 bits, with those beside the wall (2^31 / 19 places)."""
GPU_BYTES_PER_CELL = 320
"""Memory of a GPU per blood cell (sums of its arrays: 302 on 31,000 cells of the demo, 214 on 169,000)."""
BYTES_AT_LEAST = 4.5e8
"""Memory of the program itself, its compiled kernels and one surface."""
WHOLE_OVER_BLOCK = 3.5
"""Ratio of the run time of a flow to that of its steps in a block of blood that fits the cache. The rest is walls,
openings, checks, the first guess and memory. Measured: demo with Silk at 0.14 mm, 123 million updates per second
against 440 in the block; 3.4 for C0038 at 0.2 mm, 4.8 for a small bifurcation."""
BLOCK_ROWS = 4095
"""Rows of the block that the rate is measured on, an odd number (see `setup.address`)."""
BLOCK_BAND = 15
"""Rows of each of its bands."""
MARGIN = 1.05
"""The cell size that is said to fit leaves this much room."""


@dataclass(frozen=True)
class Cost:
    """What one flow will take."""

    cell_size_mm: float
    """Edge of a cell."""
    cells: int
    """Cells of blood to be computed, extensions included."""
    memory_bytes: int
    """Peak memory."""
    steps: int
    """Most time steps."""
    seconds: float
    """Most time, at the measured rate."""

    def __str__(self) -> str:
        """One sentence."""
        return (
            f"Grid spacing {self.cell_size_mm:.3g} mm ({self.cells:,.0f} cells), memory "
            f"{self.memory_bytes / 1e9:.2g} GB, run time at most {self.seconds / 60:.2g} min per flow "
            f"({self.steps:,} time steps)."
        )


def estimate(case: FlowCase) -> Cost:
    """Estimate what a flow takes, from the vessel's volume and a rate measured here and now."""
    cell_size_mm = default_cell_size_mm(case)
    cells, memory_bytes = _size(case, cell_size_mm)
    steps = _steps(case, cell_size_mm, close_up.SHARE_WITHIN if case.settings.close_up else 1)
    updates = cells * steps
    if case.settings.close_up:
        updates += _wide_cells(case, cell_size_mm) * _steps(case, cell_size_mm, close_up.SHARE_AROUND)
    seconds = updates / block_rate(on_gpu=case.settings.device_gpu) * WHOLE_OVER_BLOCK
    return Cost(cell_size_mm, round(cells), round(memory_bytes), steps, seconds)


def refuse_too_large(case: FlowCase, free_bytes: float | None = None, gpu_bytes: float | None = None) -> None:
    """Refuse a flow that does not fit in the free memory, or in the GPU's where it is to run on one, or in 32 bits.

    Raises
    ------
    FlowError
        Naming the cell size that would fit.
    """
    free_bytes = free_memory_bytes() if free_bytes is None else free_bytes
    cell_size_mm = default_cell_size_mm(case)
    if (cells := _size(case, cell_size_mm)[0]) > MOST_CELLS:
        raise FlowError(
            f"a grid spacing of {cell_size_mm:.3g} mm gives {cells / 1e6:.3g} million cells, more than the "
            f"largest number of {MOST_CELLS / 1e6:.0f} million: use a grid spacing of "
            f"{_fitting_mm(case, lambda cell_mm: _size(case, cell_mm)[0], MOST_CELLS):.2g} mm"
        )
    _refuse(case, lambda cell_mm: _size(case, cell_mm)[1], free_bytes, "memory")
    if case.settings.device_gpu:
        gpu_bytes = free_gpu_bytes() if gpu_bytes is None else gpu_bytes
        _refuse(case, lambda cell_mm: GPU_BYTES_PER_CELL * _size(case, cell_mm)[0], gpu_bytes, "the GPU's memory")


def _refuse(case: FlowCase, needed_bytes: Callable[[float], float], free_bytes: float, of: str) -> None:
    """Refuse a flow that needs more than is free, by the cell size, of some memory."""
    cell_size_mm = default_cell_size_mm(case)
    if needed_bytes(cell_size_mm) <= free_bytes:
        return
    raise FlowError(
        f"a grid spacing of {cell_size_mm:.3g} mm gives {_size(case, cell_size_mm)[0] / 1e6:.3g} million cells "
        f"and needs {needed_bytes(cell_size_mm) / 1e9:.2g} GB, but {free_bytes / 1e9:.2g} GB of {of} are free: "
        f"use a grid spacing of {_fitting_mm(case, needed_bytes, free_bytes):.2g} mm"
    )


def _fitting_mm(case: FlowCase, needed: Callable[[float], float], most: float) -> float:
    """Cell size from the case's own on at which so much at most is needed."""
    own_mm = fitting_mm = default_cell_size_mm(case)
    while needed(fitting_mm) > most and fitting_mm < 1e3 * own_mm:
        fitting_mm *= MARGIN
    return fitting_mm


def _size(case: FlowCase, cell_size_mm: float) -> tuple[float, float]:
    """Cells and bytes."""
    vessel = case.vessel
    volume_mm3 = extended_volume_mm3(vessel)
    widest = max(opening.diameter_mm for opening in vessel.openings)
    box_mm3 = float(np.prod(np.ptp(vessel.lumen.vertices_mm, axis=0) + 2 * widest))
    phases = 0 if case.settings.waveform is None else PHASES
    whole = volume_mm3 / cell_size_mm**3
    of_all = (
        BYTES_AT_LEAST + box_mm3 / cell_size_mm**3 * BYTES_PER_GRID_POINT + whole * phases * BYTES_PER_PHASE_AND_CELL
    )
    if not case.settings.close_up:
        return whole, of_all + whole * BYTES_PER_CELL
    cells = close_up.volume_mm3(case) / cell_size_mm**3
    return cells, of_all + cells * BYTES_PER_CELL + (whole - cells) * BYTES_PER_CELL_OF_RESULT


def _wide_cells(case: FlowCase, cell_size_mm: float) -> float:
    """Cells of the flow around a close-up."""
    return abs(case.vessel.closed.volume_mm3) / (close_up.WIDTH * cell_size_mm) ** 3


def _steps(case: FlowCase, cell_size_mm: float, share: float) -> int:
    """Most time steps of a pulse, or of a steady flow that makes this share of those allowed."""
    settings = case.settings
    if settings.waveform is None:
        return int(share * settings.max_steps)
    return int(pace(case, cell_size_mm, None).sum()) * settings.max_cycles


def block_rate(*, on_gpu: bool = False) -> float:
    """Cell updates per second in a block of blood without walls, measured once on what it will be computed with."""
    return _measured_rate(on_gpu)


@cache
def _measured_rate(on_gpu: bool) -> float:
    keep_flow()
    length = np.full(BLOCK_ROWS, 64, np.int32)
    stride = int(length.sum())
    address = (64 * np.arange(BLOCK_ROWS)[:, None] + stride * np.arange(19)).astype(np.int32)
    f = np.zeros(19 * stride + lanes.COUNT, np.float32)
    nothing = d3q19.no_screen(BLOCK_ROWS)
    limit = np.full(BLOCK_ROWS, np.inf, np.float32)
    relaxation = np.float32(0.6), np.zeros(4, np.float32), limit, np.float32(0.7)
    if on_gpu:
        from vstent.flow.lattice.on_gpu import seconds_of_update

        return stride / seconds_of_update(f, address, length, relaxation, nothing)
    rows = np.arange(0, BLOCK_ROWS + 1, BLOCK_BAND, dtype=np.int32)
    bands = np.column_stack([rows, np.zeros((len(rows), 4), np.int32)])
    shares = d3q19.share(length, nothing[0], bands, numba.get_num_threads())
    times: list[float] = []
    for _ in range(4):
        began = perf_counter()
        d3q19.update(f, (address[None], length, relaxation, nothing), d3q19.NO_LINKS, bands, shares)
        times.append(perf_counter() - began)
    return stride / min(times)
