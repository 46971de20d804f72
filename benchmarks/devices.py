"""Compare devices of the catalogue with published measurements; print the tables of the documentation.

Run from the repository: ``python benchmarks/devices.py``. Real arteries are taken from ``../shared/data`` where it
exists. Every row names who measured, what was measured, and what vstent computes for the same question. With
``--flow`` the flow into two sacs is computed with Enterprise too, in about three minutes.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import struts

from vstent.anatomy.repair import repair
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.deployment import cells
from vstent.deployment.coverage import coverage_fractions, pore_areas_mm2, quad_areas_mm2
from vstent.deployment.deploy import deploy
from vstent.deployment.measure import measure
from vstent.devices import catalogue, formulas
from vstent.devices.design import Size, angle_rad, piece_length_mm
from vstent.devices.stent import Deployment, Landing
from vstent.flow.problem import flow_case
from vstent.flow.settings import FlowSettings
from vstent.geometry.vessel import Anatomy, Vessel
from vstent.io.surfaces import read_surface
from vstent.phantoms import demo_phantom, phantom_surface
from vstent.units import MM_PER_UM

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))
from tubes import arc, line, tube

DATA = Path(__file__).parents[2] / "shared" / "data"
REAL = {"C0038": "aneurisk_C0038.vtp", "beta": "aneurisk_beta.vtp", "visc2011": "visc2011_metres.stl"}
BEND_MM = 7.0
BENDS_MM = (12.0, 9.0, 7.0, 5.0)
THIRD = np.arccos(1 / 3)
"""Angle from the outer side of a bend at which the outer third of the artery ends."""
LEAFLETS = (
    ("lvis", 4.5, {3.0: 57.0, 3.5: 52.0, 4.0: 44.0, 4.5: 32.0}, "instructions for use"),
    ("lvis_jr", 3.5, {2.5: 40.0, 3.0: 37.0, 3.5: 33.0}, "instructions for use"),
    ("neuroform_atlas", 4.0, {3.0: 30.8, 3.5: 30.4, 4.0: 29.2}, "instructions for use"),
    ("leo", 4.5, {4.5: 51.0, 5.4: 37.0}, "Balt catalogue 2020"),
    ("leo_baby", 2.5, {2.5: 35.0, 3.2: 23.0}, "Balt catalogue 2020"),
    ("silk_vista_baby", 2.75, {2.75: 26.5, 3.0: 18.5}, "Balt catalogue 2020"),
    ("silk", 3.0, {3.0: 30.0, 3.5: 19.0}, "Balt catalogue 2020, Silk+"),
    ("silk", 4.5, {4.5: 40.0, 5.0: 19.0}, "Balt catalogue 2020, Silk+"),
)
"""Device, label diameter, length in mm by diameter in mm, and where it is listed."""
Row = tuple[str, ...]
"""Cells of a table: mostly source and what it measured, published value, value of vstent."""


def size_of(key: str, diameter_mm: float, length_mm: float) -> Size:
    """A size of a device."""
    return catalogue.find_size(catalogue.find_design(key), diameter_mm=diameter_mm, length_mm=length_mm)


def in_tube(key: str, size: Size, diameter_mm: float, bend_mm: float | None = None) -> tuple[Anatomy, Deployment]:
    """A device deployed in a tube, straight or with a bend of 90 degrees in its middle."""
    path = line(60) if bend_mm is None else arc(bend_mm, np.pi / 2, 20)
    artery = tube(path, 0.5 * diameter_mm)
    return artery, deploy(
        catalogue.find_design(key), artery, size=size, landing=Landing(0.5 * float(artery.parent.axis.length_mm))
    )


def sides(artery: Anatomy, done: Deployment, bend_mm: float) -> tuple[float, float]:
    """Coverage on the outer and on the inner third of a bend."""
    stent = done.stent
    quads_mm = 0.25 * (stent.nodes_mm[1:] + stent.nodes_mm[:-1])
    quads_mm = quads_mm + np.roll(quads_mm, -1, axis=1)
    hidden, area_mm2 = coverage_fractions(stent), quad_areas_mm2(stent)
    is_bent = (quads_mm[..., 2] > 1) & (quads_mm[..., 0] < bend_mm - 1)
    aside_mm = np.hypot(quads_mm[..., 0] - bend_mm, quads_mm[..., 2]) - bend_mm
    reach_mm = float(stent.row_diameter_mm.mean()) / 6
    found = [
        np.average(hidden[one], weights=area_mm2[one])
        for one in (is_bent & (aside_mm > reach_mm), is_bent & (aside_mm < -reach_mm))
    ]
    return float(found[0]), float(found[1])


def outer_cell_mm2(done: Deployment, bend_mm: float | None) -> float:
    """Mean area of the cells on the outer third of a bend, or of all cells of a device in a straight tube."""
    area_mm2, middle_mm, number = pore_areas_mm2(done.stent)
    if bend_mm is not None:
        aside_mm = np.hypot(middle_mm[:, 0] - bend_mm, middle_mm[:, 2]) - bend_mm
        is_outer = aside_mm > float(done.stent.row_diameter_mm.mean()) / 6
        is_outer &= (middle_mm[:, 2] > 1) & (middle_mm[:, 0] < bend_mm - 1)
        area_mm2, number = area_mm2[is_outer], number[is_outer]
    return float(area_mm2.sum() / number.sum())


def pipeline() -> list[Row]:
    """Coverage and pore density of Pipeline at its label diameters."""
    design, found = catalogue.find_design("pipeline"), []
    for diameter_mm in (3.0, 4.0, 5.0):
        size = size_of("pipeline", diameter_mm, 20)
        artery, done = in_tube("pipeline", size, diameter_mm + 2 * design.wall_offset_um * MM_PER_UM)
        found.append(measure(artery, done))
    cover = [100 * float(one["metal_coverage_fraction"]) for one in found]
    pores = [float(one["pore_density_per_mm2"]) for one in found]
    listed = "3, 4 and 5 mm at their label diameters"
    return [
        (
            "Pipeline: porosity (Babiker et al. 2015, J Med Devices 9)",
            "65-70 %",
            f"{', '.join(f'{100 - one:.0f}' for one in cover)} % ({listed})",
        ),
        ("Pipeline: pores per mm² (same source)", "12.5-20", f"{', '.join(f'{one:.1f}' for one in pores)} ({listed})"),
    ]


def coils() -> list[Row]:
    """Coverage of stents for coils, and their order."""
    rows = []
    for key, name, told, size in (
        ("enterprise", "Enterprise", "5 % (others up to 10 %)", size_of("enterprise", 4.5, 22)),
        ("leo", "LEO", "14 %, the highest of four", size_of("leo", 4.5, 25)),
        ("lvis", "LVIS", "below 14 %", size_of("lvis", 4.5, 23)),
    ):
        design = catalogue.find_design(key)
        artery, done = in_tube(key, size, 4.5 + 2 * design.wall_offset_um * MM_PER_UM)
        cover = 100 * float(measure(artery, done)["metal_coverage_fraction"])
        free = 100 * float(formulas.coverage_fraction(design, size, size.free_diameter_mm))
        said = f"{cover:.1f} % at the label diameter, {free:.1f} % free"
        rows.append((f"{name}: coverage (Cho et al. 2017, Neurointervention 12:31)", told, said))
    order = {}
    for key, size in (
        ("enterprise", size_of("enterprise", 4.5, 22)),
        ("neuroform_atlas", size_of("neuroform_atlas", 4.5, 21)),
        ("leo", size_of("leo", 4.5, 25)),
    ):
        artery, done = in_tube(key, size, 4.0)
        order[key] = 100 * float(measure(artery, done)["metal_coverage_fraction"])
    told = " < ".join(f"{key} {value:.1f} %" for key, value in sorted(order.items(), key=lambda item: item[1]))
    rows.append(
        (
            "Order of coverage (Krischek et al. 2011, Minim Invasive Neurosurg 54:21; Neuroform3 there, Atlas here)",
            "Enterprise < Neuroform < LEO",
            f"{told} in a tube of 4 mm",
        )
    )
    margins = {key: catalogue.find_design(key).sizes[0] for key in ("leo", "lvis", "enterprise", "neuroform_atlas")}
    told = ", ".join(f"{key} {one.free_diameter_mm - one.diameter_mm:+.1f} mm" for key, one in margins.items())
    rows.append(
        ("Free diameter minus label of LEO, LVIS, Enterprise, Neuroform (Cho et al. 2017)", "above 0 for all", told)
    )
    return rows


def bends() -> list[Row]:
    """Gaps and coverage in a bend."""
    size = size_of("enterprise", 4.5, 22)
    artery, done = in_tube("enterprise", size, 3.5, BEND_MM)
    nodes_mm = done.stent.nodes_mm
    aside_mm = np.hypot(nodes_mm[..., 0] - BEND_MM, nodes_mm[..., 2]) - BEND_MM
    is_bent = (nodes_mm[..., 2] > 0) & (nodes_mm[..., 0] < BEND_MM)
    outer = done.wall_gap_mm[is_bent & (aside_mm > 0)].max()
    inner = done.wall_gap_mm[is_bent & (aside_mm < 0)].max()
    rows = [
        (
            "Enterprise 4.5 x 22 in a tube of 3.5 mm with a bend of 7 mm radius: gap (flat-panel CT, PMC3212648)",
            "crescent on the outer side when unsheathed, on the inner side when pushed",
            f"outer side up to {outer:.2f} mm, inner side up to {inner:.2f} mm",
        )
    ]
    tubes = (None, *BENDS_MM)
    open_cells = [in_tube("neuroform_atlas", size_of("neuroform_atlas", 4.5, 21), 4.0, one)[1] for one in tubes]
    closed_cells = [in_tube("enterprise", size, 4.0, one)[1] for one in tubes]
    gaps_mm = [float(done.wall_gap_mm.max()) for done in closed_cells]
    where = f"straight and in bends of {', '.join(f'{one:g}' for one in BENDS_MM)} mm, tube of 4 mm"
    told = [
        ", ".join(f"{outer_cell_mm2(done, one):.1f}" for done, one in zip(devices, tubes, strict=True))
        for devices in (open_cells, closed_cells)
    ]
    rows.append(
        (
            "Neuroform and Enterprise in ever tighter bends (flat-panel CT, Ebrahimi et al. 2007, PMC8134344)",
            "Neuroform: cells grow. Enterprise: flattens and kinks",
            f"mean cell on the outer side of Neuroform Atlas {told[0]} mm², of Enterprise {told[1]} mm², "
            f"gap of Enterprise {', '.join(f'{one:.2f}' for one in gaps_mm)} mm ({where})",
        )
    )
    told = {}
    for key, size in (
        ("lvis", size_of("lvis", 4.5, 23)),
        ("fred", size_of("fred", 4.5, 18)),
        ("pipeline", size_of("pipeline", 4.0, 20)),
    ):
        artery, done = in_tube(key, size, 3.8, BEND_MM)
        told[key] = sides(artery, done, BEND_MM)
    rows.append(
        (
            "LVIS on the inner side and FRED on the outer side of a bend (Matsuda et al. 2017, JNIS; LVIS Blue there)",
            "similar coverage",
            f"LVIS inner {100 * told['lvis'][1]:.0f} %, FRED outer {100 * told['fred'][0]:.0f} % "
            f"(bend of {BEND_MM:g} mm, artery of 3.8 mm)",
        )
    )
    rows.append(
        (
            "Pipeline in a bend: outer and inner side (Shapiro et al. 2014, AJNR 35:727; Makoyeva et al. 2013, "
            "AJNR 34:596; Asztalos et al. 2017, J Biomed Eng Biosci 4:19)",
            "less metal outside, more inside, by simple geometric rules; no numbers read",
            f"outer {100 * told['pipeline'][0]:.0f} %, inner {100 * told['pipeline'][1]:.0f} %",
        )
    )
    return rows


def enterprise() -> list[Row]:
    """Coverage of Enterprise: free, in a straight tube of 4 mm and in bends, beside that of cells with rigid struts."""
    design, size = catalogue.find_design("enterprise"), size_of("enterprise", 4.5, 22)
    free = 100 * formulas.coverage_fraction(design, size, size.free_diameter_mm)
    artery, done = in_tube("enterprise", size, 4.0)
    straight = 100 * float(measure(artery, done)["metal_coverage_fraction"])
    rows = [("free", f"{free:.1f}", "", "", "", ""), ("straight tube", f"{straight:.1f}", "", "", "", "")]
    length_mm, diameter_mm = piece_length_mm(design, size), 4.0 - 2 * design.wall_offset_um * MM_PER_UM
    for bend_mm in BENDS_MM:
        artery, done = in_tube("enterprise", size, 4.0, bend_mm)
        spacing_mm = formulas.row_spacing_mm(design, size, diameter_mm, 1 / bend_mm)
        net = []
        for first, last in ((0.0, THIRD), (np.pi - THIRD, np.pi)):
            apart = 1 + 0.5 * diameter_mm / bend_mm * np.cos(np.linspace(first, last, 101))
            turned = 2 * np.arccos(apart * spacing_mm / length_mm)  # twice the angle between strut and axis
            net.append(np.average(2 * design.strut_width_um * MM_PER_UM / length_mm / np.sin(turned), weights=apart))
        values = [float(measure(artery, done)["metal_coverage_fraction"]), *sides(artery, done, bend_mm), *net]
        rows.append((f"bend of {bend_mm:g} mm radius", *(f"{100 * one:.1f}" for one in values)))
    return rows


def over_neck() -> list[Row]:
    """Coverage of Enterprise over the neck of the demo, and what it depends on."""
    anatomy = restore(trim(trace(Vessel(phantom_surface(demo_phantom(), edge_mm=0.2)))))
    design = catalogue.find_design("enterprise")

    def covered(method: str = "constant_wire", **changes: float) -> str:
        measures = measure(anatomy, deploy(replace(design, **changes), anatomy, method=method))
        return f"{100 * float(measures['neck_metal_coverage_fraction']):.1f}"

    done = deploy(design, anatomy)
    straight = formulas.coverage_fraction(design, done.stent.size, float(done.stent.row_diameter_mm.mean()))
    rows = [("none", covered()), ("straight artery of the same diameter", f"{100 * straight:.1f}")]
    rows.append(("struts of 60 µm instead of 78 µm", covered(strut_width_um=60)))
    rows.append(("10 or 14 instead of 12 struts around", f"{covered(n_columns=10)}, {covered(n_columns=14)}"))
    angles = ", ".join(covered(cell_angle_rad=float(np.deg2rad(one))) for one in (30, 40))
    rows.append(("cell angle of 30 or 40 degrees instead of 35", angles))
    bending, found = cells.BENDING, []
    for share in (0.25, 0.5, 2.0):
        cells.BENDING = share * bending
        found.append(covered())
    cells.BENDING = bending
    rows.append(("a quarter, half or twice the weight of bending", ", ".join(found)))
    rows.append(('struts free to stretch (``method="zhong2016"``)', covered("zhong2016")))
    return rows


def flows() -> list[Row]:
    """Flow into the sacs of the demo and the arc with Enterprise, its struts as cut or free to stretch."""
    design, rows = catalogue.find_design("enterprise"), []
    for vessel, methods in (("demo", ("constant_wire", "zhong2016")), ("arc", ("constant_wire",))):
        whole = trace(Vessel(phantom_surface(struts.VESSELS[vessel](), edge_mm=0.2)))
        anatomy = restore(trim(whole))
        short = trim(whole, upstream_mm=struts.KEPT_MM, downstream_mm=struts.KEPT_MM)
        settings = FlowSettings(inflow_mL_s=flow_case(anatomy, ()).inflow_mL_s)
        start, bare = struts.computed(replace(flow_case(anatomy, (), settings), vessel=short), None, cell_size_mm=0.16)
        for method in methods:
            done = deploy(design, anatomy, method=method)
            case = replace(flow_case(anatomy, (done.stent,), settings), vessel=short)
            found = struts.computed(case, start, cell_size_mm=0.16)[1]
            covered = 100 * float(measure(anatomy, done)["neck_metal_coverage_fraction"])
            changes = (100 * (found[key] / bare[key] - 1) for key in struts.INDICES[:2])
            rows.append((f"{vessel}, {method}", f"{covered:.1f}", *(f"{one:+.0f}" for one in changes)))
    return rows


def shortening() -> list[Row]:
    """Lengths at several diameters, as makers list them, against those of the catalogue's angles."""
    rows = []
    for key, label_mm, published_mm, source in LEAFLETS:
        design = catalogue.find_design(key)
        size = catalogue.find_sizes(design, diameter_mm=label_mm)[0]
        widths_mm = np.array(list(published_mm))
        listed_mm = np.array(list(published_mm.values()))
        spacing_mm = formulas.row_spacing_mm(design, size, widths_mm)
        ours_mm = listed_mm[0] * spacing_mm / spacing_mm[0]
        at = ", ".join(f"{one:g}" for one in widths_mm)
        rows.append(
            (
                f"{design.name} {label_mm:g} mm: length in mm at {at} mm ({source})",
                ", ".join(f"{one:g}" for one in listed_mm),
                ", ".join(f"{one:.1f}" for one in ours_mm) + " from the first length on",
            )
        )
    return rows


