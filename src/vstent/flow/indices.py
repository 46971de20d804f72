"""Hemodynamic indices of a flow, and their change with a device."""

from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np

from vstent.flow import sampling
from vstent.flow.case import FlowCase, FlowField
from vstent.flow.domain import mean_diameter_mm
from vstent.flow.drag import WINDING
from vstent.flow.ends import FlowRate, outflows
from vstent.flow.ostium import sac_surfaces
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy, roles
from vstent.kernels.arrays import Bools, Floats
from vstent.units import M_PER_MM

LOW_SHEAR_PA = 0.4
"""Threshold of low wall shear stress, Pa: below it endothelium degenerates (Malek, Alper and Izumo 1999, JAMA 282,
2035)."""
LOW_SHEAR_SHARE = 0.1
"""Threshold of low shear relative to the parent artery's mean wall shear stress (Xiang et al. 2011, Stroke 42, 144)."""
FAST_M_S = 0.08
"""Speed, m/s, above which blood in a sac counts as part of the inflow jet."""
NEAR_MM = 10.0
"""Distance from the neck, mm, within which wall belongs to the parent artery (Cebral et al. 2011, AJNR 32, 145)."""
ON_SAC_MM: Final = 0.02
"""Distance from the sac's surface within which wall may belong to the sac."""
RIM_MM: Final = 0.05
"""Distance from the neck within which wall counts as the artery's. No grid tells both apart there, and behind a dense
braid the artery's shear stress on such a rim would exceed that of the whole sac."""
QUANTITIES: Final = ("neck_inflow_mL_s", "mean_sac_velocity_m_s", "mean_sac_wss_Pa", "mean_wss_Pa", "pressure_drop_Pa")
"""Indices compared between grids, as far as the vessel has them."""


def indices(
    field: FlowField,
    sac: Surface | None = None,
    ostium: Surface | None = None,
    beside: Mapping[str, Surface] | None = None,
) -> dict[str, float]:
    """Compute all hemodynamic indices of a flow, with the unit in each key.

    Of the vessel: ``inlet_flow_mL_s``, ``outlet_K_flow_mL_s``, ``inlet_pressure_Pa``, ``pressure_drop_Pa`` (inlet to
    widest outlet), ``mean_wss_Pa``; with several inlets also ``inlet_K_flow_mL_s`` and ``inlet_K_pressure_Pa``. With a
    sac and its ostium also:

    - ``neck_inflow_mL_s`` = integral over the ostium of max(u.n, 0) and ``neck_outflow_mL_s`` of max(-u.n, 0), with
      tricubic interpolation of the velocity; ``inflow_area_fraction`` = part of the ostium where u.n > 0;
      ``turnover_time_s`` = sac volume / neck inflow; the inflow through every surface of
      `beside`, as ``NAME_mL_s``;
    - ``mean_sac_velocity_m_s``, ``max_sac_velocity_m_s``, ``mean_sac_pressure_Pa`` over the sac's cells;
      ``sac_kinetic_energy_J`` = integral of rho u^2 / 2; ``fast_sac_volume_mm3`` where u > 0.08 m/s;
    - ``mean_sac_wss_Pa``, ``max_sac_wss_Pa`` over the sac's wall; ``parent_wss_Pa`` over the other wall within 10 mm of
      the neck; ``low_shear_area_fraction`` of the sac's wall below 0.4 Pa, ``relative_low_shear_area_fraction`` below a
      tenth of the parent artery's mean;
    - ``inflow_concentration_index`` = (neck inflow / flow of all inlets) / inflow area fraction (Cebral et al. 2011,
      AJNR 32, 145).

    In a pulsatile flow every index is the mean over the cycle, or a quotient of such means; an index called ``max`` is
    the maximum over the cycle. Wall shear stress is the time average of its magnitude (TAWSS), and
    ``mean_sac_oscillatory_shear_fraction`` (OSI) is added. In an unsteady flow at constant inflow, speed, wall shear
    stress and neck inflow are time averages of magnitudes, because oscillations cancel in the mean flow. Only the
    inflow area is computed from the mean flow.

    Parameters
    ----------
    field : FlowField
        The flow.
    sac : Surface, optional
        Closed surface of the sac.
    ostium : Surface, optional
        Opening of the sac, with normals into the sac.
    beside : mapping, optional
        Further surfaces by name (`vstent.flow.ostium.surfaces_beside`). Where the neck inflow cannot be computed from
        the field, the inflow through them is scaled by the same factor as that through the ostium.
    """
    openings = roles(len(field.inlets_mL_s), len(field.outlets_mL_s))
    through_mL_s = np.concatenate([field.inlets_mL_s, field.outlets_mL_s]).tolist()
    result = {f"{role}_flow_mL_s": flow for role, flow in zip(openings, through_mL_s, strict=True)}
    at_inlets = zip(openings, field.inlet_pressure_Pa.tolist(), strict=False)
    result |= {f"{role}_pressure_Pa": mean for role, mean in at_inlets}
    result["pressure_drop_Pa"] = float(field.inlet_pressure_Pa[0] - field.outlet_pressure_Pa[0])
    result["mean_wss_Pa"] = float(np.average(field.shear_Pa, weights=vertex_areas_mm2(field.wall)))
    if sac is None or ostium is None:
        return result
    of_moments = [_of_ostium(now, ostium, beside or {}) | _of_sac(now, sac) for now in field.moments()]
    for key in of_moments[0]:
        values = [one[key] for one in of_moments]
        result[key] = max(values) if key.startswith("max_") else float(np.mean(values))
    # Quotients of means over the cycle: those at single moments are unbounded where the flow is at rest.
    inflow_mL_s, share = result["neck_inflow_mL_s"], result["inflow_area_fraction"]
    result["turnover_time_s"] = abs(sac.volume_mm3) * 1e-3 / max(inflow_mL_s, 1e-12)
    result["inflow_concentration_index"] = inflow_mL_s / field.inflow_mL_s / max(share, 1e-12)
    return result | _of_sac_wall(field, sac, ostium)


