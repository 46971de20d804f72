"""Reduced model of a deployed device: what changes with its numbers, without another deployment.

- *Ends*: the rows are marched again (`vstent.deployment.braid.march`), with the altered wires, in the artery as the
  deployed device measured it. A braid is shortened besides (`vstent.plan.bends`).
- *Coverage and pore density over the neck*: the deployed device states the height h and the width w of the lattice at
  each place over the neck, which in a bend are not those of a straight artery. Rows move apart as in the closed
  formula, and a piece of wire keeps its length l, with l^2 = w^2 + h^2. Wires of diameter d of one hand cover the
  fraction d l / (2 w h).
"""

import itertools
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np

from vstent.anatomy.morphology import Measures
from vstent.deployment.braid import FREELY, Profile, expected_profile, march
from vstent.deployment.coverage import is_over_neck, quad_areas_mm2
from vstent.devices.design import Design, Size, piece_length_mm, widest_mm
from vstent.devices.formulas import free_diameters_mm, grid, mesh_nodes
from vstent.devices.stent import Deployment, Landing
from vstent.geometry.vessel import Anatomy
from vstent.kernels.arrays import Floats, Ints
from vstent.units import MM_PER_UM

NARROWEST: Final = 0.1
"""Smallest sine of the angle between wire and axis, as in tight bends (`vstent.devices.formulas.STRAIGHTEST`)."""


