"""Estimated grid size, memory and run time of a flow; a flow that does not fit in memory is refused."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from time import perf_counter

import numba
import numpy as np

from vstent.errors import FlowError
from vstent.flow.case import PHASES, FlowCase
from vstent.flow.domain import default_cell_size_mm, extended_volume_mm3
from vstent.flow.lattice.gpu import free_gpu_bytes
from vstent.flow.lattice.kernels import d3q19, lanes
from vstent.flow.lattice.kernels.warm import keep_flow
from vstent.flow.lattice.levels import WIDTH, box_points, further_levels, sizes_mm, volume_mm3
from vstent.flow.lattice.pace import pace
from vstent.flow.memory import free_memory_bytes
from vstent.units import duration

BYTES_PER_CELL = 750
"""Peak memory per cell of blood, in bytes. Measured on 0.3 to 0.8 million cells: 300 for the time steps, 280 for the
last checks and the block means; the rest is for other flows of the same study."""
BYTES_PER_PHASE_AND_CELL = 32
"""Memory in bytes per stored phase of a cycle and cell."""
BYTES_PER_GRID_POINT = 6
"""Memory in bytes per grid point of the box around the vessel (measured: 3)."""
BYTES_PER_BOX_POINT = 15
"""Memory in bytes per grid point of the box around narrow branches, while the finest level there is built (measured on
83 million points)."""
MOST_CELLS = 1e8
"""Maximum number of cells whose 19 populations can be addressed with 32 bits, cells beside the wall included (2^31 / 19
storage places)."""
GPU_BYTES_PER_CELL, GPU_BYTES_AROUND_WIRES = 320, 600
"""GPU memory in bytes per cell of blood, and on levels around wires, of which many cells are interpolated (sums of
the arrays: 218 on 28,000 cells of a tube, 277 with a level in the sac, 480 around Enterprise from 0.25 to 0.031 mm)."""
BYTES_AT_LEAST = 4.5e8
"""Memory in bytes of the program itself, its compiled kernels and one surface."""
WHOLE_OVER_BLOCK = 3.5
"""Ratio of the run time of a flow to that of its time steps in a block of blood that fits the cache. The rest is walls,
openings, checks, the initial flow and memory access. Measured: demo with Silk at 0.14 mm, 123 million updates per
second against 440 in the block; 3.4 for C0038 at 0.2 mm, 4.8 for a small bifurcation."""
AROUND_WIRES_OVER_BLOCK = 7.0
"""The same with finer levels around wires, where most of the time goes into the exchange between thin levels (demo with
Enterprise from 0.16 to 0.02 mm: 65 million updates per second on two cores)."""
EXCHANGE_S = 1e-4
"""Run time of an exchange between two levels besides that of their cells (a ball of 0.7 mm in the demo at 0.3 mm)."""
BLOCK_ROWS = 4095
"""Number of rows of the block used to measure the speed; odd, so that populations are not whole pages apart (see
`setup.PAGE`)."""
BLOCK_BAND = 15
"""Number of rows in each of its bands."""
MARGIN = 1.1
"""Factor by which the suggested grid spacing, of two digits, is increased until the flow fits."""


@dataclass(frozen=True)
class Cost:
    """Estimated cost of one flow."""

    cell_size_mm: float
    """Grid spacing."""
    cells: int
    """Number of cells of blood computed on all levels, extensions of the openings included."""
    memory_bytes: int
    """Peak memory."""
    steps: int
    """Maximum number of time steps on the finest level."""
    seconds: float
    """Maximum run time at the measured speed."""

    def __str__(self) -> str:
        """Return the estimate as one sentence."""
        return (
            f"Grid spacing {self.cell_size_mm:.3g} mm ({self.cells:,.0f} cells), memory "
            f"{self.memory_bytes / 1e9:.2g} GB, run time at most {duration(self.seconds)} per flow "
            f"({self.steps:,} time steps)."
        )


def estimate(case: FlowCase) -> Cost:
    """Estimate the cost of a flow from the vessel's volume and the speed measured on this machine."""
    cell_size_mm = default_cell_size_mm(case)
    (cells, memory_bytes), steps = _size(case, cell_size_mm), _steps(case, cell_size_mm)
    return Cost(cell_size_mm, round(cells), round(memory_bytes), steps, seconds_of(case, cell_size_mm, steps))


def seconds_of(case: FlowCase, cell_size_mm: float, steps: float) -> float:
    """Estimate the run time of so many time steps on the finest level."""
    of_levels, kept = _cells(case, cell_size_mm), 1 + case.numerics.coarser_levels
    per_step = np.array(of_levels) * WIDTH ** np.arange(1.0 - len(of_levels), 1.0)
    in_block = WHOLE_OVER_BLOCK * per_step[:kept].sum() + AROUND_WIRES_OVER_BLOCK * per_step[kept:].sum()
    return steps * float(in_block / block_rate(on_gpu=case.numerics.device_gpu) + EXCHANGE_S * (len(of_levels) > 1))


def _cells(case: FlowCase, cell_size_mm: float) -> list[float]:
    """Return the number of cells of every level, coarse to fine."""
    sizes = sizes_mm(case, cell_size_mm)
    volumes_mm3 = extended_volume_mm3(case.vessel), *(volume_mm3(case, one_mm, cell_size_mm) for one_mm in sizes[:-1])
    return [volume / size_mm**3 for volume, size_mm in zip(volumes_mm3, sizes, strict=True)]


