"""Predict what an Enterprise straightens after six months and what that does to the flow; print the table of the docs.

Run from the repository: ``python benchmarks/straightening.py``. Real arteries are taken from ``../shared/data``, where
it exists. Each row takes four flows, a few minutes. Nothing is fitted here.
"""

import sys
import time
from pathlib import Path

import numpy as np

from vstent.anatomy.read import read_vessel
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.deployment.deploy import deploy
from vstent.deployment.straightening import straighten
from vstent.errors import InputError
from vstent.flow.indices import indices
from vstent.flow.ostium import sac_surfaces
from vstent.flow.problem import flow_case
from vstent.flow.settings import FlowSettings, Numerics
from vstent.flow.simulation import simulate_case
from vstent.geometry.vessel import Anatomy, Vessel
from vstent.phantoms import demo_phantom, phantom_surface

DATA = Path(__file__).parents[2] / "shared" / "data"
CASES = {"demo": None, "C0038": "aneurisk_C0038.vtp"} | {
    name: f"aneurisk/{name}.vtp" for name in ("C0016", "C0024", "C0067")
}
"""Sidewall aneurysms of the internal carotid artery, by their file."""
SETTINGS = FlowSettings(numerics=Numerics(cell_size_mm=0.25))
PUBLISHED = -23.1, -9.6, -32.6
"""Changes of the mean velocity in the sac by the struts, by straightening and by both, in % (Kono et al. 2014)."""


def artery(name: str) -> Anatomy:
    """A restored artery."""
    file = CASES[name]
    vessel = Vessel(phantom_surface(demo_phantom(), edge_mm=0.25)) if file is None else read_vessel(DATA / file)
    return restore(trim(trace(vessel)))


def velocity_m_s(anatomy: Anatomy, stents: list) -> float:
    """Mean velocity in the sac."""
    field = simulate_case(flow_case(anatomy, stents, SETTINGS))
    return float(indices(field, *sac_surfaces(anatomy))["mean_sac_velocity_m_s"])


def main() -> None:
    """Print a row for every case, and the mean."""
    rows, start = [], time.perf_counter()
    print(
        "case, angle opened (band), Silk, degrees; radius mm; change of sac velocity by struts, straightening, both, %"
    )
    for name in [one for one in sys.argv[1:] or CASES if CASES[one] is None or (DATA / CASES[one]).exists()]:
        try:
            anatomy = artery(name)
            deployed = deploy("enterprise", anatomy)
            found = straighten(anatomy, [deployed], "six_months")
            measures = found.metrics()
            silk = straighten(anatomy, [deploy("silk", anatomy)], "six_months").metrics()
            bare = velocity_m_s(anatomy, [])
            runs = ((anatomy, [deployed.stent]), (found.anatomy, []), (found.anatomy, [found.deployed[0].stent]))
            changes = [100 * (velocity_m_s(*run) / bare - 1) for run in runs]
        except InputError as error:
            print(f"{name}: {error}", flush=True)
            continue
        degrees = np.degrees([measures[f"straightened{end}_rad"] for end in ("", "_low", "_high")])
        rows.append([degrees[0], np.degrees(silk["straightened_rad"]), *changes])
        print(
            f"{name} {deployed.stent.size.label}: {degrees[0]:.1f} ({degrees[1]:.0f} to {degrees[2]:.0f}), "
            f"Silk {rows[-1][1]:.2f}; "
            f"{measures['bend_radius_before_mm']:.1f} to {measures['bend_radius_after_mm']:.1f}; "
            f"{', '.join(f'{one:+.1f}' for one in changes)} ({time.perf_counter() - start:.0f} s)",
            flush=True,
        )
    mean, spread = np.mean(rows, axis=0), np.std(rows, axis=0, ddof=1)
    print("mean:", ", ".join(f"{one:.1f} ± {other:.1f}" for one, other in zip(mean, spread, strict=True)))
    print("published: 12.9 ± 13.1,", ", ".join(f"{one:+.1f}" for one in PUBLISHED))


if __name__ == "__main__":
    main()
