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

PROFILE_POINTS: Final = 41
"""Points across the inlet at which its profile is written."""
TABLE_POINTS: Final = 100
"""Times of a cycle in a table of flow."""


def velocity(case: FlowCase, setup: FoamSetup, walls: list[str]) -> str:
    """0/U."""
    patches: dict[str, Any] = {name: {"type": "noSlip"} for name in walls}
    patches["inlet"] = _inlet(case, setup)
    for k, outlet in enumerate(case.vessel.outlets):
        patches[outlet.role] = _outlet_velocity(case, k)
    return _field("U", "volVectorField", "[0 1 -1 0 0 0 0]", "(0 0 0)", patches)


def pressure(case: FlowCase, walls: list[str]) -> str:
    """0/p."""
    patches: dict[str, Any] = {name: {"type": "zeroGradient"} for name in (*walls, "inlet")}
    for k, outlet in enumerate(case.vessel.outlets):
        is_free = case.settings.outlets == "zero_pressure" or k == 0
        patches[outlet.role] = {"type": "fixedValue", "value": "uniform 0"} if is_free else {"type": "zeroGradient"}
    return _field("p", "volScalarField", "[0 2 -2 0 0 0 0]", "0", patches)


def _field(name: str, kind: str, dimensions: str, inside: str, patches: dict[str, Any]) -> str:
    entries = {"dimensions": dimensions, "internalField": f"uniform {inside}", "boundaryField": patches}
    return foam_file(name, entries, kind=kind)


def flow_table(case: FlowCase, share: float = 1.0) -> str:
    """Flow in m3/s, a share of the inlet's, as OpenFOAM's function of time: constant, or one cycle repeated."""
    flow_m3_s = share * case.inflow_mL_s * M3_PER_ML
    waveform = case.settings.waveform
    if waveform is None:
        return f"constant {flow_m3_s:.9g}"
    return _cycle(waveform.period_s, flow_m3_s * waveform.factor(_table_times(waveform.period_s)))


def _table_times(period_s: float) -> Floats:
    return np.linspace(0.0, period_s, TABLE_POINTS + 1)


def _cycle(period_s: float, values: Floats) -> str:
    pairs = zip(_table_times(period_s), values, strict=True)
    listed = "(" + " ".join(f"({t:.9g} {value:.9g})" for t, value in pairs) + ")"
    return f"table; outOfBounds repeat; values {listed}"


def _function(value: str) -> Any:
    """A function of time as an entry: ``constant q``, or a sub-dictionary with its table."""
    if not value.startswith("table"):
        return value
    return {"type": value.partition(";")[0]} | dict(
        part.strip().split(" ", 1) for part in value.split(";")[1:]
    )


def _inlet(case: FlowCase, setup: FoamSetup) -> dict[str, Any]:
    """The developed profile of the inlet's own shape (.com), or of its distance to the wall (.org), times the flow."""
    start = {"value": "uniform (0 0 0)"}
    if setup.flavour == "org":
        flow = {"volumetricFlowRate": _function(flow_table(case)), "profile": "laminarBL"}
        return {"type": "flowRateInletVelocity"} | flow | start
    mapped = {"type": "timeVaryingMappedFixedValue", "setAverage": True, "offset": "(0 0 0)"} | start
    waveform = case.settings.waveform
    if waveform is None:
        return mapped
    scale = _function(_cycle(waveform.period_s, waveform.factor(_table_times(waveform.period_s))))
    return {"type": "scaledFixedValue", "scale": scale, "refValue": mapped} | start


def _outlet_velocity(case: FlowCase, k: int) -> dict[str, Any]:
    if case.settings.outlets == "zero_pressure" or k == 0:
        return {"type": "inletOutlet", "inletValue": "uniform (0 0 0)", "value": "uniform (0 0 0)"}
    cubes = np.array([outlet.diameter_mm**3 for outlet in case.vessel.outlets])
    flow = _function(flow_table(case, float(cubes[k] / cubes.sum())))
    return {"type": "flowRateOutletVelocity", "volumetricFlowRate": flow, "value": "uniform (0 0 0)"}


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
