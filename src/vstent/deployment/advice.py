"""Advice on a deployment: where the device lies, what to do if it does not fit, crumpled cells, a neck on a fork."""

from functools import lru_cache
from math import inf
from typing import Final, NamedTuple

import numpy as np

from vstent.anatomy.landing_zones import neck_points_mm, neck_span_mm
from vstent.deployment.crumpling import crumpling, place_of_narrowest
from vstent.deployment.method import Course
from vstent.deployment.sizing import (
    APPOSED_GAP_MM,
    LOOSE_FRACTION,
    OVERSIZED_FRACTION,
    oversizing_fraction,
    reach_mm,
    wanted_margin_mm,
)
from vstent.devices.design import LaserCut
from vstent.devices.formulas import free_diameters_mm
from vstent.devices.stent import Stent
from vstent.geometry.vessel import Anatomy
from vstent.kernels.arrays import Bools, Floats

SHORT_MM: Final = 0.1
"""Length, in mm, by which the margin beyond the neck may be missed, since the deployed length is only estimated."""

OFF_MM: Final = 0.5
"""Distance from the parent artery, in mm, beyond which a neck also opens into another branch."""

BRAIDED: Final = "Choose a braided device."
"""Remedy for a device whose struts cannot follow a bend."""


class Gaps(NamedTuple):
    """Gaps between a device and the wall."""

    gap_mm: Floats
    """(rows, columns) gap between the outer face of the device and the wall, in mm."""
    is_at_patient: Bools
    """(rows, columns) whether that wall is the patient's own."""


def advise(anatomy: Anatomy, stent: Stent, course: Course, gaps: Gaps) -> str:
    """Describe where the device lies and what to do if it does not fit."""
    lies = _lies(anatomy, stent, course, gaps)
    crumpled = _crumpled(anatomy, stent, remedy="" if lies.endswith(BRAIDED) else _remedy_of_crumpling(stent))
    return f"{lies}{crumpled}{_beyond_patient(anatomy, stent)}{_of_fork(anatomy)}"


def _lies(anatomy: Anatomy, stent: Stent, course: Course, gaps: Gaps) -> str:
    """Return the sentence on where the device lies, its apposition and what to do."""
    gap_mm, is_at_patient = gaps
    lies = (
        f"{stent.design.name} {stent.size.label} spans "
        f"{stent.proximal_abscissa_mm:.1f}-{stent.distal_abscissa_mm:.1f} mm along the parent artery (deployed "
        f"length {stent.deployed_length_mm:.1f} mm){_width(anatomy, stent)}{_reach(anatomy, stent)}"
    )
    if course.outcome == "iteration_limit":
        done = course.terminated_fraction[-1]
        return f"{lies}, but only {done:.0%} of its contour reached the wall. Raise the iteration limit or tau."
    if not is_at_patient.any():
        return f"{lies}. All of it is over restored wall."
    is_loose = is_at_patient & (gap_mm > APPOSED_GAP_MM)
    loose = is_loose.sum() / is_at_patient.sum()
    if loose <= LOOSE_FRACTION:
        return f"{lies}; {1 - loose:.0%} of it is apposed."
    off = f"{loose:.0%} of it is not apposed, with gaps up to {gap_mm[is_at_patient].max():.2f} mm"
    return f"{lies}, and {off}: {_remedy(anatomy, stent, gap_mm, is_loose)}"


def _crumpled(anatomy: Anatomy, stent: Stent, remedy: str) -> str:
    """Return a sentence on crumpled cells that starts with a space and ends with a remedy, or an empty string."""
    found = crumpling(anatomy, stent)
    if found is None or not found.crumpled_count:
        return ""
    count, total = found.crumpled_count, found.cells_count
    cells = f"{count} of its {total} cells {'is' if count == 1 else 'are'} crumpled"
    width = f"{max(found.narrowest_fraction, 0.0):.0%} of the width in a straight artery"
    return f" {cells}, the narrowest to {width}, {place_of_narrowest(anatomy, found)}.{remedy}"


def _remedy_of_crumpling(stent: Stent) -> str:
    """Return what to do about crumpled cells, as a sentence that starts with a space."""
    return f" {BRAIDED}" if isinstance(stent.design, LaserCut) else " Move it along the artery."


def _beyond_patient(anatomy: Anatomy, stent: Stent) -> str:
    """Return a sentence on the part of a device that lies in a continued artery, or an empty string."""
    first_mm, last_mm = anatomy.parent.own_mm
    beyond_mm = {"proximal": first_mm - stent.proximal_abscissa_mm, "distal": stent.distal_abscissa_mm - last_mm}
    parts = [f"{length:.1f} mm at its {end} end" for end, length in beyond_mm.items() if length > SHORT_MM]
    return f" It leaves the patient's artery by {' and '.join(parts)}; the artery there is assumed." if parts else ""


