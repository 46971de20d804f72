"""Metal coverage and pores of a deployed device, measured on its drawn wires."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Final

import numpy as np

from vstent.anatomy.morphology import Measures
from vstent.anatomy.restore.paths import on_path
from vstent.deployment.crowns import free_crowns
from vstent.devices.formulas import coverage_fraction, grid, mesh_rows, pore_density_per_mm2
from vstent.devices.stent import Stent
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy
from vstent.kernels import curves, triangles
from vstent.kernels.arrays import Bools, Floats, Ints

NECK_TOLERANCE_MM: Final = 0.02
"""Largest distance between the neck and the landing surface, in mm, since the two have different triangles."""
ON_PATH_MM: Final = 0.5
"""Distance from the landing surface, in mm, within which wires of a device on another path lie on this one too."""
UNION: Final = "neck_union_coverage_fraction"
"""Measure of the metal over the neck: what is under a wire of any device, as a fraction of the whole neck."""
SAMPLES_PER_QUAD: Final = 8
"""Number of points per direction at which coverage is sampled in every quad of the contour."""


def quad_areas_mm2(stent: Stent) -> Floats:
    """Return the area (rows - 1, columns) of every quad of the contour, in mm2."""
    return stent.contour.areas_mm2.reshape(2, len(stent.nodes_mm) - 1, -1).sum(axis=0)


def coverage_fractions(stent: Stent) -> Floats:
    """Return the fraction (rows - 1, columns) of every quad of the contour that metal covers, seen along its normal."""
    from vstent.kernels.coverage import covered_fractions  # compiles on first use

    return covered_fractions(stent.nodes_mm, *stent.pieces_mm, SAMPLES_PER_QUAD)


def quad_middles_mm(nodes_mm: Floats) -> Floats:
    """Return the middles (rows - 1, columns, 3) of the quads of a contour (rows, columns, 3)."""
    along_mm = 0.25 * (nodes_mm[1:] + nodes_mm[:-1])
    return along_mm + np.roll(along_mm, -1, axis=1)


def pore_places(stent: Stent) -> tuple[Ints, Ints]:
    """Return the lattice rows and columns (p,) at which the whole pores of the mesh have their middle."""
    shape = grid(stent.design, stent.size)
    row, column = np.meshgrid(np.arange(1, shape.lattice_rows - 1), np.arange(shape.lattice_columns), indexing="ij")
    first, last = mesh_rows(stent.design, stent.size)
    is_pore = ((row + column) % 2 == 1) & (row > first) & (row < last)
    return row[is_pore], column[is_pore]


def pore_areas_mm2(stent: Stent) -> tuple[Floats, Floats, Floats]:
    """Compute the area, the center and the number of every whole pore.

    Pores lie where the lattice has no junction. Each fills half of the four lattice cells around it. The wires of an
    outer layer do not divide them, and its ends without a mesh have none.
    """
    shape = grid(stent.design, stent.size)
    cells = quad_areas_mm2(stent).reshape(
        shape.lattice_rows - 1, shape.row_split, shape.lattice_columns, shape.column_split
    )
    cell_mm2 = cells.sum(axis=(1, 3))
    pairs = cell_mm2 + np.roll(cell_mm2, 1, axis=1)
    area_mm2 = 0.5 * (pairs[:-1] + pairs[1:])
    row, column = pore_places(stent)
    is_free = free_crowns(stent.design, shape)
    number = 1 - 0.5 * (np.roll(is_free, 1, axis=1).astype(float) + np.roll(is_free, -1, axis=1))
    middle_mm = stent.nodes_mm[row * shape.row_split, column * shape.column_split]
    return area_mm2[row - 1, column], middle_mm, number[row, column]


def density(anatomy: Anatomy, stent: Stent) -> Measures:
    """Measure metal coverage and pore density of the whole mesh and over the neck, where the device lies over it.

    The values of the closed formulas are those at the mean diameter.
    """
    covered, quad_mm2 = coverage_fractions(stent), quad_areas_mm2(stent)
    pore_mm2, pores_mm, pores = pore_areas_mm2(stent)
    mesh = slice(*stent.mesh_nodes)
    diameter_mm = float(stent.row_diameter_mm[mesh.start : mesh.stop + 1].mean())
    starts_mm, ends_mm, half_mm = stent.pieces_mm
    found: Measures = {
        "metal_in_artery_mm2": float(2 * half_mm @ curves.lengths(ends_mm - starts_mm)),
        "metal_coverage_fraction": float(np.average(covered[mesh].ravel(), weights=quad_mm2[mesh].ravel())),
        "metal_coverage_formula_fraction": coverage_fraction(stent.design, stent.size, diameter_mm),
        "pore_density_formula_per_mm2": pore_density_per_mm2(stent.design, stent.size, diameter_mm),
    }
    if len(pores_mm):
        found["pore_density_per_mm2"] = float(pores.sum() / pore_mm2.sum())
    if anatomy.aneurysms:
        on_neck = is_over_neck(anatomy, quad_middles_mm(stent.nodes_mm).reshape(-1, 3)).reshape(covered.shape)
        if on_neck.any():
            found["neck_metal_coverage_fraction"] = float(np.average(covered[on_neck], weights=quad_mm2[on_neck]))
        on_neck = is_over_neck(anatomy, pores_mm)
        if on_neck.any():
            found["neck_pore_density_per_mm2"] = float(pores[on_neck].sum() / pore_mm2[on_neck].sum())
    return found


def together(anatomy: Anatomy, stents: Sequence[Stent]) -> Measures:
    """Measure several devices of one treatment as a whole.

    Metal over the neck is what is under a wire of any of them, as a fraction of the whole neck. Devices on several
    paths have no common length, and the neck is that on each of these paths.
    """
    is_on_one = len(stents) > 1 == len({stent.path for stent in stents})
    found: Measures = _lengths_together(stents) if is_on_one else {}
    covered_mm2 = neck_mm2 = 0.0
    for name in dict.fromkeys(stent.path for stent in stents) if anatomy.aneurysms else ():
        covered, areas_mm2 = _neck_under_wires(on_path(anatomy, name), stents)
        covered_mm2, neck_mm2 = covered_mm2 + float(covered @ areas_mm2), neck_mm2 + float(areas_mm2.sum())
    return found | ({UNION: covered_mm2 / neck_mm2} if neck_mm2 else {})


def _lengths_together(stents: Sequence[Stent]) -> Measures:
    """Return the length with any device, and that with more than one."""
    meshes_mm = sorted(stent.mesh_abscissa_mm for stent in stents)
    edges_mm = np.unique(meshes_mm)
    middles_mm, lengths_mm = 0.5 * (edges_mm[1:] + edges_mm[:-1]), np.diff(edges_mm)
    layers = sum((middles_mm > first_mm) & (middles_mm < last_mm) for first_mm, last_mm in meshes_mm)
    return {
        "covered_length_mm": float(lengths_mm[layers > 0].sum()),
        "overlap_length_mm": float(lengths_mm[layers > 1].sum()),
    }


def _neck_under_wires(anatomy: Anatomy, stents: Sequence[Stent]) -> tuple[Floats, Floats]:
    """Return covered fraction (n,) and area (n,), in mm2, of the quads of the first path that close the neck."""
    from vstent.kernels.coverage import covered_fractions  # compiles on first use

    path = anatomy.parent
    nodes_mm = path.landing_surface.vertices_mm.reshape(len(path.axis.points_mm), -1, 3)
    starts_mm, ends_mm, half_mm = (np.concatenate(part) for part in zip(*(s.pieces_mm for s in stents), strict=True))
    is_here = np.repeat([stent.path == path.name for stent in stents], [len(s.piece_starts) for s in stents])
    is_here[~is_here] = path.landing_surface.closest(starts_mm[~is_here])[1] < ON_PATH_MM
    covered = covered_fractions(nodes_mm, starts_mm[is_here], ends_mm[is_here], half_mm[is_here], SAMPLES_PER_QUAD)
    areas_mm2 = path.landing_surface.areas_mm2.reshape(2, *covered.shape).sum(axis=0)
    on_neck = is_over_neck(anatomy, quad_middles_mm(nodes_mm).reshape(-1, 3)).reshape(covered.shape)
    return covered[on_neck], areas_mm2[on_neck]


@lru_cache(maxsize=8)
def _neck_on_landing(anatomy: Anatomy) -> Surface:
    """Return the neck of the largest aneurysm projected to the landing surface."""
    # Where a sac is on a fork, its neck is at a distance from the landing surface.
    neck = anatomy.aneurysms[0].neck
    vertices_mm, faces = triangles.compact(neck.vertices_mm, neck.faces)
    return Surface(anatomy.parent.landing_surface.closest(vertices_mm)[0], faces)


def is_over_neck(anatomy: Anatomy, points_mm: Floats) -> Bools:
    """Return whether the landing surface closes or faces the largest neck at points (n, 3) on a device."""
    neck = _neck_on_landing(anatomy)
    at_most_mm = anatomy.parent.landing_surface.closest(points_mm)[1] + NECK_TOLERANCE_MM
    low_mm, high_mm = neck.vertices_mm.min(axis=0), neck.vertices_mm.max(axis=0)
    is_over = curves.lengths(points_mm - np.clip(points_mm, low_mm, high_mm)) <= at_most_mm
    is_over[is_over] = neck.closest(points_mm[is_over])[1] <= at_most_mm[is_over]
    return is_over
