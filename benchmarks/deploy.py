"""Deploy Silk and Enterprise in analytic arteries and print what it cost and how near the closed formulas it came.

Run from the repository: ``python benchmarks/deploy.py``.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from vstent import device
from vstent.deploy import deploy
from vstent.measure import measure
from vstent.struts import struts

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from tubes import arc, line, tube

ARTERIES = {
    "straight": tube(line(40), 1.9),
    "taper 4 -> 3": tube(line(40), np.linspace(2.0, 1.5, 201)),
    "bend of 7 mm": tube(arc(7.0, np.pi / 2, 14), 1.9),
    "oval": tube(line(40), 2.15, 1.65),
    "too wide": tube(line(40), 2.6),
}
DEVICES = {"silk": (4.0, 20.0), "enterprise": (4.5, 22.0)}
HEADER = (
    "artery         device      nodes  iterations  terminated  outside/mm  gap/mm  length/mm  straight  coverage  "
    "deploy/s  measure/s  struts/s"
)


def timed(work: Callable[[], Any], repeats: int = 3) -> tuple[Any, float]:
    """Return the last result and the shortest wall time; the first run, which compiles, is not timed."""
    result, best = work(), float("inf")
    for _ in range(repeats):
        began = time.perf_counter()
        result = work()
        best = min(best, time.perf_counter() - began)
    return result, best


def row(artery: str, key: str) -> str:
    """One line of the table."""
    anatomy, design = ARTERIES[artery], device.find_design(key)
    size = device.find_size(design, diameter_mm=DEVICES[key][0], length_mm=DEVICES[key][1])
    done, deploy_s = timed(lambda: deploy(design, anatomy, size=size))
    found, measure_s = timed(lambda: measure(anatomy, done), 1)
    _, struts_s = timed(lambda: struts(done.stent), 1)
    straight_mm = device.deployed_length_mm(design, size, found["mean_diameter_mm"])
    return (
        f"{artery:14} {key:10} {done.wall_gap_mm.size:6d} {len(done.terminated_fraction):11d} "
        f"{done.terminated_fraction[-1]:11.4f} {found['max_outside_mm']:11.4f} {done.wall_gap_mm.max():7.4f} "
        f"{done.stent.deployed_length_mm:10.3f} {straight_mm:9.3f} {found['metal_coverage_fraction']:9.4f} "
        f"{deploy_s:9.3f} {measure_s:10.3f} {struts_s:9.3f}"
    )


def queries() -> str:
    """Time of one closest-point query and one crossing test against the straight tube."""
    surface = ARTERIES["straight"].landing_surface
    points = np.random.default_rng(0).uniform([-1.9, -1.9, 1], [1.9, 1.9, 39], size=(20000, 3))
    axis = points * [0, 0, 1]
    _, closest_s = timed(lambda: surface.closest(points))
    _, crosses_s = timed(lambda: surface.crosses(axis, points))
    return (
        f"{len(surface.faces)} triangles: {closest_s / len(points) * 1e6:.2f} us per closest point, "
        f"{crosses_s / len(points) * 1e6:.2f} us per crossing test"
    )


if __name__ == "__main__":
    print(HEADER)
    for name in ARTERIES:
        for key in DEVICES:
            print(row(name, key))
    print(queries())
