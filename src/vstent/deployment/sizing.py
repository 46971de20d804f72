"""Sizing: which size, and where.

The rule (vstent's own, after common practice in manual sizing): the label diameter is the smallest that is not below
the wider of the two landing zones, or the next one where only that lies against the wall beside the neck; the length
is the shortest whose *deployed* length covers the neck and a margin on both sides, because in a narrower artery a braid
becomes longer than its label says.
"""

from functools import cache, partial
from itertools import chain
from math import inf
from typing import Final

import numpy as np

from vstent.anatomy.landing_zones import landing_diameters_mm, neck_span_mm
from vstent.deployment.braid import expected_profile, march
from vstent.deployment.sketch import bed
from vstent.devices.design import Design, Size
from vstent.devices.stent import Landing, Stent
from vstent.errors import LandingError
from vstent.geometry.vessel import Anatomy

MARGIN_MM: Final = 4.0
"""The device reaches beyond the neck by at least this, or by one artery diameter where that is more."""
END_MM: Final = 0.5
"""A proposed device stays this far from the artery's ends: its length is only foreseen before it is deployed."""
DIAMETER_SLACK_MM: Final = 0.05
"""A label this much below the landing zone still counts as not below it."""
APPOSED_GAP_MM: Final = 0.1
"""A node is apposed when the device's outer face is nearer to the wall than this."""
LOOSE_FRACTION: Final = 0.05
"""Fraction of a device that may have gaps without a note and without a wider size being proposed."""
OVERSIZED_FRACTION: Final = 0.8
"""A label may be this much wider than the artery without a word: Enterprise's, 4.5 mm, is from 2.5 mm on."""


def wanted_margin_mm(anatomy: Anatomy) -> float:
    """How far a device is to reach beyond the neck, on either side."""
    return max(MARGIN_MM, *landing_diameters_mm(anatomy))


def oversizing_fraction(anatomy: Anatomy, stent: Stent) -> float:
    """Label diameter over the artery's mean diameter where the device lies, less one."""
    artery_mm = 2 * np.interp(stent.row_abscissa_mm, anatomy.axis.abscissa_mm, anatomy.section_radius_mm)
    return stent.size.diameter_mm / float(artery_mm.mean()) - 1


def propose_size(design: Design, anatomy: Anatomy) -> Size:
    """Propose the size for the largest aneurysm; narrower ones where the artery is too short for it.

    Raises
    ------
    LandingError
        When even the shortest size that is not too wide for the artery is too long for it.
    """
    wider_mm = max(landing_diameters_mm(anatomy))
    labels = sorted({size.diameter_mm for size in design.sizes})
    zone = next((i for i, label in enumerate(labels) if label >= wider_mm - DIAMETER_SLACK_MM), len(labels) - 1)
    of_label = cache(partial(_of_label, design, anatomy))
    # No size follows a bulge: where the next one would have gaps too, the size of the landing zone stays.
    held = (size for label in labels[zone : zone + 2] if (size := of_label(label)) and _lies(design, anatomy, size))
    fitting = (size for label in reversed(labels[: zone + 1]) if (size := of_label(label)))
    proposed = next(chain(held, fitting), None)
    if proposed is not None:
        return proposed
    tried_mm = labels[: zone + 2][-1]
    tried = [size for size in design.sizes if size.diameter_mm <= tried_mm]
    shortest_mm = min(last - first for first, last in (_span(design, anatomy, size) for size in tried))
    raise LandingError(
        f"No size of {design.name} up to {tried_mm:g} mm in diameter fits: the shortest would be "
        f"{shortest_mm:.1f} mm long in a parent artery of {anatomy.axis.length_mm:.1f} mm. Choose another "
        "device, or give a longer piece of the artery."
    )


def propose_landing(design: Design, anatomy: Anatomy, size: Size) -> Landing:
    """Propose to center the deployed device on the neck, moved as little as the artery's ends demand."""
    profile = expected_profile(design, size, anatomy)
    target_mm = float(np.mean(neck_span_mm(anatomy)))
    wanted_mm = target_mm
    for _ in range(4):  # the middle row is not the middle of the length where the artery tapers
        rows_mm = march(design, size, Landing(wanted_mm), profile)
        first, last = float(rows_mm[0]), float(rows_mm[-1])
        spare_mm = anatomy.axis.length_mm - (last - first)
        move_mm = target_mm - 0.5 * (first + last)
        if spare_mm > 0:
            end_mm = min(END_MM, 0.5 * spare_mm)
            move_mm = min(max(move_mm, end_mm - first), anatomy.axis.length_mm - end_mm - last)
        wanted_mm += move_mm
    return Landing(wanted_mm)


def reach_mm(design: Design, anatomy: Anatomy, size: Size) -> float:
    """How far a size, landed as proposed, reaches beyond the neck on its shorter side; -inf where it does not fit."""
    first_mm, last_mm = _span(design, anatomy, size)
    return _margin(anatomy, first_mm, last_mm) if _fits(anatomy, first_mm, last_mm) else -inf


def _of_label(design: Design, anatomy: Anatomy, label_mm: float) -> Size | None:
    """The shortest size of a label that reaches far enough, or the longest that fits."""
    same = sorted((size for size in design.sizes if size.diameter_mm == label_mm), key=lambda size: size.length_mm)
    spans = {size: _span(design, anatomy, size) for size in same}
    fitting = [size for size in same if _fits(anatomy, *spans[size])]
    if not fitting:
        return None
    wanted_mm = wanted_margin_mm(anatomy)
    return next((size for size in fitting if _margin(anatomy, *spans[size]) >= wanted_mm), fitting[-1])


def _lies(design: Design, anatomy: Anatomy, size: Size) -> bool:
    """Tell whether a size, landed as proposed, will lie against the wall beside the neck, as it finds it there."""
    first_mm, last_mm = _span(design, anatomy, size)
    proximal_mm, distal_mm = neck_span_mm(anatomy)
    found = bed(design, size, anatomy)
    along_mm = found.abscissa_mm
    is_under = (along_mm >= first_mm) & (along_mm <= last_mm)
    is_loose = found.gap_mm[is_under & ((along_mm <= proximal_mm) | (along_mm >= distal_mm))] > APPOSED_GAP_MM
    return not is_loose.size or bool(is_loose.mean() <= LOOSE_FRACTION)


def _span(design: Design, anatomy: Anatomy, size: Size) -> tuple[float, float]:
    rows_mm = march(design, size, propose_landing(design, anatomy, size), expected_profile(design, size, anatomy))
    return float(rows_mm[0]), float(rows_mm[-1])


def _fits(anatomy: Anatomy, first_mm: float, last_mm: float) -> bool:
    return first_mm > 0 and last_mm < anatomy.axis.length_mm


def _margin(anatomy: Anatomy, first_mm: float, last_mm: float) -> float:
    proximal_mm, distal_mm = neck_span_mm(anatomy)
    return min(proximal_mm - first_mm, last_mm - distal_mm)
