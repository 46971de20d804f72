"""Print how fast the lattice-Boltzmann kernel is beside the memory's bandwidth, and how exact Poiseuille's flow.

Usage: python benchmarks/flow.py [--cost] [--pulse] [SURFACE] [CELL_MM ...]

Besides: how a step's time grows with its cells, and what other machines would need (computed). Seconds of the clock
depend on what else the machine does: processor seconds stand beside them. With ``--cost`` the demo is computed, steady,
bare and with Silk and Enterprise as screens, at a grid spacing of 0.1 mm, everywhere and then only in and near the sac
(`Numerics.refine`). With ``--pulse`` it is computed bare for two cycles of a pulse, in both ways. With a surface
file, in mm, that artery is, in the latter way alone.
"""

import resource
import sys
import time
from pathlib import Path

import numba
import numpy as np

import vstent
from vstent import phantoms
from vstent.anatomy.repair import repair
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.flow.case import FlowCase, FlowField
from vstent.flow.engines import Progress
from vstent.flow.indices import indices
from vstent.flow.lattice.engine import LatticeBoltzmann
from vstent.flow.lattice.stepping import advance
from vstent.flow.problem import flow_case, vessel_case
from vstent.flow.settings import FlowSettings, Numerics, Region
from vstent.flow.simulation import simulate, simulate_case
from vstent.flow.waveform import OLDER_ADULT_ICA
from vstent.geometry.vessel import Anatomy, Vessel
from vstent.io.surfaces import read_surface

RADIUS_MM, INFLOW_ML_S, VISCOSITY_PA_S = 2.0, 0.5, 0.004
STEPS = 20
BYTES_PER_UPDATE = 19 * 4 * 2
"""Read and write every population once, in place; addresses are one per segment."""
DEMO_CELLS, STEADY_STEPS, STEPS_PER_CYCLE = 830_000, 6_000, 78_000
"""The demo at a grid spacing of 0.1 mm: blood cells, steps of a bare flow that begins from a coarse one (`--cost`
counts them), steps of a cycle (`--pulse` counts two)."""
NODE_CORES, NODE_GB_S = 64, 300.0
"""A node, and its memory's bandwidth (two sockets of eight channels, three quarters of 400 GB/s)."""
GPU_GB_S, GPU_SHARE = 1555.0, 0.6
"""Bandwidth of an A100 (its maker's data sheet), and the share of it that sparse lattices reach."""


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


def throughput(vessel: Vessel, cell_mm: float) -> tuple[int, float, float]:
    """Print a row; return cells, updates per second of the clock, and updates per second of one core.

    The share of the bandwidth goes by processor seconds: the bandwidth is measured in bursts that nothing interrupts.
    """
    began = time.process_time()
    case = vessel_case(vessel, FlowSettings(inflow_mL_s=INFLOW_ML_S))
    state = LatticeBoltzmann(cell_mm).init(case, None)
    setup_s = time.process_time() - began
    advance(state, STEPS)
    clock_s, core_s = [], []
    for _ in range(5):
        began, began_core = time.perf_counter(), time.process_time()
        advance(state, STEPS)
        clock_s.append(time.perf_counter() - began)
        core_s.append(time.process_time() - began_core)
    cells = len(state.domain.cells)
    rate, of_core = cells * STEPS / min(clock_s), cells * STEPS / min(core_s)
    limit = bandwidth_GB_s(state.populations.nbytes) * 1e9 / BYTES_PER_UPDATE
    print(
        f"| {cells} | {setup_s:.1f} | {state.populations.nbytes / 1e6:.0f} | {rate / 1e6:.0f} | {of_core / 1e6:.0f} "
        f"| {limit / 1e6:.0f} | {100 * of_core * numba.get_num_threads() / limit:.0f} % |"
    )
    return cells, rate, of_core


def elsewhere(of_core: float) -> None:
    """Print the run time of the demo at 0.1 mm on other machines: computed, not measured."""
    limits = {
        f"{NODE_CORES} cores": min(NODE_CORES * of_core, NODE_GB_S * 1e9 / BYTES_PER_UPDATE),
        "one GPU": GPU_SHARE * GPU_GB_S * 1e9 / BYTES_PER_UPDATE,
    }
    print(
        f"\nComputed, not measured: a node of {NODE_CORES} cores like this one, {NODE_GB_S:.0f} GB/s together; a GPU "
        f"of {GPU_GB_S:.0f} GB/s at {GPU_SHARE:.0%} of that (`benchmarks/gpu.py` measures it where there is one).\n"
    )
    print("| machine | million updates/s | demo, 0.1 mm, bare, steady | two cycles |\n|---|---|---|---|")
    for name, rate in limits.items():
        steady, cycles = (DEMO_CELLS * steps / rate for steps in (STEADY_STEPS, 2 * STEPS_PER_CYCLE))
        print(f"| {name} | {rate / 1e6:.0f} | {steady:.0f} s | {cycles / 60:.1f} min |")


