"""What wires take of the blood about them: the drag of rows, of crossing families, and of their bands on a grid."""

import numpy as np
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk

from vstent.kernels.arrays import Floats

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
BREADTH = 0.4
"""How broad a band every wire is spread over, in spacings."""
BLUNTED = 0.8
"""How much of what an even band slows blood by one does that drags least where blood is slowest: so rows of wires 0.03
to 0.09 mm thick, 4 to 16 cells apart, hold slow blood up within 2 % of their law (`test_screen_sheet.py`)."""
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
    (`tests/flow/lattice/test_crossing_cell.py`).
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
