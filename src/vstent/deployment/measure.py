"""Measure a deployed device: position, apposition, coverage, wire stretch, crumpled cells and covered branches."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from vstent.anatomy.landing_zones import neck_points_mm, neck_span_mm
from vstent.anatomy.morphology import Measures
from vstent.anatomy.restore.paths import on_path
from vstent.deployment.basket import measure_basket
from vstent.deployment.coils import measure_coils
from vstent.deployment.coverage import UNION, density, quad_areas_mm2, together
from vstent.deployment.crowns import free_crowns
from vstent.deployment.crumpling import crumpling_measures
from vstent.deployment.sizing import oversizing_fraction
from vstent.deployment.wall import APPOSED_GAP_MM
from vstent.devices.design import Basket, Coil, piece_length_mm
from vstent.devices.formulas import grid
from vstent.devices.stent import Coils, Deployment, Stent
from vstent.geometry.vessel import Anatomy
from vstent.kernels import curves
from vstent.kernels.arrays import Floats
from vstent.units import MM_PER_UM


def measure(anatomy: Anatomy, deployment: Deployment) -> Measures:
    """Measure a deployed device in its artery.

    Parameters
    ----------
    anatomy : Anatomy
        The artery; a device on another path is measured on that.
    deployment : Deployment
        The deployed device.

    Returns
    -------
    dict
        Numbers whose names end in their unit. Numbers that cannot be measured are left out: those of the neck without
        an aneurysm, pores where none is whole, and gaps where the whole device lies over restored wall.

    Notes
    -----
    Fractions over the "neck" concern the part of the contour that closes the largest aneurysm. Coverage and pore
    density are measured on the drawn wires. The values of the closed formulas at the same mean diameter are listed too.
    """
    anatomy = on_path(anatomy, deployment.stent.path)
    if isinstance(deployment.stent, Coils):
        return measure_coils(anatomy, deployment.stent)
    stretch = wire_stretches(deployment.stent)
    p95 = float(np.quantile(np.abs(stretch), 0.95))
    stretches = {"mean_wire_stretch_fraction": float(stretch.mean()), "p95_wire_stretch_fraction": p95}
    if isinstance(deployment.stent.design, Basket):
        return measure_basket(anatomy, deployment) | stretches
    return (
        _position(anatomy, deployment.stent)
        | apposition(anatomy, deployment)
        | density(anatomy, deployment.stent)
        | stretches
        | crumpling_measures(anatomy, deployment.stent)
        | _free_crowns(anatomy, deployment.stent)
        | _branches(anatomy, deployment.stent)
        | {
            "iterations_count": float(len(deployment.terminated_fraction)),
            "terminated_fraction": float(deployment.terminated_fraction[-1]),
        }
    )


def measure_together(anatomy: Anatomy, stents: Sequence[Stent], measured: Sequence[Measures]) -> Measures:
    """Measure the devices of a treatment as a whole: `together`, and metal over the neck by all of them.

    Wires of devices in the sac count as unrelated to those of stents, since they lie at random behind them.
    """
    in_artery = [stent for stent in stents if not isinstance(stent.design, Basket | Coil)]
    found = together(anatomy, in_artery) if in_artery else {}
    left_open = 1.0 - float(found.get(UNION, 0.0))
    for measures in measured:
        left_open *= 1.0 - float(measures.get("neck_covered_by_coils_fraction", 0.0))
        if "neck_uncovered_fraction" in measures:
            within = 1.0 - float(measures["neck_uncovered_fraction"])
            left_open *= 1.0 - within * float(measures.get("neck_metal_coverage_fraction", 0.0))
    return found | ({UNION: 1.0 - left_open} if anatomy.aneurysms else {})


def _position(anatomy: Anatomy, stent: Stent) -> Measures:
    """Return length, ends, diameters and the distances from the neck."""
    proximal_mm, distal_mm = neck_span_mm(anatomy)
    first_mm, last_mm = stent.mesh_abscissa_mm
    before_mm, after_mm = proximal_mm - first_mm, last_mm - distal_mm
    diameter_mm = stent.row_diameter_mm
    found: Measures = {
        "device": stent.design.name,
        "size": stent.size.label,
        "label_diameter_mm": stent.size.diameter_mm,
        "label_length_mm": stent.size.length_mm,
        "deployed_length_mm": stent.deployed_length_mm,
        "oversizing_fraction": oversizing_fraction(anatomy, stent),
        "proximal_end_abscissa_mm": stent.proximal_abscissa_mm,
        "distal_end_abscissa_mm": stent.distal_abscissa_mm,
        "min_diameter_mm": float(diameter_mm.min()),
        "mean_diameter_mm": float(diameter_mm.mean()),
        "max_diameter_mm": float(diameter_mm.max()),
    }
    if stent.design.beyond_mm:
        found["mesh_length_mm"] = last_mm - first_mm
    if anatomy.aneurysms:
        found["neck_to_proximal_end_mm"] = before_mm
        found["neck_to_distal_end_mm"] = after_mm
        found["neck_covered_fraction"] = float(before_mm >= 0 and after_mm >= 0)
        from_axis_mm = stent.contour.closest(neck_points_mm(anatomy))[1].max()
        found["max_neck_gap_mm"] = max(0.0, float(from_axis_mm) - stent.design.wall_offset_um * MM_PER_UM)
    return found


def apposition(anatomy: Anatomy, deployment: Deployment) -> Measures:
    """Measure the gaps to the patient's own wall, and how far nodes lie outside the landing surface.

    Only the latter is given where the whole device lies over restored wall.
    """
    stent, surface = deployment.stent, anatomy.parent.landing_surface
    points_mm = stent.nodes_mm.reshape(-1, 3)
    _, distance_mm, face = surface.closest(points_mm)
    middle_mm = np.repeat(stent.nodes_mm.mean(axis=1), stent.nodes_mm.shape[1], axis=0)
    outside: Measures = {
        "max_outside_mm": float(np.where(surface.crosses(middle_mm, points_mm), distance_mm, 0.0).max())
    }
    is_wall = anatomy.parent.is_patient_face[face]
    if not is_wall.any():
        return outside
    quarter_mm2 = 0.25 * quad_areas_mm2(stent)
    beside_mm2 = np.pad(quarter_mm2 + np.roll(quarter_mm2, 1, axis=1), ((1, 1), (0, 0)))
    area_mm2 = (beside_mm2[1:] + beside_mm2[:-1]).ravel()[is_wall]  # of the contour that belongs to every node
    gap_mm = deployment.wall_gap_mm.ravel()[is_wall]
    return {
        "apposed_fraction": float((gap_mm < APPOSED_GAP_MM).mean()),
        "mean_wall_gap_mm": float(gap_mm.mean()),
        "max_wall_gap_mm": float(gap_mm.max()),
        "malapposition_volume_mm3": float((gap_mm * area_mm2).sum()),
    } | outside


def wire_stretches(stent: Stent) -> Floats:
    """Return the relative elongation (p,) of every piece of wire or strut between junctions."""
    below_mm, above_mm = stent.joints_mm
    rows, columns = below_mm.shape[:2]
    row, column = np.nonzero(np.add.outer(np.arange(rows - 1), np.arange(columns)) % 2 == 0)
    ends_mm = [below_mm[row + 1, (column + hand) % columns] for hand in (1, -1)]
    length_mm = np.linalg.norm(np.stack(ends_mm) - above_mm[row, column], axis=2).ravel()
    return length_mm / piece_length_mm(stent.design, stent.size) - 1


def _free_crowns(anatomy: Anatomy, stent: Stent) -> Measures:
    """Return the number of free crowns, and how far the farthest ones point out of the artery and into the lumen."""
    if not stent.crown_shift_mm.size:
        return {}
    shape = grid(stent.design, stent.size)
    is_free = free_crowns(stent.design, shape)
    tips_mm = stent.joints_mm[:, is_free].reshape(-1, 3)
    middle_mm = np.tile(stent.nodes_mm.mean(axis=1)[:: shape.row_split][np.nonzero(is_free)[0]], (2, 1))
    distance_mm = anatomy.parent.landing_surface.closest(tips_mm)[1]
    is_outside = anatomy.parent.landing_surface.crosses(middle_mm, tips_mm)
    from_wall_mm = distance_mm - stent.design.wall_offset_um * MM_PER_UM
    return {
        "free_crowns_count": float(len(tips_mm)),
        "max_crown_outward_mm": float(np.where(is_outside, distance_mm, 0.0).max(initial=0.0)),
        "max_crown_inward_mm": float(np.where(is_outside, 0.0, from_wall_mm).max(initial=0.0)),
    }


@lru_cache(maxsize=8)
def branches(anatomy: Anatomy) -> tuple[tuple[float, tuple[str, ...]], ...]:
    """Return the arc lengths on the first path, in mm, at which branches leave it, and the openings they lead to.

    Centerlines that leave it at one place, within the radius of the branch, count as one branch.
    """
    axis, left = anatomy.parent.axis, list[tuple[float, tuple[str, ...]]]()
    ostia_mm: list[Floats] = []
    names = [opening.role for opening in anatomy.vessel.far_ends]
    for number, line in enumerate(anatomy.vessel.centerlines):
        foot_mm, distance_mm = curves.project(axis.points_mm, line.points_mm)
        is_away = distance_mm > np.interp(foot_mm, axis.abscissa_mm, anatomy.parent.section_radius_mm)
        is_gone = np.logical_and.accumulate(is_away[::-1])[::-1]
        first = np.argmax(is_gone)
        ostium_mm, radius_mm = line.points_mm[first], line.inscribed_radius_mm[first]
        if not is_gone[-1]:
            continue
        same = [k for k, other_mm in enumerate(ostia_mm) if np.linalg.norm(ostium_mm - other_mm) <= radius_mm]
        if same:
            left[same[0]] = left[same[0]][0], (*left[same[0]][1], *names[number : number + 1])
        else:
            ostia_mm.append(ostium_mm)
            left.append((float(foot_mm[first]), tuple(names[number : number + 1])))
    return tuple(left)


def jailed_branches(anatomy: Anatomy, stents: Sequence[Stent]) -> tuple[str, ...]:
    """Return the roles of the openings to which the branches lead that leave between the ends of any of the devices."""
    jailed = {
        role
        for stent in stents
        if not isinstance(stent.design, Basket)
        for at_mm, roles in branches(on_path(anatomy, stent.path))
        if stent.proximal_abscissa_mm <= at_mm <= stent.distal_abscissa_mm
        for role in roles
    }
    return tuple(opening.role for opening in anatomy.vessel.far_ends if opening.role in jailed)


def _branches(anatomy: Anatomy, stent: Stent) -> Measures:
    """Return the number of branches between the ends of the device, and each end's distance to the nearest branch."""
    left_mm = np.array([at_mm for at_mm, _ in branches(anatomy)])
    first_mm, last_mm = stent.proximal_abscissa_mm, stent.distal_abscissa_mm
    found: Measures = {"jailed_branches_count": float(((left_mm >= first_mm) & (left_mm <= last_mm)).sum())}
    if len(left_mm):
        found["proximal_end_to_branch_mm"] = float(np.abs(left_mm - first_mm).min())
        found["distal_end_to_branch_mm"] = float(np.abs(left_mm - last_mm).min())
    return found
