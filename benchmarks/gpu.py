"""Print how fast the embedded engine steps on a GPU beside its memory's bandwidth, and on this machine's processor.

Usage: python benchmarks/gpu.py [CELL_MM ...]

A tube as in benchmarks/flow.py. Besides: by how much the two velocities differ after the same steps.
"""

import sys
import time
from dataclasses import replace

import numpy as np

from vstent import phantoms
from vstent.anatomy.trace import trace
from vstent.errors import FlowError
from vstent.flow.case import FlowCase, FlowSettings
from vstent.flow.lattice.engine import LatticeBoltzmann
from vstent.flow.lattice.gpu import gpu_name, require_gpu
from vstent.flow.lattice.state import State
from vstent.flow.lattice.stepping import advance
from vstent.geometry.vessel import Vessel

STEPS, ROUNDS = 200, 5
BYTES_PER_UPDATE = 19 * 4 * 2
"""Read and write every population once, in place."""
BANDWIDTH_BYTES = 1 << 28


def bandwidth_GB_s() -> float:
    """Bytes read and written in place per second on the GPU, the best of eight."""
    from numba import cuda

    @cuda.jit
    def scale(values: np.ndarray) -> None:
        i = cuda.grid(1)
        if i < values.size:
            values[i] *= np.float32(1.0001)

    values = cuda.to_device(np.ones(BANDWIDTH_BYTES // 4, dtype=np.float32))
    times = []
    for _ in range(9):  # the first compiles
        began = time.perf_counter()
        scale[-(-values.size // 256), 256](values)
        cuda.synchronize()
        times.append(time.perf_counter() - began)
    return 2 * BANDWIDTH_BYTES / min(times) / 1e9


def state_of(case: FlowCase, cell_mm: float, *, on_gpu: bool) -> State:
    settings = replace(case.settings, device_gpu=on_gpu)
    return LatticeBoltzmann(cell_mm).init(replace(case, settings=settings), None)


def rate(state: State, steps: int) -> float:
    """Updates per second, the best of some rounds, after one that compiles."""
    advance(state, steps)
    times = []
    for _ in range(ROUNDS):
        began = time.perf_counter()
        advance(state, steps)
        times.append(time.perf_counter() - began)
    return len(state.domain.cells) * steps / min(times)


def difference(case: FlowCase, cell_mm: float) -> float:
    """Largest difference of a momentum, over the largest momentum, after the same steps."""
    gpu, here = (state_of(case, cell_mm, on_gpu=on_gpu) for on_gpu in (True, False))
    for state in (gpu, here):
        advance(state, STEPS)
    found, wanted = gpu.device.read()[0], _moments(here)
    return float(np.abs(found - wanted)[:, 1:].max() / np.abs(wanted[:, 1:]).max())


def _moments(state: State) -> np.ndarray:
    from vstent.flow.lattice.kernels import d3q19

    return d3q19.moments(state.populations, state.addressing.stride, state.addressing.place)


def main(cells_mm: list[float]) -> int:
    try:
        require_gpu()
    except FlowError as error:
        print(f"Not measured: {error}.")
        return 0
    vessel = trace(Vessel(phantoms.phantom_surface(phantoms.tube(length_mm=30.0, radius_mm=2.0))))
    case = FlowCase(vessel, settings=FlowSettings(inflow_mL_s=0.5))
    limit = bandwidth_GB_s() * 1e9 / BYTES_PER_UPDATE
    print(f"{gpu_name()}: {limit * BYTES_PER_UPDATE / 1e9:.0f} GB/s, or {limit / 1e6:.0f} million updates/s\n")
    print("| cells | million updates/s on the GPU | of its bandwidth | on the processor | difference |")
    print("|---|---|---|---|---|")
    for cell_mm in cells_mm:
        gpu = state_of(case, cell_mm, on_gpu=True)
        on_gpu, here = rate(gpu, STEPS), rate(state_of(case, cell_mm, on_gpu=False), STEPS // 10)
        print(
            f"| {len(gpu.domain.cells)} | {on_gpu / 1e6:.0f} | {100 * on_gpu / limit:.0f} % | {here / 1e6:.0f} "
            f"| {difference(case, cell_mm):.1e} |"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main([float(word) for word in sys.argv[1:]] or [0.2, 0.1]))