def anatomy_of(surface: Path | None) -> Anatomy:
    if surface is None:
        return restore(trim(trace(Vessel(phantoms.phantom_surface(phantoms.demo_phantom(), edge_mm=0.2)))))
    lumen, _ = repair(read_surface(surface)[0])
    return restore(trim(trace(Vessel(lumen))))


def cost(surface: Path | None, *, refine: tuple[Region, ...]) -> None:
    """Print what an artery takes, steady, bare and with both devices."""
    anatomy = anatomy_of(surface)
    deployments = [None, *(vstent.deploy(name, anatomy) for name in ("silk", "enterprise"))]
    settings = FlowSettings(numerics=Numerics(cell_size_mm=0.1, refine=refine))
    began, began_core = time.perf_counter(), time.process_time()
    fields = simulate(anatomy, deployments, settings, progress=tell)
    clock_s, core_s = time.perf_counter() - began, time.process_time() - began_core
    print(f"\n{named(surface, refine=refine)}:\n")
    case = flow_case(anatomy, (), settings)
    table(case, dict(zip(("bare", "silk", "enterprise"), fields, strict=True)), clock_s, core_s)


def pulse(surface: Path | None, *, refine: tuple[Region, ...]) -> None:
    """Print what two cycles take in an artery."""
    settings = FlowSettings(waveform=OLDER_ADULT_ICA, numerics=Numerics(cell_size_mm=0.1, max_cycles=2, refine=refine))
    case = flow_case(anatomy_of(surface), (), settings)
    began, began_core = time.perf_counter(), time.process_time()
    field = simulate_case(case, progress=tell)
    clock_s, core_s = time.perf_counter() - began, time.process_time() - began_core
    print(f"\n{named(surface, refine=refine)}, two cycles of a pulse:\n")
    table(case, {"bare, mean of the second": field}, clock_s, core_s)
    print(field.advice)


def tell(now: Progress) -> None:
    """Say on the screen how far a flow has come; the tables go elsewhere."""
    print(f"\r{now.fraction:4.0%}, {now.seconds_left / 60:.1f} min left ", end="", file=sys.stderr, flush=True)


def named(surface: Path | None, *, refine: tuple[Region, ...]) -> str:
    """What is computed, in words."""
    name = "demo" if surface is None else surface.stem
    return f"{name}, grid spacing 0.1 mm{' in and near the sac' if refine else ''}"


def table(case: FlowCase, fields: dict[str, FlowField], clock_s: float, core_s: float) -> None:
    print("| flow | cells | steps | settled | million updates/s | neck inflow mL/s | sac velocity mm/s | its WSS Pa |")
    print("|---|---|---|---|---|---|---|---|")
    for flow, field in fields.items():
        found = indices(field, case.sac, case.ostium)
        row = (flow, len(field.centers_mm), field.steps, field.is_converged, round(field.updates_per_s / 1e6))
        values = f"{found['neck_inflow_mL_s']:.4f} | {1e3 * found['mean_sac_velocity_m_s']:.2f}"
        print(f"| {' | '.join(map(str, row))} | {values} | {found['mean_sac_wss_Pa']:.4f} |")
    peak_GB = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
    print(f"\nTogether {clock_s:.0f} s, {core_s:.0f} s of processor, {peak_GB:.1f} GB at most.")


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
    settings = FlowSettings(inflow_mL_s=INFLOW_ML_S, numerics=Numerics(cell_size_mm=cell_mm, tolerance=1e-3))
    field = simulate_case(vessel_case(tube(length_mm), settings))
    velocity, pressure, stress = errors(field, length_mm)
    print(
        f"| {2 * RADIUS_MM / cell_mm:.0f} | {100 * velocity:.2f} % | {100 * pressure:+.2f} % | {100 * stress:+.2f} % "
        f"| {100 * (field.outlets_mL_s.sum() / field.inflow_mL_s - 1):+.4f} % | {field.seconds:.0f} |"
    )


if __name__ == "__main__":
    words = [word for word in sys.argv[1:] if not word.startswith("--") and not Path(word).is_file()]
    surface = next((Path(word) for word in sys.argv[1:] if Path(word).is_file()), None)
    cells_mm = [float(size) for size in words] or [0.4, 0.2]
    print(f"{numba.get_num_threads()} threads\n")
    print("| cells | set-up, core s | populations MB | million updates/s | of one core | at full bandwidth | reached |")
    print("|---|---|---|---|---|---|---|")
    coarse, fine = (throughput(tube(30.0), cell_mm) for cell_mm in (0.2, 0.1))
    times = (fine[0] / fine[1]) / (coarse[0] / coarse[1])
    print(f"\n{fine[0] / coarse[0]:.1f} times the cells take {times:.1f} times as long a step.")
    elsewhere(fine[2])
    print("\n| cells a diameter | velocity | pressure gradient | WSS | mass | seconds |\n|---|---|---|---|---|---|")
    for cell_mm in cells_mm:
        poiseuille(cell_mm)
    for refine in ((), ("sac",)) if surface is None else (("sac",),):
        if "--cost" in sys.argv:
            cost(surface, refine=refine)
        if "--pulse" in sys.argv:
            pulse(surface, refine=refine)
