"""OpenFOAM boundary conditions: velocity profiles at the inlets, zero pressure or a prescribed flow at the outlets.

The flow through resistances is prescribed too. The engine adjusts it between the checks (`flow_table`), so that no
condition has to be compiled.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, assert_never

import numpy as np

from vstent.errors import InputError
from vstent.flow.case import PHASES, FlowCase
from vstent.flow.ends import End, FlowRate, Inflow, Pressure, Resistance
from vstent.flow.measured import MeasuredProfile
from vstent.flow.openfoam.dictionary import foam_file, vector
from vstent.flow.openfoam.setup import FoamSetup
from vstent.flow.profile import distance_inside
from vstent.geometry.vessel import Opening
from vstent.kernels import curves, triangles
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

PULSATING_POINTS: Final = 41
"""The same for a profile whose shape changes over a cycle, which is written at `2 * PHASES` moments of every cycle."""
UNSUPPORTED: Final = (
    "a case for openfoam.org cannot have {}: give fixed shares (--outlets split or murray) and a developed or plug "
    "profile, or use openfoam.com"
)
"""Message on a condition that only the fork of openfoam.com has."""


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
        case Inflow() if setup.dialect.reads_geometry:
            return _profiled(case, setup, opening, end, section_mm)
        case Inflow() if isinstance(end.profile, MeasuredProfile) or (end.is_pulsating and case.waveform is not None):
            raise InputError(UNSUPPORTED.format("measured or Womersley profiles at its inlets"))
        case Resistance() if setup.dialect.is_org:
            raise InputError(UNSUPPORTED.format("resistances or Windkessels at its outlets"))
        case Resistance() if opening is not case.vessel.outlets[0]:
            time_s = cycle_s(case)
            files = {table_name(opening.role): flow_table(time_s, end.mean_mL_s * case.inflow_factor(time_s))}
            entry, _ = setup.dialect.cycle("volumetricFlowRate", opening.role, "")
            return Condition({"type": "flowRateOutletVelocity", **entry} | AT_REST, ZERO_GRADIENT, files)
        case Inflow() | FlowRate():
            flow, files = _over_time(case, setup, "volumetricFlowRate", opening.role, end.mean_mL_s * M3_PER_ML)
            kind: dict[str, Any] = {"type": "flowRateOutletVelocity", **flow}
            if isinstance(end, Inflow):
                shape = {} if end.profile == "plug" else {"profile": "laminarBL"}
                kind = {"type": "flowRateInletVelocity", **flow, **shape}
            return Condition(kind | AT_REST, ZERO_GRADIENT, files)
        case Pressure() | Resistance():
            free = {"type": "inletOutlet", "inletValue": "uniform (0 0 0)"} | AT_REST
            pressure_Pa = end.pressure_Pa if isinstance(end, Pressure) else 0.0
            value = f"uniform {pressure_Pa / case.blood.density_kg_m3:.9g}"
            return Condition(free, {"type": "fixedValue", "value": value}, {})
        case _:
            assert_never(end)


def cycle_s(case: FlowCase) -> Floats:
    """Return the times (t,) of a table of flow rates, which has the first moment of a cycle at its end too."""
    return np.linspace(0.0, 1.0 if case.waveform is None else case.waveform.period_s, TABLE_POINTS + 1)


def table_name(patch: str) -> str:
    """Return the name of the file in constant/ with the flow rate through a patch."""
    return f"flow_{patch}"


def flow_table(time_s: Floats, flow_mL_s: Floats) -> str:
    """Return flow rates (t,) at times (t,) as a table in OpenFOAM's syntax and units."""
    return "(" + " ".join(vector(row) for row in zip(time_s, flow_mL_s * M3_PER_ML, strict=True)) + ")\n"


def _over_time(
    case: FlowCase, setup: FoamSetup, key: str, patch: str, mean: float
) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the entry of a quantity with this mean, constant or a repeated cycle, and the files of the cycle."""
    if case.waveform is None:
        return {key: f"constant {mean:.9g}"}, {}
    time_s = cycle_s(case)
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
    is_pulsating = end.is_pulsating and case.waveform is not None
    # Grid points that cover the section and a margin, so that no face is outside.
    reach_mm = 1.05 * max(np.abs(around_mm @ first).max(), np.abs(around_mm @ second).max())
    ticks_mm = np.linspace(-reach_mm, reach_mm, PULSATING_POINTS if is_pulsating else PROFILE_POINTS)
    a, b = (x.ravel() for x in np.meshgrid(ticks_mm, ticks_mm))
    points_mm = center_mm + a[:, None] * first + b[:, None] * second
    section = section_mm, opening.normal, points_mm
    area_mm2 = abs(float(triangles.polygon_area_vector(section_mm) @ inward))
    mean_m_s, time_s = end.mean_mL_s / area_mm2, np.zeros(1)
    shape = end.relative_velocity(*section)
    shapes, factor = shape[None], np.ones(1)
    if is_pulsating:
        period_s, count = case.pulse.period_s, 2 * PHASES
        time_s = period_s * np.arange(count * case.numerics.max_cycles + 1) / count
        _, shapes = end.pulsating_velocity(case.pulse, case.blood, time_s[:count], *section)
        shapes, factor = np.resize(shapes, (len(time_s), *shape.shape)), case.pulse.factor(time_s)
    axes = np.stack([first, second], axis=1)
    is_inside = distance_inside(section_mm @ axes, points_mm @ axes) > 0
    velocity_m_s = shapes * mean_m_s / max(float((shape[is_inside] @ inward).mean()), 1e-300)
    files = {f"boundaryData/{role}/points": _vectors(points_mm * M_PER_MM)}
    for now_s, now_m_s, of_mean in zip(time_s, velocity_m_s, factor, strict=True):
        mean = vector(of_mean * mean_m_s * inward)
        files[f"boundaryData/{role}/{now_s:.9g}/U"] = f"{_vectors(now_m_s)}{mean}\n"
    # Nearest point, because OpenFOAM's planar interpolation fails on sections of a few millimetres.
    mapped = {"type": "timeVaryingMappedFixedValue", "mapMethod": "nearest", "setAverage": True} | AT_REST
    if case.waveform is None or is_pulsating:
        return Condition(mapped, ZERO_GRADIENT, files)
    scale, cycle = _over_time(case, setup, "scale", role, 1.0)  # the profile is that of the mean flow
    return Condition({"type": "scaledFixedValue", **scale, "refValue": mapped} | AT_REST, ZERO_GRADIENT, files | cycle)


def _vectors(vectors: Floats) -> str:
    """Return vectors (n, 3) as a list in OpenFOAM's syntax."""
    return f"{len(vectors)}\n(\n" + "\n".join(map(vector, vectors)) + "\n)\n"
