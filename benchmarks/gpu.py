"""Measure the flow on a GPU and compare it with the goals; less than five minutes on an NVIDIA H100.

Usage: python benchmarks/gpu.py [SURFACE]

SURFACE is an artery with an aneurysm, in mm; without it the demo is used. Every goal holds for AneuriskWeb C0038. The
script prints, for a Silk at grid spacings of 0.4, 0.2 and 0.1 mm, the time of every kernel on the GPU (between events)
and on the host, the rate of cell updates, its share of the memory's bandwidth, and the memory; then the run time of
whole flows; then the agreement of the demo with the processor and of two runs with each other; and at last one line for
every goal. A part that fails is reported, and the others go on. No flow continues after 285 s.

With ``--tiny`` every part runs on a short tube, also on numba's simulator (``NUMBA_ENABLE_CUDASIM=1``); its
figures have no meaning.
"""

import argparse
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TypeVar

import numba
import numpy as np
from numba import cuda

import vstent
from vstent import phantoms
from vstent.anatomy.repair import repair
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.errors import FlowError
from vstent.flow import domain
from vstent.flow.case import FlowCase, FlowField
from vstent.flow.engines import Progress
from vstent.flow.indices import indices
from vstent.flow.lattice.engine import LatticeBoltzmann
from vstent.flow.lattice.gpu import gpu_name, require_gpu
from vstent.flow.lattice.recording import Pairs
from vstent.flow.lattice.state import DEFER_PAIRS, State
from vstent.flow.lattice.stepping import advance, snapshot
from vstent.flow.problem import flow_case, vessel_case
from vstent.flow.settings import FlowSettings, Numerics
from vstent.flow.simulation import simulate_case
from vstent.flow.waveform import OLDER_ADULT_ICA
from vstent.geometry.vessel import Anatomy, Vessel
from vstent.io.surfaces import read_surface

BYTES_PER_UPDATE = 19 * 4 * 2
"""Read and write every population once, in place."""
RATE_GOALS = {0.1: 10.0, 0.2: 6.0, 0.4: 1.5}
"""Billion cell updates per second at each grid spacing in mm (NVIDIA H100, C0038 with Silk)."""
STEADY_GOAL_S, CYCLES_GOAL_S, AGREEMENT_GOAL = 45.0, 75.0, 1e-3
"""Run time of three steady flows and of two cycles at 0.1 mm; relative difference from the processor."""
BEGAN, LIMIT_S = time.perf_counter(), 285.0
"""Start of the script, and the time after which no flow continues."""
NAN = float("nan")
Part = TypeVar("Part")
PATIENCE = 1.5
"""A whole flow is stopped when it has taken this many times its goal."""
WHOLE = FlowSettings(numerics=Numerics(cell_size_mm=0.1))
"""Settings of whole flows."""


class StoppedError(Exception):
    """A flow took too long; the message says how far it came."""


@dataclass(frozen=True)
class Extent:
    """How much is measured."""

    spacings_mm: tuple[float, ...] = (0.4, 0.2, 0.1)
    rounds: int = 20
    """Number of times that the kernels of `pairs` are timed."""
    pairs: Pairs = Pairs.ROUND
    """Pairs of steps whose kernels are timed."""
    updates: float = 2e9
    """Cell updates of one measurement of the rate."""
    repeats: int = 5
    """Measurements of the rate and of the bandwidth, of which the fastest counts."""
    bandwidth_bytes: int = 1 << 28
    settings: FlowSettings = WHOLE
    """Settings of whole flows."""


@dataclass
class Found:
    """What was measured for the goals; nan or None where a part failed."""

    rates: dict[float, float] = field(default_factory=dict)
    """Billion cell updates per second at each grid spacing in mm."""
    steady_s: float = NAN
    cycles_s: float = NAN
    difference: float = NAN
    same: bool | None = None


TINY = Extent(
    (0.4,),
    1,
    Pairs.LAST,
    1.0,
    1,
    1 << 7,
    FlowSettings(inflow_mL_s=0.3, numerics=Numerics(cell_size_mm=0.4, max_steps=4)),
)


def is_simulated() -> bool:
    return bool(numba.config.ENABLE_CUDASIM)


class Clock:
    """Events of the GPU on a stream; the host's clock where the GPU is simulated."""

    def __init__(self, stream: object) -> None:
        self.stream = stream

    def now(self) -> object:
        if is_simulated():
            return time.perf_counter()
        event = cuda.event()
        event.record(self.stream)
        return event

    def between_us(self, begin: object, end: object) -> float:
        if is_simulated():
            return 1e6 * (end - begin)
        return 1e3 * cuda.event_elapsed_time(begin, end)


