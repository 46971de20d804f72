"""OpenFOAM boundary conditions: developed profiles at the inlets, zero pressure or a prescribed flow at the outlets."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, assert_never

import numpy as np

from vstent.flow.case import FlowCase
from vstent.flow.ends import End, FlowRate, Inflow, Pressure
from vstent.flow.openfoam.dictionary import foam_file
from vstent.flow.openfoam.setup import FoamSetup
from vstent.flow.profile import developed_profile
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


@dataclass(frozen=True)
class Condition:
    """Boundary condition of one opening in OpenFOAM's words."""

    velocity: dict[str, Any]
    """Entry in the file 0/U."""
    pressure: dict[str, Any]
    """Entry in the file 0/p."""
    files: dict[str, str]
    """Files in constant/ that these entries refer to."""


def conditions(case: FlowCase, setup: FoamSetup, sections: Sequence[Floats]) -> dict[str, Condition]:
    """Return the boundary condition of every opening, by its role.

    Parameters
    ----------
    setup : setup of the OpenFOAM case.
    sections : sequence of (k, 3); polygon of every opening in mm.
    """
    ends = zip(case.vessel.openings, case.ends, sections, strict=True)
    return {opening.role: _condition(case, setup, opening, end, section) for opening, end, section in ends}


def _condition(case: FlowCase, setup: FoamSetup, opening: Opening, end: End, section_mm: Floats) -> Condition:
    """Return the condition of one opening, which depends on the type of its end only here."""
    role, density = opening.role, case.blood.density_kg_m3
    match end:
        case Inflow():
            return _inflow(case, setup, opening, end, section_mm)
        case FlowRate():
            flow, files = _over_time(case, setup, "volumetricFlowRate", role, end.mean_mL_s * M3_PER_ML)
            return Condition({"type": "flowRateOutletVelocity", **flow} | AT_REST, ZERO_GRADIENT, files)
        case Pressure():
            free = {"type": "inletOutlet", "inletValue": "uniform (0 0 0)"} | AT_REST
            return Condition(free, {"type": "fixedValue", "value": f"uniform {end.pressure_Pa / density:.9g}"}, {})
        case _:
            assert_never(end)


def velocity(of_openings: Mapping[str, Condition], walls: list[str]) -> str:
    """Return the text of the file 0/U; `walls` are the names of the wall patches."""
    patches = {name: {"type": "noSlip"} for name in walls} | {name: one.velocity for name, one in of_openings.items()}
    return _field("U", "volVectorField", "[0 1 -1 0 0 0 0]", "(0 0 0)", patches)


def pressure(of_openings: Mapping[str, Condition], walls: list[str]) -> str:
    """Return the text of the file 0/p; `walls` are the names of the wall patches."""
    patches = dict.fromkeys(walls, ZERO_GRADIENT) | {name: one.pressure for name, one in of_openings.items()}
    return _field("p", "volScalarField", "[0 2 -2 0 0 0 0]", "0", patches)


def _field(name: str, kind: str, dimensions: str, inside: str, patches: dict[str, Any]) -> str:
    """Return the text of a field file with a uniform initial value."""
    entries = {"dimensions": dimensions, "internalField": f"uniform {inside}", "boundaryField": patches}
    return foam_file(name, entries, kind=kind)


