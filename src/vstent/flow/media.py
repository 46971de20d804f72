"""The screen model of a stent: a thin, local, anisotropic resistance at the position of the deployed wires."""

import numpy as np

from vstent.devices.design import LaserCut
from vstent.devices.stent import Stent
from vstent.flow.case import Sheet
from vstent.flow.drag import (
    BREADTH,
    crossing_factor,
    drag_per_length,
    inertial_loss,
    parted,
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
PIECE_MM = 0.05
"""Maximum length of a piece of wire, mm."""
ACROSS = 9
"""Number of samples across a wire's band; they are closer together than grid cells."""


def media(stent: Stent, blood: Blood) -> tuple[Sheet, ...]:
    """Build the flow resistances of a deployed stent: one porous sheet, the screen model of its wires.

    Every piece of wire resists like a wire in a row with the local spacing, spread over a band around it. One law
    therefore covers braids, laser-cut cells and mixed wire diameters, also where bends have opened or closed the cells.
    The bands of a braid's wires merge into a sheet; those of laser-cut struts leave the cells between them open. The
    resistance is in proportion to the blood's viscosity.
    """
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
