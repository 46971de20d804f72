"""Compare a case with a scan or surface of the same artery after the treatment: what was planned, what is there."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from vstent.anatomy.landing_zones import neck_span_mm
from vstent.anatomy.read import read_vessel
from vstent.anatomy.restore.paths import on_path
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.deployment.motion import OFF_WALL_MM
from vstent.deployment.straightening import STEP_MM, measured
from vstent.devices.stent import Stent
from vstent.errors import InputError
from vstent.geometry.image import Image
from vstent.geometry.registration import Pose, registered, settled
from vstent.geometry.vessel import Anatomy, Vessel
from vstent.io.images import read_image
from vstent.kernels import curves
from vstent.kernels.arrays import Floats

BESIDE_MM = 2.0
"""Distance from the ends of the device beyond which the artery is registered, in mm."""
WITHIN = 1.5
"""Largest distance of metal from the axis, in radii of the artery."""

PREDICTED = {
    "arms_angle_rad": "arms_angle_after_rad",
    "bend_radius_mm": "bend_radius_after_mm",
    "straightened_rad": "straightened_rad",
}
"""Numbers of an artery after the treatment, and the metrics of straightening that predict them."""


class Followup(NamedTuple):
    """An artery after a treatment beside the one that was planned on."""

    pose: Pose
    """Motion from the frame of the plan into that of the follow-up."""
    anatomy: Anatomy
    """The artery after the treatment, in its own frame."""
    planned: dict[str, float]
    """Numbers of the plan; the end of each name is its unit."""
    real: dict[str, float]
    """The same numbers after the treatment, as far as they can be seen."""

    def metrics(self) -> dict[str, Any]:
        """Return all numbers for a file."""
        return {"registration": self.pose._asdict(), "planned": self.planned, "real": self.real}


def compare_followup(
    anatomy: Anatomy,
    stent: Stent,
    path: Path,
    metal: float | None = None,
    predicted: Mapping[str, float] = MappingProxyType({}),
) -> Followup:
    """Compare a planned device with a scan or surface; voxels from the intensity `metal` on are the real one.

    `predicted` are the metrics of the artery that was predicted to yield; without them a rigid one was planned.
    """
    anatomy, vessel = on_path(anatomy, stent.path), read_vessel(path)
    first_pose = registered(anatomy.vessel.lumen.vertices_mm, vessel.lumen)
    pose = settled(_outside_mm(anatomy, stent), vessel.lumen, first_pose)
    after = _artery(anatomy, vessel, pose)
    axis, other = anatomy.parent.axis, after.parent.axis
    ends_mm = stent.proximal_abscissa_mm, stent.distal_abscissa_mm
    # The axis keeps its length, so that arc lengths lead from the middle of the neck to the ends of the device.
    middle_mm, at_mm = (float(np.mean(neck_span_mm(one))) for one in (anatomy, after))
    if not after.aneurysms:
        at_mm = float(other.nearest_abscissa_mm(pose.of(axis.at(np.array([middle_mm]))))[0])
    after_mm = ends_mm[0] - middle_mm + at_mm, ends_mm[1] - middle_mm + at_mm
    lines_mm = [curves.resample(line.points_mm, STEP_MM) for line in (axis, other)]
    shapes = measured(lines_mm[0], ends_mm), measured(lines_mm[1], after_mm)
    planned, real = (dict(zip(("arms_angle_rad", "bend_radius_mm"), one, strict=True)) for one in shapes)
    real["straightened_rad"] = real["arms_angle_rad"] - planned["arms_angle_rad"]
    planned |= {name: predicted.get(key, planned.get(name, 0.0)) for name, key in PREDICTED.items()}
    if metal is not None:
        radius_mm = 0.5 * stent.row_diameter_mm
        gap_mm = np.interp(stent.row_abscissa_mm, axis.abscissa_mm, anatomy.parent.section_radius_mm) - radius_mm
        planned |= _device(np.array(ends_mm) - middle_mm, radius_mm, gap_mm)
        along_mm, off_mm, gap_mm = _metal(read_image(path), metal, after)
        real |= _device(np.quantile(along_mm, [0.002, 0.998]) - at_mm, off_mm, gap_mm)
    return Followup(pose, after, planned, real)


def _outside_mm(anatomy: Anatomy, stent: Stent) -> Floats:
    """Return the vertices (n, 3) of the artery's wall beside the device."""
    points_mm, wall = anatomy.vessel.lumen.vertices_mm, anatomy.parent.landing_surface
    points_mm = points_mm[wall.closest(points_mm)[1] < OFF_WALL_MM]
    at_mm = anatomy.parent.axis.nearest_abscissa_mm(points_mm)
    first_mm, last_mm = stent.proximal_abscissa_mm - BESIDE_MM, stent.distal_abscissa_mm + BESIDE_MM
    return points_mm[(at_mm < first_mm) | (at_mm > last_mm)]


def _artery(anatomy: Anatomy, vessel: Vessel, pose: Pose) -> Anatomy:
    """Return the restored artery after the treatment, between the ends of the one before."""
    axis = anatomy.parent.axis
    first_mm, middle_mm, last_mm = pose.of(axis.at(np.array([0.0, np.mean(neck_span_mm(anatomy)), axis.length_mm])))
    reach_mm = {"upstream_mm": axis.length_mm, "downstream_mm": axis.length_mm}
    traced = trim(trace(vessel, inlet_mm=first_mm), at_mm=middle_mm, **reach_mm)
    return restore(traced, outlet_mm=last_mm)


def _metal(image: Image, metal: float, after: Anatomy) -> tuple[Floats, Floats, Floats]:
    """Return arc lengths, distances from the axis and gaps to the wall (n,) of the metal in an artery, in mm."""
    points_mm = image.to_mm(np.argwhere(image.voxels >= metal).astype(np.float64))
    path = after.parent
    along_mm, off_mm = curves.project(path.axis.points_mm, points_mm)
    radius_mm = np.interp(along_mm, path.axis.abscissa_mm, path.section_radius_mm)
    is_in = (off_mm < WITHIN * radius_mm) & (along_mm > 0) & (along_mm < path.axis.length_mm)
    if not is_in.any():
        raise InputError(f"No voxel in or near the artery has an intensity of {metal:g} or more: give another --metal.")
    return along_mm[is_in], off_mm[is_in], (radius_mm - off_mm)[is_in]


def _device(ends_mm: Floats, radius_mm: Floats, gap_mm: Floats) -> dict[str, float]:
    """Return the numbers of a device from its ends (2,) about the middle of the neck, its radii and its gaps."""
    return {
        "proximal_end_to_neck_middle_mm": float(ends_mm[0]),
        "distal_end_to_neck_middle_mm": float(ends_mm[1]),
        "deployed_length_mm": float(ends_mm[1] - ends_mm[0]),
        "mean_diameter_mm": float(2 * radius_mm.mean()),
        "max_wall_gap_mm": float(max(np.quantile(gap_mm, 0.99), 0.0)),
    }
