"""Propose the size of a device and where it is landed.

The rule is vstent's own, after common practice in manual sizing:

- The label diameter is the smallest that is not below the diameter of the wider landing zone. If only the next larger
  one is apposed beside the neck, that one is proposed.
- The length is the shortest whose *deployed* length covers the neck and a margin on both sides, because a braid is
  longer than its label states where the artery is narrower.
"""

from functools import cache, partial
from itertools import chain
from math import inf
from typing import Final

import numpy as np

from vstent.anatomy.landing_zones import landing_diameters_mm, neck_span_mm
from vstent.deployment.basket import propose_basket
from vstent.deployment.braid import expected_profile, march
from vstent.deployment.sketch import measured_wall
from vstent.deployment.wall import APPOSED_GAP_MM, LOOSE_FRACTION
from vstent.devices.design import Basket, Design, Size
from vstent.devices.formulas import mesh_nodes
from vstent.devices.stent import Landing, Stent
from vstent.errors import LandingError
from vstent.geometry.vessel import Anatomy
from vstent.kernels.arrays import Floats

MARGIN_MM: Final = 4.0
"""Smallest length, in mm, by which a device extends beyond the neck; one artery diameter if that is more."""
END_MM: Final = 0.5
"""Distance, in mm, that a proposed device keeps from the ends of the artery.

It allows for the deployed length, which can only be estimated before deployment.
"""
DIAMETER_SLACK_MM: Final = 0.05
"""Amount, in mm, by which a label diameter may be below that of the landing zone and still count as not below it."""
OVERSIZED_FRACTION: Final = 0.8
"""Fraction by which the label diameter may exceed the artery's diameter without a note.

Enterprise, for example, has a label diameter of 4.5 mm and is made for arteries from 2.5 mm on.
"""


def wanted_margin_mm(anatomy: Anatomy) -> float:
    """Return the length by which a device should extend beyond the neck on either side, in mm."""
    return max(MARGIN_MM, *landing_diameters_mm(anatomy))


def oversizing_fraction(anatomy: Anatomy, stent: Stent) -> float:
    """Return the label diameter over the mean diameter of the artery along the device, less one."""
    artery_mm = 2 * np.interp(stent.row_abscissa_mm, anatomy.parent.axis.abscissa_mm, anatomy.parent.section_radius_mm)
    return stent.size.diameter_mm / float(artery_mm.mean()) - 1


def propose_size(design: Design, anatomy: Anatomy) -> Size:
    """Propose the size of a device for the largest aneurysm, narrower where the artery is too short for a wider one.

    A LandingError says that all sizes that are not too wide for the artery are too long for it, or that the neck is
    wider than any basket.
    """
    if isinstance(design, Basket):
        return propose_basket(design, anatomy)
    wider_mm = max(landing_diameters_mm(anatomy))
    labels = sorted({size.diameter_mm for size in design.sizes})
    zone = next((i for i, label in enumerate(labels) if label >= wider_mm - DIAMETER_SLACK_MM), len(labels) - 1)
    of_label = cache(partial(_of_label, design, anatomy))
    # No size can follow a bulge. If the next one would have gaps too, the size for the landing zone is proposed.
    apposed = (size for label in labels[zone : zone + 2] if (size := of_label(label)) and _lies(design, anatomy, size))
    fitting = (size for label in reversed(labels[: zone + 1]) if (size := of_label(label)))
    proposed = next(chain(apposed, fitting), None)
    if proposed is not None:
        return proposed
    tried_mm = labels[: zone + 2][-1]
    tried = [_rows_mm(design, anatomy, size) for size in design.sizes if size.diameter_mm <= tried_mm]
    shortest_mm = min(float(rows_mm[-1]) - float(rows_mm[0]) for rows_mm in tried)
    raise LandingError(
        f"No size of {design.name} up to {tried_mm:g} mm in diameter fits: the shortest would be "
        f"{shortest_mm:.1f} mm long in a parent artery of {anatomy.parent.axis.length_mm:.1f} mm. Choose another "
        "device, or give a longer piece of the artery."
    )


def propose_landing(design: Design, anatomy: Anatomy, size: Size) -> Landing:
    """Propose to center the deployed device on the neck, moved only as far as the ends of the artery require."""
    profile = expected_profile(design, size, anatomy)
    target_mm = float(np.mean(neck_span_mm(anatomy)))
    wanted_mm = target_mm
    for _ in range(4):  # where the artery tapers, the middle row is not in the middle of the length
        rows_mm = march(design, size, Landing(wanted_mm), profile)
        first, last = float(rows_mm[0]), float(rows_mm[-1])
        spare_mm = anatomy.parent.axis.length_mm - (last - first)
        move_mm = target_mm - 0.5 * (first + last)
        if spare_mm > 0:
            end_mm = min(END_MM, 0.5 * spare_mm)
            move_mm = min(max(move_mm, end_mm - first), anatomy.parent.axis.length_mm - end_mm - last)
        wanted_mm += move_mm
    return Landing(wanted_mm)


def reach_mm(design: Design, anatomy: Anatomy, size: Size) -> float:
    """Return the length by which the mesh of a size, landed as proposed, extends beyond the neck, in mm.

    It is that of the shorter side; -inf where the size does not fit the artery.
    """
    rows_mm = _rows_mm(design, anatomy, size)
    if rows_mm[0] <= 0 or rows_mm[-1] >= anatomy.parent.axis.length_mm:
        return -inf
    first_mm, last_mm = rows_mm[list(mesh_nodes(design, size))].tolist()
    proximal_mm, distal_mm = neck_span_mm(anatomy)
    return min(proximal_mm - first_mm, last_mm - distal_mm)


def _of_label(design: Design, anatomy: Anatomy, label_mm: float) -> Size | None:
    """Return the shortest size of a label diameter that extends far enough, the longest that fits, or None."""
    same = sorted((size for size in design.sizes if size.diameter_mm == label_mm), key=lambda size: size.length_mm)
    reaches_mm = {size: reach_mm(design, anatomy, size) for size in same}
    fitting = [size for size in same if reaches_mm[size] > -inf]
    wanted_mm = wanted_margin_mm(anatomy)
    return next((size for size in fitting if reaches_mm[size] >= wanted_mm), fitting[-1] if fitting else None)


def _lies(design: Design, anatomy: Anatomy, size: Size) -> bool:
    """Return whether a size, landed as proposed, is expected to be apposed beside the neck."""
    first_mm, last_mm = _rows_mm(design, anatomy, size)[[0, -1]]
    proximal_mm, distal_mm = neck_span_mm(anatomy)
    found = measured_wall(design, size, anatomy)
    along_mm = found.abscissa_mm
    is_under = (along_mm >= first_mm) & (along_mm <= last_mm)
    is_loose = found.gap_mm[is_under & ((along_mm <= proximal_mm) | (along_mm >= distal_mm))] > APPOSED_GAP_MM
    return not is_loose.size or bool(is_loose.mean() <= LOOSE_FRACTION)


def _rows_mm(design: Design, anatomy: Anatomy, size: Size) -> Floats:
    """Return the expected arc lengths (rows,) of the rows of a size, landed as proposed, in mm."""
    return march(design, size, propose_landing(design, anatomy, size), expected_profile(design, size, anatomy))
