"""Build an OpenFOAM case folder in memory: the text of every file by its relative path."""

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
OpenFOAM case written by vstent (research use only). Lengths are in m, in the vessel's LPS axes.

  ./Allrun             mesh and compute on this machine; run it again to resume from the last time written
  sbatch submit.slurm  the same on a cluster
  ./Allclean           delete all results and restore the case as exported

Patches: wall{sac}, {inlets}, outlet_1, ... (from the widest to the narrowest), each outlet at the end of a straight
extension. p is pressure divided by density ({density:.6g} kg/m3). wallShearStress is the traction of the wall on the
blood, divided by density: multiply it by minus the density to obtain the wall shear stress.
Mean inflow: {inflow:.6g} mL/s.
"""
"""README file of a case."""


@dataclass(frozen=True, eq=False)
class FoamCase:
    """The files of an OpenFOAM case."""

    files: dict[str, str]
    """Text of every file by its path relative to the case folder."""
    executable: tuple[str, ...]
    """Paths of the files that are scripts."""
    application: str
    """Name of the solver program."""


def strut_solids(case: FlowCase) -> Surface | None:
    """Return the solids of a case's wires, or None without a device.

    Raises
    ------
    FlowError
        The case has media but no wires.
    LandingError
        No wire is over a neck or a branch's ostium.
    """
    if not case.solids and not case.media:
        return None
    if not case.solids:
        raise FlowError(
            "the engine openfoam does not support the screen model of a stent: give the stent itself, whose struts are "
            "meshed, or choose the embedded engine"
        )
    solids = [struts(one) for one in case.solids if len(one.wire_points_mm)]
    if not solids:
        raise LandingError(
            "no wire of the device is over a neck or a branch's ostium, the only places where OpenFOAM meshes struts: "
            "move the landing zone across one, or compute without the device"
        )
    before = np.cumsum([0, *(len(one.vertices_mm) for one in solids)])
    faces = [one.faces + first for one, first in zip(solids, before[:-1], strict=True)]
    return Surface(np.concatenate([one.vertices_mm for one in solids]), np.concatenate(faces))


def foam_case(case: FlowCase, setup: FoamSetup) -> FoamCase:
    """Build a case that OpenFOAM meshes and computes: steady, or transient if the case has a waveform.

    Parameters
    ----------
    case : the flow. Media are ignored, because OpenFOAM meshes struts instead.
    setup : mesh, parallel processes, OpenFOAM flavour and struts.

    Raises
    ------
    FlowError
        An opening does not match any open end of the lumen.
    """
    patches, sections = named_patches(case)
    kinds = {one.name: "wall" if one.name in ("wall", "sac") else "patch" for one in patches}
    walls = [name for name, kind in kinds.items() if kind == "wall"]
    if setup.struts is not None:
        walls.append(mesh.STRUTS)
    application, of_openings = _application(case, setup), boundary.conditions(case, setup, sections)
    files = _system(case, setup, patches, walls, sections)
    features, text = mesh.feature_extract(setup)
    files |= {
        f"system/{features}": text,
        "system/snappyHexMeshDict": mesh.snappy(
            setup, kinds, _ends(case, sections), _inside_mm(case, sections), has_neck=case.ostium is not None
        ),
        "0/U": boundary.velocity(of_openings, walls),
        "0/p": boundary.pressure(of_openings, walls),
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
    files |= {f"constant/{name}": text for one in of_openings.values() for name, text in one.files.items()}
    return FoamCase(files, ("Allrun", "Allclean", "submit.slurm"), application)


def _ends(case: FlowCase, sections: tuple[Floats, ...]) -> dict[str, mesh.End]:
    """Return where each opening's patch is: its extension, and one diameter of the vessel before it."""
    ends = {}
    for one, section in zip(case.vessel.openings, sections, strict=True):
        end_mm = section.mean(axis=0)
        along = (end_mm - one.center_mm) / np.linalg.norm(end_mm - one.center_mm)
        ends[one.role] = mesh.End(one.center_mm - one.diameter_mm * along, end_mm, one.diameter_mm)
    return ends


def _application(case: FlowCase, setup: FoamSetup) -> str:
    """Return the name of the solver program."""
    if setup.flavour == "org":
        return "foamRun"
    return "simpleFoam" if case.waveform is None else "pimpleFoam"


def _system(
    case: FlowCase, setup: FoamSetup, patches: tuple[Patch, ...], walls: list[str], sections: tuple[Floats, ...]
) -> dict[str, str]:
    """Return the files in the folder system/."""
    is_steady = case.waveform is None
    step_s = 0.2 * setup.cell_size_mm * M_PER_MM / (2 * float(case.inlet_speeds_m_s.max()))
    return {
        "system/controlDict": control.control(case, setup, step_s, walls=walls, has_neck=case.ostium is not None),
        "system/fvSchemes": control.schemes(is_steady=is_steady),
        "system/fvSolution": control.solution(),
        "system/decomposeParDict": control.decomposition(setup, np.ptp(patches[0].surface.vertices_mm, axis=0)),
        "system/blockMeshDict": mesh.block_mesh(patches[0].surface.vertices_mm, setup.cell_size_mm),
    }


def _surfaces(case: FlowCase, setup: FoamSetup, patches: tuple[Patch, ...]) -> dict[str, str]:
    """Return the STL files of the case's surfaces."""
    openings = [opening.role for opening in case.vessel.openings]
    corners = {one.name: one.corners_mm for one in patches}
    surfaces = {mesh.LUMEN: corners, mesh.ENDS: {name: corners[name] for name in openings}}
    if case.ostium is not None:
        surfaces[mesh.NECK] = {mesh.NECK: case.ostium.corners_mm}
    if setup.struts is not None:
        surfaces[mesh.STRUTS] = {mesh.STRUTS: setup.struts.corners_mm}
    return {name: stl_text(solids, M_PER_MM) for name, solids in surfaces.items()}


def _inside_mm(case: FlowCase, sections: tuple[Floats, ...]) -> Floats:
    """Return a point in the inlet's straight extension that is not on a plane of the background grid."""
    inlet = case.vessel.inlet
    return np.asarray(sections[0].mean(axis=0) - inlet.normal * 0.1137 * inlet.diameter_mm)
