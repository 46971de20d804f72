"""OpenFOAM boundary conditions: developed profiles at the inlets, zero pressure or a prescribed flow at the outlets."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from vstent.flow.case import FlowCase
from vstent.flow.openfoam.dictionary import foam_file
from vstent.flow.openfoam.setup import FoamSetup
from vstent.flow.profile import developed_profile
from vstent.kernels import curves
from vstent.kernels.arrays import Floats
from vstent.units import M3_PER_ML, M_PER_MM

PROFILE_POINTS: Final = 81
"""Number of points across an inlet at which its profile is written."""
TABLE_POINTS: Final = 100
"""Number of intervals of a cycle in a table of flow rates."""


def velocity(case: FlowCase, setup: FoamSetup, walls: list[str]) -> str:
    """Return the text of the file 0/U.

    Parameters
    ----------
    case : FlowCase
        The flow.
    setup : FoamSetup
        Setup of the OpenFOAM case.
    walls : list of str
        Names of the wall patches.
    """
    patches: dict[str, Any] = {name: {"type": "noSlip"} for name in walls}
    for inlet, flow_mL_s in zip(case.vessel.inlets, case.inlets_mL_s, strict=True):
        patches[inlet.role] = _inlet(case, setup, inlet.role, flow_mL_s)
    for outlet, flow_mL_s in zip(case.vessel.outlets, case.held_mL_s, strict=True):
        patches[outlet.role] = _outlet_velocity(case, setup, outlet.role, flow_mL_s)
    return _field("U", "volVectorField", "[0 1 -1 0 0 0 0]", "(0 0 0)", patches)


def pressure(case: FlowCase, walls: list[str]) -> str:
    """Return the text of the file 0/p; `walls` are the names of the wall patches."""
    inlets = (inlet.role for inlet in case.vessel.inlets)
    patches: dict[str, Any] = {name: {"type": "zeroGradient"} for name in (*walls, *inlets)}
    for outlet, flow_mL_s in zip(case.vessel.outlets, case.held_mL_s, strict=True):
        is_held = not np.isnan(flow_mL_s)
        patches[outlet.role] = {"type": "zeroGradient"} if is_held else {"type": "fixedValue", "value": "uniform 0"}
    return _field("p", "volScalarField", "[0 2 -2 0 0 0 0]", "0", patches)


def _field(name: str, kind: str, dimensions: str, inside: str, patches: dict[str, Any]) -> str:
    """Return the text of a field file with a uniform initial value."""
    entries = {"dimensions": dimensions, "internalField": f"uniform {inside}", "boundaryField": patches}
    return foam_file(name, entries, kind=kind)


def tables(case: FlowCase) -> dict[str, str]:
    """Return the files with functions of time that the boundary conditions refer to: one cycle each, time in s."""
    if case.settings.waveform is None:
        return {}
    means = {inlet.role: 1.0 for inlet in case.vessel.inlets}  # an inlet's profile is written for its mean flow
    held = zip(case.vessel.outlets, case.held_mL_s, strict=True)
    means |= {outlet.role: flow_mL_s * M3_PER_ML for outlet, flow_mL_s in held if not np.isnan(flow_mL_s)}
    return {f"flow_{name}": _cycle(case, mean) for name, mean in means.items()}


def _cycle(case: FlowCase, mean: float) -> str:
    """Return one cycle of a quantity with this mean, as a list of (time, value) pairs."""
    waveform = case.settings.waveform
    assert waveform is not None
    time_s = np.linspace(0.0, waveform.period_s, TABLE_POINTS + 1)
    values = mean * waveform.factor(time_s)
    return "(" + " ".join(f"({t:.9g} {q:.9g})" for t, q in zip(time_s, values, strict=True)) + ")\n"


def _over_time(case: FlowCase, setup: FoamSetup, key: str, patch: str, mean: float) -> dict[str, Any]:
    """Return the dictionary entry of a quantity with this mean: constant, or a repeated cycle."""
    if case.settings.waveform is None:
        return {key: f"constant {mean:.9g}"}
    if setup.flavour == "org":
        return {key: {"type": "table", "values": _cycle(case, mean).strip(), "outOfBounds": "repeat"}}
    # Release 1912 accepts options next to a table only if the table is in a file.
    return {key: "tableFile", f"{key}Coeffs": {"file": f'"<constant>/flow_{patch}"', "outOfBounds": "repeat"}}


def _inlet(case: FlowCase, setup: FoamSetup, role: str, flow_mL_s: float) -> dict[str, Any]:
    """Return the velocity condition of an inlet.

    The profile is developed flow for the inlet's own shape (openfoam.com) or a function of the distance to the wall
    (openfoam.org), times the flow rate.
    """
    start = {"value": "uniform (0 0 0)"}
    if setup.flavour == "org":
        flow = _over_time(case, setup, "volumetricFlowRate", role, flow_mL_s * M3_PER_ML)
        return {"type": "flowRateInletVelocity", **flow, "profile": "laminarBL"} | start
    # Nearest point, because OpenFOAM's planar interpolation fails on sections of a few millimetres.
    mapped = {"type": "timeVaryingMappedFixedValue", "mapMethod": "nearest", "setAverage": True} | start
    if case.settings.waveform is None:
        return mapped
    return {"type": "scaledFixedValue", **_over_time(case, setup, "scale", role, 1.0), "refValue": mapped} | start


def _outlet_velocity(case: FlowCase, setup: FoamSetup, role: str, flow_mL_s: float) -> dict[str, Any]:
    """Return the velocity condition of an outlet: a prescribed flow rate, or free outflow where it is nan."""
    if np.isnan(flow_mL_s):
        return {"type": "inletOutlet", "inletValue": "uniform (0 0 0)", "value": "uniform (0 0 0)"}
    flow = _over_time(case, setup, "volumetricFlowRate", role, flow_mL_s * M3_PER_ML)
    return {"type": "flowRateOutletVelocity", **flow, "value": "uniform (0 0 0)"}


def inlet_profiles(case: FlowCase, sections: Sequence[Floats]) -> dict[str, str]:
    """Return the files in constant/ with the inlet profiles: points in m, and the developed velocity there.

    The velocities have the mean of the inlet's mean flow. The mean that OpenFOAM enforces on the patch (`setAverage`)
    follows the values.

    Parameters
    ----------
    case : FlowCase
        The flow.
    sections : sequence of (k, 3) float
        Polygon of every opening in mm, inlets first.
    """
    inlets = zip(case.vessel.inlets, sections, case.inlets_mL_s, strict=False)  # `sections` continues with the outlets
    return {
        f"boundaryData/{inlet.role}/{name}": text
        for inlet, section_mm, flow_mL_s in inlets
        for name, text in _profile(section_mm, -inlet.normal, flow_mL_s).items()
    }


def _profile(section_mm: Floats, inward: Floats, flow_mL_s: float) -> dict[str, str]:
    """Return the files in the folder of one inlet."""
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
