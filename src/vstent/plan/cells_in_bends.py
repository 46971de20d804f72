"""Gaps and coverage of a laser-cut device whose cells are altered: fitted to a few more deployments.

In a bend joined cells leave the wall, and they crowd over the neck, by amounts that no closed formula gives.
"""

from contextlib import suppress
from itertools import product
from typing import Final, NamedTuple, cast

import numpy as np

from vstent.anatomy.morphology import Measures
from vstent.deployment.coverage import density
from vstent.deployment.deploy import deploy
from vstent.deployment.measure import apposition
from vstent.devices.design import LaserCut, Range
from vstent.devices.ranges import altered, values_at
from vstent.devices.stent import Landing, Stent
from vstent.errors import DeviceError, LandingError
from vstent.geometry.vessel import Anatomy
from vstent.kernels.arrays import Floats

NUMBERS: Final = ("n_columns", "cell_angle_rad")
"""Numbers that change the cells."""
GAPS: Final = ("apposed_fraction", "max_wall_gap_mm")
"""Results of gaps."""
LEAST: Final = 0.01
"""Smallest fraction of nodes and gap (mm) that the fit distinguishes from none."""
NECK: Final = ("neck_metal_coverage_fraction", "neck_pore_density_per_mm2")
"""Results over the neck."""
PLACES: Final = np.array(list(product([-1, 1], repeat=2))) / np.sqrt(3)
"""(4, 2) places in the ranges of `NUMBERS`, -1 to 1, of the deployments.

1/sqrt(3) is the standard deviation of a uniform number: these are the points of Gauss's quadrature, so that the plane
through them is the best one, exact up to third order.
"""


class Plane(NamedTuple):
    """Results of the device as a linear function of its cells."""

    names: tuple[str, ...]
    """Results."""
    coefficients: Floats
    """(3, k) constant and slopes over `NUMBERS` of what is fitted of each result."""

    def at(self, design: LaserCut) -> dict[str, float]:
        """Return the results of an altered device."""
        fitted = (_terms(design) @ self.coefficients).tolist()
        return {name: _result(name, design, one) for name, one in zip(self.names, fitted, strict=True)}


def plane(anatomy: Anatomy, stent: Stent, measures: Measures, ranges: tuple[Range, ...], landing: Landing) -> Plane:
    """Deploy a laser-cut device at four places in its ranges and fit its gaps and its coverage.

    Parameters
    ----------
    stent : the device with the numbers of the catalogue.
    landing : where it is landed.

    Returns the fit. It has no results if the device fits the artery at fewer than two of the places.
    """
    assert isinstance(stent.design, LaserCut)
    varied = [one for one in ranges if one.name in NUMBERS]
    designs, found = [stent.design], [measures]
    for place in PLACES:
        at = dict(zip(NUMBERS, place.tolist(), strict=True))
        values = values_at(varied, (at[one.name] for one in varied))
        with suppress(DeviceError, LandingError):
            design, size = altered(stent.design, stent.size, values)
            deployed = deploy(design, anatomy, size=size, landing=landing)
            found.append(apposition(anatomy, deployed) | density(anatomy, deployed.stent))
            designs.append(cast(LaserCut, design))
    if len(found) <= len(NUMBERS):
        return Plane((), np.zeros((len(NUMBERS) + 1, 0)))
    names = tuple(name for name in (*GAPS, *NECK) if all(name in one for one in found))
    fitted = [
        [_fitted(name, design, float(one[name])) for name in names] for design, one in zip(designs, found, strict=True)
    ]
    terms = np.array([_terms(design) for design in designs])
    return Plane(names, np.linalg.lstsq(terms, np.array(fitted), rcond=None)[0])


def _fitted(name: str, design: LaserCut, value: float) -> float:
    """Return what is fitted of a result: the logit of a fraction of nodes, else the logarithm."""
    if name == GAPS[0]:
        inside = float(np.clip(value, LEAST, 1 - LEAST))
        return float(np.log(inside / (1 - inside)))
    return float(np.log(max(value, LEAST) / (design.strut_width_um if name == NECK[0] else 1.0)))


def _result(name: str, design: LaserCut, fitted: float) -> float:
    """Return the result of which `fitted` is fitted; coverage is proportional to the strut width."""
    if name == GAPS[0]:
        return float(1 / (1 + np.exp(-fitted)))
    return float(np.exp(fitted)) * (design.strut_width_um if name == NECK[0] else 1.0)


def _terms(design: LaserCut) -> Floats:
    """Return the terms (3,) of the plane for a device."""
    return np.array([1.0, design.n_columns, design.cell_angle_rad])
