"""Measure the work of the processor beside a GPU, for a flow with Silk. No GPU is needed.

Usage: python benchmarks/beside_gpu.py [SURFACE] [SPACING_MM]

SURFACE is an artery with an aneurysm, in mm; without it the demo is used. The grid spacing is 0.1 mm unless given.
"""

import sys
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

import vstent
from flow import anatomy_of
from vstent.flow.case import FlowField
from vstent.flow.engines import Outcome
from vstent.flow.grade import grade
from vstent.flow.indices import indices
from vstent.flow.lattice import gpu_tables, settling, stepping
from vstent.flow.lattice.engine import LatticeBoltzmann
from vstent.flow.lattice.reading import field_of, read
from vstent.flow.lattice.state import State
from vstent.flow.problem import flow_case
from vstent.flow.settings import FlowSettings, Numerics
from vstent.geometry.vessel import Anatomy
from vstent.study.outputs import write_field
from vstent.study.store import Key, Store

Result = TypeVar("Result")
COARSE_MM = 0.3
"""Grid spacing of a first round that is not printed."""


def timed(name: str, work: Callable[[], Result]) -> Result:
    """Print the time of work as a row of a table; return its result."""
    began = time.perf_counter()
    result = work()
    print(f"| {name} | {time.perf_counter() - began:.2f} |", flush=True)
    return result


def evaluate(engine: LatticeBoltzmann, state: State) -> None:
    """Do what a check takes after it has been read."""
    state.history.append(stepping.monitored(state, [state.snapshots[-1]]))
    state.blocks = settling.with_check(state.blocks, state.snapshots[-1])
    engine.terminate(state)


def result_of(state: State) -> FlowField:
    flow = read(state, [state.snapshots[-1]])
    return field_of(state, flow, Outcome(False, (1.0,), 1.0, 1.0), 0.1, "")


def table(anatomy: Anatomy, spacing_mm: float) -> None:
    settings, engine = FlowSettings(numerics=Numerics(cell_size_mm=spacing_mm)), LatticeBoltzmann(spacing_mm)
    stent = vstent.deploy(vstent.find_design("silk"), anatomy).stent
    bare = flow_case(anatomy, (), settings)
    print("| work of the processor | s |\n|---|---|")
    timed("grid and distances from the wall", lambda: engine.prepare(bare))
    before = engine.init(bare, None)
    timed("tables of the GPU, first flow", lambda: gpu_tables.tables_of(before))
    stepping.advance(before, 2)
    before.snapshots.append(stepping.snapshot(before))
    before.loop_seconds = 1.0
    start = result_of(before)
    case = timed("screen of Silk", lambda: flow_case(anatomy, (stent,), settings))
    state = timed("links, screen on the grid, monitored places, initial flow", lambda: engine.init(case, start))
    timed("tables of the GPU, later flow", lambda: gpu_tables.tables_of(state))
    state.loop_seconds = 1.0
    for _ in range(2 * settling.CHECKS_APART):
        state.snapshots.append(stepping.snapshot(state))
        evaluate(engine, state)
    state.snapshots.append(stepping.snapshot(state))
    timed("evaluation of a check", lambda: evaluate(engine, state))
    field = timed("wall shear stress and result", lambda: result_of(state))
    with TemporaryDirectory() as folder:
        store = Store(Path(folder))
        timed("storing a flow", lambda: store.save("flow silk", Key("0", "0"), field))
        timed("writing a flow", lambda: write_field(Path(folder), field))
    timed("indices and grade", lambda: grade(case, field, indices(field, case.sac, case.ostium)))


def main(words: list[str]) -> None:
    surfaces = [Path(word) for word in words if not word.replace(".", "").isdigit()]
    numbers = [float(word) for word in words if word.replace(".", "").isdigit()]
    anatomy = anatomy_of(surfaces[0] if surfaces else None)
    with redirect_stdout(None):  # compiles and imports
        table(anatomy, COARSE_MM)
    table(anatomy, numbers[0] if numbers else 0.1)


if __name__ == "__main__":
    main(sys.argv[1:])
