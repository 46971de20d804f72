"""A device in an artery: the data classes `Landing`, `Stent` and `Deployment`."""

from dataclasses import dataclass
from functools import cached_property
from typing import Final, Literal, get_args

import numpy as np

from vstent.devices.design import Design, Size
from vstent.errors import LandingError
from vstent.geometry.surface import Surface
from vstent.kernels import curves
from vstent.kernels.arrays import Floats, Ints, freeze

Anchor = Literal["center", "distal", "proximal"]
"""A point of a device by which it can be landed."""
ANCHORS: Final[tuple[str, ...]] = get_args(Anchor)


@dataclass(frozen=True, eq=False)
class Landing:
    """Where one point of the device is to lie on the parent axis."""

    abscissa_mm: float
    """Arc length on the parent axis."""
    anchor: Anchor = "center"
    """Which point of the device lies there."""

    def __post_init__(self) -> None:
        if self.anchor not in ANCHORS:
            raise LandingError(
                f"A device cannot be positioned by its {self.anchor!r}. Choose one of {', '.join(ANCHORS)}."
            )


@dataclass(frozen=True, eq=False)
class Stent:
    """A deployed device: its contour and its wires."""

    design: Design
    """The device, from the catalogue."""
    size: Size
    """The size chosen."""
    nodes_mm: Floats
    """(rows, columns, 3) the contour's nodes, row 0 proximal; each row runs once round."""
    row_abscissa_mm: Floats
    """(rows,) arc length of every row on the parent axis."""
    wire_points_mm: Floats
    """(p, 3) axes of all wires or struts, one polyline after another; a laser-cut ring ends in its first point."""
    wire_starts: Ints
    """(w + 1,) first point of every polyline, and p at the end."""
    wire_diameter_um: Floats
    """(w,) diameter (a laser-cut strut: its width) of every polyline."""

    def __post_init__(self) -> None:
        freeze(self, "nodes_mm", np.float64, (-1, -1, 3))
        freeze(self, "row_abscissa_mm", np.float64, (len(self.nodes_mm),))
        freeze(self, "wire_points_mm", np.float64, (-1, 3))
        freeze(self, "wire_starts", np.int32, (-1,))
        freeze(self, "wire_diameter_um", np.float64, (len(self.wire_starts) - 1,))

    @cached_property
    def contour(self) -> Surface:
        """The contour as triangles, normals outward; vertex (row, column) is number row * columns + column."""
        rows, columns = self.nodes_mm.shape[:2]
        return Surface(self.nodes_mm.reshape(-1, 3), tube_faces(rows, columns))

    @property
    def point_wires(self) -> Ints:
        """(p,) the wire that every point belongs to."""
        return np.repeat(np.arange(len(self.wire_starts) - 1), np.diff(self.wire_starts))

    @property
    def piece_starts(self) -> Ints:
        """(m,) points at which pieces of wire begin, each to the next point: all but the last of every wire."""
        is_last = np.zeros(len(self.wire_points_mm), dtype=bool)
        is_last[self.wire_starts[1:] - 1] = True
        return np.flatnonzero(~is_last)

    @property
    def wire_length_mm(self) -> float:
        """Length of all wires together."""
        return float(curves.lengths(np.diff(self.wire_points_mm, axis=0)[self.piece_starts]).sum())

    @property
    def spacing_mm(self) -> float:
        """Distance between neighbouring wires of one family, of two that share all wires: 2 area / length of wire."""
        return 2 * self.contour.area_mm2 / self.wire_length_mm

    @cached_property
    def row_diameter_mm(self) -> Floats:
        """(rows,) diameter of the circle of every row's perimeter, seen along the device: a row may be tilted."""
        return row_diameters_mm(self.nodes_mm)

    @property
    def proximal_abscissa_mm(self) -> float:
        """Where the device begins on the parent axis."""
        return float(self.row_abscissa_mm[0])

    @property
    def distal_abscissa_mm(self) -> float:
        """Where the device ends on the parent axis."""
        return float(self.row_abscissa_mm[-1])

    @property
    def deployed_length_mm(self) -> float:
        """Length along the parent axis between the ends."""
        return self.distal_abscissa_mm - self.proximal_abscissa_mm


@dataclass(frozen=True, eq=False)
class Deployment:
    """What the active contour did."""

    stent: Stent
    """The deployed device."""
    outcome: Literal["terminated", "iteration_limit"]
    """Whether 99 % of the nodes terminated."""
    advice: str
    """One plain sentence: what to know or do about this deployment."""
    terminated_fraction: Floats
    """(iterations,) fraction of nodes terminated after every iteration."""
    seconds: float
    """Wall time of the deployment."""
    wall_gap_mm: Floats
    """(rows, columns) clearance between the device's outer face and the landing surface."""
    history_mm: Floats
    """(iterations + 1, rows, columns, 3) contour before the first and after every iteration."""
    energy_mm2: Floats
    """(iterations + 1,) energy of the contour (Zhong et al. 2016, eq. 1) before the first and after every iteration."""

    def __post_init__(self) -> None:
        freeze(self, "terminated_fraction", np.float64, (-1,))
        freeze(self, "wall_gap_mm", np.float64, self.stent.nodes_mm.shape[:2])
        freeze(self, "history_mm", np.float64, (-1, *self.stent.nodes_mm.shape))
        freeze(self, "energy_mm2", np.float64, (len(self.history_mm),))


def row_diameters_mm(nodes_mm: Floats) -> Floats:
    """Diameters (rows,) of the circles of the perimeters of rows (rows, columns, 3), seen along the device."""
    around_mm = np.roll(nodes_mm, -1, axis=1) - nodes_mm
    columns = nodes_mm.shape[1]
    center_mm = nodes_mm.mean(axis=1)
    # The direction of the device is taken over about one diameter: centers of rows wobble.
    radius_mm = curves.lengths(around_mm).sum(axis=1).mean() / (2 * np.pi)
    step_mm = np.linalg.norm(np.diff(center_mm, axis=0), axis=1).mean()
    reach, row = max(1, round(radius_mm / step_mm)), np.arange(len(center_mm))
    ahead = center_mm[np.minimum(row + reach, row[-1])] - center_mm[np.maximum(row - reach, 0)]
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    across_mm = around_mm - np.einsum("ijk,ik->ij", around_mm, ahead)[..., None] * ahead[:, None]
    # A regular polygon is shorter than its circle by (pi/n) / sin(pi/n).
    return curves.lengths(across_mm).sum(axis=1) / (columns * np.sin(np.pi / columns))


def tube_faces(rows: int, columns: int) -> Ints:
    """Triangles (2 (rows - 1) columns, 3) of a tube of `rows` rings of `columns` vertices.

    Outward when each ring runs counter-clockwise about the direction of growing rows.
    """
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij")
    a = row * columns + column
    b = row * columns + (column + 1) % columns
    c, d = a + columns, b + columns
    first = np.stack([a, b, d], axis=-1).reshape(-1, 3)
    second = np.stack([a, d, c], axis=-1).reshape(-1, 3)
    return np.concatenate([first, second]).astype(np.int32)