def leaflets() -> list[Row]:
    """Coverage, porosity and foreshortening that makers state."""
    rows = []
    for key, label_mm, told in (
        ("lvis", 4.5, "23-27 % (free area 73-77 %)"),
        ("lvis_jr", 3.5, "17 % (free area 83 %)"),
        ("pipeline", 4.0, "approximately 30 %"),
        ("derivo", 4.0, "35 % (porosity 65 %, 15 pores/mm²)"),
    ):
        design = catalogue.find_design(key)
        size = catalogue.find_sizes(design, diameter_mm=label_mm)[0]
        cover = 100 * float(formulas.coverage_fraction(design, size, label_mm))
        pores = float(formulas.pore_density_per_mm2(design, size, label_mm))
        rows.append(
            (
                f"{design.name}: coverage stated by the maker, label {label_mm:g} mm",
                told,
                f"{cover:.0f} %, {pores:.1f} pores/mm² at the label diameter",
            )
        )
    for key, told in (("pipeline", "50-60 %"), ("fred", "up to 60 %")):
        design = catalogue.find_design(key)
        size = catalogue.find_sizes(design, diameter_mm=4.0)[0]
        lost = 100 * (1 - float(np.cos(angle_rad(design, size, 4.0))))
        rows.append((f"{design.name}: foreshortening from catheter to artery", told, f"{lost:.0f} % (label 4 mm)"))
    return rows


