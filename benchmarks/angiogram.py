"""Validate the angiogram: fronts and dispersion in a tube, the age of blood that leaves a sac, grids, and cost.

``python benchmarks/angiogram.py`` computes the dispersion in a tube and the flow in the demo's artery on four grids;
``python benchmarks/angiogram.py CASE ...`` measures the ages in the stored flows of case folders.
"""

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from vstent import phantoms
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.angiography import angiogram as angiograms
from vstent.angiography.angiogram import AngiogramSettings
from vstent.angiography.grid import grid_of
from vstent.angiography.network import Network
from vstent.angiography.transport import Transport
from vstent.angiography.washout import wash_out
from vstent.flow import sampling
from vstent.flow.case import FlowCase, FlowField, FlowSettings
from vstent.flow.indices import indices
from vstent.flow.simulation import flow_case, simulate_case
from vstent.geometry.vessel import Anatomy, Vessel
from vstent.io.archive import load_data
from vstent.kernels import sampling as kernels
from vstent.kernels.arrays import Floats, Ints
from vstent.study.folder import CACHE

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))
from cell_networks import tube

GRIDS_MM = (0.28, 0.2, 0.14, 0.1)
"""Grid spacings of the demo, mm."""
UPSTREAM_CELLS = 0.75
"""Distance upstream of the ostium at which the age is taken, in cells."""
BRANCH_CELLS = 3.0
"""Distance from the ostium, in cells, beyond which blood leaves a sac through a branch."""
WINDOW_S = 4.0
"""Window of the injections on several grids, s."""


def main() -> None:
    """Print every table; the words of the command line are grid spacings of the demo, mm, or case folders."""
    words = sys.argv[1:] or ["taylor", *map(str, GRIDS_MM)]
    for word in words:
        if word == "taylor":
            print(f"Taylor dispersion in a round tube, found over exact: {taylor():.3f}", flush=True)
        elif Path(word).is_dir():
            folder = Path(word)
            anatomy = load_data(next((folder / CACHE).glob("anatomy-*.npz")), Anatomy)
            for path in sorted((folder / CACHE).glob("flow *.npz")):
                name = path.stem.split("-")[0].removeprefix("flow ")
                ages(f"{folder.name} {name}", flow_case(anatomy, None), load_data(path, FlowField))
        else:
            demo(float(word))


def demo(spacing_mm: float) -> None:
    """Compute the flow in the demo's artery on one grid, and report its ages and the times of an injection."""
    surface = phantoms.phantom_surface(phantoms.demo_phantom(), edge_mm=0.25)
    anatomy = restore(trace(Vessel(surface)))
    case = flow_case(anatomy, None, FlowSettings(cell_size_mm=spacing_mm))
    field = simulate_case(case)
    ages(f"demo {spacing_mm:g} mm", case, field)
    began, busy = time.perf_counter(), time.process_time()
    ready = angiograms.injection(case, field, AngiogramSettings(window_s=WINDOW_S))
    told = angiograms._curves(ready, anatomy, None, lambda _: None).measures()
    wall, cpu = time.perf_counter() - began, time.process_time() - busy
    print(
        f"{'':24} retention {told['contrast_retention_s']:.4f} s  half-life {told['washout_half_life_s']:.4f} s  "
        f"mean transit {told['contrast_mean_transit_s']:.4f} s  balance "
        f"{ready.transport.balance().error_fraction:.1e}  "
        f"{wall:.0f} s ({cpu:.0f} s CPU)",
        flush=True,
    )


def ages(name: str, case: FlowCase, field: FlowField) -> None:
    """Print the ages of the blood in a sac and of the blood that leaves it, through its neck or a branch."""
    assert case.sac is not None
    assert case.ostium is not None
    began, busy = time.perf_counter(), time.process_time()
    grid = grid_of(case, field, is_preview=False)
    near, sac = grid.near
    found = wash_out(near, sac, end_s=angiograms.MOST_WASHOUT_S)
    volume_mL = 1e-3 * abs(case.sac.volume_mm3)
    branch_mL_s, branch_mL = _through_branch(near, sac, found.age_s, case)
    inflow_mL_s, leaving_mL = _at_ostium(case, field, near, found.age_s)
    leaving = (leaving_mL + branch_mL) / volume_mL
    told_s = indices(field, case.sac, case.ostium)["turnover_time_s"]
    wall, cpu = time.perf_counter() - began, time.process_time() - busy
    print(
        f"{name:24} {len(field.cells):8,} cells  corrected {grid.network.correction_fraction:.2%}  volume / inflow "
        f"{told_s:.4f} s, in the mean flow {volume_mL / inflow_mL_s:.4f} s  branch {branch_mL_s:.3f} of "
        f"{inflow_mL_s:.3f} mL/s  age on leaving {leaving * volume_mL / inflow_mL_s:.4f} s ({leaving - 1:+.1%})  "
        f"mean age {found.mean_age_s:.4f} s (extrapolated "
        f"{found.tail_fraction:.1%})  {wall:.0f} s ({cpu:.0f} s CPU)",
        flush=True,
    )


