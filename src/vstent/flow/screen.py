"""The stent as a screen: a thin, local, anisotropic resistance where the deployed wires are."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree
from scipy.special import ellipe, ellipk

from vstent.device import LaserCut
from vstent.flow import sampling
from vstent.flow.types import Blood, Screen
from vstent.kernels import lattice_sampling
from vstent.kernels.arrays import Floats, Ints
from vstent.stent import Stent
from vstent.surface import Surface
from vstent.units import M_PER_MM, MM_PER_UM

SHARE_FALL, SHARE_PER_SOLIDITY = 0.08, 5.9
"""How much less normal over tangential resistance is than that of slender rods, and how it falls with wire diameter
over spacing: what resolved crossing cells take of blood that passes at an angle, at d / s = 0.065 to 0.24 and 30 to 60
degrees, the mean of wires one on the other and in one plane (`benchmarks/screen.py`, `screen.json`)."""
LEAST_SHARE = 0.02
"""Least normal over tangential resistance."""
INERTIAL_LOSS, SPARSEST = 0.35, 0.065
"""K of the pressure drop K rho |u| u_n / 2 where blood passes at an angle at a wire Reynolds number of a half: the mean
of resolved crossing cells with d / s below 0.15, the least of which is the other (`benchmarks/screen.py`,
`screen.json`). Denser ones take half as much, beside a viscous resistance that makes either a few per cent."""
CROSSING_PER_SOLIDITY = 0.89
"""How much crossing families resist more than their sum, per wire diameter over spacing: the mean of resolved crossing
cells at d / s = 0.065 to 0.24 and 30 to 60 degrees, each 0.48 to 1.04 (`benchmarks/screen.py`, `screen.json`)."""
SMOOTHING_PORES = 1.5
"""Radius of the neighbourhood in which wire length per area is measured, in mean wire spacings."""
SAMPLE_REACHES = 0.2
"""Longest edge between samples of the surface when its area is measured in such a neighbourhood, in radii of it."""
PIECE_MM = 0.05
"""Longest piece of wire."""
BREADTH, ACROSS = 0.4, 9
"""How broad a band every wire is spread over, in spacings, and the samples across it: closer than grid cells."""
BLUNTED = 0.8
"""How much of what an even band slows blood by one does that drags least where blood is slowest: so rows of wires 0.03
to 0.09 mm thick, 4 to 16 cells apart, hold slow blood up within 2 % of their law (`tests/test_screen_sheet.py`)."""
GRID_MM = 0.15
"""Grid cells by which it is judged whether wires are told apart: between the usual ones and those of a close-up."""


def drag_per_length(diameter: Floats, spacing: Floats) -> Floats:
    """Drag per length over viscosity times velocity of a row of cylinders, F' / (mu U); same unit for both lengths.

    F' = 8 pi mu U / (1 - 2 ln(2 t) + 2 t^2 / 3 - t^4 / 9), t = pi d / (2 s) (Tamada and Fujikawa 1957, Q. J. Mech.
    Appl. Math. 10, 425; design.md section 5). 10.70 at d / s = 1 / 6.
    """
    t = np.pi * np.minimum(diameter / spacing, 0.5) / 2
    return 8 * np.pi / (1 - 2 * np.log(2 * t) + 2 * t**2 / 3 - t**4 / 9)


def round_diameter(width: float, thickness: float) -> float:
    """Diameter of the round wire that drags as much as a strut of rectangular section; same unit for all lengths.

    It is twice the radius r of the circle that the plane outside the section is mapped on, all that slow blood knows of
    it from afar: width = 4 r (E(m) - (1 - m) K(m)), thickness = the same of 1 - m, K and E being the complete elliptic
    integrals. A square strut drags as a wire 1.18 times as wide: resolved rows of either hold blood up alike within 1 %
    (`tests/test_crossing_cell.py`).
    """

    def side(m: float) -> float:
        return 2 * float(ellipe(m) - (1 - m) * ellipk(m))

    m = brentq(lambda m: side(m) * thickness - side(1 - m) * width, 1e-12, 1 - 1e-12)
    return width / side(m)


def band_radius_mm(spacing_mm: Floats, cell_size_mm: float) -> Floats:
    """Radius of the wire that slow blood takes a wire's band for, on a grid that spreads it besides.

    The geometric mean of the distance between two points of the band: e^(-gamma / 2) (a + b) where they lie about its
    axis with standard deviations a and b, gamma being Euler's constant.
    """
    of_cell_mm = cell_size_mm / np.sqrt(6)
    return np.exp(-np.euler_gamma / 2) * (np.hypot(BREADTH * spacing_mm / np.sqrt(12), of_cell_mm) + of_cell_mm)


def concentration(diameter_mm: Floats, spacing_mm: Floats, cell_size_mm: float) -> Floats:
    """How much more than by a row's law wires resist blood that a grid has slowed about them; 1 where bands melt.

    A row's drag F' is of the mean velocity. About wires far enough apart the grid slows blood itself, as about wires as
    thick as their bands; what is left to finer ones is the difference, 1 / F' - 1 / F'_band. (So has Peaceman 1978,
    Soc. Pet. Eng. J. 18, 183, wells on a grid, about which pressure is a logarithm as velocity is here.)
    """
    drag, densest = drag_per_length(diameter_mm, spacing_mm), drag_per_length(spacing_mm, spacing_mm)
    band_mm = np.maximum(2 * band_radius_mm(spacing_mm, cell_size_mm), diameter_mm)
    return 1 / (1 - BLUNTED * drag * (1 / drag_per_length(band_mm, spacing_mm) - 1 / densest))


def parted(spacing_mm: Floats) -> Floats:
    """How far a grid tells one wire from the next: 0 where their bands melt into a sheet, 1 from twice that spacing."""
    return np.clip(spacing_mm / (4 * band_radius_mm(spacing_mm, GRID_MM)) - 1, 0.0, 1.0)


def crossing_factor(diameter: Floats, spacing: Floats) -> Floats:
    """How much two crossing families resist, over the sum of two rows; 1 where wires are far apart."""
    return 1 + CROSSING_PER_SOLIDITY * np.minimum(diameter / spacing, 0.5)


def tangential_share(solidity: Floats, lengthwise: Floats, apart: Floats | float = 0.0) -> Floats:
    """Tangential over normal resistance of crossing wires to blood that passes along the artery.

    A slender rod drags half as much along itself as across (design.md section 5). But each lies in the lee of others,
    and the two layers have a height: the denser they are, the less of its way along the artery blood keeps.

    Parameters
    ----------
    solidity : wire diameter over spacing.
    lengthwise : mean squared cosine of the wires' angle to the artery.
    apart : how far a grid tells wires apart, and holds that lee itself (see `parted`).
    """
    in_lee = (1 - apart) * (SHARE_FALL + SHARE_PER_SOLIDITY * solidity)
    return 1 / np.maximum(1 / (1 - 0.5 * lengthwise) - in_lee, LEAST_SHARE)


def inertial_loss(solidity: Floats) -> Floats:
    """Loss coefficient K of K rho |u| u_n / 2, by wire diameter over spacing; fewer wires than calibrated on take less.

    A wire drags by the whole velocity at it, which past a neck is several times the one through it. Along the screen
    half as much is lost: wires that cross at right angles have half their length across the flow (see `resist`).
    """
    return INERTIAL_LOSS * np.minimum(solidity / SPARSEST, 1.0)


def screen(stent: Stent, blood: Blood) -> Screen:
    """Lay the drag of a deployed stent's wires where they are.

    Every piece of wire resists as in a row of its spacing, across a band about it. So one law serves braids, laser-cut
    cells and their mixtures of diameters, wherever bends have opened or closed them: the bands of a braid's wires melt
    into a sheet, those of laser-cut struts leave open what lies between them.
    """
    pieces = _pieces(stent)
    points_mm, along_mm, diameter_mm = pieces
    reach_mm = SMOOTHING_PORES * stent.spacing_mm
    sheet = _sheet(stent.contour, points_mm, np.linalg.norm(along_mm, axis=1), reach_mm)
    face = sheet.closest(points_mm)[2]
    spacing_mm, lengthwise, solidity = _net(stent, sheet, face, pieces, reach_mm)
    drag = drag_per_length(diameter_mm, spacing_mm) * crossing_factor(diameter_mm, spacing_mm)
    normal_Pa_s_m = blood.viscosity_Pa_s * drag * 2 / (spacing_mm * M_PER_MM)
    tangential_Pa_s_m = normal_Pa_s_m * tangential_share(solidity, lengthwise, parted(spacing_mm))
    normals = sheet.normals[face]
    band_mm, area_mm2 = bands(points_mm, along_mm, normals, spacing_mm)
    columns = normals, area_mm2, normal_Pa_s_m, tangential_Pa_s_m, inertial_loss(solidity), diameter_mm, spacing_mm
    return Screen(band_mm.reshape(-1, 3), *(np.repeat(column, ACROSS, axis=0) for column in columns))


def bands(points_mm: Floats, along_mm: Floats, normals: Floats, spacing_mm: Floats) -> tuple[Floats, Floats]:
    """Spread pieces of wire over their bands: samples (p, `ACROSS`, 3), and the area (p,) of each of a piece's.

    Of two families of wires so far apart either has half of it.

    Parameters
    ----------
    points_mm, along_mm : (p, 3) middles of the pieces, and their ways from end to end.
    normals : (p, 3) unit normals of the surface that wires span.
    spacing_mm : (p,) spacing of wires there.
    """
    length_mm = np.linalg.norm(along_mm, axis=1)
    sideways = np.cross(normals, along_mm) / length_mm[:, None]
    at_mm = BREADTH * spacing_mm[:, None] * ((np.arange(ACROSS) + 0.5) / ACROSS - 0.5)
    return points_mm[:, None] + at_mm[:, :, None] * sideways[:, None], 0.5 * length_mm * spacing_mm / ACROSS


def _net(
    stent: Stent, sheet: Surface, face: Ints, pieces: tuple[Floats, Floats, Floats], reach_mm: float
) -> tuple[Floats, Floats, Floats]:
    """How wires lie about their pieces (p,): spacing, mm; squared cosine to the device's length; diameter over spacing.

    About every node of the sheet the length of wires per area, lambda, is measured over a few pores; two crossing
    families then lie s = 2 / lambda apart. A piece has the mean of the corners of the face below it.
    """
    points_mm, along_mm, diameter_mm = pieces
    nodes, corners, length_mm = cKDTree(sheet.vertices_mm), sheet.faces[face], np.linalg.norm(along_mm, axis=1)
    sample_mm, sample_mm2 = sampling.surface_samples(sheet, SAMPLE_REACHES * reach_mm)
    area_mm2 = _kernel(nodes, sample_mm, reach_mm) @ np.linalg.norm(sample_mm2, axis=1)
    lengthwise = _lengthwise(stent, corners, along_mm)
    weight = _kernel(nodes, points_mm, reach_mm)
    wire = (weight @ (length_mm * value) for value in (1.0, lengthwise, diameter_mm))
    area_mm2, wire_mm, lengthwise_mm, covered_mm2 = (column[corners].mean(axis=1) for column in (area_mm2, *wire))
    return 2 * area_mm2 / wire_mm, lengthwise_mm / wire_mm, 0.5 * covered_mm2 / area_mm2


def _sheet(contour: Surface, points_mm: Floats, length_mm: Floats, reach_mm: float) -> Surface:
    """The contour, moved along its normals to the mean height of the wires near, of pieces (p,) at points (p, 3)."""
    below_mm, _, face = contour.closest(points_mm)
    height_mm = np.einsum("pd,pd->p", points_mm - below_mm, contour.normals[face])
    weight = _kernel(cKDTree(contour.vertices_mm), points_mm, reach_mm)
    mean_mm = weight @ (length_mm * height_mm) / np.maximum(weight @ length_mm, 1e-300)
    return Surface(contour.vertices_mm + mean_mm[:, None] * contour.vertex_normals, contour.faces)


def _lengthwise(stent: Stent, corners: Ints, along_mm: Floats) -> Floats:
    """Squared cosine (p,) of the angle of pieces of wire to the device's length, the mean over nodes (p, 3) beside."""
    length_mm = np.gradient(stent.nodes_mm, axis=0).reshape(-1, 3)[corners].mean(axis=1)
    size_mm2 = (length_mm**2).sum(axis=1) * (along_mm**2).sum(axis=1)
    return np.asarray((length_mm * along_mm).sum(axis=1) ** 2 / size_mm2)