def _over_time(
    case: FlowCase, setup: FoamSetup, key: str, patch: str, mean: float
) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the entry of a quantity with this mean, constant or a repeated cycle, and the file of the cycle."""
    if case.waveform is None:
        return {key: f"constant {mean:.9g}"}, {}
    time_s = np.linspace(0.0, case.waveform.period_s, TABLE_POINTS + 1)
    values = mean * case.waveform.factor(time_s)
    cycle = "(" + " ".join(f"({t:.9g} {q:.9g})" for t, q in zip(time_s, values, strict=True)) + ")"
    if setup.flavour == "org":
        return {key: {"type": "table", "values": cycle, "outOfBounds": "repeat"}}, {}
    # Release 1912 accepts options next to a table only if the table is in a file.
    file = f"flow_{patch}"
    entry = {key: "tableFile", f"{key}Coeffs": {"file": f'"<constant>/{file}"', "outOfBounds": "repeat"}}
    return entry, {file: cycle + "\n"}


def _inflow(case: FlowCase, setup: FoamSetup, opening: Opening, end: Inflow, section_mm: Floats) -> Condition:
    """Return the condition of an inlet.

    The profile is developed flow for the inlet's own shape (openfoam.com) or a function of the distance to the wall
    (openfoam.org), times the flow rate.
    """
    role = opening.role
    if setup.flavour == "org":
        flow, files = _over_time(case, setup, "volumetricFlowRate", role, end.mean_mL_s * M3_PER_ML)
        entry = {"type": "flowRateInletVelocity", **flow, "profile": "laminarBL"} | AT_REST
        return Condition(entry, ZERO_GRADIENT, files)
    profile = _profile(section_mm, -opening.normal, end.mean_mL_s)
    files = {f"boundaryData/{role}/{name}": text for name, text in profile.items()}
    # Nearest point, because OpenFOAM's planar interpolation fails on sections of a few millimetres.
    mapped = {"type": "timeVaryingMappedFixedValue", "mapMethod": "nearest", "setAverage": True} | AT_REST
    if case.waveform is None:
        return Condition(mapped, ZERO_GRADIENT, files)
    scale, cycle = _over_time(case, setup, "scale", role, 1.0)  # the profile is that of the mean flow
    return Condition({"type": "scaledFixedValue", **scale, "refValue": mapped} | AT_REST, ZERO_GRADIENT, files | cycle)


def _profile(section_mm: Floats, inward: Floats, flow_mL_s: float) -> dict[str, str]:
    """Return the files in the folder of an inlet: points in m, and the developed velocity there.

    The velocities have the mean of the inlet's mean flow. The mean that OpenFOAM enforces on the patch (`setAverage`)
    follows the values.
    """
    points_mm = _section_points_mm(section_mm, inward)
    shape = developed_profile(section_mm, inward, points_mm)
    mean_m_s = flow_mL_s / _polygon_area_mm2(section_mm, inward)
    speed_m_s = shape * mean_m_s / max(float(shape[shape > 0].mean()), 1e-300)
    return {
        "points": _vectors(points_mm * M_PER_MM),
        "0/U": f"{_vectors(speed_m_s[:, None] * inward)}{_vector(mean_m_s * inward)}\n",
    }


def _section_points_mm(section_mm: Floats, normal: Floats) -> Floats:
    """Return grid points (n, 3) that cover a flat section and a margin, so that no face is outside."""
    center_mm = section_mm.mean(axis=0)
    first = curves.any_perpendicular(normal)
    second = np.cross(normal, first)
    u, v = (section_mm - center_mm) @ first, (section_mm - center_mm) @ second
    reach = 1.05 * max(np.abs(u).max(), np.abs(v).max())
    ticks = np.linspace(-reach, reach, PROFILE_POINTS)
    a, b = (x.ravel() for x in np.meshgrid(ticks, ticks))
    return np.asarray(center_mm + a[:, None] * first + b[:, None] * second)


def _polygon_area_mm2(section_mm: Floats, normal: Floats) -> float:
    """Return the area of a flat polygon (k, 3)."""
    around = section_mm - section_mm.mean(axis=0)
    return abs(float(np.cross(around, np.roll(around, -1, axis=0)).sum(axis=0) @ normal)) / 2


def _vector(vector: Floats) -> str:
    """Return a vector in OpenFOAM's syntax."""
    return "(" + " ".join(f"{x:.9g}" for x in vector) + ")"


def _vectors(vectors: Floats) -> str:
    """Return vectors (n, 3) as a list in OpenFOAM's syntax."""
    return f"{len(vectors)}\n(\n" + "\n".join(map(_vector, vectors)) + "\n)\n"
