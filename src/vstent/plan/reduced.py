"""Reduced model of a deployed device: what changes with its numbers, without another deployment.

- *Ends*: the rows are marched again (`vstent.deployment.braid.march`), with the altered wires, in the artery as the
  deployed device measured it. A braid is shortened besides (`vstent.plan.shortening`).
- *Coverage and pore density over the neck*: the deployed device states the height h and the width w of the lattice at
  each place over the neck, which in a bend are not those of a straight artery. Rows move apart as in the closed
  formula, and a piece of wire keeps its length l, with l^2 = w^2 + h^2. Wires of diameter d of one hand cover the
  fraction d l / (2 w h).
- *Gaps*: a braid that opens less wide has a gap of half of the difference.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np

from vstent.deployment.braid import FREELY, Profile, expected_profile, march
from vstent.deployment.coverage import is_over_neck, quad_areas_mm2
from vstent.devices.design import Design, LaserCut, Size, piece_length_mm, widest_mm
from vstent.devices.formulas import free_diameters_mm, grid, mesh_nodes
from vstent.devices.stent import Deployment, Landing
from vstent.geometry.vessel import Anatomy
from vstent.kernels.arrays import Bools, Floats, Ints
from vstent.units import MM_PER_UM

NARROWEST: Final = 0.1
"""Smallest sine of the angle between wire and axis, as in tight bends (`vstent.devices.formulas.STRAIGHTEST`)."""


class Changed(NamedTuple):
    """A deployed device with other numbers, as the reduced model has it."""

    first_mm: float
    """Arc length of the proximal end, in mm."""
    last_mm: float
    """Arc length of the distal end, in mm."""
    mesh_first_mm: float
    """Arc length of the proximal end of the mesh, in mm. A dual-layer device has only its outer layer beyond it."""
    mesh_last_mm: float
    """Arc length of the distal end of the mesh, in mm."""
    gap_mm: Floats
    """(nodes,) gaps to the patient's own wall, at the nodes of the deployed device, in mm."""
    coverage_fraction: float
    """Metal coverage over the neck; NaN where nothing of the device lies over it."""
    pore_density_per_mm2: float
    """Pore density over the neck, per mm2; NaN where nothing of the device lies over it."""


class _Neck(NamedTuple):
    """Quads of the contour over the neck, with the lattice there."""

    stations_mm: Floats
    """(k,) arc lengths at which quads lie, in mm."""
    station: Ints
    """(q,) station of every quad."""
    height_mm: Floats
    """(q,) distance between rows of junctions, in mm."""
    width_mm: Floats
    """(q,) distance between columns of junctions, in mm."""
    area_mm2: Floats
    """(q,) areas of the quads, in mm2."""


