"""Closed formulas for braids and laser-cut cells: row spacing, deployed length, coverage and pore density."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vstent.devices.design import (
    STEEP_RAD,
    Basket,
    Design,
    Size,
    angle_rad,
    free_sine,
    piece_length_mm,
    strips_fraction,
    widest_mm,
)
from vstent.errors import DeviceError
from vstent.units import MM_PER_UM

BEND_SAMPLES, BEND_STEPS = 12, 6
"""Row spacing in a bend: angles around half of the axis (the other half is symmetric), and number of Newton steps."""
STEEPEST_BEND = 0.9
"""Largest ratio of the artery's radius to the radius of its bend. Sharper bends occur only where the wall is folded."""
STRAIGHTEST = 0.995
"""Largest cosine of the angle between the axis and the wires on the outer side of a bend."""
MERIDIAN_SAMPLES = 401
"""Number of samples of a quarter of the section of a free basket."""
NODE_SPACING_LIMIT_MM = 0.35
"""Largest distance between nodes of a contour at the label diameter, in mm."""


class Grid(NamedTuple):
    """Numbers of nodes and lattice rows and columns of a contour."""

    rows: int
    """Rows of nodes."""
    columns: int
    """Nodes in a row."""
    row_split: int
    """Rows of nodes per lattice row."""
    column_split: int
    """Columns of nodes per lattice column."""

    @property
    def lattice_rows(self) -> int:
        """Rows of junctions."""
        return (self.rows - 1) // self.row_split + 1

    @property
    def lattice_columns(self) -> int:
        """Columns of the lattice."""
        return self.columns // self.column_split


def grid(design: Design, size: Size) -> Grid:
    """Return the grid of the contour: one node per lattice row and column, more where cells are large."""
    spacing_mm = float(row_spacing_mm(design, size, size.diameter_mm))
    if isinstance(design, Basket):
        rows = rows_along(design, size, *meridian_mm(design, size))[-1]
        return Grid((2 * round(0.5 * rows) if design.is_cup else round(rows)) + 1, design.n_columns, 1, 1)
    rows = max(2, round(size.compacted_length_mm / spacing_mm) + 1) + 2 * _bare_rows(design, size)
    row_split = int(np.ceil(spacing_mm / NODE_SPACING_LIMIT_MM))
    column_split = int(np.ceil(np.pi * size.diameter_mm / design.n_columns / NODE_SPACING_LIMIT_MM))
    return Grid((rows - 1) * row_split + 1, design.n_columns * column_split, row_split, column_split)


def meridian_mm(basket: Basket, size: Size) -> tuple[np.ndarray, np.ndarray]:
    """Return heights (m,) and radii (m,) along the meridian of a free basket, from marker to marker, in mm."""
    quarter = 0.5 - 0.5 * np.cos(np.pi * np.linspace(0.0, 1.0, MERIDIAN_SAMPLES))  # dense where it turns
    angle = 0.5 * np.pi * np.concatenate([quarter, 1 + quarter[1:]])
    power = 2 / basket.exponent
    radius_mm = 0.5 * size.free_diameter_mm * np.sin(angle) ** power
    height_mm = 0.5 * size.length_mm * (1 - np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** power)
    is_mesh = radius_mm >= basket.marker_radius_mm
    return height_mm[is_mesh], radius_mm[is_mesh]


def rows_along(basket: Basket, size: Size, height_mm: np.ndarray, radius_mm: np.ndarray) -> np.ndarray:
    """Return the number (m,) of rows of crossings up to every point of a meridian, heights (m,) and radii (m,) in mm.

    A piece of wire of length l spans one column, 2 pi r / n, around the basket, and rows are sqrt(l^2 - (2 pi r / n)^2)
    apart along the meridian. On a sphere, r = R sin(t), all rows are (2 R / l) K(m), with the complete elliptic
    integral K and the square m of the sine of the wires' angle at the equator.
    """
    column_mm = 2 * np.pi * radius_mm / basket.n_columns
    per_mm = 1 / np.sqrt(np.maximum(piece_length_mm(basket, size) ** 2 - column_mm**2, 1e-12))
    step_mm = np.hypot(np.diff(height_mm), np.diff(radius_mm))
    return np.concatenate([[0.0], np.cumsum(0.5 * (per_mm[1:] + per_mm[:-1]) * step_mm)])


