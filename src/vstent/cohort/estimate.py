"""Estimate of the run time and memory of a cohort, before it starts."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from vstent.cohort.cases import Case
from vstent.io.files import is_surface_file, suffix

START_CPU_S: Final = 3.0
"""CPU time to start a process and load the compiled kernels."""
START_MB: Final = 220.0
"""Memory of a process before it has read an input."""
STL_BYTES: Final = 50
"""Bytes of one triangle in a binary STL file; other formats need about as much."""
CPU_S_PER_1000_TRIANGLES: Final = 0.25
"""CPU time of repair, trace and restore. Measured: 10 s for the 38,000 triangles of AneuriskWeb C0038, 2.5 s for the
25,000 of the demo."""
MB_PER_1000_TRIANGLES: Final = 5.0
"""Memory of these stages; measured: 400 MB in all for the demo."""
CPU_S_PER_MILLION_VOXELS: Final = 0.5
"""CPU time of reading and segmenting a scan."""
MB_PER_MILLION_VOXELS: Final = 40.0
"""Memory of several copies of a scan as 32-bit numbers."""
SCAN_TRIANGLES: Final = 60_000
"""Typical number of triangles of a vessel segmented from a scan."""
CPU_S_PER_DEVICE: Final = 1.0
"""CPU time to deploy and measure a device and to make its wires solid."""
FLOW_CELLS: Final = 200_000
"""Typical number of cells of a trimmed vessel at the grid spacing `COMMON_CELL_MM`."""
CPU_S_PER_1000_CELLS: Final = 0.6
"""CPU time of a steady flow; measured: about 130 s for each flow of the demo."""
MB_PER_1000_CELLS: Final = 1.0
"""Memory of a flow computation."""
COMMON_CELL_MM: Final = 0.17
"""Typical grid spacing."""


@dataclass(frozen=True)
class Estimate:
    """Estimated run time and memory, correct within a factor of two on a machine of 2020."""

    cpu_s: float
    """CPU time of all cases together."""
    memory_MB: float
    """Memory of the largest case."""
    jobs: int
    """Number of cases at once for which the free memory suffices."""

    @property
    def sentence(self) -> str:
        """The estimate as a phrase."""
        hours = self.cpu_s / self.jobs / 3600
        time = f"{hours:.1f} h" if hours >= 1 else f"{max(1, round(60 * hours))} min"
        return f"run time about {time} with {self.jobs} at once, memory up to {self.memory_MB:.0f} MB each"


def estimate(cases: Sequence[Case], jobs: int) -> Estimate:
    """Estimate run time and memory of cases from the sizes of their files.

    Parameters
    ----------
    cases : the cases to run.
    jobs : requested number of cases at once.
    """
    costs = [_cost(case) for case in cases]
    memory_MB = max((memory for _, memory in costs), default=START_MB)
    free_MB = _free_memory_MB()
    bearable = jobs if free_MB is None else max(1, int(free_MB / memory_MB))
    return Estimate(sum(cpu for cpu, _ in costs), memory_MB, min(jobs, bearable))


def _cost(case: Case) -> tuple[float, float]:
    """Return the CPU time, s, and the memory, MB, of one case."""
    n_bytes = _bytes(case)
    is_surface = is_surface_file(case.path)
    voxels = 0.0 if is_surface else n_bytes * (4 if suffix(case.path).endswith(".gz") else 1) / 2
    triangles = n_bytes / STL_BYTES if is_surface else SCAN_TRIANGLES
    n_devices = len(case.settings.devices)
    cpu_s = START_CPU_S + CPU_S_PER_1000_TRIANGLES * triangles / 1e3 + CPU_S_PER_MILLION_VOXELS * voxels / 1e6
    memory = START_MB + MB_PER_1000_TRIANGLES * triangles / 1e3 + MB_PER_MILLION_VOXELS * voxels / 1e6
    cpu_s += CPU_S_PER_DEVICE * n_devices
    if case.settings.flow is not None:
        finer = COMMON_CELL_MM / (case.settings.flow.cell_size_mm or COMMON_CELL_MM)
        cells = FLOW_CELLS * finer**3
        cpu_s += (1 + n_devices) * CPU_S_PER_1000_CELLS * finer * cells / 1e3
        memory += MB_PER_1000_CELLS * cells / 1e3
    return cpu_s, memory


def _bytes(case: Case) -> int:
    """Return the size of the input of a case."""
    files = case.path.rglob("*") if case.path.is_dir() else [case.path]
    return sum(file.stat().st_size for file in files if file.is_file())


def _free_memory_MB() -> float | None:
    """Return the free memory, MB; None where the system does not report it."""
    try:
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e6
    except (AttributeError, ValueError, OSError):
        return None