@dataclass(frozen=True, eq=False)
class Reduced:
    """Reduced model of one deployment."""

    anatomy: Anatomy
    """The artery."""
    deployment: Deployment
    """The deployed device."""
    shortening: Callable[[Design, Size], Floats] | None = None
    """Change (2,) of the lengths of both sides relative to those of marched rows, for an altered device."""

    @cached_property
    def landing(self) -> Landing:
        """Where the middle row lies; it stays there."""
        rows_mm = self.deployment.stent.row_abscissa_mm
        return Landing(float(rows_mm[(len(rows_mm) - 1) // 2]))

    def changed(self, design: Design, size: Size) -> Changed:
        """Compute the device with other numbers.

        Returns ends, gaps, coverage and pore density of the reduced model.
        """
        profile = self._profile(design, size)
        places = [0, -1, *mesh_nodes(design, size)]
        ends_mm, at_mm = march(design, size, self.landing, profile)[places], self.landing.abscissa_mm
        shorter = np.zeros(2) if self.shortening is None else self.shortening(design, size)
        ends_mm = ends_mm + np.tile(shorter, 2) * (ends_mm - at_mm)
        wider_mm = profile.at(self._rows_mm) - self._nominal.at(self._rows_mm)
        inward_mm = (design.wall_offset_um - self.deployment.stent.design.wall_offset_um) * MM_PER_UM
        gap_mm = np.maximum(self.deployment.wall_gap_mm - (0.5 * wider_mm + inward_mm)[:, None], 0.0)
        first_mm, last_mm, mesh_first_mm, mesh_last_mm = ends_mm.tolist()
        at_patient_mm, density = gap_mm[self._is_at_patient], self._density(design, size, profile)
        return Changed(first_mm, last_mm, mesh_first_mm, mesh_last_mm, at_patient_mm, *density)

    @property
    def _rows_mm(self) -> Floats:
        """Arc lengths (rows,) of the deployed rows, in mm."""
        return self.deployment.stent.row_abscissa_mm

    def _profile(self, design: Design, size: Size) -> Profile:
        """Return the diameter of the contour of a device along the artery."""
        offset_mm = 2 * design.wall_offset_um * MM_PER_UM
        return replace(self._wall, diameter_mm=np.minimum(self._wall.diameter_mm - offset_mm, widest_mm(design, size)))

    @cached_property
    def _nominal(self) -> Profile:
        """Diameter of the contour of the deployed device along the artery."""
        return self._profile(self.deployment.stent.design, self.deployment.stent.size)

    @cached_property
    def _wall(self) -> Profile:
        """Diameter of the artery as the deployed device measures it; as expected where it is at its free diameter."""
        stent, rows_mm = self.deployment.stent, self._rows_mm
        expected = expected_profile(stent.design, stent.size, self.anatomy)
        artery = replace(expected, diameter_mm=2 * self.anatomy.parent.section_radius_mm)
        seen_mm = stent.row_diameter_mm + 2 * stent.design.wall_offset_um * MM_PER_UM
        is_free = stent.row_diameter_mm >= FREELY * free_diameters_mm(stent.design, stent.size)
        return artery.corrected(rows_mm, np.where(is_free, np.maximum(artery.at(rows_mm), seen_mm), seen_mm))

    @cached_property
    def _is_at_patient(self) -> Bools:
        """(rows, columns) whether the wall next to a node is the patient's own."""
        nodes_mm = self.deployment.stent.nodes_mm
        face = self.anatomy.parent.landing_surface.closest(nodes_mm.reshape(-1, 3))[2]
        return self.anatomy.parent.is_patient_face[face].reshape(nodes_mm.shape[:2])

    @cached_property
    def _neck(self) -> _Neck:
        """Quads of the contour over the neck."""
        stent = self.deployment.stent
        nodes_mm, rows_mm, shape = stent.nodes_mm, self._rows_mm, grid(stent.design, stent.size)
        corners_mm = np.stack([nodes_mm, np.roll(nodes_mm, -1, axis=1)])  # (2, rows, columns, 3)
        middle_mm = 0.25 * (corners_mm[:, 1:] + corners_mm[:, :-1]).sum(axis=0)
        height_mm = shape.row_split * np.linalg.norm(np.diff(corners_mm, axis=1), axis=3).mean(axis=0)
        around_mm = np.linalg.norm(corners_mm[1] - corners_mm[0], axis=2)
        width_mm = 0.5 * shape.column_split * (around_mm[1:] + around_mm[:-1])
        is_over = is_over_neck(self.anatomy, middle_mm.reshape(-1, 3)).reshape(width_mm.shape)
        along_mm = np.broadcast_to(0.5 * (rows_mm[1:] + rows_mm[:-1])[:, None], width_mm.shape)
        stations_mm, station = np.unique(along_mm[is_over], return_inverse=True)
        return _Neck(stations_mm, station, height_mm[is_over], width_mm[is_over], quad_areas_mm2(stent)[is_over])

    @cached_property
    def _spacing_mm(self) -> Floats:
        """(k,) row spacing of the deployed device at the stations over the neck, in mm."""
        stent = self.deployment.stent
        return self._nominal.spacing_mm(stent.design, stent.size, self._neck.stations_mm)

    def _density(self, design: Design, size: Size, profile: Profile) -> tuple[float, float]:
        """Return coverage and pore density over the neck; NaN where nothing of the device lies over it."""
        if not self.anatomy.aneurysms or not len(self._neck.stations_mm):
            return np.nan, np.nan
        neck, stent = self._neck, self.deployment.stent
        taller = profile.spacing_mm(design, size, neck.stations_mm) / self._spacing_mm
        longer = piece_length_mm(design, size) / piece_length_mm(stent.design, stent.size)
        height_mm = neck.height_mm * taller[neck.station]
        piece_mm = longer * np.hypot(neck.height_mm, neck.width_mm)
        width_mm = np.sqrt(np.maximum(piece_mm**2 - height_mm**2, (NARROWEST * piece_mm) ** 2))
        per_mm = 0.5 * piece_mm / (width_mm * height_mm)
        strips, layer = (np.minimum(one_mm * per_mm, 1.0) for one_mm in _strips_mm(design))
        covered = strips if isinstance(design, LaserCut) else 1 - (1 - strips) ** 2 * (1 - layer) ** 2
        pores_per_mm2 = 0.5 / (width_mm * height_mm)
        return float(np.average(covered, weights=neck.area_mm2)), float(
            np.average(pores_per_mm2, weights=neck.area_mm2)
        )


def _strips_mm(design: Design) -> tuple[float, float]:
    """Return the wires per column of the mesh and of an outer layer, or the struts of both directions, in mm."""
    if isinstance(design, LaserCut):
        return 2 * design.strut_width_um * MM_PER_UM, 0.0
    outside = [(one.count, one.diameter_um) for one in design.strands if one.place == "outside"]
    beside = [(one.count, one.diameter_um) for one in design.strands if one.place == "beside"]
    mesh_mm, layer_mm = (
        sum(count * diameter_um for count, diameter_um in wires) / design.n_wires * MM_PER_UM
        for wires in ([*design.wires, *beside], outside)
    )
    return mesh_mm, layer_mm