def lengths() -> list[Row]:
    """Foreshortening: change of length with radius, and label against deployed length."""
    design, size = catalogue.find_design("pipeline"), size_of("pipeline", 4.0, 20)
    slopes = {d: -(float(np.tan(angle_rad(design, size, d))) ** 2) for d in (4.0, 3.75, 3.5, 3.25)}
    rows = [
        (
            "Pipeline: change of length for a change of radius, d ln L / d ln R (Bouillot et al. 2016, AJNR 37:2079)",
            "-2.2 (13 % too long at a radius 6 % too small), -1.8 (9 % too short at a radius 5 % too large)",
            ", ".join(f"{slope:.1f} at {d:g} mm" for d, slope in slopes.items()) + " (label 4 mm)",
        )
    ]
    ratios = []
    for name, file in REAL.items():
        if not (DATA / file).is_file():
            continue
        anatomy = restore(trim(trace(Vessel(repair(read_surface(DATA / file)[0])[0]))))
        done = deploy(catalogue.find_design("pipeline_vantage"), anatomy)
        label_mm, length_mm = done.stent.size.length_mm, done.stent.deployed_length_mm
        ratios.append((name, 100 * (1 - abs(label_mm - length_mm) / length_mm), length_mm / label_mm))
    if ratios:
        told = ", ".join(f"{name} {one:.0f} %" for name, one, _ in ratios)
        rows.append(
            (
                "Pipeline Vantage: accuracy of the label length (Sanders et al. 2025, Interv Neuroradiol, PMC12286983)",
                "78.7 ± 12.4 % of the length after implantation (planner Ankyras: 92.1 ± 4.9 %)",
                f"{told} of the length that vstent computes for the proposed size",
            )
        )
    return rows


def show(widths: str, rows: list[Row]) -> None:
    """Print a table."""
    print(f".. list-table::\n   :header-rows: 1\n   :widths: {widths}\n")
    for row in rows:
        for k, cell in enumerate(row):
            print(f"   {'*' if k == 0 else ' '} - {cell}".rstrip())
    print()


def main() -> None:
    """Print the tables."""
    rows = [*pipeline(), *coils(), *bends(), *leaflets(), *shortening(), *lengths()]
    show("44 24 32", [("measured by others", "published", "vstent"), *rows])
    names = ("Enterprise", "whole device, %", "outer third, %", "inner third, %", "net, outer, %", "net, inner, %")
    show("30 14 14 14 14 14", [names, *enterprise()])
    show("60 20", [("change", "metal over the neck of the demo, %"), *over_neck()])
    if "--flow" in sys.argv[1:]:
        names = ("vessel and method", "metal over the neck, %", "neck inflow, %", "mean sac velocity, %")
        show("34 22 22 22", [names, *flows()])


if __name__ == "__main__":
    main()
