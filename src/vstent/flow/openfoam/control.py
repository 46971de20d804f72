"""OpenFOAM dictionaries of the computation: schemes, solvers, time control, fluid, sampling, decomposition."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from vstent.flow.case import PHASES, FlowCase
from vstent.flow.openfoam.dictionary import foam_file
from vstent.flow.openfoam.mesh import NECK
from vstent.flow.openfoam.setup import FoamSetup
from vstent.flow.settings import Blood
from vstent.kernels.arrays import Floats

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
        "SIMPLE": {
            "consistent": True,
            "nNonOrthogonalCorrectors": 1,
            "residualControl": {"p": 1e-5, "U": 1e-5},
        },
        "PIMPLE": {"nOuterCorrectors": 1, "nCorrectors": 2, "nNonOrthogonalCorrectors": 1},
        "potentialFlow": {"nNonOrthogonalCorrectors": 5},
        "relaxationFactors": {"equations": {"U": 0.9, "UFinal": 1}},
        "cache": {"grad(U)": ""},
    }
    return foam_file("fvSolution", entries)


def control(case: FlowCase, setup: FoamSetup, step_s: float, *, walls: Sequence[str], has_neck: bool) -> str:
    """Return controlDict: iterations for steady flow, or seconds with a bounded Courant number for transient flow.

    Parameters
    ----------
    setup : setup of the OpenFOAM case.
    step_s : first time step of a transient flow.
    walls : names of the wall patches.
    has_neck : whether to sample the flow through the neck.
    """
    is_org, is_steady = setup.flavour == "org", case.waveform is None
    program = "foamRun" if is_org else "simpleFoam" if is_steady else "pimpleFoam"
    patches = [opening.role for opening in case.vessel.openings]
    entries: dict[str, Any] = {"application": program} | ({"solver": "incompressibleFluid"} if is_org else {})
    entries |= {"startFrom": "latestTime", "startTime": 0, "stopAt": "endTime"}
    entries |= _steady_times(setup) if is_steady else _transient_times(case, step_s)
    entries |= {
        "writeFormat": "ascii",
        "writePrecision": 9,
        "timePrecision": 9,
        "runTimeModifiable": False,
        "functions": _functions(setup, patches, walls, has_neck),
    }
    return foam_file("controlDict", entries)


def _steady_times(setup: FoamSetup) -> dict[str, Any]:
    """Return the entries of a steady flow's iterations and output."""
    every = {"writeControl": "timeStep", "writeInterval": 50, "purgeWrite": 2}
    return {"endTime": setup.iterations, "deltaT": 1} | every


def _transient_times(case: FlowCase, step_s: float) -> dict[str, Any]:
    """Return the entries of a transient flow's time steps and output."""
    waveform = case.waveform
    assert waveform is not None
    return {
        "endTime": case.numerics.max_cycles * waveform.period_s,
        "deltaT": step_s,
        "adjustTimeStep": True,
        "maxCo": MAX_COURANT,
        "maxDeltaT": waveform.period_s / PHASES,
        "writeControl": "adjustableRunTime",
        "writeInterval": waveform.period_s / PHASES,
        "purgeWrite": 2 * PHASES,
    }


def _functions(setup: FoamSetup, patches: Sequence[str], walls: Sequence[str], has_neck: bool) -> dict[str, Any]:
    """Return the function objects: flow rates and pressures of openings, wall shear stress, flow through the neck."""
    functions: dict[str, Any] = {}
    for name in patches:
        functions[f"flow_{name}"] = _over_patch(name, "sum", "phi")
        functions[f"pressure_{name}"] = _over_patch(name, "areaAverage", "p")
    stress = {"type": "wallShearStress", "libs": FIELD_LIBRARY, "patches": list(walls), "writeControl": "writeTime"}
    functions["wallShearStress"] = stress
    if has_neck and setup.flavour == "com":
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
    return functions


def _over_patch(name: str, operation: str, field: str) -> dict[str, Any]:
    """Return a function object that sums or averages a field over a patch."""
    # The first two entries name the patch for openfoam.com, the third for openfoam.org.
    where = {"regionType": "patch", "name": name, "patch": name}
    what = {"operation": operation, "fields": [field], "writeFields": False, "log": False}
    when = {"writeControl": "timeStep", "writeInterval": 1}
    return {"type": "surfaceFieldValue", "libs": FIELD_LIBRARY} | where | what | when


def decomposition(setup: FoamSetup, extent_mm: Floats) -> str:
    """Return decomposeParDict: the domain is cut along the axes, most often along the longest.

    Scotch is not used because Debian's build of it is a stub.

    Parameters
    ----------
    setup : setup with the number of processes.
    extent_mm : (3,); size of the domain along the axes.
    """
    parts = np.ones(3, dtype=int)
    for factor in _prime_factors(setup.processes):
        parts[np.argmax(extent_mm / parts)] *= factor
    coefficients = {"n": tuple(int(n) for n in parts), "delta": 0.001, "order": "xyz"}
    entries = {"numberOfSubdomains": setup.processes, "method": "hierarchical", "hierarchicalCoeffs": coefficients}
    return foam_file("decomposeParDict", entries)


def _prime_factors(number: int) -> list[int]:
    """Return the prime factors, the largest first."""
    factors, divisor = [], 2
    while number > 1:
        if number % divisor == 0:
            factors.append(divisor)
            number //= divisor
        else:
            divisor += 1
    return factors[::-1]


def fluid(blood: Blood, setup: FoamSetup) -> dict[str, str]:
    """Return the fluid's files by name: kinematic viscosity, the shear-thinning law if there is one, laminar flow."""
    note = f"Blood: {blood.viscosity_Pa_s:.6g} Pa s at {blood.density_kg_m3:.6g} kg/m3; p is pressure over density."
    nu, nu_at_rest, law = _viscosity(blood)
    laminar: dict[str, Any] = {"simulationType": "laminar"}
    if setup.flavour == "org":
        if law:
            laminar["laminar"] = {"model": "generalisedNewtonian", "viscosityModel": "BirdCarreau", **law}
        constant = {"viscosityModel": "constant", "nu": nu_at_rest}
        return {
            "physicalProperties": foam_file("physicalProperties", constant, note=note),
            "momentumTransport": foam_file("momentumTransport", laminar),
        }
    transport: dict[str, Any] = {"transportModel": "Newtonian", "nu": f"nu {nu}"}
    if law:
        transport = {"transportModel": "BirdCarreau", "BirdCarreauCoeffs": {"nu0": nu_at_rest, **law}}
    return {
        "transportProperties": foam_file("transportProperties", transport, note=note),
        "turbulenceProperties": foam_file("turbulenceProperties", laminar),
    }


def _viscosity(blood: Blood) -> tuple[str, str, dict[str, str]]:
    """Return the kinematic viscosity at high and at zero shear rate, and the other Carreau-Yasuda entries."""
    nu, law = f"[0 2 -1 0 0 0 0] {blood.kinematic_viscosity_m2_s:.9g}", blood.thinning
    if law is None:
        return nu, nu, {}
    nu_at_rest = f"[0 2 -1 0 0 0 0] {law.rest_viscosity_Pa_s / blood.density_kg_m3:.9g}"
    numbers = {name: f"[0 0 0 0 0 0 0] {getattr(law, name):.9g}" for name in ("n", "a")}
    return nu, nu_at_rest, {"nuInf": nu, "k": f"[0 0 1 0 0 0 0] {law.time_s:.9g}", **numbers}
