"""Estimate: the time and memory that a cohort will take, told before it begins."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from vstent.cohort.cases import Case
from vstent.io.files import is_surface_file, suffix

START_CPU_S: Final = 3.0
"""A process starts and loads its compiled kernels."""
START_MB: Final = 220.0
"""What a process holds before it has read anything."""
STL_BYTES: Final = 50
"""Of one triangle in a binary file; other surface files hold about as much a triangle."""
CPU_S_PER_1000_TRIANGLES: Final = 0.25
"""Repair, trace, restore: 38,000 triangles of AneuriskWeb's C0038 take 10 s, 25,000 of the demo's 2.5 s."""
MB_PER_1000_TRIANGLES: Final = 5.0
"""Beside them: 400 MB in all for the demo."""
CPU_S_PER_MILLION_VOXELS: Final = 0.5
"""Reading and segmenting, before the surface is worked on."""
MB_PER_MILLION_VOXELS: Final = 40.0
"""Several copies of a scan, as 32-bit numbers."""
SCAN_TRIANGLES: Final = 60_000
"""Of a vessel tree out of a scan."""
CPU_S_PER_DEVICE: Final = 1.0
"""Deployed, measured, its wires made solid."""
FLOW_CELLS: Final = 200_000
"""Measured on a trimmed vessel with a grid spacing of 0.17 mm."""
CPU_S_PER_1000_CELLS: Final = 0.6
"""Steady, from rest: the demo's flows take about 130 s of CPU each."""
MB_PER_1000_CELLS: Final = 1.0
"""Of a flow at work."""
COMMON_CELL_MM: Final = 0.17


@dataclass(frozen=True)
class Estimate:
    """What is foreseen, roughly: within a factor of two on a machine of 2020's."""

    cpu_s: float
    """Time of one core for all cases."""
    memory_MB: float
    """Largest memory of one case."""
    jobs: int
    """Cases at once that the memory left on this machine bears."""

    @property
    def sentence(self) -> str:
        """The estimate in words."""
        hours = self.cpu_s / self.jobs / 3600
        time = f"{hours:.1f} h" if hours >= 1 else f"{max(1, round(60 * hours))} min"
        return f"about {time} with {self.jobs} parallel processes, up to {self.memory_MB:.0f} MB each"


def estimate(cases: Sequence[Case], jobs: int) -> Estimate:
    """Foresee time and memory of the cases left to do from the sizes of their files."""
    costs = [_cost(case) for case in cases]
    memory_MB = max((memory for _, memory in costs), default=START_MB)
    free_MB = _free_memory_MB()
    bearable = jobs if free_MB is None else max(1, int(free_MB / memory_MB))
    return Estimate(sum(cpu for cpu, _ in costs), memory_MB, min(jobs, bearable))


def _cost(case: Case) -> tuple[float, float]:
    """CPU seconds and MB of one case."""
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
    files = case.path.rglob("*") if case.path.is_dir() else [case.path]
    return sum(file.stat().st_size for file in files if file.is_file())


def _free_memory_MB() -> float | None:
    """Memory that new processes may take; None where the system does not say."""
    try:
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e6
    except (AttributeError, ValueError, OSError):
        return None
