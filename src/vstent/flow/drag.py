"""Drag of stent wires: rows of cylinders, crossing families, and the correction for wires thinner than a grid cell."""

import numpy as np
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk

from vstent.kernels.arrays import Floats

SHARE_FALL, SHARE_PER_SOLIDITY = 0.08, 5.9
"""Reduction of the ratio of normal to tangential resistance below that of slender rods: a constant, and its slope
with wire diameter over spacing. Fitted to resolved crossing cells in oblique flow, at d / s = 0.065 to 0.24 and 30
to 60 degrees, as the mean of stacked and coplanar wires (`benchmarks/screen.py`, `screen.json`)."""
LEAST_SHARE = 0.02
"""Lower limit of the ratio of normal to tangential resistance."""
INERTIAL_LOSS, SPARSEST = 0.35, 0.065
"""Coefficient K of the pressure drop K rho |u| u_n / 2 in oblique flow at a wire Reynolds number of 0.5, and the
smallest d / s it is fitted to. The mean of resolved crossing cells with d / s below 0.15 (`benchmarks/screen.py`,
`screen.json`). Denser wires lose half as much, but their viscous resistance makes either value a few per cent of the
total."""
CROSSING_PER_SOLIDITY = 0.89
"""Extra resistance of crossing families over the sum of two rows, per wire diameter over spacing. The mean of
resolved crossing cells at d / s = 0.065 to 0.24 and 30 to 60 degrees, which range from 0.48 to 1.04
(`benchmarks/screen.py`, `screen.json`)."""
BREADTH = 0.4
"""Width of the band over which every wire is spread, in wire spacings."""
BLUNTED = 0.8
"""Ratio of the slowing by a band that drags least where the blood is slowest to the slowing by a uniform band. With
this value, rows of wires 0.03 to 0.09 mm thick and 4 to 16 cells apart resist slow flow within 2 % of their drag law
(`test_screen_sheet.py`)."""
KOZENY = 3.3, 0.37
"""Kozeny constant c = a + b / density of coils: 4.5 at 31 % and 5.8 at 15 %, within 15 % of resolved cubes cut from
placed coils. Their loops lie side by side and leave larger pores than straight wires along three axes, which have 6.4
and 9.0, or random fibres with 6 to 7 (`benchmarks/meshes.py`, `meshes.json`; Jackson and James 1986, Can. J. Chem. Eng.
64, 364)."""
WINDING = 1.14
"""Mean speed between coils over that of the blood's way through them: 1.07 to 1.22 in those cubes."""
COIL_INERTIA = 0.024
"""Increase of the resistance of coils per Reynolds number of their diameter and the superficial speed: resolved wires
resist 1.23 to 1.26 times as much at 10 as in creeping flow, at 15 to 31 % (`benchmarks/meshes.py`, `meshes.json`)."""
GRID_MM = 0.15
"""Grid spacing, mm, at which `parted` judges whether wires are distinguished: between the default and that of a
refined sac."""


def drag_per_length(diameter: Floats, spacing: Floats) -> Floats:
    """Return the drag per length of a row of cylinders over viscosity times mean velocity, F' / (mu U).

    F' = 8 pi mu U / (1 - 2 ln(2 t) + 2 t^2 / 3 - t^4 / 9), t = pi d / (2 s) (Tamada and Fujikawa 1957, Q. J. Mech.
    Appl. Math. 10, 425). It is 10.70 at d / s = 1 / 6.
    """
    t = np.pi * np.minimum(diameter / spacing, 0.5) / 2
    return 8 * np.pi / (1 - 2 * np.log(2 * t) + 2 * t**2 / 3 - t**4 / 9)


def permeability_mm2(density_fraction: Floats, diameter_mm: float) -> Floats:
    """Return the permeability of coils by their local packing density 1 - e: K = e^3 / (c S^2), S = 4 (1 - e) / d.

    S is the surface of the coils per volume, e the porosity, and c follows from `KOZENY`.
    """
    surface_per_mm, constant = 4 * density_fraction / diameter_mm, KOZENY[0] + KOZENY[1] / density_fraction
    return np.asarray((1 - density_fraction) ** 3 / (constant * surface_per_mm**2), dtype=np.float64)


