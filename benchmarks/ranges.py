"""Compare the bands of every device with full deployments, and print what a band costs.

Run from the repository: ``python benchmarks/ranges.py [CASE ...]`` (demo C0038). All numbers of a device lie anywhere
in their ranges in 128 deployments. Every column holds the width of the band over the width of the interval of these
deployments, and the largest distance of an end from the interval's, over the width; "-" where both have no width. The
time is the processor time of the bands, without and with the search of the sizes at their ends, and of the bands of
gaps.
"""

import sys
import time
from pathlib import Path

import numpy as np

from vstent import phantoms
from vstent.anatomy.repair import repair
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.deployment.deploy import deploy, propose_size
from vstent.deployment.measure import measure
from vstent.devices.catalogue import catalogue
from vstent.devices.design import Design
from vstent.devices.ranges import altered, uncertain, values_at
from vstent.devices.stent import Landing
from vstent.errors import VstentError
from vstent.geometry.vessel import Anatomy, Vessel
from vstent.io.surfaces import read_surface
from vstent.plan.bands import Band, bands, gap_bands, interval
from vstent.plan.shares import centered_points

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
CASES = {"demo": "", "C0038": "aneurisk_C0038.vtp"}
SAMPLES = 128
SHOWN = {
    "deployed_length_mm": "length",
    "neck_to_proximal_end_mm": "proximal end",
    "neck_to_distal_end_mm": "distal end",
    "neck_metal_coverage_fraction": "coverage",
    "neck_pore_density_per_mm2": "pores",
    "apposed_fraction": "apposed",
    "max_wall_gap_mm": "largest gap",
}
NARROWEST = 1e-3
"""Width of an interval below which it counts as none."""


def anatomy(case: str) -> Anatomy:
    """Restore the artery of a case."""
    if not CASES[case]:
        return restore(trim(trace(Vessel(phantoms.phantom_surface(phantoms.demo_phantom())))))
    return restore(trim(trace(Vessel(repair(read_surface(DATA / CASES[case])[0])[0]))))


def row(artery: Anatomy, design: Design) -> str:
    """Return the row of one device."""
    size = propose_size(design, artery)
    lies = deploy(design, artery, size=size)
    rows_mm = lies.stent.row_abscissa_mm
    landing = Landing(float(rows_mm[(len(rows_mm) - 1) // 2]))
    measures = measure(artery, lies)
    bands(artery, lies, measures)  # compiles
    began = time.process_time()
    found = bands(artery, lies, measures).results
    alone_s = time.process_time() - began
    bands(artery, lies, measures, is_proposed=True)
    with_sizes_s = time.process_time() - began - alone_s
    began = time.process_time()
    found |= gap_bands(artery, lies, measures)
    gaps_s = time.process_time() - began
    ranges = uncertain(design)
    sampled = []
    for point in centered_points(len(ranges), SAMPLES):
        try:
            other, other_size = altered(design, size, values_at(ranges, point))
            sampled.append(measure(artery, deploy(other, artery, size=other_size, landing=landing)))
        except VstentError:
            continue
    cells = [
        _cell(found.get(key), [float(one[key]) for one in sampled if key in one], float(measures.get(key, np.nan)))
        for key in SHOWN
    ]
    return f"| {design.name} {size.label} | {' | '.join(cells)} | {alone_s:.2f}, {with_sizes_s:.2f}, {gaps_s:.2f} |"


def _cell(band: Band | None, values: list[float], value: float) -> str:
    """Return the ratio of the widths and the largest distance of an end."""
    if band is None or not values:
        return ""
    low, high = interval(np.array(values), value)
    width = high - low
    if width < NARROWEST:
        return "-" if band.high - band.low < NARROWEST else "wider"
    off = max(abs(band.low - low), abs(band.high - high)) / width
    return f"{(band.high - band.low) / width:.2f} ({off:.2f})"


def compared(cases: list[str]) -> None:
    for case in cases:
        artery = anatomy(case)
        print(f"\n{case}\n\n| device and size | {' | '.join(SHOWN.values())} | band, processor s |")
        print(f"|---{'|---' * len(SHOWN)}|---|", flush=True)
        for design in catalogue().values():
            print(row(artery, design), flush=True)


if __name__ == "__main__":
    compared(sys.argv[1:] or list(CASES))
