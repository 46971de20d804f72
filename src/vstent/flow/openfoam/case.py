"""A flow case as OpenFOAM's case folder, in memory: relative path to text."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from vstent.errors import LandingError
from vstent.flow.openfoam import boundary, control, mesh, scripts
from vstent.flow.openfoam.patches import Patch, named_patches, stl_text
from vstent.flow.openfoam.setup import FoamSetup
from vstent.flow.types import FlowCase
from vstent.kernels.arrays import Floats
from vstent.stent import Stent
from vstent.surface import Surface
from vstent.units import M_PER_MM

STRUT_REACH_MM: Final = 1.0
"""Wires that come nearer to the neck than this are meshed."""
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


def wires_near(stent: Stent, ostium: Surface, reach_mm: float) -> Stent:
    """Return a stent of which only the pieces of wire are left that lie nearer to the ostium than `reach_mm`.

    Raises
    ------
    LandingError
        When none does.
    """
    wire = np.repeat(np.arange(len(stent.wire_starts) - 1), np.diff(stent.wire_starts))
    is_near = ostium.closest(stent.wire_points_mm)[1] < reach_mm
    first = is_near & ~np.r_[False, is_near[:-1] & (wire[1:] == wire[:-1])]
    piece, kept = np.cumsum(first) - 1, np.flatnonzero(is_near)
    kept = kept[np.bincount(piece[kept])[piece[kept]] > 1]  # a single point is no piece
    if not len(kept):
        raise _none_near(reach_mm)
    starts = np.r_[np.flatnonzero(np.r_[True, np.diff(piece[kept]) > 0]), len(kept)]
    return replace(
        stent,
        wire_points_mm=stent.wire_points_mm[kept],
        wire_starts=starts,
        wire_diameter_um=stent.wire_diameter_um[wire[kept[starts[:-1]]]],
    )


def struts_near(struts: Surface, ostium: Surface, reach_mm: float) -> Surface:
    """Return the solids that come nearer to the ostium than `reach_mm`, each whole: only they change what enters.

    Parameters
    ----------
    struts : closed solids that share no vertex with each other.

    Raises
    ------
    LandingError
        When none comes so near.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    a, b = struts.faces[:, [0, 1]].T
    b2, c = struts.faces[:, [1, 2]].T
    count = len(struts.vertices_mm)
    rows, columns = np.concatenate([a, b2]), np.concatenate([b, c])
    graph = coo_matrix((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(count, count))
    _, solid = connected_components(graph, directed=False)
    is_near = ostium.closest(struts.vertices_mm)[1] < reach_mm
    if not is_near.any():
        raise _none_near(reach_mm)
    chosen = np.isin(solid[struts.faces[:, 0]], np.unique(solid[is_near]))
    return Surface(struts.vertices_mm, struts.faces[chosen])


def _none_near(reach_mm: float) -> LandingError:
    return LandingError(
        f"no wire of the device lies within {reach_mm:g} mm of the neck, where OpenFOAM meshes its struts: land it "
        "across the neck, or leave it away"
    )
