"""Steady flow through a round tube with one sudden step, by OpenFOAM in a wedge: what a round jet is without a lean."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import LinearNDInterpolator

from vstent.flow.openfoam import program, results
from vstent.flow.openfoam.dictionary import foam_file
from vstent.flow.settings import Blood
from vstent.io.writers import write_text
from vstent.units import M3_PER_ML, M_PER_MM

HALF_ANGLE = np.radians(1.0)
ITERATIONS = 8000

Point = tuple[float, float]


def axial_speed(
    folder: Path, narrowing: list[Point], wide: Point, inflow_mL_s: float, blood: Blood, edge_mm: float
) -> LinearNDInterpolator:
    """Axial speed (m/s) by (z, r) in mm, of laminar flow that enters developed.

    Parameters
    ----------
    folder : for OpenFOAM's case.
    narrowing : (z, r) of the wall before the step, mm.
    wide : z of the end and radius behind the step, mm.
    edge_mm : of a cell along r, in the narrowest part; half of it along z.
    """
    across = round(narrowing[-1][1] / edge_mm)
    files = {"system/blockMeshDict": _mesh(narrowing, wide, edge_mm, across), **_fluid(blood), **_solver()}
    for name, entries in files.items():
        write_text(folder / name, foam_file(Path(name).name, entries))
    for name, (kind, entries) in _fields(narrowing[0][1], across, inflow_mL_s).items():
        write_text(folder / "0" / name, foam_file(name, entries, kind=kind))
    found = program.find()
    for words in (["blockMesh"], ["postProcess", "-func", "writeCellCentres", "-time", "0"], ["simpleFoam"]):
        program.run(found, folder, words)
    z, r, _ = results.read_field(folder, "0", "C").inside.T / M_PER_MM
    speed, before = (
        results.read_field(folder, time, "U").inside[:, 0] for time in (str(ITERATIONS), str(ITERATIONS // 2))
    )
    assert np.abs(speed - before).max() < 2e-3 * speed.max()
    return LinearNDInterpolator(np.column_stack([np.r_[z, z], np.r_[r, -r]]), np.r_[speed, speed])


def _mesh(narrowing: list[Point], wide: Point, edge_mm: float, across: int) -> dict[str, Any]:
    """Blocks of cells along the axis, x, and the radius, y: one after another before the step, two behind it."""
    vertices: list[tuple[float, float, float]] = []

    def rim(x: float, y: float) -> tuple[int, int]:
        sides = [(x, y * np.cos(HALF_ANGLE), side * y * np.sin(HALF_ANGLE)) for side in (-1, 1)]
        vertices.extend(sides)
        return len(vertices) - 2, len(vertices) - 1

    (step_mm, radius_mm), (end_mm, wide_mm) = narrowing[-1], wide
    places = [*narrowing, (end_mm, radius_mm)]
    rims = [rim(*place) for place in places]
    vertices += [(x, 0.0, 0.0) for x, _ in places]
    axis = range(len(vertices) - len(places), len(vertices))
    counts = [max(1, round(2 * (b - a) / edge_mm)) for (a, _), (b, _) in pairwise(places)]
    pieces = list(zip(pairwise(axis), pairwise(rims), strict=True))
    blocks = [
        ((a, b, bm, am, a, b, bp, ap), n, across)
        for ((a, b), ((am, ap), (bm, bp))), n in zip(pieces, counts, strict=True)
    ]
    (am, ap), (bm, bp) = rims[-2:]
    (cm, cp), (dm, dp) = rim(step_mm, wide_mm), rim(end_mm, wide_mm)
    blocks.append(((am, bm, dm, cm, ap, bp, dp, cp), counts[-1], round((wide_mm - radius_mm) / edge_mm)))
    walls = [(m, n, q, p) for _, ((m, p), (n, q)) in pieces[:-1]]
    patches = {
        "inlet": ("patch", [(axis[0], *rims[0], axis[0])]),
        "outlet": ("patch", [(axis[-1], bm, bp, axis[-1]), (bm, dm, dp, bp)]),
        "walls": ("wall", [*walls, (cm, dm, dp, cp), (am, cm, cp, ap)]),
        "front": ("wedge", [corners[:4] for corners, _, _ in blocks]),
        "back": ("wedge", [corners[4:] for corners, _, _ in blocks]),
        "axis": ("empty", [(a, b, b, a) for (a, b), _ in pieces]),
    }
    return {
        "convertToMeters": M_PER_MM,
        "vertices": [tuple(float(x) for x in vertex) for vertex in vertices],
        "blocks": [f"hex {_list(corners)} ({n} {m} 1) simpleGrading (1 1 1)" for corners, n, m in blocks],
        "boundary": [
            f"{name} {{ type {kind}; faces {_list(map(_list, faces))}; }}" for name, (kind, faces) in patches.items()
        ],
    }


def _list(items: Any) -> str:
    return "(" + " ".join(map(str, items)) + ")"


def _fields(radius_mm: float, across: int, inflow_mL_s: float) -> dict[str, tuple[str, dict[str, Any]]]:
    part = (np.arange(across) + 0.5) / across
    speed = 2 * inflow_mL_s * M3_PER_ML / (np.pi * (radius_mm * M_PER_MM) ** 2) * (1 - part**2)
    rows = " ".join(f"({u:.9g} 0 0)" for u in speed)
    sides = {"front": {"type": "wedge"}, "back": {"type": "wedge"}, "axis": {"type": "empty"}}
    developed = {"type": "fixedValue", "value": f"nonuniform List<vector> {across} ({rows})"}
    level, still = {"type": "zeroGradient"}, {"type": "noSlip"}
    at_rest = {"type": "fixedValue", "value": "uniform 0"}
    velocity = {"boundaryField": sides | {"inlet": developed, "outlet": level, "walls": still}}
    pressure = {"boundaryField": sides | {"inlet": level, "outlet": at_rest, "walls": level}}
    return {
        "U": ("volVectorField", {"dimensions": "[0 1 -1 0 0 0 0]", "internalField": "uniform (0 0 0)", **velocity}),
        "p": ("volScalarField", {"dimensions": "[0 2 -2 0 0 0 0]", "internalField": "uniform 0", **pressure}),
    }


def _fluid(blood: Blood) -> dict[str, dict[str, Any]]:
    viscosity = f"nu [0 2 -1 0 0 0 0] {blood.kinematic_viscosity_m2_s:.9g}"
    return {
        "constant/transportProperties": {"transportModel": "Newtonian", "nu": viscosity},
        "constant/turbulenceProperties": {"simulationType": "laminar"},
    }


def _solver() -> dict[str, dict[str, Any]]:
    times = {"startFrom": "startTime", "startTime": 0, "stopAt": "endTime", "endTime": ITERATIONS, "deltaT": 1}
    output = {"writeControl": "timeStep", "writeInterval": ITERATIONS // 2, "writeFormat": "ascii", "writePrecision": 9}
    viscous = {"div((nuEff*dev2(T(grad(U)))))": "Gauss linear"}
    pressure = {"solver": "GAMG", "smoother": "GaussSeidel", "tolerance": 1e-10, "relTol": 0.05}
    velocity = {"solver": "smoothSolver", "smoother": "symGaussSeidel", "tolerance": 1e-12, "relTol": 0.1}
    return {
        "system/controlDict": {"application": "simpleFoam", **times, **output},
        "system/fvSchemes": {
            "ddtSchemes": {"default": "steadyState"},
            "gradSchemes": {"default": "Gauss linear"},
            "divSchemes": {"default": "none", "div(phi,U)": "bounded Gauss linear", **viscous},
            "laplacianSchemes": {"default": "Gauss linear corrected"},
            "interpolationSchemes": {"default": "linear"},
            "snGradSchemes": {"default": "corrected"},
        },
        "system/fvSolution": {
            "solvers": {"p": pressure, "U": velocity},
            "SIMPLE": {"consistent": True, "nNonOrthogonalCorrectors": 0},
            "relaxationFactors": {"equations": {"U": 0.9}},
        },
    }
