"""Bending stiffness of a device from its wires or struts, with its range."""

from typing import Final

import numpy as np

from vstent.devices.design import Basket, Braid, Coil, Design, LaserCut, Size, angle_rad, piece_length_mm
from vstent.kernels.arrays import Floats
from vstent.units import MM_PER_UM

MODULUS_N_MM2: Final = 60e3, 40e3, 83e3
"""Young's modulus of struts, in N/mm2, with its range: nitinol from martensite to austenite."""
BRAIDED_MODULUS_N_MM2: Final = 60e3, 40e3, 240e3
"""The same of wires, some of which are platinum or cobalt-chromium."""
RUBBING: Final = 10.0
"""Factor on the stiffness of wires that slide freely, for the highest one of a braid whose crossings rub. On the bench
the braid Leo+ resists bending more than Neuroform (Krischek et al. 2011, Minim. Invasive Neurosurg. 54:21), but wires
of Leo that slide freely have a tenth of its stiffness."""
POISSON: Final = 0.33
"""Poisson's ratio of the metal."""


def bending_stiffness_N_mm2(design: Design, size: Size, diameter_mm: Floats) -> Floats:
    """Return the likely, the lowest and the highest bending stiffness (3, n) of a device at diameters (n,), in N mm2.

    A wire of a braid is a helix whose ends and crossings are free. A bending moment bends and twists it. Wires of the
    section E I and Poisson's ratio nu, at the angle alpha to the axis, resist with

        B = sum of 2 E I cos(alpha) / (2 + nu sin(alpha)^2).

    The ends of a strut of the length l do not turn, so a ring of n struts with the spacing h resists the strain of the
    tube by S = n h / (sin(alpha)^2 l^3 / (12 E I) + cos(alpha)^2 l / (E A)). It resists bending by S D^2 / 8, to which
    what its struts resist as single wires is added. Where a fraction of the crowns is joined, S is less by its square.

    The range is that of the modulus, of the sections in the catalogue, and of the friction between wires. Coils and
    devices in sacs have no stiffness.
    """
    if isinstance(design, Coil | Basket):
        return np.zeros((3, len(diameter_mm)))
    is_cut, found = not isinstance(design, Braid), []
    sections = [one for one in design.ranges if one.name.endswith(("diameter_um", "width_um", "thickness_um"))]
    limits: list[dict[str, float]] = [
        {},
        {one.name: one.low for one in sections},
        {one.name: one.high for one in sections},
    ]
    for values, modulus in zip(limits, MODULUS_N_MM2 if is_cut else BRAIDED_MODULUS_N_MM2, strict=True):
        found.append(modulus * _per_modulus_mm4(design.altered(values, design.sizes), size, diameter_mm))
    return np.stack(found) * np.array([1.0, 1.0, 1.0 if is_cut else RUBBING])[:, None]


def _per_modulus_mm4(design: Braid | LaserCut, size: Size, diameter_mm: Floats) -> Floats:
    """Return the bending stiffness (n,) over the modulus, in mm4."""
    angle = angle_rad(design, size, diameter_mm)
    sine2, cosine = np.sin(angle) ** 2, np.cos(angle)
    bent = 2 * cosine / (2 + POISSON * sine2)
    if isinstance(design, Braid):
        wires = [*design.wires, *((one.count, one.diameter_um) for one in design.strands)]
        return sum(count * np.pi / 64 * (um * MM_PER_UM) ** 4 for count, um in wires) * bent
    width_mm, thickness_mm = design.strut_width_um * MM_PER_UM, design.strut_thickness_um * MM_PER_UM
    inertia_mm4, length_mm = thickness_mm * width_mm**3 / 12, piece_length_mm(design, size)
    per_strain = sine2 * length_mm**3 / 12 / inertia_mm4 + cosine**2 * length_mm / (width_mm * thickness_mm)
    tube = length_mm * cosine / per_strain * diameter_mm**2 / 8
    return np.asarray(design.n_columns * (design.joined_fraction**2 * tube + inertia_mm4 * bent))