def between_coils(found: dict[str, float], porosity: float) -> dict[str, float]:
    """Return the indices of a flow in which coils are a porous region, for the blood between them alone.

    `porosity` is the blood's part of the sac: there is less of it, and it is faster than the velocity of the region,
    which is the flow rate per area of blood and coils, also because it winds between them (`vstent.flow.drag.WINDING`).
    """
    winding = WINDING if porosity < 1 else 1.0
    factors = {
        "turnover_time_s": porosity,
        "fast_sac_volume_mm3": porosity,
        "mean_sac_velocity_m_s": winding / porosity,
        "sac_kinetic_energy_J": winding**2 / porosity,
    }
    return {name: value * factors.get(name, 1.0) for name, value in found.items()}


def balance(case: FlowCase, field: FlowField) -> dict[str, float]:
    """Return shares, asked and reached, and mean pressures of several outlets, and the pressure that they share."""
    result = {"common_pressure_Pa": field.common_pressure_Pa} if case.resistances else {}
    if len(field.outlets_mL_s) < 2:
        return result
    asked = _asked_outflow_mL_s(case, field) / case.inflow_mL_s
    reached = field.outlets_mL_s / field.outlets_mL_s.sum()
    for k, role in enumerate(roles(len(field.inlets_mL_s), len(asked))[-len(asked) :]):
        of_outlet = {"share_fraction": reached[k], "asked_share_fraction": asked[k]}
        of_outlet["pressure_Pa"] = field.outlet_pressure_Pa[k]
        result |= {f"{role}_{name}": float(value) for name, value in of_outlet.items() if np.isfinite(value)}
    return result


