"""The screen model of a stent: a thin, local, anisotropic resistance at the position of the deployed wires."""

import numpy as np

from vstent.devices.design import LaserCut
from vstent.devices.stent import Coils, Stent
from vstent.flow.case import Sheet
from vstent.flow.drag import (
    BREADTH,
    COIL_INERTIA,
    crossing_factor,
    drag_per_length,
    inertial_loss,
    parted,
    permeability_mm2,
    round_diameter,
    tangential_share,
)
from vstent.flow.settings import Blood
from vstent.geometry.surface import Surface
from vstent.kernels import curves, nearby
from vstent.kernels.arrays import Floats, Ints
from vstent.units import M_PER_MM, MM_PER_UM

SMOOTHING_PORES = 1.5
"""Radius of the neighbourhood in which wire length per area is measured, in mean wire spacings."""
SAMPLE_REACHES = 0.2
"""Maximum edge between the surface samples that measure the area of such a neighbourhood, in its radii."""
REGION_MM = 0.15
"""Spacing of the samples of a region of coils."""
AROUND_COILS = 1.0
"""Radius of the neighbourhood in which the density of coils is measured, in wound diameters: a wider one fills the gap
between the neck and the first loops (`benchmarks/coils.py`)."""
SPARSEST_COILS, DENSEST_COILS = 0.005, 0.6
"""Local densities below which coils do not resist, and above which they do as at this one."""
PIECE_MM = 0.05
"""Maximum length of a piece of wire, mm."""
ACROSS = 9
"""Number of samples across a wire's band; they are closer together than grid cells."""


def media(stent: Stent, blood: Blood) -> tuple[Sheet, ...]:
    """Build the flow resistances of a deployed stent: one porous sheet, the screen model of its wires.

    Those of coils are one porous region.

    Every piece of wire resists like a wire in a row with the local spacing, spread over a band around it. One law
    therefore covers braids, laser-cut cells and mixed wire diameters, also where bends have opened or closed the cells.
    The bands of a braid's wires merge into a sheet; those of laser-cut struts leave the cells between them open. The
    resistance is in proportion to the blood's viscosity.
    """
    if isinstance(stent, Coils):
        return (_region(stent, blood),)
    pieces = _pieces(stent)
    points_mm, along_mm, diameter_mm = pieces
    reach_mm = SMOOTHING_PORES * stent.spacing_mm
    sheet = _sheet(stent.contour, points_mm, curves.lengths(along_mm), reach_mm)
    face = sheet.closest(points_mm)[2]
    spacing_mm, lengthwise, solidity = _net(stent, sheet, face, pieces, reach_mm)
    drag = drag_per_length(diameter_mm, spacing_mm) * crossing_factor(diameter_mm, spacing_mm)
    normal_Pa_s_m = blood.viscosity_Pa_s * drag * 2 / (spacing_mm * M_PER_MM)
    tangential_Pa_s_m = normal_Pa_s_m * tangential_share(solidity, lengthwise, parted(spacing_mm))
    normals = sheet.normals[face]
    band_mm, area_mm2 = bands(points_mm, along_mm, normals, spacing_mm)
    columns = normals, area_mm2, normal_Pa_s_m, tangential_Pa_s_m, inertial_loss(solidity), diameter_mm, spacing_mm
    return (Sheet(band_mm.reshape(-1, 3), *(np.repeat(column, ACROSS, axis=0) for column in columns)),)


def _region(coils: Coils, blood: Blood) -> Sheet:
    """Build the flow resistance of coils: a porous region of their local density, alike in all directions.

    The density at a point is the volume of coil over that of the sac around it. Coils have no preferred direction, and
    a grid of usual spacing does not see single ones.
    """
    first_mm, last_mm, half_mm = coils.pieces_mm
    wound_mm = 2 * float(half_mm[0])
    low_mm, high_mm = coils.sac.vertices_mm.min(axis=0), coils.sac.vertices_mm.max(axis=0)
    shape = np.ceil((high_mm - low_mm) / REGION_MM).astype(int) + 1
    points_mm = low_mm + np.indices(shape).reshape(3, -1).T * REGION_MM
    points_mm = points_mm[coils.sac.signed_distance(points_mm) < 0]
    volume_mm3 = np.full((len(points_mm), 1), REGION_MM**3)
    coil_mm3 = np.pi * half_mm**2 * curves.lengths(last_mm - first_mm)
    reach_mm = AROUND_COILS * wound_mm
    around_mm3 = nearby.sums(points_mm, points_mm, volume_mm3, reach_mm)[:, 0]
    density = nearby.sums(points_mm, 0.5 * (first_mm + last_mm), coil_mm3[:, None], reach_mm)[:, 0] / around_mm3
    is_filled = density > SPARSEST_COILS
    permeability = permeability_mm2(np.minimum(density[is_filled], DENSEST_COILS), wound_mm)
    resistance_Pa_s_m = blood.viscosity_Pa_s / (permeability * M_PER_MM)
    loss, wound = 4 * COIL_INERTIA * wound_mm / permeability, np.full(len(permeability), wound_mm)
    where, still = points_mm[is_filled], np.zeros((len(permeability), 3))
    volumes = volume_mm3[is_filled, 0]
    return Sheet(where, still, volumes, resistance_Pa_s_m, resistance_Pa_s_m, loss, wound, wound)


