"""Data classes of a device in an artery: `Landing`, `Stent` and `Deployment`."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np

from vstent.devices.design import Design, Size
from vstent.devices.formulas import grid, mesh_nodes
from vstent.devices.treatment import ANCHORS, Anchor
from vstent.errors import LandingError
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import PARENT
from vstent.kernels import curves
from vstent.kernels.arrays import Floats, Ints, freeze
from vstent.units import MM_PER_UM


@dataclass(frozen=True, eq=False)
class Landing:
    """Position on the parent axis at which a point of the device lies."""

    abscissa_mm: float
    """Arc length on the parent axis, in mm."""
    anchor: Anchor = "center"
    """Point of the device that lies there."""

    def __post_init__(self) -> None:
        if self.anchor not in ANCHORS:
            raise LandingError(
                f"A device cannot be positioned by its {self.anchor!r}. Choose one of {', '.join(ANCHORS)}."
            )


@dataclass(frozen=True, eq=False)
class Stent:
    """A deployed device: its contour and its wires."""

    design: Design
    """The device from the catalogue."""
    size: Size
    """Its size."""
    nodes_mm: Floats
    """(rows, columns, 3) nodes of the contour, in mm. Row 0 is proximal, and each row is one closed loop."""
    row_abscissa_mm: Floats
    """(rows,) arc length of every row on the parent axis, in mm."""
    wire_points_mm: Floats
    """(p, 3) axes of all wires or rings of struts, in mm, polyline after polyline. A ring ends in its first point."""
    wire_starts: Ints
    """(w + 1,) first point of every polyline, followed by p."""
    wire_diameter_um: Floats
    """(w,) wire diameter, or strut width of a laser-cut device, of every polyline, in um."""
    crown_shift_mm: Floats = field(default_factory=lambda: np.zeros((2, 0, 0, 3)))
    """(2, lattice rows, lattice columns, 3) displacement of the crowns of the ring below and of the ring above from the
    node at which they would be joined, in mm; empty unless the device has open cells."""
    path: str = PARENT
    """Name of the path on which it lies; its arc lengths are on the axis of that path."""

    def __post_init__(self) -> None:
        freeze(self, "nodes_mm", np.float64, (-1, -1, 3))
        freeze(self, "row_abscissa_mm", np.float64, (len(self.nodes_mm),))
        freeze(self, "wire_points_mm", np.float64, (-1, 3))
        freeze(self, "wire_starts", np.int32, (-1,))
        freeze(self, "wire_diameter_um", np.float64, (len(self.wire_starts) - 1,))
        freeze(self, "crown_shift_mm", np.float64, (2, -1, -1, 3))

    @cached_property
    def contour(self) -> Surface:
        """Contour as triangles with outward normals; vertex (row, column) has the number row * columns + column."""
        return Surface(self.nodes_mm.reshape(-1, 3), tube_faces(*self.nodes_mm.shape[:2]))

    @property
    def point_wires(self) -> Ints:
        """(p,) wire to which every point belongs."""
        return np.repeat(np.arange(len(self.wire_starts) - 1), np.diff(self.wire_starts))

    @property
    def piece_starts(self) -> Ints:
        """(m,) first points of all straight pieces of wire: every point but the last of each wire."""
        is_last = np.zeros(len(self.wire_points_mm), dtype=bool)
        is_last[self.wire_starts[1:] - 1] = True
        return np.flatnonzero(~is_last)

    @property
    def pieces_mm(self) -> tuple[Floats, Floats, Floats]:
        """First and last points (m, 3) and half the widths (m,) of all straight pieces of wire, in mm."""
        here, points_mm = self.piece_starts, self.wire_points_mm
        half_mm = 0.5 * self.wire_diameter_um[self.point_wires[here]] * MM_PER_UM
        return points_mm[here], points_mm[here + 1], half_mm

    @property
    def wire_length_mm(self) -> float:
        """Total length of all wires, in mm."""
        return float(curves.lengths(np.diff(self.wire_points_mm, axis=0)[self.piece_starts]).sum())

    @property
    def spacing_mm(self) -> float:
        """Distance between neighbouring wires of one of two hands, in mm: 2 area / length of all wires."""
        return 2 * self.contour.area_mm2 / self.wire_length_mm

    @property
    def joints_mm(self) -> Floats:
        """(2, lattice rows, lattice columns, 3) junctions, in mm, as the struts below and above every row end there.

        Both are the same where crowns are joined, and in braids.
        """
        shape = grid(self.design, self.size)
        joined_mm = self.nodes_mm[:: shape.row_split, :: shape.column_split]
        return joined_mm + (self.crown_shift_mm if self.crown_shift_mm.size else np.zeros((2, 1, 1, 1)))

    @cached_property
    def row_diameter_mm(self) -> Floats:
        """(rows,) diameters of circles with the rows' perimeters, in mm, seen along the device."""
        return row_diameters_mm(self.nodes_mm)

    @property
    def proximal_abscissa_mm(self) -> float:
        """Arc length of the proximal end on the parent axis, in mm."""
        return float(self.row_abscissa_mm[0])

    @property
    def distal_abscissa_mm(self) -> float:
        """Arc length of the distal end on the parent axis, in mm."""
        return float(self.row_abscissa_mm[-1])

    @property
    def middle_abscissa_mm(self) -> float:
        """Arc length of the middle row on the parent axis, in mm."""
        return float(self.row_abscissa_mm[(len(self.row_abscissa_mm) - 1) // 2])

    @cached_property
    def mesh_nodes(self) -> tuple[int, int]:
        """First and last row of nodes of the mesh. A dual-layer device has only its outer layer beyond them."""
        return mesh_nodes(self.design, self.size)

    @property
    def mesh_abscissa_mm(self) -> tuple[float, float]:
        """Arc lengths of the proximal and the distal end of the mesh on the parent axis, in mm."""
        first, last = self.row_abscissa_mm[list(self.mesh_nodes)]
        return float(first), float(last)

    @property
    def deployed_length_mm(self) -> float:
        """Length between the ends along the parent axis, in mm."""
        return self.distal_abscissa_mm - self.proximal_abscissa_mm


@dataclass(frozen=True, eq=False)
class Coils(Stent):
    """Coils in a sac, each one wire, the framing coil first; they have no contour."""

    coils: tuple[Size, ...] = ()
    """Size of every coil; its length is that which was pushed in."""
    seed: int = 0
    """Number from which the tips of the catheter and the turns of the framing coil are drawn."""
    sac: Surface = field(default_factory=lambda: Surface(np.zeros((0, 3)), np.zeros((0, 3), np.int32)))
    """Closed surface of the sac that they fill."""

    @property
    def volume_mm3(self) -> float:
        """Volume of the coils, as round as they are wound."""
        return float(np.pi / 4 * (self.wire_diameter_um[0] * MM_PER_UM) ** 2 * self.wire_length_mm)

    @property
    def density_fraction(self) -> float:
        """Packing density: volume of the coils over that of the sac."""
        return self.volume_mm3 / abs(self.sac.volume_mm3)


@dataclass(frozen=True, eq=False)
class Deployment:
    """Result of a deployment."""

    stent: Stent
    """The deployed device."""
    outcome: Literal["terminated", "iteration_limit"]
    """``terminated`` if 99 % of the nodes terminated, else ``iteration_limit``."""
    advice: str
    """Where the device lies, and what to do if it does not fit, in plain words."""
    terminated_fraction: Floats
    """(iterations,) fraction of nodes that have terminated, after every iteration."""
    seconds: float
    """Wall time of the deployment, in s."""
    wall_gap_mm: Floats
    """(rows, columns) gap between the outer face of the device and the landing surface, in mm."""
    history_mm: Floats
    """(iterations + 1, rows, columns, 3) contour before the first and after every iteration, in mm."""
    energy_mm2: Floats
    """(iterations + 1,) energy (Zhong et al. 2016, eq. 1) before the first and after every iteration, in mm2."""

    def __post_init__(self) -> None:
        freeze(self, "terminated_fraction", np.float64, (-1,))
        freeze(self, "wall_gap_mm", np.float64, self.stent.nodes_mm.shape[:2])
        freeze(self, "history_mm", np.float64, (-1, *self.stent.nodes_mm.shape))
        freeze(self, "energy_mm2", np.float64, (len(self.history_mm),))


def row_diameters_mm(nodes_mm: Floats) -> Floats:
    """Compute the diameters (rows,) of circles with the perimeters of the rows (rows, columns, 3), in mm.

    The perimeters are projected along the device because rows may be tilted.
    """
    around_mm = np.roll(nodes_mm, -1, axis=1) - nodes_mm
    columns = nodes_mm.shape[1]
    center_mm = nodes_mm.mean(axis=1)
    # The direction of the device is averaged over about one diameter, since the centers of single rows fluctuate.
    radius_mm = curves.lengths(around_mm).sum(axis=1).mean() / (2 * np.pi)
    step_mm = np.linalg.norm(np.diff(center_mm, axis=0), axis=1).mean()
    reach, row = max(1, round(radius_mm / step_mm)), np.arange(len(center_mm))
    ahead = center_mm[np.minimum(row + reach, row[-1])] - center_mm[np.maximum(row - reach, 0)]
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    across_mm = around_mm - np.einsum("ijk,ik->ij", around_mm, ahead)[..., None] * ahead[:, None]
    # The perimeter of a circle is (pi/n) / sin(pi/n) times that of its regular n-gon.
    return curves.lengths(across_mm).sum(axis=1) / (columns * np.sin(np.pi / columns))


def tube_faces(rows: int, columns: int) -> Ints:
    """Build the triangles (2 (rows - 1) columns, 3) of a tube of rings of vertices.

    They face outward if each ring runs counter-clockwise about the direction of increasing rows.
    """
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij")
    a = row * columns + column
    b = row * columns + (column + 1) % columns
    c, d = a + columns, b + columns
    return np.stack([[a, b, d], [a, d, c]]).transpose(0, 2, 3, 1).reshape(-1, 3).astype(np.int32)