def _bare_rows(design: Design, size: Size) -> int:
    """Return the number of lattice rows at each end that carry only an outer layer."""
    beyond_mm = design.beyond_mm * (1 - size.compaction_fraction)
    return round(beyond_mm / float(row_spacing_mm(design, size, size.diameter_mm))) if beyond_mm else 0


def mesh_rows(design: Design, size: Size) -> tuple[int, int]:
    """Return the first and the last lattice row of the mesh; a dual-layer device has further rows at both ends."""
    bare = _bare_rows(design, size)
    return bare, grid(design, size).lattice_rows - 1 - bare


def mesh_nodes(design: Design, size: Size) -> tuple[int, int]:
    """Return the first and the last row of nodes of the mesh; a dual-layer device has only its outer layer beyond."""
    first, last = mesh_rows(design, size)
    split = grid(design, size).row_split
    return first * split, last * split


def free_diameters_mm(design: Design, size: Size) -> np.ndarray:
    """Return the free diameter of every row of nodes (rows,), in mm."""
    rows = grid(design, size).rows
    if not size.free_profile_mm:
        return np.full(rows, size.free_diameter_mm)
    where, diameter_mm = np.transpose(size.free_profile_mm)
    return np.minimum(np.interp(np.linspace(0.0, 1.0, rows), where, diameter_mm), widest_mm(design, size))


def compacted(design: Design, size: Size, fraction: float) -> Size:
    """Compact a braid: push it together by a fraction of its length, or pull it apart with a negative one.

    The ends of the wires are free. When the braid is pushed, its wires wind more often around it and cross more often.
    A wire of the same length over the fraction (1 - q) of the axis has cos(alpha) = (1 - q) cos(alpha at the label
    diameter). A DeviceError is raised where the wires would become too steep or too straight, or cells are joined.
    """
    if fraction == 0.0:
        return size
    changed = replace(size, compaction_fraction=fraction)
    if design.kind != "braid":
        why, then = "its cells are joined", "0, or another device"
    elif np.sin(STEEP_RAD[0]) < free_sine(design, changed) < np.sin(STEEP_RAD[1]):
        return changed
    else:
        why = "its wires would be too steep" if fraction > 0 else "its wires would be pulled straight"
        then = "a fraction nearer to 0"
    raise DeviceError(
        f"{design.name} {size.label} cannot be compacted by {fraction:g} of its length, because {why}. Give {then}."
    )