@cuda.jit
def scale(source: np.ndarray, target: np.ndarray) -> None:
    i = cuda.grid(1)
    if i < source.size:
        target[i] = source[i] * np.float32(1.0001)


def bandwidth_GB_s(extent: Extent, *, in_place: bool) -> float:
    """Bytes read and written per second on the GPU, in place or from one array to another; the best of several."""
    n_bytes = extent.bandwidth_bytes
    source = cuda.to_device(np.ones(n_bytes // 4, dtype=np.float32))
    target = source if in_place else cuda.to_device(np.ones(n_bytes // 4, dtype=np.float32))
    times = []
    for _ in range(1 + extent.repeats):  # the first compiles
        began = time.perf_counter()
        scale[-(-source.size // 256), 256](source, target)
        cuda.synchronize()
        times.append(time.perf_counter() - began)
    return 2 * n_bytes / min(times) / 1e9


def state_of(case: FlowCase, spacing_mm: float, *, on_gpu: bool) -> State:
    numerics = replace(case.numerics, device_gpu=on_gpu, cell_size_mm=spacing_mm)
    return LatticeBoltzmann(spacing_mm).init(replace(case, numerics=numerics), None)


def kernel_times(state: State, rounds: int, pairs: Pairs) -> dict[str, tuple[int, float, float]]:
    """Launches per round, and mean times in us on the GPU and on the host, of every kernel, launched one by one."""
    device = state.device
    launches = [one for _ in range(rounds) for one in device.launches(pairs, 0) if one[0].threads]
    clock, found = Clock(device.stream), {}
    device.stream.synchronize()
    for launch, further in launches:
        begin, began = clock.now(), time.perf_counter()
        launch(device.stream, *further)
        host_s = time.perf_counter() - began
        found.setdefault(launch.kernel.__name__, []).append((begin, clock.now(), host_s))
    device.stream.synchronize()
    return {
        name: (
            len(marks) // rounds,
            float(np.mean([clock.between_us(begin, end) for begin, end, _ in marks])),
            1e6 * float(np.mean([host_s for *_, host_s in marks])),
        )
        for name, marks in found.items()
    }


def rate(state: State, extent: Extent) -> float:
    """Cell updates per second of the time steps as a run makes them, the best of several."""
    cells = len(state.domain.cells)
    steps, times = 2 * max(1, round(extent.updates / cells / 2)), []
    for _ in range(extent.repeats):
        began = time.perf_counter()
        advance(state, steps)
        times.append(time.perf_counter() - began)
    return cells * steps / min(times)


def spacing_table(case: FlowCase, spacing_mm: float, extent: Extent, in_place_GB_s: float) -> float:
    """Print what a grid takes; return billion updates per second."""
    state = state_of(case, spacing_mm, on_gpu=True)
    began = time.perf_counter()
    advance(state, 4)  # compiles, loads and records
    first_s = time.perf_counter() - began
    updates_per_s = rate(state, extent)
    began = time.perf_counter()
    snapshot(state)
    read_s, cells = time.perf_counter() - began, len(state.domain.cells)
    of_run, step_us = state.device, 1e6 * cells / updates_per_s
    share = updates_per_s * BYTES_PER_UPDATE / in_place_GB_s / 1e9
    print(f"\nGrid spacing {spacing_mm} mm: {cells:,} cells, {len(state.links.address):,} links")
    print(f"- on the GPU: {of_run.nbytes / 1e6:.0f} MB, {of_run.nbytes / cells:.0f} bytes per cell")
    print(f"- launched {of_run.how}: {step_us:.1f} us per step, {updates_per_s / 1e9:.3g} billion updates/s")
    print(f"- share of the bandwidth in place: {share:.0%}")
    print(f"- first steps: {first_s:.1f} s; reading back: {1e3 * read_s:.1f} ms\n")
    steps = 2 * DEFER_PAIRS if extent.pairs is Pairs.ROUND else 2
    print(f"| kernel | launches in {steps} steps | GPU us | host us |\n|---|---|---|---|")
    for name, (count, gpu_us, host_us) in kernel_times(state, extent.rounds, extent.pairs).items():
        print(f"| {name} | {count} | {gpu_us:.1f} | {host_us:.1f} |", flush=True)
    return updates_per_s / 1e9


def left_s() -> float:
    """Time left for flows, in s."""
    return float("inf") if is_simulated() else max(0.0, LIMIT_S - (time.perf_counter() - BEGAN))


@contextmanager
def stopped_after(seconds: float) -> Iterator[Callable[[Progress], None]]:
    """Give a progress callback that ends a flow after some seconds."""
    began = time.perf_counter()

    def tell(now: Progress) -> None:
        if time.perf_counter() - began > seconds:
            raise StoppedError(f"stopped after {seconds:.0f} s, {now.fraction:.0%} of the last flow done")

    yield tell


def timed(name: str, goal_s: float, compute: Callable[[Callable[[Progress], None]], tuple[FlowField, ...]]) -> float:
    """Print and return the run time of whole flows; infinity when they were stopped."""
    began = time.perf_counter()
    try:
        with stopped_after(min(PATIENCE * goal_s, left_s())) as tell:
            fields = compute(tell)
    except StoppedError as stopped:
        print(f"| {name} | {stopped} | | |", flush=True)
        return float("inf")
    seconds = time.perf_counter() - began
    steps, loops = sum(one.steps for one in fields), [one.updates_per_s / 1e9 for one in fields]
    print(f"| {name} | {seconds:.1f} s | {steps:,} | {', '.join(f'{loop:.2f}' for loop in loops)} |", flush=True)
    return seconds


def steady_flows(cases: list[FlowCase], settings: FlowSettings) -> float:
    """Print and return the run time of steady flows, set-up included."""
    on_gpu = replace(settings.numerics, device_gpu=True)
    print("\n| whole flows | run time | steps on the finest grid | billion updates/s |\n|---|---|---|---|")

    def steady(tell: Callable[[Progress], None]) -> tuple[FlowField, ...]:
        fields: list[FlowField] = []
        for case in cases:
            start = fields[0] if fields else None
            fields.append(simulate_case(replace(case, numerics=on_gpu), start=start, progress=tell))
        return tuple(fields)

    return timed(f"{len(cases)} steady flows", STEADY_GOAL_S, steady)


def two_cycles(case: FlowCase, settings: FlowSettings) -> float:
    """Print and return the run time of two cycles, set-up included."""
    numerics = replace(settings.numerics, device_gpu=True, max_cycles=2)
    pulse = replace(case, waveform=OLDER_ADULT_ICA, numerics=numerics)
    return timed("two cycles, bare", CYCLES_GOAL_S, lambda tell: (simulate_case(pulse, progress=tell),))


def on_levels(cases: list[FlowCase], numerics: Numerics) -> None:
    """Print the run times of flows on nested levels: with the sac refined, and with wires of the last case as walls."""
    for name, case, changes in (
        ("sac refined", cases[1], {"refine": ("sac",)}),
        ("walls", cases[-1], {"wires": "resolved"}),
    ):
        one = replace(case, numerics=replace(numerics, **changes))
        timed(name, STEADY_GOAL_S, lambda tell, one=one: (simulate_case(one, progress=tell),))


def measures(field: FlowField, case: FlowCase) -> np.ndarray:
    """Neck inflow, sac velocity and wall shear stress of the sac; of a vessel without a sac, means over the vessel."""
    if case.sac is None:
        return np.array(
            [np.linalg.norm(values, axis=1).mean() for values in (field.velocity_m_s, field.wall_shear_stress_Pa)]
        )
    found = indices(field, case.sac, case.ostium)
    return np.array([found[name] for name in ("neck_inflow_mL_s", "mean_sac_velocity_m_s", "mean_sac_wss_Pa")])


def agreement(case: FlowCase, settings: FlowSettings) -> tuple[float, bool]:
    """Print and return the largest relative difference from the processor, and whether two runs have the same bits."""
    with stopped_after(left_s()) as tell:
        gpu, again, here = (
            simulate_case(replace(case, numerics=replace(settings.numerics, device_gpu=on_gpu)), progress=tell)
            for on_gpu in (True, True, False)
        )
    wanted, found = measures(here, case), measures(gpu, case)
    spacing_mm = settings.numerics.cell_size_mm
    same = all(
        getattr(gpu, name).tobytes() == getattr(again, name).tobytes()
        for name in ("velocity_m_s", "pressure_Pa", "wall_shear_stress_Pa", "residual")
    )
    difference = float(np.abs(found / wanted - 1).max())
    print(f"\nAgreement at {spacing_mm} mm (inflow, velocity, stress): processor {wanted}, GPU {found}")
    print(
        f"Largest difference {difference:.1e}; two runs on the GPU: {'same' if same else 'different'} bits", flush=True
    )
    return difference, same


def goals(found: Found) -> None:
    """Print a line for every goal."""
    print("\n| goal (NVIDIA H100, C0038) | wanted | measured | reached |\n|---|---|---|---|")
    for spacing_mm, goal in RATE_GOALS.items():
        rate = found.rates.get(spacing_mm, NAN)
        line(f"Silk, {spacing_mm} mm, billion updates/s", f"{goal:g}", f"{rate:.3g}", reached=rate >= goal)
    for name, goal, seconds in (
        ("bare, Silk, Enterprise, steady, 0.1 mm, s", STEADY_GOAL_S, found.steady_s),
        ("two cycles, bare, 0.1 mm, s", CYCLES_GOAL_S, found.cycles_s),
    ):
        line(name, f"{goal:g}", f"{seconds:.1f}", reached=seconds <= goal)
    agrees = found.difference <= AGREEMENT_GOAL
    line("demo with Silk against the processor", f"{AGREEMENT_GOAL:g}", f"{found.difference:.1e}", reached=agrees)
    bits = "nan" if found.same is None else "same" if found.same else "different"
    line("two runs, bit for bit", "same", bits, reached=bool(found.same))


def line(goal: str, wanted: str, measured: str, *, reached: bool) -> None:
    said = "not measured" if measured == "nan" else "yes" if reached else "no"
    print(f"| {goal} | {wanted} | {measured} | {said} |")


def anatomy_of(surface: Path | None) -> Anatomy:
    if surface is None:
        return restore(trim(trace(Vessel(phantoms.phantom_surface(phantoms.demo_phantom(), edge_mm=0.2)))))
    lumen, _ = repair(read_surface(surface)[0])
    return restore(trim(trace(Vessel(lumen))))


def cases_of(anatomy: Anatomy, settings: FlowSettings) -> list[FlowCase]:
    """The flow bare, with Silk and with Enterprise."""
    stents = [(vstent.deploy(vstent.find_design(name), anatomy).stent,) for name in ("silk", "enterprise")]
    return [flow_case(anatomy, implants, settings) for implants in ((), *stents)]


def tiny_cases(settings: FlowSettings) -> list[FlowCase]:
    domain.MIN_CELLS = 30  # the simulator is slow
    sys.setswitchinterval(5e-4)  # its threads wait for each other
    tube = phantoms.phantom_surface(phantoms.tube(length_mm=0.8, radius_mm=0.6))
    return [vessel_case(trace(Vessel(tube)), settings)]


def about() -> str:
    """Versions of what takes part."""
    names = []
    for package in ("numba", "numba-cuda", "cuda-core", "cuda-bindings", "numpy"):
        try:
            names.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            names.append(f"no {package}")
    return ", ".join(names)


def main(words: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("surface", nargs="?", type=Path)
    parser.add_argument("--tiny", action="store_true")
    asked = parser.parse_args(words)
    try:
        require_gpu()
    except FlowError as error:
        print(f"Not measured: {error}.")
        return 0
    began = time.perf_counter()
    print(f"{gpu_name()}; {about()}")
    goals(measured(asked.surface, TINY if asked.tiny else Extent()))
    print(f"\nMeasured in {time.perf_counter() - began:.0f} s.")
    return 0


def part(name: str, compute: Callable[[], Part], otherwise: Part) -> Part:
    """The result of a part; if it fails, this is printed and the others go on."""
    try:
        return compute()
    except Exception as error:  # noqa: BLE001 each part fails for itself, whatever the reason
        words = next(iter(str(error).splitlines()), "")
        print(f"\nFailed: {name}: {type(error).__name__}: {words}", flush=True)
        traceback.print_exc()
        return otherwise


def bandwidths(extent: Extent) -> float:
    """Print the bandwidths; return the one in place, in GB/s."""
    in_place, copy = (bandwidth_GB_s(extent, in_place=in_place) for in_place in (True, False))
    print(f"Bandwidth in place {in_place:.3g} GB/s, copying {copy:.3g} GB/s")
    return in_place


def measured(surface: Path | None, extent: Extent) -> Found:
    """Measure and print every part."""
    is_tiny, settings, found = extent is TINY, extent.settings, Found()
    in_place = part("bandwidth", lambda: bandwidths(extent), NAN)
    cases = part(
        "artery and devices", lambda: tiny_cases(settings) if is_tiny else cases_of(anatomy_of(surface), settings), []
    )
    if not cases:
        return found
    with_silk = cases[min(1, len(cases) - 1)]
    for mm in extent.spacings_mm:
        of_spacing = partial(spacing_table, with_silk, mm, extent, in_place)
        found.rates[mm] = part(f"kernels at {mm} mm", of_spacing, NAN)
    steady_s = part("steady flows", lambda: steady_flows(cases, settings), NAN)
    if is_tiny:  # its rates and times are not those of the goals
        found.rates.clear()
    else:
        found.steady_s = steady_s
        found.cycles_s = part("two cycles", lambda: two_cycles(cases[0], settings), NAN)
        part("levels", lambda: on_levels(cases, replace(settings.numerics, device_gpu=True)), None)
    found.difference, found.same = part(
        "agreement with the processor",
        lambda: agreement(
            with_silk if is_tiny or surface is None else cases_of(anatomy_of(None), settings)[1], settings
        ),
        (NAN, None),
    )
    return found


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