def residuals(case: FlowCase, field: FlowField) -> dict[str, float]:
    """Return what is missing of the flow rates of all openings together, and of each where one is asked, as fractions.

    All are relative to the inflow.
    """
    through_mL_s = np.concatenate([field.inlets_mL_s, field.outlets_mL_s])
    asked_mL_s = np.concatenate([case.inlets_mL_s, _asked_outflow_mL_s(case, field)])
    missing = (asked_mL_s - through_mL_s) / case.inflow_mL_s
    openings = roles(len(field.inlets_mL_s), len(field.outlets_mL_s))
    named = {f"{role}_residual_fraction": float(one) for role, one in zip(openings, missing, strict=True)}
    mass = float((field.inlets_mL_s.sum() - field.outlets_mL_s.sum()) / case.inflow_mL_s)
    return {name: one for name, one in ({"mass_residual_fraction": mass} | named).items() if np.isfinite(one)}


def _asked_outflow_mL_s(case: FlowCase, field: FlowField) -> Floats:
    """Return the flow rate (k,) that the condition at every outlet asks for, nan where it only sets the pressure."""
    if case.resistances:
        outlets_Pa = np.nan_to_num(field.outlet_pressure_Pa)
        return outflows(case.resistances, np.array([case.inflow_mL_s]), outlets_Pa[None])[0][0]
    ends = case.ends[len(case.vessel.inlets) :]
    asked_mL_s = np.array([end.mean_mL_s if isinstance(end, FlowRate) else np.nan for end in ends])
    if case.is_split_given:
        asked_mL_s[np.isnan(asked_mL_s)] = case.inflow_mL_s - np.nansum(asked_mL_s)
    return asked_mL_s


def ratios(before: dict[str, float], after: dict[str, float]) -> dict[str, float]:
    """Return the ratios after over before, ``KEY_ratio``, of the indices in both that are not 0 before."""
    return {f"{key}_ratio": after[key] / value for key, value in before.items() if key in after and value != 0}


class Change(NamedTuple):
    """An index of two flows, in the unit at the end of its name."""

    before: float
    """Value in the first flow."""
    after: float
    """Value in the second flow."""
    ratio: float
    """`after` divided by `before`; nan where that is 0."""


def compare(anatomy: Anatomy, before: FlowField, after: FlowField) -> dict[str, Change]:
    """Compute the hemodynamic indices of two flows in one vessel, and their change.

    Parameters
    ----------
    anatomy : Anatomy
        The vessel of both flows; the indices of the sac are those of its largest aneurysm.
    before : FlowField
        Usually the flow without a device.
    after : FlowField
        Usually the flow with a device.

    Returns
    -------
    dict
        Values before and after and their ratio, by the names of `indices`; those of the vessel alone where it has no
        aneurysm.
    """
    shapes = sac_surfaces(anatomy)
    first, second = indices(before, *shapes), indices(after, *shapes)
    change = ratios(first, second)
    return {key: Change(first[key], second[key], change.get(f"{key}_ratio", np.nan)) for key in first if key in second}


def _of_ostium(field: FlowField, ostium: Surface, beside: Mapping[str, Surface]) -> dict[str, float]:
    """Return the indices of the flow through the ostium, and the inflow through further surfaces."""

    def through(surface: Surface) -> tuple[Floats, Floats]:
        points_mm, area_mm2 = sampling.surface_samples(surface, field.finest.cell_size_mm)
        return sampling.through_surface_mL_s(field, points_mm, area_mm2), np.linalg.norm(area_mm2, axis=1)

    through_mL_s, sizes_mm2 = through(ostium)
    sampled_mL_s = sampling.inflow_mL_s(through_mL_s)
    inflow_mL_s = sampled_mL_s if field.neck_inflow_mL_s is None else field.neck_inflow_mL_s
    factor = inflow_mL_s / max(sampled_mL_s, 1e-12)
    return {
        **{f"{name}_mL_s": factor * sampling.inflow_mL_s(through(one)[0]) for name, one in beside.items()},
        "neck_inflow_mL_s": inflow_mL_s,
        "neck_outflow_mL_s": inflow_mL_s - float(through_mL_s.sum()),
        "inflow_area_fraction": float(sizes_mm2[through_mL_s > 0].sum() / sizes_mm2.sum()),
    }