def _through_branch(near: Network, sac: Ints, age_s: Floats, case: FlowCase) -> tuple[float, float]:
    """Return the flow rate through the branches that leave a sac, in mL/s, and its sum with the age, in mL."""
    assert case.ostium is not None
    is_sac = np.zeros(len(near.cells) + near.openings, dtype=bool)
    is_sac[sac] = True
    crossing = is_sac[near.left] != is_sac[near.right]
    left, right, flux = near.left[crossing], near.right[crossing], near.flux_mm3_s[0][crossing]
    within = np.where(is_sac[left], left, right)
    is_branch = case.ostium.closest(near.points_mm[within])[1] > BRANCH_CELLS * near.spacing_mm
    out_mL_s = 1e-3 * np.where(is_sac[left], flux, -flux)[is_branch]
    age = np.r_[age_s, np.zeros(near.openings)][np.where(flux > 0, left, right)[is_branch]]
    return float(out_mL_s.sum()), float(out_mL_s @ age)


def _at_ostium(case: FlowCase, field: FlowField, near: Network, age_s: Floats) -> tuple[float, float]:
    """Return the inflow through the ostium in mL/s, and the net sum of flow rate out times age there in mL."""
    assert case.ostium is not None
    points_mm, area_mm2 = sampling.surface_samples(case.ostium, field.cell_size_mm)
    points = (points_mm - field.origin_mm) / field.cell_size_mm
    through = sampling.read_through_mL_s(field.index, field.velocity_m_s, points, area_mm2)
    # The age is that of the blood upstream: on the other side it is mixed with fresh blood within a cell.
    normals = area_mm2 / np.linalg.norm(area_mm2, axis=1, keepdims=True)
    upstream = points - UPSTREAM_CELLS * np.sign(through)[:, None] * normals
    at = kernels.interpolate(*_on_grid(field, near, age_s), upstream, False)[:, 0]
    return float(np.maximum(through, 0).sum()), float(-through @ at)


def _on_grid(field: FlowField, near: Network, age_s: Floats) -> tuple[np.ndarray, Floats]:
    """Return the cell numbers on the grid of a flow, for the fine cells only, and the age (n, 1) there."""
    fine = np.flatnonzero(near.width == 1)
    index = np.full(field.index.shape, -1, dtype=np.int32)
    index[tuple(near.cells[fine].T)] = np.arange(len(fine), dtype=np.int32)
    return index, age_s[fine][:, None]


def taylor(radius: float = 12.5, peclet: float = 10.0) -> float:
    """Return the dispersion in a round tube over D (1 + Pe^2 / 48) (Aris 1956, Proc. R. Soc. A 235, 67)."""
    net = tube(radius, round(24 * radius))
    speed = net.flux_mm3_s[0][net.axis == 2].mean()
    round_radius = np.sqrt(np.bincount(net.cells[:, 2])[0] / np.pi)
    diffusivity = speed * round_radius / peclet
    z = net.cells[:, 2].astype(float)
    unit_s = round_radius**2 / diffusivity
    march = Transport(net, diffusivity_mm2_s=diffusivity, initial=np.exp(-(((z - 4 * radius) / radius) ** 2)))
    spreads = list(_spreads(march, z, 0.35 * unit_s, 1.05 * unit_s))
    return float((spreads[-1] - spreads[-2]) / (0.7 * unit_s) / (diffusivity * (1 + peclet**2 / 48)))


def _spreads(march: Transport, z: Floats, interval_s: float, end_s: float) -> Iterator[float]:
    """Yield the variance of a concentration along z."""
    for _, values in march.frames(interval_s, end_s):
        yield float(np.average((z - np.average(z, weights=values)) ** 2, weights=values))


if __name__ == "__main__":
    main()