def _pieces(stent: Stent) -> tuple[Floats, Floats, Floats]:
    """Wires cut into pieces of at most `PIECE_MM`: midpoints (p, 3), ways along them (p, 3) and diameters (p,), mm.

    A rectangular strut has the diameter of the round wire that drags as much.
    """
    starts = stent.wire_starts
    wire = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    inner = stent.piece_starts
    a, b = stent.wire_points_mm[inner], stent.wire_points_mm[inner + 1]
    length = np.linalg.norm(b - a, axis=1)
    count = np.maximum(np.ceil(length / PIECE_MM).astype(int), 1)
    owner = np.repeat(np.arange(len(a)), count)
    rank = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    part = ((rank + 0.5) / count[owner])[:, None]
    diameter = _drag_diameters_um(stent)[wire[inner]] * MM_PER_UM
    return a[owner] + part * (b - a)[owner], ((b - a) / count[:, None])[owner], diameter[owner]


def _drag_diameters_um(stent: Stent) -> Floats:
    """Diameter (w,) of the round wires that drag as a stent's wires or struts do."""
    if not isinstance(stent.design, LaserCut):
        return stent.wire_diameter_um
    widths_um, which = np.unique(stent.wire_diameter_um, return_inverse=True)
    return np.array([round_diameter(width, stent.design.strut_thickness_um) for width in widths_um])[which]


