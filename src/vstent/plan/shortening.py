"""Shortening of a braid by its crossings in bends, fitted over its numbers to a few previews.

`vstent.deployment.braid.march` gives the rows of a braid before its crossings slide along the wall. In bends the
sliding shortens the device, by more where the wires are steeper. A preview (`vstent.deployment.sketch`) contains it.
"""

from contextlib import suppress
from typing import Final, NamedTuple

import numpy as np

from vstent.deployment.braid import march
from vstent.deployment.sketch import bed, sketch
from vstent.devices.design import Design, Range, Size
from vstent.devices.ranges import LENGTH, MARGIN, altered, values_at
from vstent.devices.stent import Landing, Stent
from vstent.errors import DeviceError, LandingError
from vstent.geometry.vessel import Anatomy
from vstent.kernels.arrays import Floats

NUMBERS: Final = ("braid_angle_rad", MARGIN, LENGTH)
"""Numbers on which the shortening depends."""
PLACES: Final = 0.8 * np.array([[-1, -1, 1], [-1, 1, -1], [1, -1, -1], [1, 1, 1]])
"""(4, 3) half of a two-level factorial design: places in the ranges of `NUMBERS`, -1 to 1, of the previews."""


class Shortening(NamedTuple):
    """Shortening of both sides of a braid as a linear function of its numbers."""

    center: Floats
    """(3,) numbers of the catalogue."""
    slopes: Floats
    """(3, 2) slopes of the ratio of the length after to that before the crossings slide, proximal and distal."""

    def change(self, design: Design, size: Size) -> Floats:
        """Return the change (2,) of the ratios, proximal and distal, for an altered device."""
        return (_numbers(design, size) - self.center) @ self.slopes


def shortening(anatomy: Anatomy, stent: Stent, ranges: tuple[Range, ...], landing: Landing) -> Shortening:
    """Preview a braid at five places in its ranges and fit its shortening.

    Parameters
    ----------
    stent : the device with the numbers of the catalogue.
    landing : where its middle row lies.

    Returns the fit; slopes over numbers without a range are 0.
    """
    varied = [one for one in ranges if one.name in NUMBERS]
    devices = [(stent.design, stent.size)]
    for place in PLACES:
        at = dict(zip(NUMBERS, place.tolist(), strict=True))
        values = values_at(varied, (at[one.name] for one in varied))
        with suppress(DeviceError):
            devices.append(altered(stent.design, stent.size, values))
    center = _numbers(stent.design, stent.size)
    terms, ratios = [], []
    for design, size in devices:
        with suppress(LandingError):  # it does not fit the artery: the others give the slopes
            ratios.append(_ratios(anatomy, design, size, landing))
            terms.append([1.0, *(_numbers(design, size) - center)])
    if not ratios:
        return Shortening(center, np.zeros((len(NUMBERS), 2)))
    return Shortening(center, np.linalg.lstsq(np.array(terms), np.array(ratios), rcond=None)[0][1:])


def _ratios(anatomy: Anatomy, design: Design, size: Size, landing: Landing) -> Floats:
    """Return the ratios (2,) of the lengths of both sides after to those before the crossings slide."""
    wall = bed(design, size, anatomy)
    marched_mm = march(design, size, landing, wall.profile)[[0, -1]]
    lies_mm = sketch(wall, landing).stent.row_abscissa_mm[[0, -1]]
    return np.asarray((lies_mm - landing.abscissa_mm) / (marched_mm - landing.abscissa_mm))


def _numbers(design: Design, size: Size) -> Floats:
    """Return `NUMBERS` of a device in one size."""
    return np.array([design.angle_rad, size.free_diameter_mm - size.diameter_mm, size.length_mm])