def row_spacing_mm(
    design: Design, size: Size, diameter_mm: float | np.ndarray, curvature_per_mm: float | np.ndarray = 0.0
) -> np.ndarray:
    """Compute the distance h along the axis between rows of junctions at a local diameter.

    Diameters above the largest free one count as that; `curvature_per_mm` is the curvature of the axis.

    Notes
    -----
    Let k = curvature D / 2. In a bend, rows are h (1 + k cos(theta)) apart at the angle theta around the axis. Pieces
    of wire keep their length l, so that cos(alpha) = h (1 + k cos(theta)) / l. A column occupies l sin(alpha) of the
    circumference. The n columns fill the circumference where the mean of 1 / sin(alpha) around it is n l / (pi D). The
    spacing h is smaller than in a straight artery: columns narrow on the outer side of the bend, where wires are drawn
    along the axis, more than they widen on the inner side.

    The only assumption is that pieces keep their length between crossings, and that the wires keep their crossings. The
    formula therefore holds for the joined struts of a laser-cut device as well, as long as its cells can be apposed.
    Where h (1 + k), with the h of a straight artery, would exceed l, cells on the outer side begin to leave the wall,
    and the device is longer than this formula predicts.

    References
    ----------
    Chebyshev (1878), Sur la coupe des vetements: the net of inextensible threads, here on a torus.
    """
    piece_mm, angle = piece_length_mm(design, size), angle_rad(design, size, diameter_mm)
    if not np.any(curvature_per_mm):
        return piece_mm * np.cos(angle)
    opened_mm = np.minimum(diameter_mm, widest_mm(design, size))
    bend = np.minimum(0.5 * np.abs(curvature_per_mm) * opened_mm, STEEPEST_BEND)
    apart = 1 + np.multiply.outer(bend, np.cos(np.pi * (np.arange(BEND_SAMPLES) + 0.5) / BEND_SAMPLES))
    longest = STRAIGHTEST / (1 + bend)
    cosine = np.minimum(np.cos(angle), longest)
    for _ in range(BEND_STEPS):  # Newton steps; the mean is convex in the cosine
        width = 1 / np.sqrt(1 - (cosine[..., None] * apart) ** 2)
        excess = width.mean(axis=-1) - 1 / np.sin(angle)
        slope = cosine * (apart * apart * width * width * width).mean(axis=-1)
        cosine = np.clip(cosine - excess / slope, 0.0, longest)
    return piece_mm * cosine


def deployed_length_mm(design: Design, size: Size, diameter_mm: float) -> float:
    """Return the length of the device in a straight tube with the contour diameter `diameter_mm`, in mm."""
    shape = grid(design, size)
    if size.free_profile_mm:
        opened_mm = np.minimum(diameter_mm, free_diameters_mm(design, size))
        step_mm = row_spacing_mm(design, size, opened_mm) / shape.row_split
        return float(0.5 * (step_mm[1:] + step_mm[:-1]).sum())
    return float((shape.lattice_rows - 1) * row_spacing_mm(design, size, diameter_mm))


def foreshortening_fraction(design: Design, size: Size, diameter_mm: float) -> float:
    """Compute the shortening at a local diameter relative to the label.

    It is 1 - L(D)/L_label = 1 - (1 - q) cos(alpha)/cos(alpha_label), with q the compaction.
    """
    here, label = angle_rad(design, size, np.array([diameter_mm, size.diameter_mm]))
    return float(1 - (1 - size.compaction_fraction) * np.cos(here) / np.cos(label))


def coverage_fraction(design: Design, size: Size, diameter_mm: float) -> float:
    """Compute the fraction of the wall under metal at a local diameter.

    With f = sum of the wire diameters of one hand / (pi D cos(alpha)), the two hands of a braid cover 1 - (1 - f)^2.
    An outer layer leaves the fraction (1 - g)^2 of the rest open, g being the same for its wires. For laser-cut struts,
    which meet without crossing, f counts all struts and is the coverage; free crowns of open cells are shorter by half
    of the gap between them.
    """
    hand, layer = (
        min(1.0, strips_fraction(design, size, diameter_mm, strips_um))
        for strips_um in (design.hand_um, design.layer_um)
    )
    spacing_mm = float(row_spacing_mm(design, size, size.diameter_mm))
    shorter = (1 - design.joined_fraction) * design.crown_gap_um * MM_PER_UM / spacing_mm
    return design.covered(hand, layer) * (1 - shorter)


def pore_density_per_mm2(design: Design, size: Size, diameter_mm: float) -> float:
    """Compute the number of pores per mm2 of wall at a local diameter: 2 (n/2)^2 tan(alpha) / (pi D)^2.

    A free crown of open cells leaves two pores joined, so the number is multiplied by the fraction of joined crowns.
    """
    tangent = float(np.tan(angle_rad(design, size, diameter_mm)))
    return float(design.joined_fraction * 0.5 * design.n_columns**2 * tangent / (np.pi * diameter_mm) ** 2)
