"""Measure: the aneurysm's morphology, and how a deployed device lies on the wall."""

from dataclasses import replace
from functools import lru_cache
from typing import Final

import numpy as np
from scipy.spatial.distance import pdist

from vstent.deployment.deploy import APPOSED_GAP_MM
from vstent.deployment.sizing import landing_diameters_mm, neck_points_mm, neck_span_mm, oversizing_fraction
from vstent.devices.design import coverage_fraction, grid, piece_length_mm, pore_density_per_mm2
from vstent.devices.stent import Deployment, Stent
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy, Aneurysm
from vstent.kernels import curves, triangles
from vstent.kernels.arrays import Bools, Floats
from vstent.units import MM_PER_UM

Measures = dict[str, float | str]
"""Numbers by names that end in their unit; a few names hold words."""
Morphology = dict[str, float | str | Measures]
"""The same, with the measures of each further sac under a name of their own: ``sac_2``, ``sac_3``, ..."""

NECK_TOLERANCE_MM: Final = 0.02
"""The neck's triangles lie on the landing surface to within this: they are other triangles than its own."""
PARTED: Final = 0.9
"""A section by the neck plane of less than so much of the neck is a piece: the artery's wall rises through it."""
FEWEST_AXIS_POINTS: Final = 9
"""A shorter axis is too short to tell how it bends."""
BENT: Final = 0.1
"""An axis is bent, and has a torsion, where its curvature exceeds this over the artery's diameter."""
SAMPLES_PER_QUAD: Final = 8
"""Points per direction at which coverage is tried in every quad of the contour."""


def measure(anatomy: Anatomy, deployment: Deployment) -> Measures:
    """Measure how a device lies in its artery.

    What there is nothing to measure by is left out: the neck without an aneurysm, pores where none is whole, gaps where
    all of the device lies over restored wall.

    Fractions over the "neck" concern the part of the contour that closes the largest aneurysm. Coverage and pore
    density are measured on the drawn wires; the closed formulas at the same mean diameter stand beside them.
    """
    return (
        _position(anatomy, deployment.stent)
        | _apposition(anatomy, deployment)
        | _density(anatomy, deployment.stent)
        | _stretch(deployment.stent)
        | _branches(anatomy, deployment.stent)
        | {
            "iterations_count": float(len(deployment.terminated_fraction)),
            "terminated_fraction": float(deployment.terminated_fraction[-1]),
        }
    )


def _position(anatomy: Anatomy, stent: Stent) -> Measures:
    proximal_mm, distal_mm = neck_span_mm(anatomy)
    before_mm, after_mm = proximal_mm - stent.proximal_abscissa_mm, stent.distal_abscissa_mm - distal_mm
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
    if anatomy.aneurysms:
        found["neck_to_proximal_end_mm"] = before_mm
        found["neck_to_distal_end_mm"] = after_mm
        found["neck_covered_fraction"] = float(before_mm >= 0 and after_mm >= 0)
        from_axis_mm = stent.contour.closest(neck_points_mm(anatomy))[1].max()
        found["max_neck_gap_mm"] = max(0.0, float(from_axis_mm) - stent.design.wall_offset_um * MM_PER_UM)
    return found


def _apposition(anatomy: Anatomy, deployment: Deployment) -> Measures:
    stent = deployment.stent
    points_mm = stent.nodes_mm.reshape(-1, 3)
    surface = anatomy.landing_surface
    _, distance_mm, face = surface.closest(points_mm)
    is_wall = ~anatomy.is_restored_face[face]
    middle_mm = np.repeat(stent.nodes_mm.mean(axis=1), stent.nodes_mm.shape[1], axis=0)
    outside_mm = np.where(surface.crosses(middle_mm, points_mm), distance_mm, 0.0)
    gap_mm, area_mm2 = deployment.wall_gap_mm.ravel()[is_wall], _node_areas_mm2(stent).ravel()[is_wall]
    outside: Measures = {"max_outside_mm": float(outside_mm.max())}
    if not is_wall.any():
        return outside
    return {
        "apposed_fraction": float((gap_mm < APPOSED_GAP_MM).mean()),
        "mean_wall_gap_mm": float(gap_mm.mean()),
        "max_wall_gap_mm": float(gap_mm.max()),
        "malapposition_volume_mm3": float((gap_mm * area_mm2).sum()),
    } | outside


def quad_areas_mm2(stent: Stent) -> Floats:
    """Area (rows - 1, columns) of every quad of the contour."""
    return stent.contour.areas_mm2.reshape(2, len(stent.nodes_mm) - 1, -1).sum(axis=0)