def bands(points_mm: Floats, along_mm: Floats, normals: Floats, spacing_mm: Floats) -> tuple[Floats, Floats]:
    """Spread pieces of wire, midpoints and vectors (p, 3) on a surface with normals (p, 3), over their bands.

    Each of two crossing families represents half of the surface. Returns sample points (p, `ACROSS`, 3) across every
    band, and the area (p,) in mm2 that each sample of a piece represents.
    """
    length_mm = curves.lengths(along_mm)
    sideways = np.cross(normals, along_mm) / length_mm[:, None]
    at_mm = BREADTH * spacing_mm[:, None] * ((np.arange(ACROSS) + 0.5) / ACROSS - 0.5)
    samples_mm = at_mm[:, :, None] * sideways[:, None]
    samples_mm += points_mm[:, None]
    return samples_mm, 0.5 * length_mm * spacing_mm / ACROSS


def _net(
    stent: Stent, sheet: Surface, face: Ints, pieces: tuple[Floats, Floats, Floats], reach_mm: float
) -> tuple[Floats, Floats, Floats]:
    """Return for all pieces (p,) the wire spacing in mm, the squared cosine to the device's axis, and the solidity.

    The length of wire per area, lambda, is measured around every node of the sheet over a few pores. The spacing of two
    crossing families is then s = 2 / lambda. A piece takes the mean of the corners of the face below it.
    """
    points_mm, along_mm, diameter_mm = pieces
    length_mm, nodes_mm = curves.lengths(along_mm), sheet.vertices_mm
    axis_mm = np.gradient(stent.nodes_mm, axis=0).reshape(-1, 3)[sheet.faces].mean(axis=1)
    size_mm2 = (axis_mm**2).sum(axis=1)[face] * np.einsum("pd,pd->p", along_mm, along_mm)
    lengthwise = np.einsum("pd,pd->p", axis_mm[face], along_mm) ** 2 / size_mm2
    columns = np.stack([length_mm, length_mm * lengthwise, length_mm * diameter_mm], axis=1)
    of_wires = nearby.sums(nodes_mm, points_mm, columns, reach_mm)
    area_mm2 = nearby.areas(nodes_mm, sheet.corners_mm, SAMPLE_REACHES * reach_mm, reach_mm)
    around = np.column_stack([area_mm2, of_wires])[sheet.faces].mean(axis=1)
    area_mm2, wire_mm, lengthwise_mm, covered_mm2 = around[face].T
    return 2 * area_mm2 / wire_mm, lengthwise_mm / wire_mm, 0.5 * covered_mm2 / area_mm2


def _sheet(contour: Surface, points_mm: Floats, length_mm: Floats, reach_mm: float) -> Surface:
    """Return the contour, moved along its normals to the mean height of the wires near it."""
    below_mm, _, face = contour.closest(points_mm)
    height_mm = np.einsum("pd,pd->p", points_mm - below_mm, contour.normals[face])
    columns = np.stack([length_mm * height_mm, length_mm], axis=1)
    risen_mm2, wire_mm = nearby.sums(contour.vertices_mm, points_mm, columns, reach_mm).T
    mean_mm = risen_mm2 / np.maximum(wire_mm, 1e-300)
    return Surface(contour.vertices_mm + mean_mm[:, None] * contour.vertex_normals, contour.faces)


def _pieces(stent: Stent) -> tuple[Floats, Floats, Floats]:
    """Return wires cut into pieces of at most `PIECE_MM`: midpoints (p, 3), vectors (p, 3) and diameters (p,) in mm.

    A rectangular strut gets the diameter of the round wire with the same drag.
    """
    inner, diameter_um = stent.piece_starts, stent.wire_diameter_um
    if isinstance(stent.design, LaserCut):
        widths_um, which = np.unique(diameter_um, return_inverse=True)
        diameter_um = np.array([round_diameter(one, stent.design.strut_thickness_um) for one in widths_um])[which]
    a, b = stent.wire_points_mm[inner], stent.wire_points_mm[inner + 1]
    count, owner, part = cut(np.linalg.norm(b - a, axis=1), PIECE_MM)
    diameter_mm = diameter_um[stent.point_wires[inner]] * MM_PER_UM
    return a[owner] + part[:, None] * (b - a)[owner], ((b - a) / count[:, None])[owner], diameter_mm[owner]


def cut(length_mm: Floats, longest_mm: float) -> tuple[Ints, Ints, Floats]:
    """Cut lines (n,) into equal pieces: return their number (n,), and of all pieces (p,) line and relative midpoint."""
    count = np.maximum(np.ceil(length_mm / longest_mm).astype(int), 1)
    owner = np.repeat(np.arange(len(count)), count)
    rank = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    return count, owner, (rank + 0.5) / count[owner]