def refuse_too_large(case: FlowCase, free_bytes: float | None = None, gpu_bytes: float | None = None) -> None:
    """Check that a flow fits in the free memory, in the GPU's memory if it runs there, and in 32-bit addresses.

    Otherwise raise a `FlowError` that names the grid spacing that would fit.
    """
    free_bytes = free_memory_bytes() if free_bytes is None else free_bytes
    cell_size_mm = default_cell_size_mm(case)
    if (cells := _size(case, cell_size_mm)[0]) > MOST_CELLS:
        raise FlowError(
            f"a grid spacing of {cell_size_mm:.3g} mm gives {cells / 1e6:.3g} million cells, more than the "
            f"largest number of {MOST_CELLS / 1e6:.0f} million: "
            f"{_instead(case, lambda cell_mm: _size(case, cell_mm)[0], MOST_CELLS)}"
        )
    _refuse(case, lambda cell_mm: _size(case, cell_mm)[1], free_bytes, "memory")
    if case.numerics.device_gpu:
        gpu_bytes = free_gpu_bytes() if gpu_bytes is None else gpu_bytes
        _refuse(case, lambda cell_mm: _gpu_bytes(case, cell_mm), gpu_bytes, "the GPU's memory")


def fits(case: FlowCase) -> bool:
    """Return whether a flow fits in the free memory, and in the GPU's memory if it runs there."""
    is_here = not case.numerics.device_gpu
    fits_there = is_here or _gpu_bytes(case, default_cell_size_mm(case)) < free_gpu_bytes()
    return fits_there and memory_bytes(case) < free_memory_bytes()


def _gpu_bytes(case: FlowCase, cell_size_mm: float) -> float:
    """Return the memory of a flow on a GPU."""
    of_levels, kept = _cells(case, cell_size_mm), 1 + case.numerics.coarser_levels
    return GPU_BYTES_PER_CELL * sum(of_levels[:kept]) + GPU_BYTES_AROUND_WIRES * sum(of_levels[kept:])


def _refuse(case: FlowCase, needed_bytes: Callable[[float], float], free_bytes: float, of: str) -> None:
    """Raise a `FlowError` when the case needs more bytes than are free in the memory named `of`."""
    cell_size_mm = default_cell_size_mm(case)
    if needed_bytes(cell_size_mm) <= free_bytes:
        return
    raise FlowError(
        f"a grid spacing of {cell_size_mm:.3g} mm gives {_size(case, cell_size_mm)[0] / 1e6:.3g} million cells "
        f"and needs {needed_bytes(cell_size_mm) / 1e9:.2g} GB, but {free_bytes / 1e9:.2g} GB of {of} are free: "
        f"{_instead(case, needed_bytes, free_bytes)}"
    )


def _instead(case: FlowCase, needed: Callable[[float], float], most: float) -> str:
    """Return what to do about a case that needs too much: the next coarser spacing that fits, or a screen for walls."""
    if case.walls is not None:  # a coarser grid may have finer walls
        return "use a screen (--wires screen)"
    own_mm = fitting_mm = default_cell_size_mm(case)
    while needed(fitting_mm) > most and fitting_mm < 1e3 * own_mm:
        fitting_mm = float(f"{MARGIN * fitting_mm:.2g}")
    return f"use a grid spacing of {fitting_mm:.2g} mm"


def memory_bytes(case: FlowCase) -> float:
    """Return the estimated peak memory of a flow."""
    return _size(case, default_cell_size_mm(case))[1]


def _size(case: FlowCase, cell_size_mm: float) -> tuple[float, float]:
    """Return the number of cells computed and the peak memory in bytes."""
    vessel, cells = case.vessel, sum(_cells(case, cell_size_mm))
    widest = max(opening.diameter_mm for opening in vessel.openings)
    box_mm3 = float(np.prod(np.ptp(vessel.lumen.vertices_mm, axis=0) + 2 * widest))
    phases = 0 if case.waveform is None else PHASES
    of_cell, further = BYTES_PER_CELL + phases * BYTES_PER_PHASE_AND_CELL, further_levels(case, cell_size_mm)
    of_boxes = box_mm3 / cell_size_mm**3 * BYTES_PER_GRID_POINT
    of_boxes += BYTES_PER_BOX_POINT * box_points(case, cell_size_mm * WIDTH / WIDTH**further) * (further > 0)
    return cells, BYTES_AT_LEAST + of_boxes + cells * of_cell


def _steps(case: FlowCase, cell_size_mm: float) -> int:
    """Return the maximum number of time steps on the finest level."""
    sizes, kept = sizes_mm(case, cell_size_mm), 1 + case.numerics.coarser_levels
    if case.waveform is None:
        return int(part_of_steps(case, len(sizes)) * case.numerics.max_steps) * WIDTH ** (len(sizes) - kept)
    return WIDTH ** (len(sizes) - 1) * int(pace(case, sizes[0], None).sum()) * case.numerics.max_cycles


def part_of_steps(case: FlowCase, levels: int) -> float:
    """Return the part of the allowed time steps of a steady flow that a run with so many levels makes.

    It is small where it begins from a flow on the coarsest level, or from the flow with a screen.
    """
    coarser = case.numerics.coarser_levels
    return 1 / 8 if case.walls is not None and levels > 1 + coarser else 1 / 3 if coarser else 1.0


@cache
def block_rate(*, on_gpu: bool) -> float:
    """Return the cell updates per second in a block of blood without walls, measured once on the CPU or the GPU."""
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

        return stride / seconds_of_update(address[:, 0], length, stride, relaxation)
    rows = np.arange(0, BLOCK_ROWS + 1, BLOCK_BAND, dtype=np.int32)
    bands = np.column_stack([rows, np.zeros((len(rows), 4), np.int32)])
    shares = d3q19.share(length, nothing[0], bands, numba.get_num_threads())
    times: list[float] = []
    for _ in range(4):
        began = perf_counter()
        d3q19.update(f, (address[None], length, relaxation, nothing), d3q19.NO_LINKS, bands, shares)
        times.append(perf_counter() - began)
    return stride / min(times)
