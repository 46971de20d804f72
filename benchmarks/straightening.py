"""Predict what an Enterprise straightens after six months and what that does to the flow; print the table of the docs.

Run from the repository: ``python benchmarks/straightening.py``. Real arteries are taken from ``../shared/data``, where
it exists. Each row takes four flows, a few minutes, and nothing is fitted. With ``fit`` the factors of
`vstent.deployment.straightening.SETTINGS` are fitted instead, from the shape of the arteries alone.
"""

import sys
import time
from pathlib import Path

import numpy as np
from scipy.optimize import brentq

from vstent.anatomy.read import read_vessel
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.deployment.beam import Beam
from vstent.deployment.deploy import deploy
from vstent.deployment.straightening import OVER_MM, SETTINGS, artery_beam, measured, settled, straighten
from vstent.devices.catalogue import find_design
from vstent.devices.stiffness import bending_stiffness_N_mm2
from vstent.errors import InputError
from vstent.flow.indices import indices
from vstent.flow.ostium import sac_surfaces
from vstent.flow.problem import flow_case
from vstent.flow.settings import FlowSettings, Numerics
from vstent.flow.simulation import simulate_case
from vstent.geometry.vessel import Anatomy, Vessel
from vstent.kernels import curves
from vstent.phantoms import demo_phantom, phantom_surface

DATA = Path(__file__).parents[2] / "shared" / "data"
PATIENTS = "C0038", "C0016", "C0024", "C0067", "C0005", "C0018", "C0027"
CASES = {name: f"aneurisk/{name}.vtp" for name in PATIENTS} | {"C0038": "aneurisk_C0038.vtp", "demo": None}
"""Sidewall aneurysms of the internal carotid artery, by their file: all in ``../shared/data``."""
FLOW = FlowSettings(numerics=Numerics(cell_size_mm=0.3))
PUBLISHED = -23.1, -9.6, -32.6
"""Changes of the mean velocity in the sac by the struts, by straightening and by both, in % (Kono et al. 2014)."""


def artery(name: str) -> Anatomy:
    """A restored artery."""
    file = CASES[name]
    vessel = Vessel(phantom_surface(demo_phantom(), edge_mm=0.25)) if file is None else read_vessel(DATA / file)
    return restore(trim(trace(vessel)))


def velocity_m_s(anatomy: Anatomy, stents: list) -> float:
    """Mean velocity in the sac."""
    field = simulate_case(flow_case(anatomy, stents, FLOW))
    return float(indices(field, *sac_surfaces(anatomy))["mean_sac_velocity_m_s"])


def rested(anatomy: Anatomy, length_mm: float) -> tuple[Beam, np.ndarray, tuple[float, float]]:
    """The beam of an artery, the stiffness of an Enterprise of a length over the neck at its nodes, and its ends."""
    rest, path, design = artery_beam(anatomy), anatomy.parent, find_design("enterprise")
    where_mm, middle_mm = curves.arc_length(rest.rest_mm), float(np.mean(path.span_mm(anatomy.aneurysms[0])))
    ends_mm = middle_mm - 0.5 * length_mm, middle_mm + 0.5 * length_mm
    inner_mm = 2 * np.interp(where_mm, path.axis.abscissa_mm, path.section_radius_mm) - design.wall_offset_um * 2e-3
    free_mm = np.minimum(inner_mm, design.sizes[-1].free_diameter_mm)
    is_in = (where_mm >= ends_mm[0]) & (where_mm <= ends_mm[1])
    return rest, np.where(is_in, bending_stiffness_N_mm2(design, design.sizes[-1], free_mm)[0], 0.0), ends_mm


def straightened(found: tuple[Beam, np.ndarray, tuple[float, float]], factor: float) -> tuple[float, float, float]:
    """Mean and sharpest radius along the device, relative to those before, and the angle by which its arms open."""
    rest, device, ends_mm = found
    shapes = rest.rest_mm, settled(rest, factor * device, rest.rest_mm)
    is_in = device > 0
    bent = [curves.curvature_and_torsion(one, OVER_MM)[0][is_in] for one in shapes]
    angles = [measured(one, ends_mm)[0] for one in shapes]
    return bent[0].mean() / bent[1].mean(), bent[0].max() / bent[1].max(), np.degrees(angles[1] - angles[0])


def fit() -> None:
    """Print the factors that give the published means, and what the immediate one predicts for six months."""
    arteries = [artery(name) for name, file in CASES.items() if file is not None]
    long, short = ([rested(one, length_mm) for one in arteries] for length_mm in (25.4, 14.0))

    def mean(factor: float, found: list, which: int) -> float:
        return float(np.mean([straightened(one, factor)[which] for one in found]))

    for title, found, which, wanted in (
        ("immediate, mean radius", long, 0, np.array([10.7, 8.0, 13.4]) / 7.1),
        ("immediate, sharpest radius", long, 1, np.array([10.7, 8.0]) / 7.1),
        ("six months", short, 2, np.array([12.9, 26.0])),
    ):
        factors = [brentq(lambda x, y=y: mean(x, found, which) - y, 1e-3, 2.0, xtol=1e-4) for y in wanted]  # noqa: B023
        print(f"{title}: {', '.join(f'{one:.3f}' for one in factors)}", flush=True)
    for name, (factor, *_) in SETTINGS.items():
        opened = [straightened(one, factor)[2] for one in short]
        print(f"opened with {name}: {np.mean(opened):.1f} ± {np.std(opened, ddof=1):.1f} degrees")


def main() -> None:
    """Print a row for every case, and the mean of the patients."""
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
        row = [degrees[0], np.degrees(silk["straightened_rad"]), *changes]
        rows += [row] if CASES[name] else []
        print(
            f"{name} {deployed.stent.size.label}: {degrees[0]:.1f} ({degrees[1]:.0f} to {degrees[2]:.0f}), "
            f"Silk {row[1]:.2f}; "
            f"{measures['bend_radius_before_mm']:.1f} to {measures['bend_radius_after_mm']:.1f}; "
            f"{', '.join(f'{one:+.1f}' for one in changes)} ({time.perf_counter() - start:.0f} s)",
            flush=True,
        )
    if len(rows) > 1:
        mean, spread = np.mean(rows, axis=0), np.std(rows, axis=0, ddof=1)
        print("patients:", ", ".join(f"{one:.1f} ± {other:.1f}" for one, other in zip(mean, spread, strict=True)))
    print("published: 12.9 ± 13.1,", ", ".join(f"{one:+.1f}" for one in PUBLISHED))


if __name__ == "__main__":
    fit() if sys.argv[1:] == ["fit"] else main()
