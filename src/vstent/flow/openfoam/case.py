"""Build an OpenFOAM case folder in memory: the text of every file by its relative path."""

from dataclasses import dataclass, replace
from importlib import resources
from string import Template
from typing import Final

import numpy as np

from vstent.devices.stent import Coils
from vstent.errors import FlowError, LandingError
from vstent.flow.case import FlowCase
from vstent.flow.openfoam import control, mesh
from vstent.flow.openfoam.boundary import boundary_files
from vstent.flow.openfoam.patches import named_patches, stl_text
from vstent.flow.openfoam.porous import porous_files, regions
from vstent.flow.openfoam.setup import FoamSetup
from vstent.geometry.surface import Surface
from vstent.units import M_PER_MM

SCRIPTS: Final = ("Allrun", "Allclean", "submit.slurm")
"""Scripts of a case; their texts and that of its README are in the folder ``exported``."""


RESISTING_NOTE: Final = """\
The outlets have resistances, but this case imposes flows: constant/flow_outlet_2, ... hold those without a device,
and outlet_1 takes the rest. A device changes them: Q = (P + p) / R with the mean pressure p of an outlet in Pa, and P
such that as much leaves as enters. vstent run --engine openfoam adjusts these files between its checks. ./Allrun does
not: with a device, correct them by this formula. R in Pa s/mL: $resistances.
"""
"""What the README says of resistances: OpenFOAM itself would need a compiler for them."""


@dataclass(frozen=True, eq=False)
class FoamCase:
    """The files of an OpenFOAM case."""

    files: dict[str, str]
    """Text of every file by its path relative to the case folder."""
    application: str
    """Name of the solver program."""


def strut_solids(case: FlowCase) -> Surface | None:
    """Return the solids of a case's wires, or None where it has none but coils, which are porous zones.

    A device without wires over an ostium is refused.
    """
    case = replace(case, solids=tuple(one for one in case.solids if not isinstance(one, Coils)))
    if not case.solids and len(regions(case)) == len(case.media):
        return None
    if not case.solids:
        raise FlowError(
            "the engine openfoam does not support the screen model of a stent: give the stent itself, whose struts are "
            "meshed, or choose the embedded engine"
        )
    if case.wires is None:
        raise LandingError(
            "no wire of the device is over a neck or a branch's ostium, the only places where OpenFOAM meshes struts: "
            "move the landing zone across one, or compute without the device"
        )
    return case.wires


def foam_case(case: FlowCase, setup: FoamSetup) -> FoamCase:
    """Build a case that OpenFOAM meshes and computes: steady, or transient if the case has a waveform.

    Of the media only regions resist, in porous zones, because OpenFOAM meshes the struts of the setup.
    """
    patches, sections = named_patches(case)
    vertices_mm, dialect, is_steady = patches[0].surface.vertices_mm, setup.dialect, case.waveform is None
    kinds = {one.name: "wall" if one.name in ("wall", "sac") else "patch" for one in patches}
    walls = [name for name, kind in kinds.items() if kind == "wall"]
    corners_mm = {one.name: one.corners_mm for one in patches}
    surfaces = {
        mesh.LUMEN: corners_mm,
        mesh.ENDS: {opening.role: corners_mm[opening.role] for opening in case.vessel.openings},
    }
    if case.ostium is not None:
        surfaces[mesh.NECK] = {mesh.NECK: case.ostium.corners_mm}
    if setup.struts is not None:
        surfaces[mesh.STRUTS] = {mesh.STRUTS: setup.struts.corners_mm}
        walls.append(mesh.STRUTS)
    porous, around = porous_files(case, setup)
    surfaces |= around
    application = dialect.application(is_steady=is_steady)["application"]
    before, solve, after = "", application, ""
    if setup.processes > 1:
        before = "[ -d processor0 ] || decomposePar > log.decomposePar 2>&1\n"
        solve = f"mpirun -np {setup.processes} {application} -parallel"
        after = "reconstructPar -latestTime > log.reconstructPar 2>&1\n"
    named = zip(case.vessel.outlets, case.resistances, strict=False)
    resistances = ", ".join(f"{outlet.role} {end.at(0.0):.4g}" for outlet, end in named)
    values = {
        "before": before,
        "solve": solve,
        "after": after,
        "application": application,
        "features": dialect.features,
        "processes": setup.processes,
        "sac": ", sac" if "sac" in kinds else "",
        "inlets": ", ".join(inlet.role for inlet in case.vessel.inlets),
        "density": f"{case.blood.density_kg_m3:.6g}",
        "inflow": f"{case.inflow_mL_s:.6g}",
        "resisting": Template(RESISTING_NOTE).substitute(resistances=resistances) if case.resistances else "",
        "zones": "    topoSet > log.topoSet 2>&1\n" if porous else "",
    }
    texts = {
        name: (resources.files(__package__) / "exported" / name).read_text(encoding="utf-8")
        for name in ("README", *SCRIPTS)
    }
    files = {
        "system/controlDict": control.control(case, setup, walls),
        "system/fvSchemes": control.schemes(is_steady=is_steady),
        "system/fvSolution": control.solution(),
        "system/decomposeParDict": control.decomposition(setup.processes, np.ptp(vertices_mm, axis=0)),
        "system/blockMeshDict": mesh.block_mesh(vertices_mm, setup.cell_size_mm),
        f"system/{dialect.features}Dict": dialect.rims(f"{mesh.ENDS}.stl"),
        "system/snappyHexMeshDict": mesh.snappy(case, setup, kinds, sections),
        **porous,
        **{name: Template(text).safe_substitute(values) for name, text in texts.items()},
        "vstent.foam": "",
        **boundary_files(case, setup, sections, walls),
    }
    files |= {f"constant/{name}": text for name, text in control.fluid(case.blood, setup).items()}
    files |= {f"{dialect.surfaces}/{name}.stl": stl_text(solids, M_PER_MM) for name, solids in surfaces.items()}
    return FoamCase(files, application)
