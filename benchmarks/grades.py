"""Check the grades of flows: every vessel at several grid spacings, bare and with two devices, against the finest.

Usage: python benchmarks/grades.py [--vessel NAME ...] [--print]

Flows are computed once and kept in `grades.json`; `--print` only prints the table. A grade is right if no flow graded
good is more than 10 % from the finest one in neck inflow or sac velocity, and if no pair graded good or fair reverses
two devices that the finest grid separates by more than its uncertainty.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

import vstent
from vstent import phantoms
from vstent.anatomy.repair import repair
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.flow.grade import GOOD, NOT_USABLE, grade_of, measures_of
from vstent.flow.indices import indices
from vstent.flow.problem import flow_case
from vstent.flow.settings import FlowSettings, Numerics
from vstent.flow.simulation import simulate_case
from vstent.geometry.vessel import Anatomy, Vessel
from vstent.io.surfaces import read_surface
from vstent.phantoms import Phantom

TABLE = Path(__file__).with_suffix(".json")
DATA = Path(__file__).parents[2] / "shared" / "data"
DEVICES = ("silk", "enterprise")
SPACINGS_MM = {
    "demo": (0.4, 0.3, 0.22, 0.16, 0.14),
    "arc": (0.4, 0.3, 0.25, 0.22, 0.16),
    "t": (0.4, 0.3, 0.25, 0.22, 0.16),
    "aneurisk_C0038.vtp": (0.4, 0.32, 0.25, 0.22, 0.2),
    "aneurisk_beta.vtp": (0.4, 0.3, 0.22, 0.16, 0.13),
    "visc2011_metres.stl": (0.4, 0.32, 0.25, 0.2, 0.16),
}
"""Grid spacings of every vessel, mm; the last one is the reference."""
SURE = 0.01
"""Difference between two reductions that the uncertainty of steady flows can make."""
ALLOWED = 0.1
"""Largest difference from the finest grid that a flow graded good may have."""


def arc() -> Phantom:
    """Return an artery of 3.4 mm in a bend of 12 mm with a sac of 6 mm at its side."""
    artery = phantoms.torus_arc(bend_radius_mm=12.0, angle_rad=2.2, radius_mm=1.7)
    middle_mm = 0.5 * artery.parent.length_mm
    return phantoms.with_sac(
        artery, abscissa_mm=middle_mm, width_mm=6.0, neck_mm=4.2, direction=np.array([0.0, 1.0, 0.0])
    )


def straight() -> Phantom:
    """Return a straight artery of 4 mm with a sac of 6 mm at its side (a T)."""
    return phantoms.with_sac(phantoms.tube(length_mm=30.0), abscissa_mm=15.0, width_mm=6.0, neck_mm=4.0)


def anatomy_of(name: str) -> Anatomy:
    """Return the anatomy of a vessel by its name."""
    made = {"demo": phantoms.demo_phantom, "arc": arc, "t": straight}
    if name in made:
        return restore(trim(trace(Vessel(phantoms.phantom_surface(made[name](), edge_mm=0.2)))))
    lumen, _ = repair(read_surface(DATA / name)[0])
    return restore(trim(trace(Vessel(lumen))))


def compute(name: str, rows: dict[str, dict[str, Any]]) -> None:
    """Compute the missing flows of a vessel, coarse grids first, and keep each at once."""
    anatomy = anatomy_of(name)
    implants = {one: (vstent.deploy(vstent.find_design(one), anatomy).stent,) for one in DEVICES}
    implants = {"bare": (), **implants}
    for spacing_mm in SPACINGS_MM[name]:
        bare = None
        for device, deployed in implants.items():
            key = f"{name} {spacing_mm} {device}"
            if key in rows and device != "bare":
                continue
            if all(f"{name} {spacing_mm} {one}" in rows for one in implants):
                continue
            case = flow_case(anatomy, deployed, FlowSettings(numerics=Numerics(cell_size_mm=spacing_mm)))
            began = time.perf_counter()
            field = simulate_case(case, start=bare)
            bare = bare if deployed else field
            found = indices(field, case.sac, case.ostium)
            row = measures_of(case, field, found) | {"seconds": time.perf_counter() - began}
            rows[key] = row | {one: found[one] for one in ("neck_inflow_mL_s", "mean_sac_velocity_m_s")}
            TABLE.write_text(json.dumps(rows, indent=1, sort_keys=True))
            print(key, {one: round(value, 4) for one, value in rows[key].items()}, flush=True)


def table(rows: dict[str, dict[str, Any]]) -> int:
    """Print every flow with its grade and its difference from the finest grid; return the number of wrong grades."""
    print("| vessel | spacing, mm | flow | grade | neck inflow | sac velocity | why |\n|---|---|---|---|---|---|---|")
    n_wrong = 0
    for name, spacings_mm in SPACINGS_MM.items():
        finest = {one: rows.get(f"{name} {spacings_mm[-1]} {one}") for one in ("bare", *DEVICES)}
        for spacing_mm in spacings_mm:
            for device, best in finest.items():
                row = rows.get(f"{name} {spacing_mm} {device}")
                if row is None or best is None:
                    continue
                off = [row[key] / best[key] - 1 for key in ("neck_inflow_mL_s", "mean_sac_velocity_m_s")]
                grade = grade_of(row)
                is_wrong = grade.level == GOOD and max(map(abs, off)) > ALLOWED
                n_wrong += is_wrong
                print(
                    f"| {name} | {spacing_mm} | {device} | {grade.level}{' WRONG' if is_wrong else ''} | {off[0]:+.0%} "
                    f"| {off[1]:+.0%} | {'; '.join(grade.reasons)} |"
                )
    return n_wrong + reversed_pairs(rows)


def reversed_pairs(rows: dict[str, dict[str, Any]]) -> int:
    """Print the pairs of usable flows that reverse two devices against the finest grid; return their number."""
    n_reversed = 0
    for name, spacings_mm in SPACINGS_MM.items():
        finest = _difference(rows, name, spacings_mm[-1])
        for spacing_mm in spacings_mm:
            keys = [f"{name} {spacing_mm} {one}" for one in ("bare", *DEVICES)]
            found = _difference(rows, name, spacing_mm)
            if found is None or finest is None or any(grade_of(rows[key]).level == NOT_USABLE for key in keys):
                continue
            if found * finest < 0 and min(abs(found), abs(finest)) > SURE:
                n_reversed += 1
                print(f"\nREVERSED: {name} at {spacing_mm} mm, {found:+.1%} instead of {finest:+.1%}")
    return n_reversed


def _difference(rows: dict[str, dict[str, Any]], name: str, spacing_mm: float) -> float | None:
    """Return the reduction of the neck inflow by the first device minus that by the second; None where missing."""
    keys = [f"{name} {spacing_mm} {one}" for one in ("bare", *DEVICES)]
    if any(key not in rows for key in keys):
        return None
    bare, first, second = (rows[key]["neck_inflow_mL_s"] for key in keys)
    return float((first - second) / bare)


def main() -> int:
    """Compute what is missing and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--vessel", nargs="*", default=list(SPACINGS_MM))
    parser.add_argument("--print", action="store_true", dest="only_prints")
    given = parser.parse_args()
    rows = json.loads(TABLE.read_text()) if TABLE.exists() else {}
    for name in [] if given.only_prints else given.vessel:
        compute(name, rows)
    return table(rows)


if __name__ == "__main__":
    raise SystemExit(main())