def _node_areas_mm2(stent: Stent) -> Floats:
    quarter = 0.25 * quad_areas_mm2(stent)
    beside = quarter + np.roll(quarter, 1, axis=1)
    empty = np.zeros((1, beside.shape[1]))
    return np.concatenate([beside, empty]) + np.concatenate([empty, beside])


def coverage_fractions(stent: Stent) -> Floats:
    """Part (rows - 1, columns) of every quad of the contour under metal, seen square to the contour."""
    from vstent.kernels.coverage import covered_fractions  # compiles on first use

    here = stent.piece_starts
    radius_mm = 0.5 * stent.wire_diameter_um[stent.point_wires[here]] * MM_PER_UM
    points_mm = stent.wire_points_mm
    return covered_fractions(stent.nodes_mm, points_mm[here], points_mm[here + 1], radius_mm, SAMPLES_PER_QUAD)


def pore_areas_mm2(stent: Stent) -> tuple[Floats, Floats]:
    """Area (p,) of every whole pore and its center (p, 3).

    Pores sit where the lattice has no junction; each fills half of the four lattice cells around it.
    """
    shape = grid(stent.design, stent.size)
    lattice_mm = stent.nodes_mm[:: shape.row_split, :: shape.column_split]
    cells = quad_areas_mm2(stent).reshape(
        shape.lattice_rows - 1, shape.row_split, shape.lattice_columns, shape.column_split
    )
    cell_mm2 = cells.sum(axis=(1, 3))
    pairs = cell_mm2 + np.roll(cell_mm2, 1, axis=1)
    area_mm2 = 0.5 * (pairs[:-1] + pairs[1:])
    row, column = np.meshgrid(np.arange(1, shape.lattice_rows - 1), np.arange(shape.lattice_columns), indexing="ij")
    is_pore = (row + column) % 2 == 1
    return area_mm2[is_pore], lattice_mm[1:-1][is_pore]


def _density(anatomy: Anatomy, stent: Stent) -> Measures:
    quads_mm = 0.25 * (stent.nodes_mm[1:] + stent.nodes_mm[:-1])
    quads_mm = (quads_mm + np.roll(quads_mm, -1, axis=1)).reshape(-1, 3)
    hidden, area_mm2 = coverage_fractions(stent).ravel(), quad_areas_mm2(stent).ravel()
    pore_mm2, pores_mm = pore_areas_mm2(stent)
    diameter_mm = float(stent.row_diameter_mm.mean())
    found: Measures = {
        "metal_coverage_fraction": float(np.average(hidden, weights=area_mm2)),
        "metal_coverage_formula_fraction": coverage_fraction(stent.design, stent.size, diameter_mm),
        "pore_density_formula_per_mm2": pore_density_per_mm2(stent.design, stent.size, diameter_mm),
    }
    if len(pores_mm):
        found["pore_density_per_mm2"] = float(len(pore_mm2) / pore_mm2.sum())
    if anatomy.aneurysms:
        on_neck = is_over_neck(anatomy, quads_mm)
        if on_neck.any():
            found["neck_metal_coverage_fraction"] = float(np.average(hidden[on_neck], weights=area_mm2[on_neck]))
        on_neck = is_over_neck(anatomy, pores_mm)
        if on_neck.any():
            found["neck_pore_density_per_mm2"] = float(on_neck.sum() / pore_mm2[on_neck].sum())
    return found


@lru_cache(maxsize=8)
def _neck_on_landing(anatomy: Anatomy) -> Surface:
    """The largest aneurysm's neck moved to the landing surface, which it faces from afar where a sac sits on a fork."""
    neck = anatomy.aneurysms[0].neck
    vertices_mm, faces = triangles.compact(neck.vertices_mm, neck.faces)
    return Surface(anatomy.landing_surface.closest(vertices_mm)[0], faces)


def is_over_neck(anatomy: Anatomy, points_mm: Floats) -> Bools:
    """Tell for (n, 3) points on the device whether the landing surface there closes or faces the largest neck."""
    neck = _neck_on_landing(anatomy)
    at_most_mm = anatomy.landing_surface.closest(points_mm)[1] + NECK_TOLERANCE_MM
    low_mm, high_mm = neck.vertices_mm.min(axis=0), neck.vertices_mm.max(axis=0)
    is_over = curves.lengths(points_mm - np.clip(points_mm, low_mm, high_mm)) <= at_most_mm
    is_over[is_over] = neck.closest(points_mm[is_over])[1] <= at_most_mm[is_over]
    return is_over


