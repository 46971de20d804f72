"""A flow case as OpenFOAM's case folder, in memory: relative path to text."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from vstent.deployment.struts import struts
from vstent.errors import FlowError, LandingError
from vstent.flow.case import FlowCase
from vstent.flow.openfoam import boundary, control, mesh, scripts
from vstent.flow.openfoam.patches import Patch, named_patches, stl_text
from vstent.flow.openfoam.setup import FoamSetup
from vstent.geometry.surface import Surface
from vstent.kernels.arrays import Floats
from vstent.units import M_PER_MM

README: Final = """\
OpenFOAM case written by vstent (research use only). Lengths are metres: the vessel's millimetres, LPS, times 0.001.

  ./Allrun             mesh and compute here; given again it goes on from the last time written
  sbatch submit.slurm  the same on a cluster
  ./Allclean           back to what was exported

Patches: wall{sac}, {inlets}, outlet_1, ... (from the widest to the narrowest), each outlet at the end of a straight
extension. p is pressure over density ({density:.6g} kg/m3). wallShearStress is what the wall does to the blood, over
density: the wall's own stress is its negative times the density.
Mean inflow: {inflow:.6g} mL/s.
"""


@dataclass(frozen=True, eq=False)
class FoamCase:
    """The files of a case and the names in them."""

    files: dict[str, str]
    """Text by path relative to the case folder; those of `executable` are scripts."""
    executable: tuple[str, ...]
    """Paths of the scripts."""
    application: str
    """The solver's program."""


def strut_solids(case: FlowCase) -> Surface | None:
    """Return the solids of a case's wires, or None where there is no device.

    Raises
    ------
    FlowError
        When there is a screen, and no wires for it.
    LandingError
        When no wire lies where blood passes it.
    """
    if case.stent is None and case.screen is None:
        return None
    if case.stent is None:
        raise FlowError(
            "OpenFOAM's porous zones have the same resistance in every cell, which a screen has not: give the "
            "stent, whose wires are meshed, or use the embedded engine"
        )
    if not len(case.stent.wire_points_mm):
        raise LandingError(
            "no wire of the device is over a neck or a branch ostium, where OpenFOAM meshes wires: move it "
            "across one, or compute without it"
        )
    return struts(case.stent)


def foam_case(case: FlowCase, setup: FoamSetup) -> FoamCase:
    """Write a case that OpenFOAM meshes and computes: steady, or transient where the case has a waveform.

    Parameters
    ----------
    case : lumen, sac, ostium, blood, inflow; a screen is left out, for OpenFOAM meshes struts instead.
    setup : mesh, machine, dialect, struts.

    Raises
    ------
    FlowError
        When an opening has no open end of the lumen.
    """
    patches, sections = named_patches(case)
    kinds = {one.name: "wall" if one.name in ("wall", "sac") else "patch" for one in patches}
    walls = [name for name, kind in kinds.items() if kind == "wall"]
    if setup.struts is not None:
        walls.append(mesh.STRUTS)
    application = _application(case, setup)
    files = _system(case, setup, patches, walls, sections)
    features, text = mesh.feature_extract(setup)
    files |= {
        f"system/{features}": text,
        "system/snappyHexMeshDict": mesh.snappy(
            setup, kinds, _ends(case, sections), _inside_mm(case, sections), has_neck=case.ostium is not None
        ),
        "0/U": boundary.velocity(case, setup, walls),
        "0/p": boundary.pressure(case, walls),
        "Allrun": scripts.all_run(setup, application),
        "Allclean": scripts.all_clean(),
        "submit.slurm": scripts.slurm(setup),
        "README": README.format(
            sac=", sac" if "sac" in kinds else "",
            inlets=", ".join(inlet.role for inlet in case.vessel.inlets),
            density=case.blood.density_kg_m3,
            inflow=case.inflow_mL_s,
        ),
        "vstent.foam": "",
    }
    files |= {f"constant/{name}": text for name, text in control.fluid(case.blood, setup).items()}
    folder = "constant/geometry" if setup.flavour == "org" else "constant/triSurface"
    files |= {f"{folder}/{name}.stl": text for name, text in _surfaces(case, setup, patches).items()}
    if setup.flavour == "com":
        files |= {f"constant/{name}": text for name, text in boundary.tables(case).items()}
        files |= {f"constant/{name}": text for name, text in boundary.inlet_profiles(case, sections).items()}
    return FoamCase(files, ("Allrun", "Allclean", "submit.slurm"), application)


def _ends(case: FlowCase, sections: tuple[Floats, ...]) -> dict[str, mesh.End]:
    """Where the patches of the openings lie: the extension, and as much of the vessel as the opening is wide."""
    ends = {}
    for one, section in zip(case.vessel.openings, sections, strict=True):
        end_mm = section.mean(axis=0)
        along = (end_mm - one.center_mm) / np.linalg.norm(end_mm - one.center_mm)
        ends[one.role] = mesh.End(one.center_mm - one.diameter_mm * along, end_mm, one.diameter_mm)
    return ends


def _application(case: FlowCase, setup: FoamSetup) -> str:
    if setup.flavour == "org":
        return "foamRun"
    return "simpleFoam" if case.settings.waveform is None else "pimpleFoam"


def _system(
    case: FlowCase, setup: FoamSetup, patches: tuple[Patch, ...], walls: list[str], sections: tuple[Floats, ...]
) -> dict[str, str]:
    is_steady = case.settings.waveform is None
    step_s = 0.2 * setup.cell_size_mm * M_PER_MM / (2 * float(case.inlet_speeds_m_s.max()))
    return {
        "system/controlDict": control.control(case, setup, step_s, walls=walls, has_neck=case.ostium is not None),
        "system/fvSchemes": control.schemes(is_steady=is_steady),
        "system/fvSolution": control.solution(),
        "system/decomposeParDict": control.decomposition(setup, np.ptp(patches[0].surface.vertices_mm, axis=0)),
        "system/blockMeshDict": mesh.block_mesh(patches[0].surface.vertices_mm, setup.cell_size_mm),
    }


def _surfaces(case: FlowCase, setup: FoamSetup, patches: tuple[Patch, ...]) -> dict[str, str]:
    openings = [opening.role for opening in case.vessel.openings]
    corners = {one.name: one.corners_mm for one in patches}
    surfaces = {mesh.LUMEN: corners, mesh.ENDS: {name: corners[name] for name in openings}}
    if case.ostium is not None:
        surfaces[mesh.NECK] = {mesh.NECK: case.ostium.corners_mm}
    if setup.struts is not None:
        surfaces[mesh.STRUTS] = {mesh.STRUTS: setup.struts.corners_mm}
    return {name: stl_text(solids, M_PER_MM) for name, solids in surfaces.items()}


def _inside_mm(case: FlowCase, sections: tuple[Floats, ...]) -> Floats:
    """A point in the inlet's straight extension, off every plane of the grid."""
    inlet = case.vessel.inlet
    return np.asarray(sections[0].mean(axis=0) - inlet.normal * 0.1137 * inlet.diameter_mm)
