"""Boundary conditions: the developed profile at the inlet, zero pressure or a share of the flow at the outlets."""

from typing import Any, Final

import numpy as np

from vstent.flow.openfoam.dictionary import foam_file
from vstent.flow.openfoam.setup import FoamSetup
from vstent.flow.profile import developed_profile
from vstent.flow.types import FlowCase
from vstent.kernels import curves
from vstent.kernels.arrays import Floats
from vstent.units import M3_PER_ML, M_PER_MM

PROFILE_POINTS: Final = 81
"""Points across the inlet at which its profile is written."""
TABLE_POINTS: Final = 100
"""Times of a cycle in a table of flow."""


def velocity(case: FlowCase, setup: FoamSetup, walls: list[str]) -> str:
    """0/U."""
    patches: dict[str, Any] = {name: {"type": "noSlip"} for name in walls}
    patches["inlet"] = _inlet(case, setup)
    for k, outlet in enumerate(case.vessel.outlets):
        patches[outlet.role] = _outlet_velocity(case, setup, k)
    return _field("U", "volVectorField", "[0 1 -1 0 0 0 0]", "(0 0 0)", patches)


def pressure(case: FlowCase, walls: list[str]) -> str:
    """0/p."""
    patches: dict[str, Any] = {name: {"type": "zeroGradient"} for name in (*walls, "inlet")}
    for k, outlet in enumerate(case.vessel.outlets):
        is_held = k in case.held_shares
        patches[outlet.role] = {"type": "zeroGradient"} if is_held else {"type": "fixedValue", "value": "uniform 0"}
    return _field("p", "volScalarField", "[0 2 -2 0 0 0 0]", "0", patches)


def _field(name: str, kind: str, dimensions: str, inside: str, patches: dict[str, Any]) -> str:
    entries = {"dimensions": dimensions, "internalField": f"uniform {inside}", "boundaryField": patches}
    return foam_file(name, entries, kind=kind)


def tables(case: FlowCase) -> dict[str, str]:
    """Files of functions of time that the boundary conditions name: one cycle, time in s."""
    if case.settings.waveform is None:
        return {}
    shares = {"inlet": 1.0 / case.inflow_mL_s / M3_PER_ML}  # the inlet's profile is that of the mean flow
    shares |= {case.vessel.outlets[k].role: share for k, share in case.held_shares.items()}
    return {f"flow_{name}": _cycle(case, share) for name, share in shares.items()}


def _cycle(case: FlowCase, share: float) -> str:
    """A share of the flow in m3/s over one cycle, as a list of pairs."""
    waveform = case.settings.waveform
    assert waveform is not None
    time_s = np.linspace(0.0, waveform.period_s, TABLE_POINTS + 1)
    flow_m3_s = share * case.inflow_mL_s * M3_PER_ML * waveform.factor(time_s)
    return "(" + " ".join(f"({t:.9g} {q:.9g})" for t, q in zip(time_s, flow_m3_s, strict=True)) + ")\n"


def _over_time(case: FlowCase, setup: FoamSetup, key: str, patch: str, share: float) -> dict[str, Any]:
    """Entry of a share of the flow in m3/s: constant, or a cycle that repeats."""
    if case.settings.waveform is None:
        return {key: f"constant {share * case.inflow_mL_s * M3_PER_ML:.9g}"}
    if setup.flavour == "org":
        return {key: {"type": "table", "values": _cycle(case, share).strip(), "outOfBounds": "repeat"}}
    # 1912 takes a table apart from its options only from a file.
    return {key: "tableFile", f"{key}Coeffs": {"file": f'"<constant>/flow_{patch}"', "outOfBounds": "repeat"}}


def _inlet(case: FlowCase, setup: FoamSetup) -> dict[str, Any]:
    """The developed profile of the inlet's own shape (.com), or of its distance to the wall (.org), times the flow."""
    start = {"value": "uniform (0 0 0)"}
    if setup.flavour == "org":
        flow = _over_time(case, setup, "volumetricFlowRate", "inlet", 1.0)
        return {"type": "flowRateInletVelocity", **flow, "profile": "laminarBL"} | start
    # By the nearest point: OpenFOAM's own interpolation in the plane fails on sections of a few millimetres.
    mapped = {"type": "timeVaryingMappedFixedValue", "mapMethod": "nearest", "setAverage": True} | start
    if case.settings.waveform is None:
        return mapped
    return {"type": "scaledFixedValue", **_over_time(case, setup, "scale", "inlet", 1.0), "refValue": mapped} | start


def _outlet_velocity(case: FlowCase, setup: FoamSetup, k: int) -> dict[str, Any]:
    share = case.held_shares.get(k)
    if share is None:
        return {"type": "inletOutlet", "inletValue": "uniform (0 0 0)", "value": "uniform (0 0 0)"}
    flow = _over_time(case, setup, "volumetricFlowRate", case.vessel.outlets[k].role, share)
    return {"type": "flowRateOutletVelocity", **flow, "value": "uniform (0 0 0)"}


def inlet_profile(case: FlowCase, section_mm: Floats) -> dict[str, str]:
    """Files of constant/boundaryData/inlet: points in m, and there the developed profile whose mean is the mean flow's.

    The mean that OpenFOAM holds the patch to stands behind the values (`setAverage`).
    """
    inward = -case.vessel.inlet.normal
    points_mm = _section_points_mm(section_mm, inward)
    shape = developed_profile(section_mm, inward, points_mm)
    mean_m_s = case.inflow_mL_s / _polygon_area_mm2(section_mm, inward)
    speed_m_s = shape * mean_m_s / max(float(shape[shape > 0].mean()), 1e-300)
    return {
        "points": _vectors(points_mm * M_PER_MM),
        "0/U": f"{_vectors(speed_m_s[:, None] * inward)}{_vector(mean_m_s * inward)}\n",
    }


def _section_points_mm(section_mm: Floats, normal: Floats) -> Floats:
    """Points on a grid over a flat section, one ring beyond it included, so that none of its faces lies outside."""
    center_mm = section_mm.mean(axis=0)
    first = curves.any_perpendicular(normal)
    second = np.cross(normal, first)
    u, v = (section_mm - center_mm) @ first, (section_mm - center_mm) @ second
    reach = 1.05 * max(np.abs(u).max(), np.abs(v).max())
    ticks = np.linspace(-reach, reach, PROFILE_POINTS)
    a, b = (x.ravel() for x in np.meshgrid(ticks, ticks))
    return np.asarray(center_mm + a[:, None] * first + b[:, None] * second)


def _polygon_area_mm2(section_mm: Floats, normal: Floats) -> float:
    around = section_mm - section_mm.mean(axis=0)
    return abs(float(np.cross(around, np.roll(around, -1, axis=0)).sum(axis=0) @ normal)) / 2


def _vector(vector: Floats) -> str:
    return "(" + " ".join(f"{x:.9g}" for x in vector) + ")"


def _vectors(vectors: Floats) -> str:
    return f"{len(vectors)}\n(\n" + "\n".join(map(_vector, vectors)) + "\n)\n"
