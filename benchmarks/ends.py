"""Measure what inlets and outlets do to a flow: the artery cut after fewer bends, and a branch that a device covers.

``python benchmarks/ends.py cut SURFACE`` cuts the artery of C0038 at four places, with two profiles;
``python benchmarks/ends.py branch SURFACE`` covers the branch of a fork with Silk, for three outlet conditions.
``--grid MM`` sets the grid spacing.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from vstent.anatomy.read import read_vessel
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.deployment.deploy import deploy
from vstent.devices.stent import Landing
from vstent.flow.indices import indices
from vstent.flow.problem import flow_case
from vstent.flow.settings import FlowSettings, Numerics
from vstent.flow.simulation import simulate_case

UPSTREAM_MM = {"none": 60.0, "the first of three": 45.0, "two": 27.0, "two and a half": 14.0}
"""Bends of C0038 upstream of its sac that are cut off, and the length of artery kept upstream of the sac, mm."""
INFLOW_ML_S = 4.0
"""Inflow of C0038, the same wherever it is cut."""


def main() -> None:
    """Print one table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("table", choices=["cut", "branch"])
    parser.add_argument("surface", type=Path)
    parser.add_argument("--grid", type=float, default=0.35)
    arguments = parser.parse_args()
    rows = cut if arguments.table == "cut" else branch
    for row in rows(arguments.surface, Numerics(cell_size_mm=arguments.grid)):
        print(row, flush=True)


def cut(surface: Path, numerics: Numerics) -> Iterator[str]:
    """Yield the flow in the sac for every cut and profile, as a change against the longest artery."""
    traced = trace(read_vessel(surface))
    first: dict[str, float] = {}
    keys = ("neck_inflow_mL_s", "mean_sac_velocity_m_s", "mean_sac_wss_Pa")
    for name, kept_mm in UPSTREAM_MM.items():
        anatomy = restore(trim(traced, upstream_mm=kept_mm))
        for profile in ("developed", "plug"):
            settings = FlowSettings(INFLOW_ML_S, profile=profile, outlets="murray", numerics=numerics)
            case = flow_case(anatomy, (), settings)
            field = simulate_case(case)
            found = indices(field, case.sac, case.ostium)
            first = first or found
            changes = ", ".join(f"{key} {100 * (found[key] / first[key] - 1):+.1f} %" for key in keys)
            known = f"known to {field.unsettled_fraction:.1%}"
            yield f"bends cut: {name}, {kept_mm:g} mm kept, {profile}: {changes} ({known})"


def branch(surface: Path, numerics: Numerics) -> Iterator[str]:
    """Yield what Silk leaves of the flow of a branch, without a sac, for every condition at the outlets."""
    anatomy = restore(trim(trace(read_vessel(surface))))
    axis, line = anatomy.parent.axis, anatomy.vessel.centerlines[1]
    apart = np.linalg.norm(line.points_mm - axis.at(axis.nearest_abscissa_mm(line.points_mm)), axis=1)
    fork_mm = axis.nearest_abscissa_mm(line.points_mm[np.flatnonzero(apart > 0.5)[:1]])[0]
    silk = deploy("silk", anatomy, landing=Landing(axis.length_mm / 2))
    name = f"{silk.stent.design.name} {silk.stent.size.label}"
    yield f"{name} in the middle of {axis.length_mm:.1f} mm, fork at {fork_mm:.1f} mm"
    for outlets in ("zero_pressure", "murray", "resistance"):
        settings = FlowSettings(outlets=outlets, numerics=replace(numerics, tolerance=0.002))
        bare = simulate_case(flow_case(anatomy, (), settings))
        after = simulate_case(flow_case(anatomy, (silk.stent,), settings), start=bare)
        before, left = bare.outlets_mL_s[1], after.outlets_mL_s[1]
        changed = f"with Silk {100 * (left / before - 1):+.2f} %"
        yield f"{outlets}: branch {before:.3f} mL/s of {bare.inflow_mL_s:.3f}, {changed}"


if __name__ == "__main__":
    main()
