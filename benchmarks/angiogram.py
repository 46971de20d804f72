"""Validate the angiogram: fronts and dispersion in a tube, the age of blood that leaves a sac, grids, and cost.

``python benchmarks/angiogram.py`` computes the dispersion in a tube and the flow in the demo's artery on four grids;
``python benchmarks/angiogram.py CASE ...`` measures the ages in the stored flows of case folders.
"""

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates

from vstent import phantoms
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.angiography import angiogram as angiograms
from vstent.angiography.angiogram import AngiogramSettings
from vstent.angiography.grid import grid_of
from vstent.angiography.network import Network
from vstent.angiography.transport import Transport
from vstent.angiography.washout import INTERVAL_S, wash_out
from vstent.flow import sampling
from vstent.flow.case import FlowCase, FlowField
from vstent.flow.indices import indices
from vstent.flow.problem import flow_case
from vstent.flow.settings import FlowSettings, Numerics
from vstent.flow.simulation import simulate_case
from vstent.geometry.vessel import Anatomy, Vessel
from vstent.io.archive import load_data
from vstent.kernels.arrays import Floats, Ints
from vstent.study.folder import CACHE

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))
from cell_networks import tube

GRIDS_MM = (0.28, 0.2, 0.14, 0.1)
"""Grid spacings of the demo, mm."""
SAMPLE_CELLS = 0.5
"""Distance between samples of the ostium, in cells."""
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
                if path.stem.endswith(".running"):
                    continue
                name = path.stem.split("-")[0].removeprefix("flow ")
                ages(f"{folder.name} {name}", flow_case(anatomy, ()), load_data(path, FlowField))
        else:
            demo(float(word))


def demo(spacing_mm: float) -> None:
    """Compute the flow in the demo's artery on one grid, and report its ages and the times of an injection."""
    surface = phantoms.phantom_surface(phantoms.demo_phantom(), edge_mm=0.25)
    anatomy = restore(trace(Vessel(surface)))
    case = flow_case(anatomy, (), FlowSettings(numerics=Numerics(cell_size_mm=spacing_mm)))
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
    march = Transport(near, initial=np.isin(np.arange(len(near.cells)), sac).astype(np.float64))
    for _ in march.frames(INTERVAL_S, found.time_s[-1]):
        pass
    moved_mm3, volume_mm3 = march.moved(), abs(case.sac.volume_mm3)  # in a steady flow: flow rate times age
    branch_mm3_s, branch_mm3 = (_through_branch(near, sac, values, case) for values in (near.flux_mm3_s[0], moved_mm3))
    inflow_mm3_s = 1e3 * _inflow_mL_s(case, field)
    carried_mm3_s = float(np.maximum(_at_ostium(case, field, near, near.flux_mm3_s[0]), 0).sum())
    # What is still in the sac at the end leaves it later.
    leaving_mm3 = branch_mm3 - _at_ostium(case, field, near, moved_mm3).sum() + found.left_fraction[-1] * volume_mm3
    told_s = indices(field, case.sac, case.ostium)["turnover_time_s"]
    wall, cpu = time.perf_counter() - began, time.process_time() - busy
    print(
        f"{name:24} {len(field.centers_mm):8,} cells  corrected {grid.network.correction_fraction:.2%}  "
        f"volume / inflow {told_s:.4f} s, in the mean flow {volume_mm3 / inflow_mm3_s:.4f} s  "
        f"branch {1e-3 * branch_mm3_s:.3f} of {1e-3 * inflow_mm3_s:.3f} mL/s "
        f"({carried_mm3_s / inflow_mm3_s - 1:+.1%} in the transport)  "
        f"age on leaving {leaving_mm3 / inflow_mm3_s:.4f} s ({leaving_mm3 / volume_mm3 - 1:+.1%})  "
        f"mean age {found.mean_age_s:.4f} s (extrapolated "
        f"{found.tail_fraction:.1%})  {wall:.0f} s ({cpu:.0f} s CPU)",
        flush=True,
    )


def _through_branch(near: Network, sac: Ints, through: Floats, case: FlowCase) -> float:
    """Return the sum of a quantity (f,) that passes the faces, over the branches that leave a sac."""
    assert case.ostium is not None
    is_sac = np.zeros(len(near.cells) + near.openings, dtype=bool)
    is_sac[sac] = True
    crossing = np.flatnonzero(is_sac[near.left] != is_sac[near.right])
    leaves = is_sac[near.left[crossing]]
    within = np.where(leaves, near.left[crossing], near.right[crossing])
    is_branch = case.ostium.closest(near.points_mm[within])[1] > BRANCH_CELLS * near.spacing_mm
    return float(np.where(leaves, through[crossing], -through[crossing])[is_branch].sum())


def _inflow_mL_s(case: FlowCase, field: FlowField) -> float:
    """Return the inflow through the ostium in the velocity of a flow."""
    assert case.ostium is not None
    samples = sampling.surface_samples(case.ostium, field.finest.cell_size_mm)
    return sampling.inflow_mL_s(sampling.through_surface_mL_s(field, *samples))


def _at_ostium(case: FlowCase, field: FlowField, near: Network, through: Floats) -> Floats:
    """Return what passes samples (p,) of the ostium into the sac, of a quantity (f,) that passes the faces.

    Per area it is linear between the centers of the faces across one axis, and 0 on faces at a wall.
    """
    assert case.ostium is not None
    grid = sampling.uniform(field).finest
    points_mm, area_mm2 = sampling.surface_samples(case.ostium, SAMPLE_CELLS * grid.cell_size_mm)
    points = grid.places(points_mm)
    found = np.zeros(len(points))
    for axis, step in enumerate(np.eye(3, dtype=np.int64)):
        low = near.left[near.axis == axis]
        fine = (low < len(near.cells)) & (near.width[np.minimum(low, len(near.cells) - 1)] == 1)
        per_mm2 = np.zeros(grid.index.shape)
        per_mm2[tuple(near.cells[low[fine]].T)] = through[near.axis == axis][fine] / grid.cell_size_mm**2
        found += area_mm2[:, axis] * map_coordinates(per_mm2, (points - 0.5 * step).T, order=1)
    return found


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