def wire_stretches(stent: Stent) -> Floats:
    """By how much every piece of wire (strut) between junctions is longer than it was made, (p,) fractions."""
    shape = grid(stent.design, stent.size)
    junctions_mm = stent.nodes_mm[:: shape.row_split, :: shape.column_split]
    row, column = np.meshgrid(np.arange(shape.lattice_rows - 1), np.arange(shape.lattice_columns), indexing="ij")
    row, column = row[(row + column) % 2 == 0], column[(row + column) % 2 == 0]
    ends_mm = [junctions_mm[row + 1, (column + hand) % shape.lattice_columns] for hand in (1, -1)]
    length_mm = np.linalg.norm(np.stack(ends_mm) - junctions_mm[row, column], axis=2).ravel()
    return length_mm / piece_length_mm(stent.design, stent.size) - 1


def _stretch(stent: Stent) -> Measures:
    stretch = wire_stretches(stent)
    return {
        "mean_wire_stretch_fraction": float(stretch.mean()),
        "p95_wire_stretch_fraction": float(np.quantile(np.abs(stretch), 0.95)),
    }


@lru_cache(maxsize=8)
def branch_abscissas_mm(anatomy: Anatomy) -> Floats:
    """Where on the parent axis (b,) branches leave the parent artery.

    Centerlines that leave it at one place, within the branch's radius, go through one branch.
    """
    axis, left_mm = anatomy.axis, []
    ostia_mm: list[Floats] = []
    for line in anatomy.vessel.centerlines:
        foot_mm, distance_mm = curves.project(axis.points_mm, line.points_mm)
        is_away = distance_mm > np.interp(foot_mm, axis.abscissa_mm, anatomy.section_radius_mm)
        is_gone = np.logical_and.accumulate(is_away[::-1])[::-1]
        first = np.argmax(is_gone)
        ostium_mm, radius_mm = line.points_mm[first], line.inscribed_radius_mm[first]
        if is_gone[-1] and all(np.linalg.norm(ostium_mm - other_mm) > radius_mm for other_mm in ostia_mm):
            ostia_mm.append(ostium_mm)
            left_mm.append(foot_mm[first])
    return np.array(left_mm)


def _branches(anatomy: Anatomy, stent: Stent) -> Measures:
    """Branches between the ends of the device, and how far the nearest branch is from each end."""
    left_mm = branch_abscissas_mm(anatomy)
    first_mm, last_mm = stent.proximal_abscissa_mm, stent.distal_abscissa_mm
    found: Measures = {"jailed_branches_count": float(((left_mm >= first_mm) & (left_mm <= last_mm)).sum())}
    if len(left_mm):
        found["proximal_end_to_branch_mm"] = float(np.abs(left_mm - first_mm).min())
        found["distal_end_to_branch_mm"] = float(np.abs(left_mm - last_mm).min())
    return found


def morphology(anatomy: Anatomy) -> Morphology:
    """Measure the parent artery and its aneurysms: the largest first, others under ``sac_2``, ``sac_3`` and so on.

    Height, aspect ratio and size ratio as defined by Dhar et al. 2008 (Neurosurgery 63:185): the height is measured
    square to the neck plane; the size ratio takes the longest distance from the neck's center to the dome; the neck's
    diameter in the aspect ratio is twice the mean distance from its center to its rim. Volume and area are those of
    the sac, closed across the neck, which is curved like the artery's wall. Most of the literature cuts a sac by a
    plane instead (Raghavan, Ma and Harbaugh 2005, J. Neurosurg. 102:355): the sac beyond the neck plane, which goes
    through the neck's center square to its vector area, and its section by it stand beside; the section is left out
    where the artery's wall rises through the plane and parts it. Curvature and torsion are those of the parent axis
    (Piccinelli et al. 2009, IEEE Trans. Med. Imaging 28:1141), of a quartic through one diameter of it to both sides;
    that much is left out at its ends.
    """
    found: Morphology = {**_parent(anatomy)}
    if anatomy.vessel.threshold_band_mm > 0:
        found["diameter_threshold_band_mm"] = anatomy.vessel.threshold_band_mm
    found |= _course(anatomy)
    for number, aneurysm in enumerate(anatomy.aneurysms, start=1):
        beside = _parent(replace(anatomy, aneurysms=(aneurysm,)))
        measures = _sac(aneurysm, 0.5 * sum(beside.values()))
        found |= measures if number == 1 else {f"sac_{number}": {**beside, **measures}}
    return found


def _parent(anatomy: Anatomy) -> dict[str, float]:
    """Diameters of the parent artery beside the neck of the largest aneurysm."""
    proximal_mm, distal_mm = landing_diameters_mm(anatomy)
    return {"parent_proximal_diameter_mm": proximal_mm, "parent_distal_diameter_mm": distal_mm}


