"""The screen beside resolved struts, over necks and branches: write `struts.json`, print it as a table.

Usage: python benchmarks/struts.py [--vessel demo|arc|tee] [--cell MM] [--foam-cell MM] [--across CELLS] [-j N]
                                   [--cases FOLDER] [--wires WORD] [--picture FILE] [DEVICE ...]

The demo's artery, an arc of one with a sac at its side, cut to 9 mm on either side of the sac, or a straight one with a
small sac, cut to 3 mm, is computed twice
with every device: by the embedded engine with the device as a screen, and by OpenFOAM with its struts meshed, at least
so many cells across each, without layers along walls (on wires so fine they do not come to an end). Both have only the
part of the device that OpenFOAM meshes (`vstent.deployment.struts.over_restored`); what the whole screen does, with
what lies on the artery's wall, is kept besides. The two engines differ in the bare vessel already: what a device
leaves of each engine's own bare value stands beside. `alignment` is the correlation of the two velocity fields in the
sac, 1 where they are alike but for their size. A row is kept for every device in every vessel; other rows stay as they
are. With --wires, only the embedded engine computes, takes the wires in that way (``vstent run --wires``), at a spacing
of its own where none is given, and prints what it finds; --across is then the least number of cells across a wire that
is a wall. --picture draws it beside the screen, in the plane of the artery through the middle of the sac. With --cases,
OpenFOAM's cases stay in that folder, by vessel and device, and one that is there already resumes.
"""

import argparse
import json
import time
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import get_args

import numpy as np
from matplotlib.figure import Figure

import vstent
from vstent import phantoms
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.deployment.struts import is_over_restored
from vstent.flow import domain as domains, sampling
from vstent.flow.case import FlowCase, FlowField
from vstent.flow.engines import run
from vstent.flow.indices import indices
from vstent.flow.openfoam import setup
from vstent.flow.openfoam.engine import OpenFoam
from vstent.flow.problem import flow_case
from vstent.flow.settings import OPENFOAM, FlowSettings, Wires
from vstent.flow.simulation import simulate_case
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Vessel
from vstent.phantoms import Phantom

TABLE = Path(__file__).with_suffix(".json")
# Without branches in the sac as much blood enters as leaves, which OpenFOAM misses by up to 15 %: the inflow here is
# the mean of both.
INDICES = ("neck_inflow_mL_s", "mean_sac_velocity_m_s", "mean_sac_wss_Pa")


def arc() -> Phantom:
    """An artery 3.4 mm wide that bends by 24 mm, with a sac of 6 mm beside the bend, neither outside nor inside it."""
    artery = phantoms.torus_arc(bend_radius_mm=12.0, angle_rad=2.2, radius_mm=1.7)
    sideways = np.array([0.0, 1.0, 0.0])
    middle_mm = 0.5 * artery.parent.length_mm
    return phantoms.with_sac(artery, abscissa_mm=middle_mm, width_mm=6.0, neck_mm=4.2, direction=sideways)


def tee() -> Phantom:
    """A straight artery 2.6 mm wide with a sac of 2.6 mm on a neck of 2 mm."""
    artery = phantoms.tube(length_mm=30.0, radius_mm=1.3)
    sideways = np.array([1.0, 0.0, 0.0])
    return phantoms.with_sac(artery, abscissa_mm=15.0, width_mm=2.6, neck_mm=2.0, direction=sideways)


VESSELS = {"demo": (phantoms.demo_phantom, 9.0), "arc": (arc, 9.0), "tee": (tee, 3.0)}
"""Vessels by name, and how much of them is kept on either side of the sac, in mm."""


