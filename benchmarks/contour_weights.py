"""Weights of the active contour (Zhong et al. 2016, eq. 2-5): where the method works, where it fails, and why so.

Run from the repository: ``python benchmarks/contour_weights.py``. One weight at a time is scaled away from the
defaults, for a flow diverter in a bent artery with lobed sections, deployed by the paper's method.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from vstent.deployment.active_contour import ActiveContour
from vstent.deployment.deploy import deploy
from vstent.deployment.measure import measure
from vstent.deployment.method import Zhong2016
from vstent.devices import catalogue
from vstent.devices.stent import Landing
from vstent.errors import VstentError
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))
from tubes import arc, tube

STIFF = ("a1", "a2", "a3", "a4", "a5")
STUDY = {
    "all a x": [{name: x * getattr(ActiveContour(), name) for name in STIFF} for x in (0, 0.1, 1, 10, 100, 1000)],
    "tension a1 = a3 =": [{"a1": x, "a3": x} for x in (0, 0.01, 0.1, 1.0, 10.0)],
    "bending a2 = a4 =": [{"a2": x, "a4": x} for x in (0, 0.02, 0.2, 2.0, 20.0)],
    "balloon k1 =": [{"k1": x} for x in (0.05, 0.2, 0.5, 0.8, 1.0, 1.2, 1.6, 2.0)],
    "vessel k2 =": [{"k2": x} for x in (0, 0.01, 0.05, 0.2, 0.5)],
    "step tau =": [{"tau": x} for x in (0.1, 0.5, 1.0, 1.5, 2.0)],
}
HEADER = f"{'weights':34} outcome          iterations  terminated  outside/mm  gap/mm  roughness  edge/mm"


def lobed() -> Anatomy:
    """A bent artery whose sections have three lobes: far from the inscribed circles in between."""
    artery = tube(arc(7.0, 1.2, 12), 1.7)
    parent, around = artery.parent, 160
    surface, points_mm = parent.landing_surface, parent.axis.points_mm
    middle_mm = np.repeat(points_mm, around, axis=0)
    growth = 1 + 0.15 * (1 + np.cos(3 * np.tile(2 * np.pi * np.arange(around) / around, len(points_mm))))
    vertices_mm = middle_mm + growth[:, None] * (surface.vertices_mm - middle_mm)
    return replace(artery, paths=(replace(parent, landing_surface=Surface(vertices_mm, surface.faces)),))


def row(anatomy: Anatomy, weights: dict[str, float]) -> str:
    """Deploy with some weights; roughness is the worst ratio of neighbouring node distances round a row."""
    label = ", ".join(f"{name} {value:g}" for name, value in weights.items())
    design = catalogue.find_design("silk")
    size = catalogue.find_size(design, diameter_mm=4, length_mm=15)
    try:
        done = deploy(design, anatomy, size=size, landing=Landing(15.0), method=Zhong2016(ActiveContour(**weights)))
    except VstentError as error:
        return f"{label[:33]:34} {error}"
    nodes_mm, gap_mm = done.stent.nodes_mm, done.wall_gap_mm.max(axis=1)
    chords_mm = np.linalg.norm(np.roll(nodes_mm, -1, axis=1) - nodes_mm, axis=2)
    rough = float((chords_mm.max(axis=1) / np.maximum(chords_mm.min(axis=1), 1e-9)).max())
    edge_mm = max(gap_mm[:3].max(), gap_mm[-3:].max()) - gap_mm[3:-3].max()
    return (
        f"{label[:33]:34} {done.outcome:16} {len(done.terminated_fraction):10d} {done.terminated_fraction[-1]:11.4f} "
        f"{measure(anatomy, done)['max_outside_mm']:11.4f} {done.wall_gap_mm.max():7.3f} {rough:10.2f} {edge_mm:8.3f}"
    )


if __name__ == "__main__":
    print(HEADER)
    for title, choices in STUDY.items():
        print(title)
        for choice in choices:
            print(" ", row(lobed(), choice))
