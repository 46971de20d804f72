"""OpenFOAM boundary conditions: velocity profiles at the inlets, zero pressure or a prescribed flow at the outlets."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, assert_never

import numpy as np

from vstent.errors import InputError
from vstent.flow.case import FlowCase
from vstent.flow.ends import End, FlowRate, Inflow, Pressure, Resistance
from vstent.flow.openfoam.dictionary import foam_file, vector
from vstent.flow.openfoam.setup import FoamSetup
from vstent.flow.profile import developed_profile, plug_profile
from vstent.geometry.vessel import Opening
from vstent.kernels import curves
from vstent.kernels.arrays import Floats
from vstent.units import M3_PER_ML, M_PER_MM

PROFILE_POINTS: Final = 81
"""Number of points across an inlet at which its profile is written."""
TABLE_POINTS: Final = 100
"""Number of intervals of a cycle in a table of flow rates."""
ZERO_GRADIENT: Final[dict[str, Any]] = {"type": "zeroGradient"}
"""Pressure where the velocity is prescribed."""
AT_REST: Final[dict[str, Any]] = {"value": "uniform (0 0 0)"}
"""Initial velocity at an opening."""

UNSUPPORTED: Final = (
    "an OpenFOAM case cannot have {}: give fixed shares (--outlets split or murray) and a developed or plug profile"
)
"""Message on a condition that OpenFOAM's own boundary conditions do not have."""


@dataclass(frozen=True)
class Condition:
    """Boundary condition of one opening in OpenFOAM's words."""

    velocity: dict[str, Any]
    """Entry in the file 0/U."""
    pressure: dict[str, Any]
    """Entry in the file 0/p."""
    files: dict[str, str]
    """Files in constant/ that these entries refer to."""


def boundary_files(
    case: FlowCase, setup: FoamSetup, sections: Sequence[Floats], walls: Sequence[str]
) -> dict[str, str]:
    """Return 0/U, 0/p and the files that they refer to, from the polygon (k, 3) in mm of every opening."""
    ends = zip(case.vessel.openings, case.ends, sections, strict=True)
    conditions = {opening.role: _condition(case, setup, opening, end, section) for opening, end, section in ends}
    velocity = {name: {"type": "noSlip"} for name in walls} | {role: one.velocity for role, one in conditions.items()}
    pressure = dict.fromkeys(walls, ZERO_GRADIENT) | {role: one.pressure for role, one in conditions.items()}
    return {
        "0/U": _field("U", "volVectorField", "[0 1 -1 0 0 0 0]", "(0 0 0)", velocity),
        "0/p": _field("p", "volScalarField", "[0 2 -2 0 0 0 0]", "0", pressure),
        **{f"constant/{name}": text for one in conditions.values() for name, text in one.files.items()},
    }


def _field(name: str, kind: str, dimensions: str, inside: str, patches: Mapping[str, Any]) -> str:
    """Return the text of a field file with a uniform initial value."""
    entries = {"dimensions": dimensions, "internalField": f"uniform {inside}", "boundaryField": patches}
    return foam_file(name, entries, kind=kind)


def _condition(case: FlowCase, setup: FoamSetup, opening: Opening, end: End, section_mm: Floats) -> Condition:
    """Return the condition of one opening, which depends on the type of its end only here."""
    match end:
        case Inflow() if end.profile == "womersley" and case.waveform is not None:
            raise InputError(UNSUPPORTED.format("Womersley profiles at its inlets"))
        case Inflow() if setup.dialect.reads_geometry:
            return _profiled(case, setup, opening, end, section_mm)
        case Inflow() | FlowRate():
            flow, files = _over_time(case, setup, "volumetricFlowRate", opening.role, end.mean_mL_s * M3_PER_ML)
            kind: dict[str, Any] = {"type": "flowRateOutletVelocity", **flow}
            if isinstance(end, Inflow):
                shape = {} if end.profile == "plug" else {"profile": "laminarBL"}
                kind = {"type": "flowRateInletVelocity", **flow, **shape}
            return Condition(kind | AT_REST, ZERO_GRADIENT, files)
        case Pressure():
            free = {"type": "inletOutlet", "inletValue": "uniform (0 0 0)"} | AT_REST
            value = f"uniform {end.pressure_Pa / case.blood.density_kg_m3:.9g}"
            return Condition(free, {"type": "fixedValue", "value": value}, {})
        case Resistance():
            raise InputError(UNSUPPORTED.format("resistances or Windkessels at its outlets"))
        case _:
            assert_never(end)


def _over_time(
    case: FlowCase, setup: FoamSetup, key: str, patch: str, mean: float
) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the entry of a quantity with this mean, constant or a repeated cycle, and the files of the cycle."""
    if case.waveform is None:
        return {key: f"constant {mean:.9g}"}, {}
    time_s = np.linspace(0.0, case.waveform.period_s, TABLE_POINTS + 1)
    values = mean * case.waveform.factor(time_s)
    table = "(" + " ".join(vector(row) for row in zip(time_s, values, strict=True)) + ")"
    return setup.dialect.cycle(key, patch, table)


def _profiled(case: FlowCase, setup: FoamSetup, opening: Opening, end: Inflow, section_mm: Floats) -> Condition:
    """Return the condition of an inlet with the velocity profile of its section.

    The velocities have the mean of the inlet's mean flow. The mean that OpenFOAM enforces on the patch (`setAverage`)
    follows the values.
    """
    role, inward = opening.role, -opening.normal
    center_mm = section_mm.mean(axis=0)
    first = curves.any_perpendicular(inward)
    second = np.cross(inward, first)
    around_mm = section_mm - center_mm
    # Grid points that cover the section and a margin, so that no face is outside.
    reach_mm = 1.05 * max(np.abs(around_mm @ first).max(), np.abs(around_mm @ second).max())
    ticks_mm = np.linspace(-reach_mm, reach_mm, PROFILE_POINTS)
    a, b = (x.ravel() for x in np.meshgrid(ticks_mm, ticks_mm))
    points_mm = center_mm + a[:, None] * first + b[:, None] * second
    profile = plug_profile if end.profile == "plug" else developed_profile
    shape = profile(section_mm, inward, points_mm)
    area_mm2 = abs(float(np.cross(around_mm, np.roll(around_mm, -1, axis=0)).sum(axis=0) @ inward)) / 2
    mean_m_s = end.mean_mL_s / area_mm2
    speed_m_s = shape * mean_m_s / max(float(shape[shape > 0].mean()), 1e-300)
    files = {
        f"boundaryData/{role}/points": _vectors(points_mm * M_PER_MM),
        f"boundaryData/{role}/0/U": f"{_vectors(speed_m_s[:, None] * inward)}{vector(mean_m_s * inward)}\n",
    }
    # Nearest point, because OpenFOAM's planar interpolation fails on sections of a few millimetres.
    mapped = {"type": "timeVaryingMappedFixedValue", "mapMethod": "nearest", "setAverage": True} | AT_REST
    if case.waveform is None:
        return Condition(mapped, ZERO_GRADIENT, files)
    scale, cycle = _over_time(case, setup, "scale", role, 1.0)  # the profile is that of the mean flow
    return Condition({"type": "scaledFixedValue", **scale, "refValue": mapped} | AT_REST, ZERO_GRADIENT, files | cycle)


def _vectors(vectors: Floats) -> str:
    """Return vectors (n, 3) as a list in OpenFOAM's syntax."""
    return f"{len(vectors)}\n(\n" + "\n".join(map(vector, vectors)) + "\n)\n"