@lru_cache(maxsize=8)
def _of_fork(anatomy: Anatomy) -> str:
    """Return a sentence that starts with a space if the neck opens into more than the parent artery, else nothing."""
    off_mm = anatomy.parent.landing_surface.closest(neck_points_mm(anatomy))[1].max(initial=0.0)
    if off_mm < OFF_MM:
        return ""
    return (
        f" The neck is on a fork and extends up to {off_mm:.1f} mm beyond this artery; blood enters there "
        "beside any device in it."
    )


def _width(anatomy: Anatomy, stent: Stent) -> str:
    """Return a clause that starts with a comma if the label diameter is far wider than the artery, else nothing."""
    over = oversizing_fraction(anatomy, stent)
    if over <= OVERSIZED_FRACTION:
        return ""
    has_narrower = any(size.diameter_mm < stent.size.diameter_mm for size in stent.design.sizes)
    narrower = "narrower size" if has_narrower else "device for narrower arteries"
    return f", label diameter {1 + over:.1f} times the diameter of the artery (choose a {narrower})"


def _reach(anatomy: Anatomy, stent: Stent) -> str:
    """Return a clause that starts with a comma if the margin beyond the neck is missing or too short, else nothing."""
    if not anatomy.aneurysms:
        return ""
    proximal_mm, distal_mm = neck_span_mm(anatomy)
    first_mm, last_mm = stent.mesh_abscissa_mm
    before_mm, after_mm = proximal_mm - first_mm, last_mm - distal_mm
    end, beyond_mm, move = (
        ("proximal", before_mm, "proximally") if before_mm < after_mm else ("distal", after_mm, "distally")
    )
    wanted_mm = wanted_margin_mm(anatomy)
    if beyond_mm >= wanted_mm - SHORT_MM:
        return ""
    what = f"only {beyond_mm:.1f} mm beyond" if beyond_mm >= 0 else f"{-beyond_mm:.1f} mm short of"
    return (
        f", {what} the {end} end of the neck{_remedy_of_reach(anatomy, stent, np.array([before_mm, after_mm]), move)}"
    )


def _remedy_of_reach(anatomy: Anatomy, stent: Stent, beyond_mm: Floats, move: str) -> str:
    """Return advice in brackets for a device that extends by `beyond_mm` (2,) beyond the neck, or nothing."""
    half_mm, center_mm = 0.5 * stent.deployed_length_mm, float(np.mean(neck_span_mm(anatomy)))
    fits = half_mm < center_mm < anatomy.parent.axis.length_mm - half_mm
    if fits and beyond_mm.mean() >= wanted_margin_mm(anatomy):
        return f" (move it {move})"
    size = stent.size
    longer = (
        other
        for other in sorted(stent.design.sizes, key=lambda other: other.length_mm)
        if other.diameter_mm == size.diameter_mm and other.length_mm > size.length_mm
    )
    next_one = next(longer, None)
    helps = next_one is not None and reach_mm(stent.design, anatomy, next_one) > beyond_mm.min() + SHORT_MM
    return " (choose a longer size)" if helps else ""


def _remedy(anatomy: Anatomy, stent: Stent, gap_mm: Floats, is_loose: Bools) -> str:
    """Return why nodes have gaps `gap_mm` (rows, columns) to the wall, and what to do."""
    free_mm = stent.size.free_diameter_mm
    could_open = stent.row_diameter_mm + 2 * gap_mm.mean(axis=1) < free_diameters_mm(stent.design, stent.size)
    if isinstance(stent.design, LaserCut) and is_loose[could_open].sum() > 0.5 * is_loose.sum():
        return f"its struts keep their length, and the way around the outside of the bend is longer. {BRAIDED}"
    its = f"its free diameter is {free_mm:.2f} mm"
    wider = [size for size in stent.design.sizes if size.diameter_mm > stent.size.diameter_mm]
    if not wider:
        return f"{its}. Choose a device of larger diameter."
    # The shortest sizes come first because they are the most likely to fit.
    wider.sort(key=lambda size: (size.length_mm, size.diameter_mm))
    if all(reach_mm(stent.design, anatomy, size) == -inf for size in wider):
        return f"{its}, and wider sizes are too long for this artery. Choose another device."
    return f"{its}. Choose a wider size."
