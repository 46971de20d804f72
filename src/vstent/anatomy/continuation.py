"""Continue a parent artery that was cut near the neck, so that a device of the right size has an artery to lie in.

Research data sets often keep a few millimetres of artery beside the neck only. Beyond such an end the artery is
assumed to run straight, with a section that relaxes from that of the end to the circle of its area.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from vstent.anatomy.landing_zones import neck_span_mm
from vstent.devices.stent import tube_faces
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy, Centerline
from vstent.kernels import curves
from vstent.kernels.arrays import Floats

Value = TypeVar("Value", bound=np.generic)
ENOUGH_MM: Final = 14.0
"""Length of artery beside the neck, mm, that devices of the usual sizes need: half of a 20 mm device that deploys a
third longer, on a neck of any width. Longer arteries are not continued."""
TANGENT_DIAMETERS: Final = 0.75
"""Length of the artery's end from which its direction is taken, in diameters."""
RELAXING_DIAMETERS: Final = 0.5
"""Length over which the section's difference from a circle decays by a factor e, in diameters."""


@dataclass(frozen=True, eq=False)
class _End:
    """Continuation of one end, its rings ordered away from the artery."""

    points_mm: Floats
    """(k, 3) axis."""
    rings_mm: Floats
    """(k, rays, 3) vertices of the landing surface."""


def continued(anatomy: Anatomy) -> Anatomy:
    """Continue the parent artery where an end is less than `ENOUGH_MM` from the neck.

    Parameters
    ----------
    anatomy : restored parent artery.

    Returns otherwise abscissae count from the continued proximal end, and `continued_mm` tells the lengths that were
    added.
    """
    first_mm, last_mm = neck_span_mm(anatomy)
    spare_mm = first_mm, anatomy.parent.axis.length_mm - last_mm
    added_mm = tuple(ENOUGH_MM - spare if spare < ENOUGH_MM else 0.0 for spare in spare_mm)
    if not any(added_mm):
        return anatomy
    points_mm = anatomy.parent.axis.points_mm
    rings_mm = anatomy.parent.landing_surface.vertices_mm.reshape(len(points_mm), -1, 3)
    before = _beyond(points_mm[::-1], rings_mm[::-1], added_mm[0])
    after = _beyond(points_mm, rings_mm, added_mm[1])
    return _assembled(anatomy, rings_mm, before, after)


def _beyond(points_mm: Floats, rings_mm: Floats, length_mm: float) -> _End:
    """Return the continuation beyond the last point of an axis (n, 3) and its rings (n, rays, 3)."""
    step_mm = float(np.linalg.norm(points_mm[-1] - points_mm[-2]))
    count = int(np.ceil(length_mm / step_mm)) if length_mm > 0 else 0
    offset_mm = rings_mm[-1] - points_mm[-1]
    tangent = _direction(points_mm, 2 * float(np.linalg.norm(offset_mm, axis=1).mean()))
    across_mm = offset_mm - (offset_mm @ tangent)[:, None] * tangent
    rho_mm = np.linalg.norm(across_mm, axis=1)
    radius_mm = float(np.sqrt((rho_mm**2).mean()))
    along_mm = np.linspace(length_mm / max(count, 1), length_mm, count)
    left = np.exp(-along_mm / (2 * radius_mm * RELAXING_DIAMETERS))[:, None]
    new_rho_mm = radius_mm + left * (rho_mm - radius_mm)
    new_mm = points_mm[-1] + along_mm[:, None] * tangent
    return _End(new_mm, new_mm[:, None] + new_rho_mm[..., None] * (across_mm / rho_mm[:, None]))


def _direction(points_mm: Floats, diameter_mm: float) -> Floats:
    """Return the direction (3,) of the end of an axis (n, 3)."""
    back_mm = curves.arc_length(points_mm[::-1])
    start = points_mm[::-1][int(np.searchsorted(back_mm, min(TANGENT_DIAMETERS * diameter_mm, back_mm[-1])))]
    vector = points_mm[-1] - start
    return np.asarray(vector / np.linalg.norm(vector))


def _assembled(anatomy: Anatomy, rings_mm: Floats, before: _End, after: _End) -> Anatomy:
    """Return the anatomy with both continuations; abscissae count from the new proximal end."""
    points_mm = np.concatenate([before.points_mm[::-1], anatomy.parent.axis.points_mm, after.points_mm])
    rings_mm = np.concatenate([before.rings_mm[::-1], rings_mm, after.rings_mm])
    k, m = len(before.points_mm), len(after.points_mm)
    new = [*range(k), *range(len(points_mm) - m, len(points_mm))]
    rho_mm = np.linalg.norm(rings_mm[new] - points_mm[new, None], axis=2)
    round_mm = np.sqrt((rho_mm**2).mean(axis=1))
    axis = Centerline(points_mm, _around(anatomy.parent.axis.inscribed_radius_mm, rho_mm.min(axis=1), k))
    shift_mm = float(axis.abscissa_mm[k])
    n_rays = rings_mm.shape[1]
    added_mm = shift_mm, float(axis.length_mm - axis.abscissa_mm[len(points_mm) - 1 - m])
    parent = replace(
        anatomy.parent,
        axis=axis,
        section_radius_mm=_around(anatomy.parent.section_radius_mm, round_mm, k),
        landing_surface=Surface(rings_mm.reshape(-1, 3), tube_faces(len(points_mm), n_rays)),
        is_restored=_around(anatomy.parent.is_restored, np.zeros((k + m) * n_rays, dtype=bool), k * n_rays),
        continued_mm=added_mm,
    )
    return replace(anatomy, paths=(parent,), notes=(*anatomy.notes, _told(added_mm)))


def _around(own: NDArray[Value], new: NDArray[Value], k: int) -> NDArray[Value]:
    """Return values with `k` new ones before them, and the other new ones after them."""
    return np.concatenate([new[:k], own, new[k:]])


def _told(added_mm: Sequence[float]) -> str:
    """Return a note on what was added."""
    named = dict(zip(("proximal", "distal"), added_mm, strict=True))
    ends = " and ".join(f"{length:.1f} mm beyond its {end} end" for end, length in named.items() if length)
    return (
        f"The artery ends near the neck. It is continued straight by {ends}, so that devices of the usual lengths can "
        "be placed; that part counts in no measure of the wall."
    )
