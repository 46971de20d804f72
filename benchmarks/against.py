"""Compare this checkout with another one: processor seconds of the demo, its rerun, its start, an exchange and a flow.

Usage: python benchmarks/against.py OTHER_CHECKOUT [--repeats N] [--part NAME ...]

Both run in turn on the same machine, each in processes of their own, and the smallest of the repeats counts. Processor
seconds (user and system, of one thread) depend little on what else the machine does. Before the first repeat every part
runs once, so that all kernels are compiled.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

HERE = Path(__file__).parents[1]
EXCHANGE = """
from time import process_time
import vstent
from vstent import phantoms
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.flow.settings import Blood
from vstent.flow.domain import build
from vstent.flow.lattice.screen import on_grid
from vstent.flow.media import media
from vstent.geometry.vessel import Vessel

anatomy = restore(trim(trace(Vessel(phantoms.phantom_surface(phantoms.demo_phantom(), edge_mm=0.2)))))
stent = vstent.deploy(vstent.find_design("{device}"), anatomy).stent
grid = build(anatomy.vessel, 0.17)
for _ in range(2):
    began = process_time()
    made = media(stent, Blood())
    on_grid(made, grid.index, grid.origin_mm, grid.cell_size_mm)
    took = process_time() - began
print("SECONDS", took)
"""
"""Program that prints the processor seconds of the exchange of a device: its screen, and its cells."""
STEPS = """
from time import process_time
from vstent import phantoms
from vstent.anatomy.trace import trace
from vstent.flow.problem import vessel_case
from vstent.flow.settings import FlowSettings
from vstent.flow.lattice.engine import LatticeBoltzmann
from vstent.flow.lattice.stepping import advance
from vstent.geometry.vessel import Vessel

vessel = trace(Vessel(phantoms.phantom_surface(phantoms.tube(length_mm=30.0, radius_mm=2.0))))
state = LatticeBoltzmann(0.1).init(vessel_case(vessel, FlowSettings(inflow_mL_s=0.5)), None)
took = []
for _ in range(6):
    began = process_time()
    advance(state, 100)
    took.append(process_time() - began)
print("SECONDS", min(took))
"""
"""Program that prints the processor seconds of 100 time steps of a tube with 476,520 cells."""
DEMO = "from vstent.cli import main; main()"


def ran(checkout: Path, code: str, *arguments: str) -> tuple[float, str]:
    """Return the processor seconds and the output of a Python program with the sources of a checkout."""
    own = os.environ | {"PYTHONPATH": str(checkout / "src"), "NUMBA_NUM_THREADS": "1"}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], env=own, cwd=checkout, capture_output=True, text=True, check=True
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, done.stdout


def started(checkout: Path, _: Path) -> float:
    """Return the seconds of the imports of a study."""
    return ran(checkout, "import vstent.cli.console, vstent.study.pipeline, vstent.reporting.write, vstent.study.demo")[
        0
    ]


def demo(checkout: Path, folder: Path) -> float:
    """Return the seconds of the demo without flow in an empty folder."""
    with tempfile.TemporaryDirectory(dir=folder) as out:
        return ran(checkout, DEMO, "demo", "--no-flow", "--out", f"{out}/demo")[0]


def rerun(checkout: Path, folder: Path) -> float:
    """Return the seconds of the finished demo, run again."""
    out = folder / checkout.resolve().as_posix().replace("/", "_")
    if not (out / "report.html").exists():
        ran(checkout, DEMO, "demo", "--no-flow", "--out", str(out))
    return ran(checkout, DEMO, "demo", "--no-flow", "--out", str(out))[0]


def exchange(device: str) -> Callable[[Path, Path], float]:
    """Return the measurement of the exchange of a device."""
    code = EXCHANGE.replace("{device}", device)
    return lambda checkout, _: float(ran(checkout, code)[1].split("SECONDS")[1])


def steps(checkout: Path, _: Path) -> float:
    """Return the seconds of 100 time steps of a tube."""
    return float(ran(checkout, STEPS)[1].split("SECONDS")[1])


PARTS = {
    "start (imports of a study)": started,
    "demo --no-flow": demo,
    "the same again": rerun,
    "exchange of Silk in the demo": exchange("silk"),
    "exchange of Enterprise in the demo": exchange("enterprise"),
    "exchange of Pipeline in the demo": exchange("pipeline"),
    "100 time steps of a tube": steps,
}


def main() -> None:
    """Run the comparison and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("other", type=Path)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--part", nargs="*", default=list(PARTS))
    given = parser.parse_args()
    print("| part | other, CPU s | this, CPU s | ratio |\n|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for name, measure in PARTS.items():
            if not any(one in name for one in given.part):
                continue
            both = given.other.resolve(), HERE
            for checkout in both:
                measure(checkout, Path(folder))  # compiles what is not compiled yet
            found = [[measure(checkout, Path(folder)) for checkout in both] for _ in range(given.repeats)]
            other, this = (min(column) for column in zip(*found, strict=True))
            print(f"| {name} | {other:.2f} | {this:.2f} | {this / other:.2f} |", flush=True)


if __name__ == "__main__":
    main()