def cases(names: list[str], phantom: Phantom, kept_mm: float) -> dict[str, tuple[FlowCase, FlowCase]]:
    """The bare vessel and every device in it, deployed in the whole one and computed in a short one.

    The first case of each has the whole screen, the second only as much as OpenFOAM meshes struts.
    """
    whole = trace(Vessel(phantoms.phantom_surface(phantom, edge_mm=0.2)))
    anatomy = restore(trim(whole))
    short = trim(whole, upstream_mm=kept_mm, downstream_mm=kept_mm)
    inflow_mL_s = flow_case(anatomy, ()).inflow_mL_s
    settings = FlowSettings(inflow_mL_s=inflow_mL_s)
    stents = {name: (vstent.deploy(vstent.find_design(name), anatomy).stent,) for name in names}
    found = {}
    for name, implants in {"bare": (), **stents}.items():
        whole_case = replace(flow_case(anatomy, implants, settings), vessel=short)
        parts = (
            sheet.part(is_over_restored(one, anatomy, sheet.points_mm))
            for sheet, one in zip(whole_case.media, implants, strict=True)
        )
        found[name] = whole_case, replace(whole_case, media=tuple(parts))
    return found


def computed(
    case: FlowCase, start: FlowField | None, folder: Path | None = None, **changes: object
) -> tuple[FlowField, dict[str, float]]:
    settings = replace(case.numerics, **changes)
    case, began = replace(case, numerics=settings), time.perf_counter()
    if settings.engine == OPENFOAM:
        with nullcontext(folder) if folder is not None else TemporaryDirectory() as own:
            field = run(OpenFoam(settings.cell_size_mm, Path(own), layers=0), case, start=start)
    else:
        field = simulate_case(case, start=start)
    found = indices(field, case.sac, case.ostium)
    found = found | {INDICES[0]: 0.5 * (found[INDICES[0]] + found["neck_outflow_mL_s"])}
    values = {key: round(float(found[key]), 6) for key in INDICES}
    print(f"{settings.engine}: {field.advice} {time.perf_counter() - began:.0f} s {values}", flush=True)
    return field, values


def alignment(screened: FlowField, resolved: FlowField, sac: Surface) -> float:
    """Correlation of two velocity fields in the sac, on the cells of the first."""
    cells = sampling.field_cells_inside(screened, sac)
    one = screened.velocity_m_s[cells]
    other = sampling.values_at(resolved, screened.centers_mm[cells])[0]
    return round(float((one * other).sum() / np.sqrt((one**2).sum() * (other**2).sum())), 4)


