"""Restore paths beside the parent artery: from the inlet to another outlet, and from one arm of a fork to the other."""

from dataclasses import replace
from functools import lru_cache
from typing import Final

import numpy as np

from vstent.anatomy.continuation import continued
from vstent.anatomy.restore.axis import Mouth, fit_axis
from vstent.anatomy.restore.landing import close_landing
from vstent.devices.treatment import ARM_TO_ARM
from vstent.errors import InputError
from vstent.geometry.vessel import PARENT, Anatomy, Centerline, Path
from vstent.kernels import curves

ENOUGH_MM: Final = 18.0
"""Length of artery beside the neck, in mm, up to which these paths are continued: a stent of 14 mm that begins at the
fork is up to 17 mm long in a narrow arm."""


@lru_cache(maxsize=16)
def on_path(anatomy: Anatomy, name: str) -> Anatomy:
    """Return the anatomy with a path in the first place, where devices are deployed; it is restored if it is not there.

    Parameters
    ----------
    anatomy : restored artery.
    name : ``parent``; the role of an opening such as ``outlet_2``, for the path from the inlet to it; or
        ``outlet_1>outlet_2`` for the path from one arm of a fork to the other.

    Returns
    -------
    anatomy : the same artery, with this path first.

    Raises
    ------
    InputError
        There is no such opening.
    VesselError
        No tube fits the wall along this path.
    """
    if anatomy.parent.name == name:
        return anatomy
    known = {path.name: path for path in anatomy.paths}
    path = known.get(name) or _restored(anatomy, name)
    return replace(anatomy, paths=(path, *(other for other in anatomy.paths if other is not path)))


def _restored(anatomy: Anatomy, name: str) -> Path:
    """Return the path of a name, its necks and ostia closed and its short ends continued."""
    vessel = anatomy.vessel
    lines = {opening.role: line for opening, line in zip(vessel.far_ends, vessel.centerlines, strict=True)}
    ends = name.split(ARM_TO_ARM)
    if len(ends) > 2 or len(set(ends)) < len(ends) or not set(ends) <= lines.keys():
        raise InputError(
            f"This artery has no path {name!r}. Choose {PARENT}, one of {', '.join(lines)}, or two of them with "
            f"{ARM_TO_ARM!r} in between."
        )
    line = lines[ends[0]] if len(ends) == 1 else _arm_to_arm(lines[ends[0]], lines[ends[1]])
    mouths = [Mouth(sac.neck_mm, (sac.plane or sac.mean_plane).normal) for sac in anatomy.aneurysms]
    landing = close_landing(vessel.lumen, fit_axis(vessel.lumen, line, mouths))
    path = Path(name, landing.axis, landing.section_radius_mm, landing.surface, landing.is_restored.ravel())
    return continued(replace(anatomy, paths=(path,)), ENOUGH_MM).parent


def _arm_to_arm(first: Centerline, second: Centerline) -> Centerline:
    """Return the curve back along one centerline and on along another; it is straight across the fork."""
    parts = []
    for line, other in ((first, second), (second, first)):
        away_mm = curves.project(other.points_mm, line.points_mm)[1]
        is_apart = away_mm > line.inscribed_radius_mm
        parts.append(np.flatnonzero(~is_apart)[-1] + 1)
    points_mm = np.concatenate([first.points_mm[parts[0] :][::-1], second.points_mm[parts[1] :]])
    radius_mm = np.concatenate([first.inscribed_radius_mm[parts[0] :][::-1], second.inscribed_radius_mm[parts[1] :]])
    even_mm = curves.resample(points_mm, float(np.median(curves.lengths(np.diff(points_mm, axis=0)))))
    where_mm, along_mm = curves.arc_length(even_mm), curves.arc_length(points_mm)
    scaled_mm = where_mm * along_mm[-1] / where_mm[-1]
    return Centerline(even_mm, np.interp(scaled_mm, along_mm, radius_mm))