class _Changed(NamedTuple):
    """A deployed device with other numbers, as the reduced model has it."""

    first_mm: float
    """Arc length of the proximal end, in mm."""
    last_mm: float
    """Arc length of the distal end, in mm."""
    mesh_first_mm: float
    """Arc length of the proximal end of the mesh, in mm. A dual-layer device has only its outer layer beyond it."""
    mesh_last_mm: float
    """Arc length of the distal end of the mesh, in mm."""
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
    spacing_mm: Floats
    """(k,) row spacing of the deployed device at the stations, in mm."""
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
        return Landing(self.deployment.stent.middle_abscissa_mm)

    def results(self, measures: Measures, devices: Iterable[tuple[Design, Size]]) -> dict[str, Floats]:
        """Return the measured results (n,) by name, changed as the model changes with other devices."""
        nominal = self._changed(self.deployment.stent.design, self.deployment.stent.size)
        found: dict[str, list[float]] = {}
        for other in itertools.starmap(self._changed, devices):
            first_mm, last_mm = other.first_mm - nominal.first_mm, other.last_mm - nominal.last_mm
            before_mm, after_mm = nominal.mesh_first_mm - other.mesh_first_mm, other.mesh_last_mm - nominal.mesh_last_mm
            moves = {
                "deployed_length_mm": last_mm - first_mm,
                "proximal_end_abscissa_mm": first_mm,
                "distal_end_abscissa_mm": last_mm,
                "neck_to_proximal_end_mm": before_mm,
                "neck_to_distal_end_mm": after_mm,
                "mesh_length_mm": before_mm + after_mm,
            }
            factors = {
                "neck_metal_coverage_fraction": other.coverage_fraction / nominal.coverage_fraction,
                "neck_pore_density_per_mm2": other.pore_density_per_mm2 / nominal.pore_density_per_mm2,
            }
            values = {name: float(measures[name]) + move for name, move in moves.items() if name in measures}
            values |= {
                name: float(measures[name]) * by for name, by in factors.items() if name in measures and by == by
            }
            for name, value in values.items():
                found.setdefault(name, []).append(value)
        return {name: np.array(values) for name, values in found.items()}

    def _changed(self, design: Design, size: Size) -> _Changed:
        """Compute ends, coverage and pore density of the device with other numbers."""
        profile = self._profile(design, size)
        places = [0, -1, *mesh_nodes(design, size)]
        ends_mm, at_mm = march(design, size, self.landing, profile)[places], self.landing.abscissa_mm
        shorter = np.zeros(2) if self.shortening is None else self.shortening(design, size)
        ends_mm = ends_mm + np.tile(shorter, 2) * (ends_mm - at_mm)
        first_mm, last_mm, mesh_first_mm, mesh_last_mm = ends_mm.tolist()
        return _Changed(first_mm, last_mm, mesh_first_mm, mesh_last_mm, *self._density(design, size, profile))

    def _profile(self, design: Design, size: Size) -> Profile:
        """Return the diameter of the contour of a device along the artery."""
        offset_mm = 2 * design.wall_offset_um * MM_PER_UM
        return replace(self._wall, diameter_mm=np.minimum(self._wall.diameter_mm - offset_mm, widest_mm(design, size)))

    @cached_property
    def _wall(self) -> Profile:
        """Diameter of the artery as the deployed device measures it; as expected where it is at its free diameter."""
        stent, rows_mm = self.deployment.stent, self.deployment.stent.row_abscissa_mm
        expected = expected_profile(stent.design, stent.size, self.anatomy)
        artery = replace(expected, diameter_mm=2 * self.anatomy.parent.section_radius_mm)
        seen_mm = stent.row_diameter_mm + 2 * stent.design.wall_offset_um * MM_PER_UM
        is_free = stent.row_diameter_mm >= FREELY * free_diameters_mm(stent.design, stent.size)
        return artery.corrected(rows_mm, np.where(is_free, np.maximum(artery.at(rows_mm), seen_mm), seen_mm))

    @cached_property
    def _neck(self) -> _Neck:
        """Quads of the contour over the neck."""
        stent = self.deployment.stent
        nodes_mm, rows_mm, shape = stent.nodes_mm, stent.row_abscissa_mm, grid(stent.design, stent.size)
        corners_mm = np.stack([nodes_mm, np.roll(nodes_mm, -1, axis=1)])  # (2, rows, columns, 3)
        middle_mm = 0.25 * (corners_mm[:, 1:] + corners_mm[:, :-1]).sum(axis=0)
        height_mm = shape.row_split * np.linalg.norm(np.diff(corners_mm, axis=1), axis=3).mean(axis=0)
        around_mm = np.linalg.norm(corners_mm[1] - corners_mm[0], axis=2)
        width_mm = 0.5 * shape.column_split * (around_mm[1:] + around_mm[:-1])
        is_over = is_over_neck(self.anatomy, middle_mm.reshape(-1, 3)).reshape(width_mm.shape)
        along_mm = np.broadcast_to(0.5 * (rows_mm[1:] + rows_mm[:-1])[:, None], width_mm.shape)
        stations_mm, station = np.unique(along_mm[is_over], return_inverse=True)
        spacing_mm = self._profile(stent.design, stent.size).spacing_mm(stent.design, stent.size, stations_mm)
        lattice_mm = height_mm[is_over], width_mm[is_over]
        return _Neck(stations_mm, station, spacing_mm, *lattice_mm, quad_areas_mm2(stent)[is_over])

    def _density(self, design: Design, size: Size, profile: Profile) -> tuple[float, float]:
        """Return coverage and pore density over the neck; NaN where nothing of the device lies over it."""
        if not self.anatomy.aneurysms or not len(self._neck.stations_mm):
            return np.nan, np.nan
        neck, stent = self._neck, self.deployment.stent
        taller = profile.spacing_mm(design, size, neck.stations_mm) / neck.spacing_mm
        longer = piece_length_mm(design, size) / piece_length_mm(stent.design, stent.size)
        height_mm = neck.height_mm * taller[neck.station]
        piece_mm = longer * np.hypot(neck.height_mm, neck.width_mm)
        width_mm = np.sqrt(np.maximum(piece_mm**2 - height_mm**2, (NARROWEST * piece_mm) ** 2))
        per_mm = 0.5 * piece_mm / (width_mm * height_mm)
        # Of the wires of a hand, so many mm lie in every column of the lattice.
        column_mm = (2 * um / design.n_columns * MM_PER_UM for um in (design.hand_um, design.layer_um))
        covered = design.covered(*(np.minimum(wires_mm * per_mm, 1.0) for wires_mm in column_mm))
        coverage, pores_per_mm2 = np.average([covered, 0.5 / (width_mm * height_mm)], weights=neck.area_mm2, axis=1)
        return float(coverage), float(pores_per_mm2)
