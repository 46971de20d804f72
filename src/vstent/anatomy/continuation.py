"""Continue a parent artery that was cut near the neck, so that a device of the right size has an artery to lie in.

Research data sets often keep a few millimetres of artery beside the neck only. Beyond such an end the artery is
assumed to run straight, with a section that relaxes from that of the end to the circle of its area.
"""

from dataclasses import replace
from typing import Final

import numpy as np

from vstent.anatomy.landing_zones import neck_span_mm
from vstent.devices.stent import tube_faces
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy, Centerline
from vstent.kernels import curves
from vstent.kernels.arrays import Floats

ENOUGH_MM: Final = 14.0
"""Length of artery beside the neck, mm, that devices of the usual sizes need: half of a 20 mm device that deploys a
third longer, on a neck of any width. Longer arteries are not continued."""
TANGENT_DIAMETERS: Final = 0.75
"""Length of the artery's end from which its direction is taken, in diameters."""
RELAXING_DIAMETERS: Final = 0.5
"""Length over which the section's difference from a circle decays by a factor e, in diameters."""


def continued(anatomy: Anatomy, enough_mm: float = ENOUGH_MM) -> Anatomy:
    """Continue the parent artery where an end is less than `enough_mm` from the neck.

    Abscissae then count from the continued proximal end, and the path's `continued_mm` are the lengths added.
    """
    parent = anatomy.parent
    first_mm, last_mm = neck_span_mm(anatomy)
    spare_mm = first_mm, parent.axis.length_mm - last_mm
    missing_mm = [enough_mm - spare if spare < enough_mm else 0.0 for spare in spare_mm]
    if not any(missing_mm):
        return anatomy
    points_mm = parent.axis.points_mm
    rings_mm = parent.landing_surface.vertices_mm.reshape(len(points_mm), -1, 3)
    before_mm, before_rings_mm = (new[::-1] for new in _beyond(points_mm[::-1], rings_mm[::-1], missing_mm[0]))
    after_mm, after_rings_mm = _beyond(points_mm, rings_mm, missing_mm[1])
    ends = len(before_mm), len(after_mm)
    points_mm = np.concatenate([before_mm, points_mm, after_mm])
    rings_mm = np.concatenate([before_rings_mm, rings_mm, after_rings_mm])
    rho_mm = np.linalg.norm(rings_mm - points_mm[:, None], axis=2)
    round_mm = np.sqrt((rho_mm**2).mean(axis=1))
    is_own = slice(ends[0], len(points_mm) - ends[1])
    inscribed_mm = rho_mm.min(axis=1)
    inscribed_mm[is_own], round_mm[is_own] = parent.axis.inscribed_radius_mm, parent.section_radius_mm
    axis = Centerline(points_mm, inscribed_mm)
    added_mm = float(axis.abscissa_mm[ends[0]]), float(axis.length_mm - axis.abscissa_mm[is_own.stop - 1])
    n_rays = rings_mm.shape[1]
    restored = replace(
        parent,
        axis=axis,
        section_radius_mm=round_mm,
        landing_surface=Surface(rings_mm.reshape(-1, 3), tube_faces(len(points_mm), n_rays)),
        is_restored=np.pad(parent.is_restored, [n * n_rays for n in ends]),
        continued_mm=added_mm,
    )
    named = zip(("proximal", "distal"), added_mm, strict=True)
    beyond = " and ".join(f"{length:.1f} mm beyond its {end} end" for end, length in named if length)
    note = (
        f"The artery ends near the neck. It is continued straight by {beyond}, so that devices of the usual lengths "
        "can be placed; that part counts in no measure of the wall."
    )
    return replace(anatomy, paths=(restored,), notes=(*anatomy.notes, note))


def _beyond(points_mm: Floats, rings_mm: Floats, length_mm: float) -> tuple[Floats, Floats]:
    """Return points (k, 3) and rings (k, rays, 3) beyond the last of an axis (n, 3) with rings (n, rays, 3)."""
    step_mm = float(np.linalg.norm(points_mm[-1] - points_mm[-2]))
    count = int(np.ceil(length_mm / step_mm)) if length_mm > 0 else 0
    offset_mm = rings_mm[-1] - points_mm[-1]
    back_mm = curves.arc_length(points_mm[::-1])
    reach_mm = TANGENT_DIAMETERS * 2 * float(np.linalg.norm(offset_mm, axis=1).mean())
    tangent = points_mm[-1] - points_mm[::-1][int(np.searchsorted(back_mm, min(reach_mm, back_mm[-1])))]
    tangent = tangent / np.linalg.norm(tangent)
    across_mm = offset_mm - (offset_mm @ tangent)[:, None] * tangent
    rho_mm = np.linalg.norm(across_mm, axis=1)
    radius_mm = float(np.sqrt((rho_mm**2).mean()))
    along_mm = np.linspace(length_mm / max(count, 1), length_mm, count)
    left = np.exp(-along_mm / (2 * radius_mm * RELAXING_DIAMETERS))[:, None]
    new_rho_mm = radius_mm + left * (rho_mm - radius_mm)
    new_mm = points_mm[-1] + along_mm[:, None] * tangent
    return new_mm, new_mm[:, None] + new_rho_mm[..., None] * (across_mm / rho_mm[:, None])