def _course(anatomy: Anatomy) -> Measures:
    """How the parent axis bends and twists; nothing for an axis of a few points."""
    axis = anatomy.axis
    diameter_mm = 2 * float(np.median(anatomy.section_radius_mm))
    inner = (axis.abscissa_mm >= diameter_mm) & (axis.abscissa_mm <= axis.length_mm - diameter_mm)
    if inner.sum() < FEWEST_AXIS_POINTS:
        return {}
    even_mm = curves.resample_evenly(axis.points_mm, len(axis.points_mm))
    curvature, torsion = curves.curvature_and_torsion(even_mm, diameter_mm)
    is_bent = inner & (curvature * diameter_mm > BENT)
    found: Measures = {
        "parent_mean_curvature_per_mm": float(curvature[inner].mean()),
        "parent_max_curvature_per_mm": float(curvature[inner].max()),
        "parent_mean_torsion_per_mm": float(np.abs(torsion[is_bent]).mean()) if is_bent.any() else 0.0,
    }
    if anatomy.aneurysms:
        proximal_mm, distal_mm = neck_span_mm(anatomy)
        at_neck = np.interp(np.linspace(proximal_mm, distal_mm, 51), axis.abscissa_mm, curvature)
        found["neck_mean_curvature_per_mm"] = float(at_neck.mean())
    return found


def _sac(aneurysm: Aneurysm, parent_diameter_mm: float) -> Measures:
    rim_mm, dome_mm = aneurysm.neck_mm, aneurysm.sac.vertices_mm
    center_mm = triangles.polygon_centroid(rim_mm)
    vector_mm2 = triangles.polygon_area_vector(rim_mm)
    neck_area_mm2 = float(np.linalg.norm(vector_mm2))
    normal = vector_mm2 / neck_area_mm2 * np.sign((dome_mm.mean(axis=0) - center_mm) @ vector_mm2)
    height_mm = float(((dome_mm - center_mm) @ normal).max())
    reach_mm = float(np.linalg.norm(dome_mm - center_mm, axis=1).max())
    neck_mean_mm = float(2 * np.linalg.norm(rim_mm - center_mm, axis=1).mean())
    width_mm = _widths_mm(rim_mm, normal)
    plane_area_mm2, plane_volume_mm3 = _beyond(aneurysm.sac, center_mm, normal)
    found: Measures = {
        "sac_volume_mm3": abs(aneurysm.sac.volume_mm3),
        "sac_area_mm2": aneurysm.sac.area_mm2 - aneurysm.neck.area_mm2,
        "sac_height_mm": height_mm,
        "sac_max_height_mm": reach_mm,
        "sac_max_diameter_mm": _diameter_mm(dome_mm),
        "sac_plane_volume_mm3": plane_volume_mm3,
        "neck_area_mm2": neck_area_mm2,
        "neck_surface_area_mm2": aneurysm.neck.area_mm2,
        "neck_perimeter_mm": triangles.perimeter(rim_mm),
        "neck_min_diameter_mm": float(width_mm.min()),
        "neck_max_diameter_mm": float(width_mm.max()),
        "aspect_ratio": height_mm / neck_mean_mm,
        "size_ratio": reach_mm / parent_diameter_mm,
    }
    if plane_area_mm2 > PARTED * neck_area_mm2:
        found["neck_plane_area_mm2"] = plane_area_mm2
    return found


def _beyond(sac: Surface, center_mm: Floats, normal: Floats) -> tuple[float, float]:
    """Area of the largest piece of a sac's section by a plane, and the volume beyond that plane."""
    below_mm = -(sac.vertices_mm - center_mm) @ normal
    vertices, faces, _ = triangles.clip(sac.vertices_mm, sac.faces, below_mm)
    loops = triangles.boundary_loops(vertices, faces)
    capped, closed = triangles.cap(vertices, faces, loops)
    areas = [float(np.linalg.norm(triangles.polygon_area_vector(vertices[loop]))) for loop in loops]
    return max(areas, default=0.0), triangles.volume(capped[closed])


def _diameter_mm(points_mm: Floats) -> float:
    """Largest distance between points (n, 3), sought among those that are outermost in 600 directions."""
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(600)
    z = np.linspace(-1, 1, 600)
    directions = np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], axis=1)
    outermost = np.unique((points_mm @ directions.T).argmax(axis=0))
    return float(pdist(points_mm[outermost]).max())


def _widths_mm(rim_mm: Floats, normal: Floats) -> Floats:
    """Widths (180,) of a closed curve in every direction of the plane square to `normal`, one per degree."""
    first = curves.any_perpendicular(normal)
    second = np.cross(normal, first)
    angle = np.pi * np.arange(180) / 180
    along = rim_mm @ (np.outer(first, np.cos(angle)) + np.outer(second, np.sin(angle)))
    return np.ptp(along, axis=0)
