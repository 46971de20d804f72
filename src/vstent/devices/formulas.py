"""Closed formulas of braids and of laser-cut cells: row spacing, deployed length, coverage and pore density."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vstent.devices.design import (
    STEEP_RAD,
    Braid,
    Design,
    LaserCut,
    Size,
    angle_rad,
    free_sine,
    piece_length_mm,
    strips_fraction,
)
from vstent.errors import DeviceError

BEND_SAMPLES, BEND_STEPS = 12, 6
"""Angles round half the axis (the other half mirrors it), and Newton steps, for the spacing of rows in a bend."""
STEEPEST_BEND = 0.9
"""Artery's radius over the bend's, at most: sharper ones are only sharp where the wall is folded."""
STRAIGHTEST = 0.995
"""Cosine of the angle that wires outside a bend have to the axis, at most."""
NODE_SPACING_LIMIT_MM = 0.35
"""A contour's nodes are never further apart than this at the label diameter."""


class Grid(NamedTuple):
    """How a device's lattice is laid on the contour's nodes."""

    rows: int
    """Rows of nodes."""
    columns: int
    """Nodes of a row."""
    row_split: int
    """Node rows per lattice row."""
    column_split: int
    """Node columns per lattice column."""

    @property
    def lattice_rows(self) -> int:
        """Rows of junctions."""
        return (self.rows - 1) // self.row_split + 1

    @property
    def lattice_columns(self) -> int:
        """Columns of the lattice."""
        return self.columns // self.column_split


def grid(design: Design, size: Size) -> Grid:
    """Return the contour's grid: one node per junction column and row, finer where cells are large."""
    spacing_mm = float(row_spacing_mm(design, size, size.diameter_mm))
    rows = max(2, round(size.compacted_length_mm / spacing_mm) + 1)
    row_split = int(np.ceil(spacing_mm / NODE_SPACING_LIMIT_MM))
    column_split = int(np.ceil(np.pi * size.diameter_mm / design.n_columns / NODE_SPACING_LIMIT_MM))
    return Grid((rows - 1) * row_split + 1, design.n_columns * column_split, row_split, column_split)


def compacted(design: Design, size: Size, fraction: float) -> Size:
    """Return a size of a braid pushed together (pulled apart: below zero) by a part of its length.

    The wires' ends are free: pushed, wires wind more often round the device and cross more often. A wire of the same
    length over the fraction (1 - q) of the axis has cos(alpha) = (1 - q) cos(alpha of the label).

    Raises
    ------
    DeviceError
        When the wires of such a device would stand too steep, or the device has none.
    """
    if fraction == 0.0:
        return size
    changed = replace(size, compaction_fraction=fraction)
    if not (isinstance(design, Braid) and np.sin(STEEP_RAD[0]) < free_sine(design, changed) < np.sin(STEEP_RAD[1])):
        would = "its wires would be too steep" if fraction > 0 else "its wires would be pulled straight"
        why, then = (
            (would, "a fraction nearer to 0")
            if isinstance(design, Braid)
            else ("its cells are joined", "0, or another device")
        )
        raise DeviceError(
            f"{design.name} {size.label} cannot be compacted by {fraction:g} of its length, because {why}. Give {then}."
        )
    return changed


def row_spacing_mm(
    design: Design, size: Size, diameter_mm: float | np.ndarray, curvature_per_mm: float | np.ndarray = 0.0
) -> np.ndarray:
    """Distance h along the axis between rows of junctions at a local diameter, at most the free one.

    Where the axis bends, rows are h (1 + k cos(theta)) apart at the angle theta round it, k = curvature D / 2. Pieces
    of wire keep their length l, so that cos(alpha) = h (1 + k cos(theta)) / l, and a column takes l sin(alpha) of the
    circumference: n of them fill it when the mean of 1 / sin(alpha) round it is n l / (pi D). h is less than in a
    straight artery: what columns lose outside, where wires are drawn along the axis, is more than what they gain
    inside. This is the net of inextensible threads (Chebyshev 1878, Sur la coupe des vetements) on a torus. It asks
    nothing but that pieces keep their length between crossings that all their wires keep, so it holds for the joined
    struts of a laser-cut device as for a braid, as long as its cells can lie against the wall: where h (1 + k) would
    have to exceed l in a straight artery's rows they begin to leave it outside, and the device is longer than this.
    """
    piece_mm, angle = piece_length_mm(design, size), angle_rad(design, size, diameter_mm)
    if not np.any(curvature_per_mm):
        return piece_mm * np.cos(angle)
    opened_mm = np.minimum(diameter_mm, size.free_diameter_mm)
    bend = np.minimum(0.5 * np.abs(curvature_per_mm) * opened_mm, STEEPEST_BEND)
    apart = 1 + np.multiply.outer(bend, np.cos(np.pi * (np.arange(BEND_SAMPLES) + 0.5) / BEND_SAMPLES))
    longest = STRAIGHTEST / (1 + bend)
    cosine = np.minimum(np.cos(angle), longest)
    for _ in range(BEND_STEPS):  # Newton's; the mean grows faster than linearly with the cosine
        width = 1 / np.sqrt(1 - (cosine[..., None] * apart) ** 2)
        excess = width.mean(axis=-1) - 1 / np.sin(angle)
        slope = cosine * (apart * apart * width * width * width).mean(axis=-1)
        cosine = np.clip(cosine - excess / slope, 0.0, longest)
    return piece_mm * cosine


def deployed_length_mm(design: Design, size: Size, diameter_mm: float) -> float:
    """Length in a straight tube where the contour's diameter is `diameter_mm` all along."""
    rows = grid(design, size).lattice_rows
    return float((rows - 1) * row_spacing_mm(design, size, diameter_mm))


def foreshortening_fraction(design: Design, size: Size, diameter_mm: float) -> float:
    """Shortening at a local diameter against the label: 1 - L(D)/L_label = 1 - (1 - q) cos(alpha)/cos(alpha_label)."""
    here, label = angle_rad(design, size, np.array([diameter_mm, size.diameter_mm]))
    return float(1 - (1 - size.compaction_fraction) * np.cos(here) / np.cos(label))


def coverage_fraction(design: Design, size: Size, diameter_mm: float) -> float:
    """Part of the wall under metal at a local diameter.

    Two hands of strips cover 1 - (1 - f)^2, f = sum of wire diameters of one hand / (pi D cos(alpha)); struts that
    meet without crossing cover 2 f.
    """
    strips = min(1.0, strips_fraction(design, size, diameter_mm))
    return strips if isinstance(design, LaserCut) else 1 - (1 - strips) ** 2


def pore_density_per_mm2(design: Design, size: Size, diameter_mm: float) -> float:
    """Pores per area of wall at a local diameter: 2 (n/2)^2 tan(alpha) / (pi D)^2."""
    tangent = float(np.tan(angle_rad(design, size, diameter_mm)))
    return float(0.5 * design.n_columns**2 * tangent / (np.pi * diameter_mm) ** 2)
