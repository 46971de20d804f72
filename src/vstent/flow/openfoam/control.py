"""OpenFOAM dictionaries of the computation: schemes, solvers, time control, fluid, sampling, decomposition."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from vstent.flow.case import PHASES, FlowCase
from vstent.flow.openfoam.dictionary import foam_file
from vstent.flow.openfoam.mesh import NECK
from vstent.flow.openfoam.setup import CHECK_ITERATIONS, ITERATIONS, FoamSetup
from vstent.flow.settings import Blood
from vstent.kernels.arrays import Floats
from vstent.units import M_PER_MM

MAX_COURANT: Final = 2.0
"""Maximum Courant number of a transient flow; implicit steps may exceed 1 in flat or small cells."""
FIELD_LIBRARY: Final = ['"libfieldFunctionObjects.so"']
"""Library of OpenFOAM's function objects for fields."""


def schemes(*, is_steady: bool) -> str:
    """Return fvSchemes: second order in space, and in time for transient flow."""
    bounded = "bounded Gauss" if is_steady else "Gauss"
    entries = {
        "ddtSchemes": {"default": "steadyState" if is_steady else "backward"},
        "gradSchemes": {"default": "Gauss linear", "grad(U)": "Gauss linear"},
        "divSchemes": {
            "default": "none",
            "div(phi,U)": f"{bounded} LUST grad(U)",
            "div((nuEff*dev2(T(grad(U)))))": "Gauss linear",
        },
        "laplacianSchemes": {"default": "Gauss linear limited 0.5"},
        "interpolationSchemes": {"default": "linear"},
        "snGradSchemes": {"default": "limited 0.5"},
    }
    return foam_file("fvSchemes", entries)


def solution() -> str:
    """Return fvSolution: SIMPLE for steady flow, PISO (PIMPLE with one outer loop) for transient flow."""
    pressure = {"solver": "GAMG", "smoother": "GaussSeidel", "tolerance": 1e-9, "relTol": 0.05}
    velocity = {"solver": "smoothSolver", "smoother": "symGaussSeidel", "tolerance": 1e-9, "relTol": 0.05}
    entries = {
        "solvers": {
            "p": pressure,
            "pFinal": pressure | {"relTol": 0.01},
            "Phi": pressure,
            "U": velocity,
            "UFinal": velocity | {"relTol": 0},
        },
        "SIMPLE": {"consistent": True, "nNonOrthogonalCorrectors": 1, "residualControl": {"p": 1e-5, "U": 1e-5}},
        "PIMPLE": {"nOuterCorrectors": 1, "nCorrectors": 2, "nNonOrthogonalCorrectors": 1},
        "potentialFlow": {"nNonOrthogonalCorrectors": 5},
        "relaxationFactors": {"equations": {"U": 0.9, "UFinal": 1}},
        "cache": {"grad(U)": ""},
    }
    return foam_file("fvSolution", entries)


def control(case: FlowCase, setup: FoamSetup, walls: Sequence[str]) -> str:
    """Return controlDict: iterations for steady flow, or seconds with a bounded Courant number for transient flow.

    Its function objects write flow rates and pressures of openings, wall shear stress, and the flow on the neck.
    """
    waveform = case.waveform
    functions: dict[str, Any] = {}
    for role in (opening.role for opening in case.vessel.openings):
        for quantity, operation, field in (("flow", "sum", "phi"), ("pressure", "areaAverage", "p")):
            functions[f"{quantity}_{role}"] = {
                "type": "surfaceFieldValue",
                "libs": FIELD_LIBRARY,
                # The first two entries name the patch for openfoam.com, the third for openfoam.org.
                "regionType": "patch",
                "name": role,
                "patch": role,
                "operation": operation,
                "fields": [field],
                "writeFields": False,
                "log": False,
                "writeControl": "timeStep",
                "writeInterval": 1,
            }
    stress = {"type": "wallShearStress", "libs": FIELD_LIBRARY, "patches": list(walls), "writeControl": "writeTime"}
    functions["wallShearStress"] = stress
    if case.ostium is not None and setup.dialect.reads_geometry:
        functions[NECK] = {
            "type": "surfaces",
            "libs": ['"libsampling.so"'],
            "writeControl": "writeTime",
            "surfaceFormat": "vtk",
            "fields": ["U", "p"],
            "interpolationScheme": "cellPoint",
            "surfaces": [
                NECK,
                {"type": "sampledTriSurfaceMesh", "surface": f"{NECK}.stl", "source": "cells", "interpolate": True},
            ],
        }
    if waveform is None:
        every = {"writeControl": "timeStep", "writeInterval": CHECK_ITERATIONS, "purgeWrite": 2}
        times = {"endTime": ITERATIONS, "deltaT": 1, **every}
    else:
        times = {
            "endTime": case.numerics.max_cycles * waveform.period_s,
            "deltaT": 0.2 * setup.cell_size_mm * M_PER_MM / (2 * float(case.inlet_speeds_m_s.max())),
            "adjustTimeStep": True,
            "maxCo": MAX_COURANT,
            "maxDeltaT": waveform.period_s / PHASES,
            "writeControl": "adjustableRunTime",
            "writeInterval": waveform.period_s / PHASES,
            "purgeWrite": 2 * PHASES,
        }
    entries = {
        **setup.dialect.application(is_steady=waveform is None),
        "startFrom": "latestTime",
        "startTime": 0,
        "stopAt": "endTime",
        **times,
        "writeFormat": "ascii",
        "writePrecision": 9,
        "timePrecision": 9,
        "runTimeModifiable": False,
        "functions": functions,
    }
    return foam_file("controlDict", entries)


def decomposition(processes: int, extent_mm: Floats) -> str:
    """Return decomposeParDict: the domain of size `extent_mm` (3,) is cut along the axes, most often along the longest.

    Scotch is not used because Debian's build of it is a stub.
    """
    factors, divisor, rest = [], 2, processes
    while rest > 1:
        if rest % divisor == 0:
            factors.append(divisor)
            rest //= divisor
        else:
            divisor += 1
    parts = np.ones(3, dtype=int)
    for factor in reversed(factors):  # the largest first
        parts[np.argmax(extent_mm / parts)] *= factor
    coefficients = {"n": tuple(int(n) for n in parts), "delta": 0.001, "order": "xyz"}
    entries = {"numberOfSubdomains": processes, "method": "hierarchical", "hierarchicalCoeffs": coefficients}
    return foam_file("decomposeParDict", entries)


def fluid(blood: Blood, setup: FoamSetup) -> dict[str, str]:
    """Return the fluid's files by name: kinematic viscosity, the shear-thinning law if there is one, laminar flow."""
    note = f"Blood: {blood.viscosity_Pa_s:.6g} Pa s at {blood.density_kg_m3:.6g} kg/m3; p is pressure over density."
    law, entries = blood.thinning, {}
    nu = nu_at_rest = f"[0 2 -1 0 0 0 0] {blood.kinematic_viscosity_m2_s:.9g}"
    if law is not None:
        nu_at_rest = f"[0 2 -1 0 0 0 0] {law.rest_viscosity_Pa_s / blood.density_kg_m3:.9g}"
        exponents = {name: f"[0 0 0 0 0 0 0] {getattr(law, name):.9g}" for name in ("n", "a")}
        entries = {"nuInf": nu, "k": f"[0 0 1 0 0 0 0] {law.time_s:.9g}", **exponents}
    return setup.dialect.fluid(nu, nu_at_rest, entries, note)