def _of_sac(field: FlowField, sac: Surface) -> dict[str, float]:
    """Return the indices of the flow in the sac."""
    cells = sampling.field_cells_inside(field, sac)
    speed_m_s, volume = field.speed_m_s[cells], (field.sizes_mm[cells] / field.finest.cell_size_mm) ** 3
    # Cells cut by the sac's wall count fully or not at all, so integrals are scaled to the true volume.
    volume_mm3 = abs(sac.volume_mm3)
    energy_J = (
        0.5 * field.blood.density_kg_m3 * float(np.average(speed_m_s**2, weights=volume)) * volume_mm3 * M_PER_MM**3
    )
    return {
        "mean_sac_velocity_m_s": float(np.average(speed_m_s, weights=volume)),
        "max_sac_velocity_m_s": float(speed_m_s.max()),
        "mean_sac_pressure_Pa": float(np.average(field.pressure_Pa[cells], weights=volume)),
        "sac_kinetic_energy_J": energy_J,
        "fast_sac_volume_mm3": float(np.average(speed_m_s > FAST_M_S, weights=volume)) * volume_mm3,
    }


def _of_sac_wall(field: FlowField, sac: Surface, ostium: Surface) -> dict[str, float]:
    """Return the indices of wall shear stress on the sac and the parent artery."""
    stress_Pa, area_mm2 = field.shear_Pa, vertex_areas_mm2(field.wall)
    is_sac = on_sac(field.wall, sac, ostium)
    is_near = ostium.closest(field.wall.vertices_mm)[1] < NEAR_MM
    moments_Pa = [np.linalg.norm(phase.wall_shear_stress_Pa[is_sac], axis=1) for phase in field.phases]

    def mean(values: Floats | Bools, chosen: Bools = is_sac) -> float:
        return float(np.average(values[chosen], weights=area_mm2[chosen]))

    parent_Pa = mean(stress_Pa, is_near & ~is_sac)
    pulse = {"mean_sac_oscillatory_shear_fraction": mean(field.oscillatory_shear_index)} if field.phases else {}
    return pulse | {
        "mean_sac_wss_Pa": mean(stress_Pa),
        "max_sac_wss_Pa": float(max(one_Pa.max() for one_Pa in moments_Pa or [stress_Pa[is_sac]])),
        "parent_wss_Pa": parent_Pa,
        "low_shear_area_fraction": mean(stress_Pa < LOW_SHEAR_PA),
        "relative_low_shear_area_fraction": mean(stress_Pa < LOW_SHEAR_SHARE * parent_Pa),
    }


def on_sac(wall: Surface, sac: Surface, ostium: Surface) -> Bools:
    """Return which vertices (v,) of the wall belong to a sac: they lie on its surface, and not on the neck's rim."""
    is_sac = np.asarray(sac.closest(wall.vertices_mm)[1] < ON_SAC_MM)
    is_sac[is_sac] = ostium.closest(wall.vertices_mm[is_sac])[1] > RIM_MM
    return is_sac


def vertex_areas_mm2(surface: Surface) -> Floats:
    """Return the area (v,) of every vertex: a third of its faces."""
    area_mm2 = np.repeat(surface.areas_mm2 / 3, 3)
    return np.bincount(surface.faces.ravel(), area_mm2, len(surface.vertices_mm)).astype(np.float64)


def neck_diameter_mm(ostium: Surface) -> float:
    """Return the diameter of a circle with the area of the ostium."""
    return float(np.sqrt(4 * ostium.area_mm2 / np.pi))


def parent_diameter_mm(case: FlowCase) -> float:
    """Return the diameter of the artery beside the neck: of the widest path, a low quartile because a sac widens it."""
    ostium = case.ostium
    assert ostium is not None
    near = [line.inscribed_radius_mm[ostium.closest(line.points_mm)[1] < NEAR_MM] for line in case.vessel.centerlines]
    widths_mm = [2 * float(np.quantile(radius_mm, 0.25)) for radius_mm in near if len(radius_mm)]
    return max(widths_mm, default=mean_diameter_mm(case.vessel))