def round_diameter(width: float, thickness: float) -> float:
    """Return the diameter of the round wire with the same drag as a strut of rectangular section.

    It is twice the radius r of the circle onto which the plane outside the section is mapped conformally; slow flow far
    from the strut depends only on r. With the complete elliptic integrals K and E, width = 4 r (E(m) - (1 - m) K(m)),
    and thickness is the same expression with 1 - m. A square strut has the drag of a round wire 1.18 times as wide;
    resolved rows of the two agree within 1 % (`tests/flow/lattice/test_periodic_box.py`).
    """

    def side(m: float) -> float:
        return 2 * float(ellipe(m) - (1 - m) * ellipk(m))

    m = brentq(lambda m: side(m) * thickness - side(1 - m) * width, 1e-12, 1 - 1e-12)
    return width / side(m)


def band_radius_mm(spacing_mm: Floats, cell_size_mm: float) -> Floats:
    """Return the radius of the wire that acts on slow flow like a wire's band, further spread by the grid.

    It is the geometric mean of the distance between two points of the band: e^(-gamma / 2) (a + b) for points
    distributed about the axis with standard deviations a and b, where gamma is Euler's constant.
    """
    of_cell_mm = cell_size_mm / np.sqrt(6)
    return np.exp(-np.euler_gamma / 2) * (np.hypot(BREADTH * spacing_mm / np.sqrt(12), of_cell_mm) + of_cell_mm)


def concentration(diameter_mm: Floats, spacing_mm: Floats, cell_size_mm: float) -> Floats:
    """Return the factor on a row's drag law for wires that the grid resolves as separate bands; 1 where bands merge.

    The drag F' of a row refers to the mean velocity. Around wires far enough apart, the grid itself slows the blood, as
    around wires as thick as their bands. The remaining part, due to the thinner wires, is the difference 1 / F' - 1 /
    F'_band. Peaceman 1978, Soc. Pet. Eng. J. 18, 183, treats wells on a grid the same way: around them the pressure is
    logarithmic, as the velocity is here.
    """
    drag, densest = drag_per_length(diameter_mm, spacing_mm), drag_per_length(spacing_mm, spacing_mm)
    band_mm = np.maximum(2 * band_radius_mm(spacing_mm, cell_size_mm), diameter_mm)
    return 1 / (1 - BLUNTED * drag * (1 / drag_per_length(band_mm, spacing_mm) - 1 / densest))


def parted(spacing_mm: Floats) -> Floats:
    """Return how far a grid separates neighbouring wires: 0 where their bands merge, 1 from twice that spacing on."""
    return np.clip(spacing_mm / (4 * band_radius_mm(spacing_mm, GRID_MM)) - 1, 0.0, 1.0)


def crossing_factor(diameter: Floats, spacing: Floats) -> Floats:
    """Return the resistance of two crossing families over the sum of two rows; 1 where wires are far apart."""
    return 1 + CROSSING_PER_SOLIDITY * np.minimum(diameter / spacing, 0.5)


def tangential_share(solidity: Floats, lengthwise: Floats, apart: Floats | float = 0.0) -> Floats:
    """Return the ratio of tangential to normal resistance of crossing wires, for flow along the artery.

    A slender rod has half the drag along its axis as across it. Wires in the lee of others, and the height of the two
    layers, raise the ratio: the denser the wires, the less tangential velocity remains.
    """
    in_lee = (1 - apart) * (SHARE_FALL + SHARE_PER_SOLIDITY * solidity)
    return 1 / np.maximum(1 / (1 - 0.5 * lengthwise) - in_lee, LEAST_SHARE)


def inertial_loss(solidity: Floats) -> Floats:
    """Return the loss coefficient K of K rho |u| u_n / 2 from wire diameter over spacing.

    Below the range of calibration (`SPARSEST`) K falls in proportion to solidity. The drag of a wire depends on the
    full velocity at it, which over a neck is several times the velocity through it. Tangentially the loss is half as
    large: wires that cross at right angles have half their length across the flow (see `resist`).
    """
    return INERTIAL_LOSS * np.minimum(solidity / SPARSEST, 1.0)