def picture(screened: FlowField, other: FlowField, case: FlowCase, path: Path) -> None:
    """Draw the speeds with a screen and with other wires in the plane of artery and sac, and their difference."""
    assert case.sac is not None
    assert case.ostium is not None
    neck_mm, middle_mm = case.ostium.vertices_mm.mean(axis=0), case.sac.vertices_mm.mean(axis=0)
    up = (middle_mm - neck_mm) / np.linalg.norm(middle_mm - neck_mm)
    line = case.vessel.centerlines[0].points_mm
    nearest = int(np.linalg.norm(line - neck_mm, axis=1).argmin())
    along = line[nearest + 5] - line[nearest - 5]
    along -= (along @ up) * up
    along /= np.linalg.norm(along)
    size_mm = 0.6 * np.ptp(case.sac.vertices_mm @ along), np.ptp(case.sac.vertices_mm @ up)
    x, y = np.meshgrid(np.linspace(-size_mm[0], size_mm[0], 300), np.linspace(-0.3 * size_mm[1], 1.1 * size_mm[1], 300))
    points_mm = neck_mm + x.reshape(-1, 1) * along + y.reshape(-1, 1) * up
    is_blood, in_sac = (one.signed_distance(points_mm) < 0 for one in (case.vessel.closed, case.sac))
    speeds = [np.linalg.norm(sampling.values_at(one, points_mm)[0], axis=1) for one in (screened, other)]
    parts = (is_blood, speeds[1]), (is_blood, speeds[0]), (in_sac, speeds[0] - speeds[1])
    most = 1e3 * np.quantile(speeds[1][in_sac], 0.98), 1e3 * np.quantile(abs(speeds[0] - speeds[1])[in_sac], 0.98)
    figure = Figure(figsize=(11, 4), layout="constrained")
    titles = (f"wires {case.numerics.wires}", "screen", f"screen minus {case.numerics.wires}")
    ways = ("cividis", 0.0, most[0]), ("cividis", 0.0, most[0]), ("PuOr", -most[1], most[1])
    for axes, (is_shown, speed), title, (colors, low, high) in zip(
        figure.subplots(1, 3), parts, titles, ways, strict=True
    ):
        values = np.where(is_shown, 1e3 * speed, np.nan).reshape(x.shape)
        mesh = axes.pcolormesh(x, y, values, cmap=colors, vmin=low, vmax=high, rasterized=True)
        axes.set(title=title, aspect="equal", xlabel="along the artery, mm", ylabel="from the neck, mm")
        figure.colorbar(mesh, ax=axes, label="mm/s", shrink=0.8)
    figure.savefig(path, dpi=90)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("devices", nargs="*", default=["enterprise", "silk"])
    parser.add_argument("--vessel", choices=VESSELS, default="demo")
    parser.add_argument("--cell", type=float)
    parser.add_argument("--foam-cell", type=float, default=0.2)
    parser.add_argument("--across", type=float)
    parser.add_argument("-j", dest="processes", type=int, default=1)
    parser.add_argument("--cases", type=Path)
    parser.add_argument("--wires", choices=get_args(Wires))
    parser.add_argument("--picture", type=Path)
    given = parser.parse_args()
    make, kept_mm = VESSELS[given.vessel]
    if given.wires:
        domains.LEAST_ACROSS = given.across or domains.LEAST_ACROSS
        for _, case in cases(given.devices, make(), kept_mm).values():
            if not case.solids:
                continue
            found = computed(case, None, cell_size_mm=given.cell, wires=given.wires)[0]
            if given.picture:
                beside = computed(case, None, cell_size_mm=given.cell, wires="screen")[0]
                asked = replace(case, numerics=replace(case.numerics, wires=given.wires))
                picture(beside, found, asked, given.picture)
        raise SystemExit
    given.cell = given.cell or 0.125
    setup.ACROSS = given.across = given.across or setup.ACROSS
    rows = json.loads(TABLE.read_text()) if TABLE.exists() else {}
    foam = {"engine": OPENFOAM, "cell_size_mm": given.foam_cell, "processes": given.processes}
    bare: tuple[FlowField, dict[str, float]] | None = None
    for name, (whole_case, case) in cases(given.devices, make(), kept_mm).items():
        # The embedded engine takes its start for the bare flow; OpenFOAM begins from any in this vessel.
        embedded, screened = computed(case, bare[0] if bare else None, cell_size_mm=given.cell)
        folder = None if given.cases is None else given.cases / given.vessel / name
        meshed, resolved = computed(case, embedded, folder, **foam)
        if bare is None or case.sac is None:
            bare, bare_resolved = (embedded, screened), resolved
            continue
        left = {key: (screened[key] / bare[1][key], resolved[key] / bare_resolved[key]) for key in INDICES}
        rows[f"{given.vessel} {name}"] = {
            "screen": screened,
            "struts": resolved,
            "whole_screen": computed(whole_case, bare[0], cell_size_mm=given.cell)[1],
            "bare_embedded": bare[1],
            "bare_openfoam": bare_resolved,
            "left_with_screen": {key: round(one[0], 4) for key, one in left.items()},
            "left_with_struts": {key: round(one[1], 4) for key, one in left.items()},
            "alignment": alignment(embedded, meshed, case.sac),
            "cell_size_mm": given.cell,
            "openfoam_cell_size_mm": given.foam_cell,
            "openfoam_cells_across": given.across,
        }
        TABLE.write_text(json.dumps(rows, indent=2) + "\n")
    print("\n| | index | screen | struts | difference | left, screen | left, struts | whole screen to its part |")
    print(8 * "|---" + "|")
    for name, row in sorted(rows.items()):
        for key in row["screen"]:
            screen, struts = row["screen"][key], row["struts"][key]
            left = f"{row['left_with_screen'][key]:.3f} | {row['left_with_struts'][key]:.3f}"
            apart = f"{100 * (screen / struts - 1):+.1f} %"
            whole = f"{100 * (row['whole_screen'][key] / screen - 1):+.1f} %"
            print(f"| {name} | {key} | {screen:.4g} | {struts:.4g} | {apart} | {left} | {whole} |")
        print(f"| {name} | alignment | {row['alignment']:.3f} | | | | | |")
