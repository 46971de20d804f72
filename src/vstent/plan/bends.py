"""What a bend does to a device with other numbers: fitted over its numbers to a few previews or deployments.

`vstent.deployment.braid.march` gives the rows of a braid before its crossings slide along the wall. In bends the
sliding shortens the device, by more where the wires are steeper. A preview (`vstent.deployment.sketch`) contains it.
The joined cells of a laser-cut device crowd over the neck, by amounts that no closed formula gives.
"""

from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import product
from typing import Final

import numpy as np

from vstent.anatomy.morphology import Measures
from vstent.deployment.braid import march
from vstent.deployment.coverage import density
from vstent.deployment.deploy import deploy
from vstent.deployment.sketch import measured_wall, sketch
from vstent.devices.design import Design, Range, Size
from vstent.devices.ranges import LENGTH, MARGIN, altered, values_at
from vstent.devices.stent import Landing, Stent
from vstent.errors import DeviceError, LandingError
from vstent.geometry.vessel import Anatomy
from vstent.kernels.arrays import Floats

SHORTENED_BY: Final = ("braid_angle_rad", MARGIN, LENGTH)
"""Numbers on which the shortening of a braid depends."""
PREVIEWED: Final = 0.8 * np.array([[-1, -1, 1], [-1, 1, -1], [1, -1, -1], [1, 1, 1]])
"""(4, 3) half of a two-level factorial design: places in the ranges of `SHORTENED_BY`, -1 to 1, of the previews."""
CROWDED_BY: Final = ("n_columns", "cell_angle_rad")
"""Numbers that change the cells of a laser-cut device."""
DEPLOYED: Final = np.array(list(product([-1, 1], repeat=2))) / np.sqrt(3)
"""(4, 2) places in the ranges of `CROWDED_BY`, -1 to 1, of the deployments.

1/sqrt(3) is the standard deviation of a uniform number: these are the points of Gauss's quadrature, so that the plane
through them is the best one, exact up to third order.
"""
NECK: Final = ("neck_metal_coverage_fraction", "neck_pore_density_per_mm2")
"""Results over the neck."""
LEAST: Final = 0.01
"""Smallest result over the neck that the fit distinguishes from none."""


def shortening(
    anatomy: Anatomy, stent: Stent, ranges: tuple[Range, ...], landing: Landing
) -> Callable[[Design, Size], Floats]:
    """Preview a braid at five places in its ranges and fit its shortening, linear in its numbers.

    Returns a function that gives, for an altered device, the change (2,) of the ratio of the length after to that
    before the crossings slide, proximal and distal. It is 0 over numbers without a range.
    """

    def numbers(design: Design, size: Size) -> Floats:
        return np.array([design.angle_rad, size.free_diameter_mm - size.diameter_mm, size.length_mm])

    center = numbers(stent.design, stent.size)
    terms, ratios = [], []
    for design, size in [(stent.design, stent.size), *_altered(stent, ranges, SHORTENED_BY, PREVIEWED)]:
        with suppress(LandingError):  # it does not fit the artery: the others give the slopes
            wall = measured_wall(design, size, anatomy)
            marched_mm = march(design, size, landing, wall.profile)[[0, -1]]
            lies_mm = sketch(wall, landing).stent.row_abscissa_mm[[0, -1]]
            ratios.append((lies_mm - landing.abscissa_mm) / (marched_mm - landing.abscissa_mm))
            terms.append([1.0, *(numbers(design, size) - center)])
    slopes = np.linalg.lstsq(np.array(terms), np.array(ratios), rcond=None)[0][1:] if ratios else np.zeros((3, 2))
    return lambda design, size: (numbers(design, size) - center) @ slopes


def crowding(
    anatomy: Anatomy, stent: Stent, measures: Measures, ranges: tuple[Range, ...], landing: Landing
) -> Callable[[Design], dict[str, float]]:
    """Deploy a laser-cut device at four places in its ranges and fit its coverage and pores over the neck.

    Returns a function that gives the results of an altered device. It gives none if the device fits the artery at fewer
    than two of the places.
    """

    def terms(design: Design) -> list[float]:
        return [1.0, *(design.numbers[name] for name in CROWDED_BY)]

    def scale(name: str, design: Design) -> float:  # coverage is proportional to the strut width
        return design.numbers["strut_width_um"] if name == NECK[0] else 1.0

    found = [(stent.design, measures)]
    for design, size in _altered(stent, ranges, CROWDED_BY, DEPLOYED):
        with suppress(LandingError):
            found.append((design, density(anatomy, deploy(design, anatomy, size=size, landing=landing).stent)))
    names = [name for name in NECK if len(found) > len(CROWDED_BY) and all(name in one for _, one in found)]
    fitted = [[np.log(max(float(one[name]), LEAST) / scale(name, design)) for name in names] for design, one in found]
    plane = np.linalg.lstsq(np.array([terms(design) for design, _ in found]), np.array(fitted), rcond=None)[0]

    def at(design: Design) -> dict[str, float]:
        values = np.exp(np.array(terms(design)) @ plane).tolist()
        return {name: value * scale(name, design) for name, value in zip(names, values, strict=True)}

    return at


def _altered(
    stent: Stent, ranges: tuple[Range, ...], names: tuple[str, ...], places: Floats
) -> Iterator[tuple[Design, Size]]:
    """Yield a device and its size with the numbers `names` at places (k, d) in their ranges, where it can be made."""
    varied = [one for one in ranges if one.name in names]
    for place in places:
        at = dict(zip(names, place.tolist(), strict=True))
        with suppress(DeviceError):
            yield altered(stent.design, stent.size, values_at(varied, (at[one.name] for one in varied)))
