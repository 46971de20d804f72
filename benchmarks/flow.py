"""Print how fast the lattice-Boltzmann kernel is beside the memory's bandwidth, and how exact Poiseuille's flow.

Usage: python benchmarks/flow.py [CELL_MM ...]
"""

import sys
import time

import numba
import numpy as np

from vstent import phantoms
from vstent.flow import FlowCase, FlowField, FlowSettings, simulate_case
from vstent.flow.engines.lattice_boltzmann import LatticeBoltzmann
from vstent.flow.engines.lattice_state import advance
from vstent.trace import trace
from vstent.vessel import Vessel

RADIUS_MM, INFLOW_ML_S, VISCOSITY_PA_S = 2.0, 0.5, 0.004
STEPS = 20
BYTES_PER_UPDATE = 19 * 4 * 2
"""Read and write every population once, in place; addresses are one per segment."""


def tube(length_mm: float) -> Vessel:
    return trace(Vessel(phantoms.phantom_surface(phantoms.tube(length_mm=length_mm, radius_mm=RADIUS_MM))))


@numba.njit(parallel=True, fastmath=True)
def scale(values: np.ndarray) -> None:
    for i in numba.prange(values.size):
        values[i] *= np.float32(1.0001)


def bandwidth_GB_s(n_bytes: int) -> float:
    """Bytes read and written in place per second over an array of this size, the best of eight."""
    values = np.ones(n_bytes // 4, dtype=np.float32)
    scale(values)
    times = []
    for _ in range(8):
        began = time.perf_counter()
        scale(values)
        times.append(time.perf_counter() - began)
    return 2 * values.nbytes / min(times) / 1e9


def throughput(vessel: Vessel, cell_mm: float) -> None:
    case = FlowCase(vessel, settings=FlowSettings(inflow_mL_s=INFLOW_ML_S))
    state = LatticeBoltzmann(cell_mm).init(case, None)
    advance(state, STEPS)
    times = []
    for _ in range(5):
        began = time.perf_counter()
        advance(state, STEPS)
        times.append(time.perf_counter() - began)
    rate = len(state.domain.cells) * STEPS / min(times)
    limit = bandwidth_GB_s(state.populations.nbytes) * 1e9 / BYTES_PER_UPDATE
    print(
        f"| {len(state.domain.cells)} | {state.populations.nbytes / 1e6:.0f} | {rate / 1e6:.0f} | {limit / 1e6:.0f} "
        f"| {100 * rate / limit:.0f} % |"
    )


def errors(field: FlowField, length_mm: float) -> tuple[float, float, float]:
    """Relative errors of velocity (rms over the peak), pressure gradient and mean wall shear stress."""
    mean_m_s = INFLOW_ML_S / (np.pi * RADIUS_MM**2)
    x, y, z = field.centers_mm.T
    sign = np.sign(field.velocity_m_s[:, 2].mean())
    middle = (z > 0.4 * length_mm) & (z < 0.8 * length_mm)
    exact = 2 * mean_m_s * (1 - (x**2 + y**2) / RADIUS_MM**2)
    velocity = (sign * field.velocity_m_s[:, 2] - exact)[middle] / (2 * mean_m_s)
    gradient = -sign * np.polyfit(z[middle] * 1e-3, field.pressure_Pa[middle], 1)[0]
    along = field.wall.vertices_mm[:, 2]
    stress = sign * field.wall_shear_stress_Pa[(along > 0.4 * length_mm) & (along < 0.8 * length_mm), 2]
    radius_m = RADIUS_MM * 1e-3
    return (
        float(np.sqrt((velocity**2).mean())),
        float(gradient / (8 * VISCOSITY_PA_S * mean_m_s / radius_m**2)) - 1,
        float(stress.mean() / (4 * VISCOSITY_PA_S * mean_m_s / radius_m)) - 1,
    )


def poiseuille(cell_mm: float, length_mm: float = 12.0) -> None:
    settings = FlowSettings(inflow_mL_s=INFLOW_ML_S, cell_size_mm=cell_mm, tolerance=1e-3)
    field = simulate_case(FlowCase(tube(length_mm), settings=settings))
    velocity, pressure, stress = errors(field, length_mm)
    print(
        f"| {2 * RADIUS_MM / cell_mm:.0f} | {100 * velocity:.2f} % | {100 * pressure:+.2f} % | {100 * stress:+.2f} % "
        f"| {100 * (field.outlets_mL_s.sum() / field.inlet_mL_s - 1):+.4f} % | {field.seconds:.0f} |"
    )


if __name__ == "__main__":
    cells_mm = [float(size) for size in sys.argv[1:]] or [0.4, 0.2]
    print(f"{numba.get_num_threads()} threads\n")
    print("| cells | populations MB | million updates/s | at full bandwidth | reached |\n|---|---|---|---|---|")
    for cell_mm in (0.2, 0.12):
        throughput(tube(30.0), cell_mm)
    print("\n| cells a diameter | velocity | pressure gradient | WSS | mass | seconds |\n|---|---|---|---|---|---|")
    for cell_mm in cells_mm:
        poiseuille(cell_mm)
