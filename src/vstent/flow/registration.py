"""A measured velocity profile in the frame of its own plane, and carried over to the section of an inlet."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import ConvexHull, cKDTree
from scipy.spatial.transform import Rotation

from vstent.errors import InputError
from vstent.flow.profile import distance_inside, grid_over
from vstent.kernels import curves
from vstent.kernels.arrays import Complex, Floats

FLAT: Final = 0.1
"""Largest spread of the points across their plane, as a fraction of the smaller spread within it."""
DIRECTED: Final = 0.1
"""Smallest mean velocity through the plane, as a fraction of the mean speed."""
AREA_MM2: Final = (0.2, 1000.0)
"""Smallest and largest area of a section."""
AROUND: Final = 256
"""Number of points along an outline."""


@dataclass(frozen=True, eq=False)
class MeasuredSection:
    """Velocities in the plane in which they were measured; the third axis is along the mean flow."""

    places_mm: Floats
    """(n, 2) points in the plane, about the centroid of the outline."""
    velocity_m_s: Floats
    """(m, n, 3) velocities of every moment."""
    outline_mm: Floats
    """(k, 2) convex outline, half the distance of neighbors outside the outermost points."""
    axes: Floats
    """(3, 3) axes as rows, in LPS."""
    area_mm2: float
    """Area within the outline."""
    flow_mL_s: Floats
    """(m,) flow rate of every moment."""

    def turn(self, normal: Floats) -> Rotation:
        """Return the smallest rotation that makes the mean flow enter through an opening with this outward normal."""
        axis, cosine = np.cross(self.axes[2], -normal), -float(self.axes[2] @ normal)
        if np.linalg.norm(axis) < 1e-9:
            axis = curves.any_perpendicular(normal)
        return Rotation.from_rotvec(np.arccos(np.clip(cosine, -1, 1)) * axis / np.linalg.norm(axis))

    def described(self, normal: Floats) -> str:
        """Return mean, area and directions as one clause."""
        mean = self.velocity_m_s.mean(axis=(0, 1))
        lean, turned = np.degrees([np.arccos(mean[2] / np.linalg.norm(mean)), self.turn(normal).magnitude()])
        return (
            f"measured: mean {self.flow_mL_s.mean() / self.area_mm2:.2f} m/s through {self.area_mm2:.1f} mm2, "
            f"{lean:.0f} degrees from the normal of its plane, which is turned by {turned:.0f} degrees onto the inlet"
        )


def section_of(points_mm: Floats, velocity_m_s: Floats) -> MeasuredSection:
    """Return velocities (m, n, 3) at points (n, 3) in the frame of their plane; InputError where there is none."""
    around_mm = points_mm - points_mm.mean(axis=0)
    spread, axes = np.linalg.svd(around_mm, full_matrices=False)[1:]
    if spread[1] < FLAT * spread[0] or spread[2] > FLAT * spread[1]:
        raise InputError("the points of the inlet profile are not spread over a plane section: give those of one plane")
    mean_m_s = velocity_m_s.mean(axis=(0, 1))
    if abs(axes[2] @ mean_m_s) < DIRECTED * np.linalg.norm(velocity_m_s, axis=2).mean():
        raise InputError(
            "the velocities of the inlet profile have no mean direction through their plane: check the columns"
        )
    along = axes[2] * np.sign(axes[2] @ mean_m_s)
    # Of a flat picture the first axis is that of its rows.
    first = np.eye(3)[np.abs(along).argmin()]
    first = first - (first @ along) * along
    first /= np.linalg.norm(first)
    axes = np.stack([first, np.cross(along, first), along])
    flat_mm = around_mm @ axes[:2].T
    half_mm = float(np.median(np.asarray(cKDTree(flat_mm).query(flat_mm, k=2)[0])[:, 1])) / 2
    angle = np.arange(16) * np.pi / 8
    grown_mm = (flat_mm[:, None] + half_mm * np.stack([np.cos(angle), np.sin(angle)], axis=1)).reshape(-1, 2)
    hull = ConvexHull(grown_mm)
    outline_mm, area_mm2 = grown_mm[hull.vertices], float(hull.volume)
    if not AREA_MM2[0] <= area_mm2 <= AREA_MM2[1]:
        raise InputError(f"the points of the inlet profile cover {area_mm2:.3g} mm2: give their coordinates in mm")
    grid_mm = grid_over(outline_mm)[0].reshape(-1, 2)
    grid_mm = grid_mm[distance_inside(outline_mm, grid_mm) > 0]
    velocity_m_s = velocity_m_s @ axes.T
    flow_mL_s = area_mm2 * velocity_m_s[:, cKDTree(flat_mm).query(grid_mm)[1], 2].mean(axis=1)
    center_mm = grid_mm.mean(axis=0)
    return MeasuredSection(flat_mm - center_mm, velocity_m_s, outline_mm - center_mm, axes, area_mm2, flow_mL_s)


def registered(measured: MeasuredSection, section_mm: Floats, normal: Floats, points_mm: Floats) -> Floats:
    """Return the velocity (m, n, 3), over the mean speed through a section (k, 3), at points (n, 3).

    The centroid goes to the centroid of the section and the outline to its edge, where blood is at rest: along every
    ray from the centroid, distances are scaled. The plane is turned by the smallest rotation.
    """
    center_mm = section_mm.mean(axis=0)
    axes = measured.turn(normal).apply(measured.axes)
    polygon_mm = (section_mm - center_mm) @ axes[:2].T
    grid_mm = grid_over(polygon_mm)[0].reshape(-1, 2)
    grid_mm = grid_mm[distance_inside(polygon_mm, grid_mm) > 0]
    center_2_mm = grid_mm.mean(axis=0)
    places_mm = np.concatenate([grid_mm, (points_mm - center_mm) @ axes[:2].T]) - center_2_mm
    angle = np.arctan2(places_mm[:, 1], places_mm[:, 0])
    scale = _reach(measured.outline_mm, angle) / _reach(polygon_mm - center_2_mm, angle)
    outline_mm = _even(measured.outline_mm)
    m, n, _ = measured.velocity_m_s.shape
    at_rest = np.zeros((len(outline_mm), 3 * m))
    values = np.concatenate([measured.velocity_m_s.transpose(1, 0, 2).reshape(n, -1), at_rest])
    between = LinearNDInterpolator(np.concatenate([measured.places_mm, outline_mm]), values, fill_value=0.0)
    velocity = between(places_mm * scale[:, None]).reshape(-1, m, 3).transpose(1, 0, 2)
    return np.asarray(velocity[:, len(grid_mm) :] / velocity[:, : len(grid_mm), 2].mean() @ axes)


def harmonics_of(velocity: Floats, count: int) -> tuple[Floats, Complex]:
    """Return the mean (n, 3) and the first `count` harmonics (h, n, 3) of velocities (m, n, 3) over a cycle."""
    spectrum = np.fft.rfft(velocity, axis=0) / len(velocity)
    waves = np.zeros((count, *velocity.shape[1:]), dtype=complex)
    known = spectrum[1 : min(count, (len(velocity) - 1) // 2) + 1]
    waves[: len(known)] = 2 * known
    return spectrum[0].real, waves


def _even(outline_mm: Floats) -> Floats:
    """Return equally spaced points (AROUND, 2) along a closed outline."""
    closed_mm = np.concatenate([outline_mm, outline_mm[:1]])
    along_mm = curves.arc_length(closed_mm)
    return curves.interpolate(along_mm, closed_mm, along_mm[-1] * np.arange(AROUND) / AROUND)


def _reach(outline_mm: Floats, angle: Floats) -> Floats:
    """Return the distance (n,) from the origin to an outline around it, in directions (n,)."""
    even_mm = _even(outline_mm)
    at = np.arctan2(even_mm[:, 1], even_mm[:, 0])
    return np.interp(angle, at, np.linalg.norm(even_mm, axis=1), period=2 * np.pi)
