"""Estimate run time and memory of a cohort before it starts."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from vstent.cohort.cases import Case
from vstent.flow.lattice.calibration import ROUNDS
from vstent.flow.memory import free_memory_bytes
from vstent.io.files import is_surface_file, suffix
from vstent.units import BYTES_PER_MB

START_CPU_S: Final = 3.0
"""CPU time in s to start a process and load its compiled kernels."""
START_MB: Final = 220.0
"""Memory in MB of a process before it reads its input."""
STL_BYTES: Final = 50
"""Bytes per triangle of a binary STL file; other surface files have about as many."""
CPU_S_PER_1000_TRIANGLES: Final = 0.25
"""CPU time in s per 1000 triangles to repair, trace and restore.

38,000 triangles of AneuriskWeb's C0038 take 10 s, 25,000 of the demo's 2.5 s.
"""
MB_PER_1000_TRIANGLES: Final = 5.0
"""Memory in MB per 1000 triangles on top of `START_MB`; the demo uses 400 MB in all."""
CPU_S_PER_MILLION_VOXELS: Final = 0.5
"""CPU time in s per million voxels to read and segment a scan."""
MB_PER_MILLION_VOXELS: Final = 40.0
"""Memory in MB per million voxels: several copies of a scan as 32-bit numbers."""
SCAN_TRIANGLES: Final = 60_000
"""Typical number of triangles of the vessel tree segmented from a scan."""
CPU_S_PER_DEVICE: Final = 1.0
"""CPU time in s to deploy and measure a device and to build the solids of its wires."""
FLOW_CELLS: Final = 200_000
"""Number of grid cells of a flow, measured on a trimmed vessel with a grid spacing of `COMMON_CELL_MM`."""
CPU_S_PER_1000_CELLS: Final = 0.6
"""CPU time in s per 1000 grid cells of a steady flow computed from rest; the demo's flows take about 130 s each."""
MB_PER_1000_CELLS: Final = 1.0
"""Memory in MB per 1000 grid cells during a flow computation."""
COMMON_CELL_MM: Final = 0.17
"""Grid spacing in mm to which `FLOW_CELLS` and `CPU_S_PER_1000_CELLS` refer."""


@dataclass(frozen=True)
class Estimate:
    """Estimated run time and memory, within a factor of two on a machine of the 2020s."""

    cpu_s: float
    """CPU time of all cases, in s."""
    memory_MB: float
    """Memory of the largest case."""
    jobs: int
    """Number of parallel cases for which the free memory of this machine suffices."""

    @property
    def sentence(self) -> str:
        """The estimate as text."""
        hours = self.cpu_s / self.jobs / 3600
        time = f"{hours:.1f} h" if hours >= 1 else f"{max(1, round(60 * hours))} min"
        return f"about {time} with {self.jobs} parallel processes, up to {self.memory_MB:.0f} MB each"


def estimate(cases: Sequence[Case], jobs: int) -> Estimate:
    """Return the estimated run time and memory of cases with parallel processes, from the sizes of their files."""
    costs = [_cost(case) for case in cases]
    memory_MB = max((memory for _, memory in costs), default=START_MB)
    bearable = max(1.0, free_memory_bytes() / BYTES_PER_MB / memory_MB)
    return Estimate(sum(cpu for cpu, _ in costs), memory_MB, int(min(jobs, bearable)))


def _cost(case: Case) -> tuple[float, float]:
    """Return CPU time in s and memory in MB of one case."""
    files = case.path.rglob("*") if case.path.is_dir() else [case.path]
    n_bytes = sum(file.stat().st_size for file in files if file.is_file())
    is_surface = is_surface_file(case.path)
    voxels = 0.0 if is_surface else n_bytes * (4 if suffix(case.path).endswith(".gz") else 1) / 2
    triangles = n_bytes / STL_BYTES if is_surface else SCAN_TRIANGLES
    n_devices = sum(len(one.implants) for one in case.settings.treatments)
    cpu_s = START_CPU_S + CPU_S_PER_1000_TRIANGLES * triangles / 1e3 + CPU_S_PER_MILLION_VOXELS * voxels / 1e6
    memory = START_MB + MB_PER_1000_TRIANGLES * triangles / 1e3 + MB_PER_MILLION_VOXELS * voxels / 1e6
    cpu_s += CPU_S_PER_DEVICE * n_devices
    if case.settings.flow is not None:
        numerics = case.settings.flow.numerics
        finer = COMMON_CELL_MM / (numerics.cell_size_mm or COMMON_CELL_MM)
        cells, rounds = FLOW_CELLS * finer**3, ROUNDS if numerics.wires in ("auto", "calibrated") else 0
        cpu_s += (1 + n_devices * (1 + rounds)) * CPU_S_PER_1000_CELLS * finer * cells / 1e3
        memory += MB_PER_1000_CELLS * cells / 1e3
    return cpu_s, memory