def _kernel(nodes: cKDTree, points_mm: Floats, reach_mm: float) -> csr_matrix:
    """Weights (nodes, points) (1 - r^2 / reach^2)^2 within the reach."""
    near = nodes.sparse_distance_matrix(cKDTree(points_mm), reach_mm, output_type="coo_matrix")
    return csr_matrix(((1 - (near.data / reach_mm) ** 2) ** 2, (near.row, near.col)), shape=near.shape)


@dataclass(frozen=True, eq=False)
class GridResistance:
    """A screen spread over the grid cells beside it."""

    cell: Ints
    """(e,) cells, ascending."""
    normal: Floats
    """(e, 3) the screen's unit normal there."""
    along_Pa_s_m2: Floats
    """(e,) resistance along the normal per volume: pressure gradient per velocity."""
    across_Pa_s_m2: Floats
    """(e,) resistance across it."""
    spread_Pa_s_m: Floats
    """(e,) what of the screen's resistance across it acts twice, in layers of cells (see `of_thin_sheet`)."""
    inertial_per_m: Floats
    """(e,) pressure gradient along the normal over rho |u| u_n."""


def on_grid(screen: Screen, index: Ints, origin_mm: Floats, cell_size_mm: float) -> GridResistance:
    """Share every sample's resistance among the eight cells around it, trilinearly; what falls outside is void.

    So a cell at the rim resists as its neighbours do, where the screen goes on over the wall beyond the neck.

    Parameters
    ----------
    index : (i, j, k) cell number at every grid point, -1 outside.
    """
    at = (screen.points_mm - origin_mm) / cell_size_mm
    cells, weights = lattice_sampling.stencils(index, at)
    share = np.where(cells >= 0, weights, 0.0)
    is_used = share > 0
    cell, owner = cells[is_used], np.broadcast_to(np.arange(len(cells))[:, None], cells.shape)[is_used]
    per_volume = share[is_used] * screen.area_mm2[owner] / (cell_size_mm**3 * M_PER_MM)
    found, place = np.unique(cell, return_inverse=True)

    def gathered(values: Floats) -> Floats:
        return np.bincount(place, per_volume * values[owner], len(found)).astype(np.float64)

    # The normals of one sheet agree nearly; signs may differ where two sheets meet in a cell, but only n n^T counts.
    normal = np.stack([gathered(component) for component in screen.normals.T], axis=1)
    length = np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    factor = concentration(screen.wire_diameter_mm, screen.spacing_mm, cell_size_mm)
    along = gathered(factor * screen.normal_resistance_Pa_s_m)
    across_Pa_s_m = factor * screen.tangential_resistance_Pa_s_m
    across, twice = gathered(across_Pa_s_m), _twice(at, screen.normals)
    kept = along > 0
    return GridResistance(
        found[kept].astype(np.int32),
        (normal / length)[kept],
        along[kept],
        across[kept],
        (gathered(twice * across_Pa_s_m**2) / np.maximum(across, 1e-300))[kept],
        0.5 * gathered(screen.inertial_loss)[kept],
    )


def _twice(at: Floats, normals: Floats) -> Floats:
    """Sum (p,) over pairs of cells about points (p, 3) of their trilinear weights and their way along the normals."""
    part = at - np.floor(at)
    corners = np.indices((2, 2, 2)).reshape(3, -1).T
    weight = np.where(corners == 1, part[:, None], 1 - part[:, None]).prod(axis=2)
    height = normals @ corners.T
    return np.asarray(
        sum(weight[:, a] * weight[:, b] * np.abs(height[:, a] - height[:, b]) for a in range(8) for b in range(a))
    )
