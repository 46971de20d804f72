"""Advice on a deployment: where the device lies, what to do if it does not fit, crumpled cells, a neck on a fork."""

from functools import lru_cache
from math import inf
from typing import Final

from vstent.anatomy.landing_zones import beside_neck, neck_points_mm, neck_span_mm
from vstent.deployment.crumpling import cells, place_of_narrowest
from vstent.deployment.method import Course
from vstent.deployment.sizing import OVERSIZED_FRACTION, oversizing_fraction, reach_mm, wanted_margin_mm
from vstent.deployment.wall import APPOSED_GAP_MM, LOOSE_FRACTION
from vstent.devices.formulas import free_diameters_mm
from vstent.devices.stent import Stent
from vstent.geometry.vessel import Anatomy
from vstent.kernels.arrays import Bools, Floats

SHORT_MM: Final = 0.1
"""Length, in mm, by which the margin beyond the neck may be missed, since the deployed length is only estimated."""
OFF_MM: Final = 0.5
"""Distance from the parent artery, in mm, beyond which a neck also opens into another branch."""


def advise(anatomy: Anatomy, stent: Stent, course: Course, gap_mm: Floats, is_at_patient: Bools) -> str:
    """Describe where the device lies and what to do if it does not fit.

    The gaps (rows, columns) are those between the device and the wall, which is the patient's own at some nodes.
    """
    lies = (
        f"{stent.design.name} {stent.size.label} reaches from {beside_neck(anatomy, stent.proximal_abscissa_mm)} to "
        f"{beside_neck(anatomy, stent.distal_abscissa_mm)} (deployed length {stent.deployed_length_mm:.1f} mm)"
        f"{_width(anatomy, stent)}{_reach(anatomy, stent)}"
    )
    is_loose = is_at_patient & (gap_mm > APPOSED_GAP_MM)
    loose = is_loose.sum() / max(is_at_patient.sum(), 1)
    if course.outcome == "iteration_limit":
        done = course.terminated_fraction[-1]
        lies += f", but only {done:.0%} of its contour reached the wall. Raise the iteration limit or tau."
    elif not is_at_patient.any():
        lies += ". All of it is over restored wall."
    elif loose <= LOOSE_FRACTION:
        lies += f"; {1 - loose:.0%} of it is apposed."
    else:
        largest_mm, remedy = gap_mm[is_at_patient].max(), _remedy(anatomy, stent, gap_mm, is_loose)
        lies += f", and {loose:.0%} of it is not apposed, with gaps up to {largest_mm:.2f} mm: {remedy}"
    found = cells(stent, anatomy.parent.axis)
    if found.n_crumpled:
        count = f"{found.n_crumpled} of its {len(found.width_fraction)} cells"
        width = f"{max(found.width_fraction[found.narrowest], 0.0):.0%} of the width in a straight artery"
        lies += f" {count} {'is' if found.n_crumpled == 1 else 'are'} crumpled, the narrowest to {width}, "
        lies += f"{place_of_narrowest(anatomy, found)}. Move it along the artery."
    first_mm, last_mm = anatomy.parent.own_mm
    beyond_mm = {"proximal": first_mm - stent.proximal_abscissa_mm, "distal": stent.distal_abscissa_mm - last_mm}
    parts = [f"{length:.1f} mm at its {end} end" for end, length in beyond_mm.items() if length > SHORT_MM]
    if parts:
        lies += f" It leaves the patient's artery by {' and '.join(parts)}; the artery there is assumed."
    return f"{lies}{_of_fork(anatomy)}"


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
    short = f", {what} the {end} end of the neck"
    half_mm, center_mm = 0.5 * stent.deployed_length_mm, 0.5 * (proximal_mm + distal_mm)
    fits = half_mm < center_mm < anatomy.parent.axis.length_mm - half_mm
    if fits and 0.5 * (before_mm + after_mm) >= (wanted_mm if beyond_mm >= 0 else 0):  # what misses the neck is moved
        return f"{short} (move it {move})"
    same = [size for size in stent.design.sizes if size.diameter_mm == stent.size.diameter_mm]
    longer = [size for size in same if size.length_mm > stent.size.length_mm]
    next_longer = min(longer, key=lambda size: size.length_mm, default=None)
    if next_longer is not None and reach_mm(stent.design, anatomy, next_longer) > beyond_mm + SHORT_MM:
        return f"{short} (choose a longer size)"
    return short


def _remedy(anatomy: Anatomy, stent: Stent, gap_mm: Floats, is_loose: Bools) -> str:
    """Return why nodes have gaps `gap_mm` (rows, columns) to the wall, and what to do."""
    could_open = stent.row_diameter_mm + 2 * gap_mm.mean(axis=1) < free_diameters_mm(stent.design, stent.size)
    if not stent.design.follows_bends and is_loose[could_open].sum() > 0.5 * is_loose.sum():
        return "its struts keep their length, and the way around the outside of the bend is longer."
    its = f"its free diameter is {stent.size.free_diameter_mm:.2f} mm"
    wider = [size for size in stent.design.sizes if size.diameter_mm > stent.size.diameter_mm]
    if not wider:
        return f"{its}. Choose a device of larger diameter."
    # The shortest sizes come first because they are the most likely to fit.
    wider.sort(key=lambda size: (size.length_mm, size.diameter_mm))
    if all(reach_mm(stent.design, anatomy, size) == -inf for size in wider):
        return f"{its}, and wider sizes are too long for this artery. Choose another device."
    return f"{its}. Choose a wider size."
