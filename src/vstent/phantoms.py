"""Analytic vessels with known dimensions, as surfaces and as synthetic 3DRA scans.

A phantom is the union of round tubes around given axes and, optionally, an ellipsoidal sac. An implicit function,
negative in the lumen, defines the surface, the scan and the true volumes.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.random import Generator
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter

from vstent.geometry.image import Image
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Centerline
from vstent.kernels import curves, smoothing, triangles
from vstent.kernels.arrays import Floats, freeze
from vstent.kernels.voxels import isosurface

AXIS_STEP_MM: Final = 0.04
"""Distance between the points of an axis, in mm."""
BLOCK: Final = 4
"""Edge of the blocks of samples of which only those near the wall are computed, in samples."""
STEEPEST: Final = 1.2
"""Upper bound on the gradient of the implicit function; it is 1 except near an ellipsoid."""


@dataclass(frozen=True, eq=False)
class Sac:
    """An ellipsoid of revolution that represents an aneurysm."""

    center_mm: Floats
    """(3,) center."""
    direction: Floats
    """(3,) unit vector along the height, away from the parent artery."""
    width_radius_mm: float
    """Semi-axis across `direction`."""
    height_radius_mm: float
    """Semi-axis along `direction`."""

    def __post_init__(self) -> None:
        freeze(self, "center_mm direction", np.float64, (3,))

    @property
    def reach_mm(self) -> float:
        """Larger semi-axis."""
        return max(self.width_radius_mm, self.height_radius_mm)

    def implicit_mm(self, points_mm: Floats) -> tuple[Floats, Floats]:
        """Return the signed distance to the ellipsoid and its unit gradient.

        The distance is exact for a sphere and first-order accurate near the wall of an ellipsoid: k0 (k0 - 1) / k1 with
        k0 = abs(x / r) and k1 = abs(x / r^2). Points are (n, 3).
        """
        local = points_mm - self.center_mm
        along = (local @ self.direction)[:, None] * self.direction
        across = local - along
        scaled = across / self.width_radius_mm**2 + along / self.height_radius_mm**2
        k0 = np.sqrt(
            (across**2).sum(axis=1) / self.width_radius_mm**2 + (along**2).sum(axis=1) / self.height_radius_mm**2
        )
        k1 = np.maximum(np.linalg.norm(scaled, axis=1), 1e-9)
        return k0 * (k0 - 1) / k1, scaled / k1[:, None]


@dataclass(frozen=True, eq=False)
class Phantom:
    """A vessel with known dimensions."""

    name: str
    """Name of the phantom."""
    parent: Centerline
    """The parent artery: its true axis and radius, from inlet to outlet."""
    branches: tuple[Centerline, ...] = ()
    """Other tubes; the first point of each is on the parent's axis, the last is an outlet."""
    sac: Sac | None = None
    """The aneurysm."""
    blebs: tuple[Sac, ...] = ()
    """Daughter sacs on the sac."""

    @property
    def sacs(self) -> tuple[Sac, ...]:
        """The sac and its blebs."""
        return self.blebs if self.sac is None else (self.sac, *self.blebs)

    @property
    def tubes(self) -> tuple[Centerline, ...]:
        """All tubes, the parent artery first."""
        return (self.parent, *self.branches)

    def implicit_mm(self, points_mm: Floats) -> tuple[Floats, Floats]:
        """Return the signed distance of points (n, 3) to the wall of the union and its unit gradient.

        Tubes are extended straight beyond their ends, except at an end inside the parent artery.
        """
        value, gradient = tube_implicit_mm(self.parent, points_mm)
        parts = []
        for branch in self.branches:
            begins_inside = bool(tube_implicit_mm(self.parent, branch.points_mm[:1])[0][0] < 0)
            parts.append(tube_implicit_mm(branch, points_mm, begins_inside=begins_inside))
        for part_value, part_gradient in [*parts, *(sac.implicit_mm(points_mm) for sac in self.sacs)]:
            nearer = part_value < value
            value, gradient = np.where(nearer, part_value, value), np.where(nearer[:, None], part_gradient, gradient)
        return value, gradient

    @cached_property
    def ends(self) -> tuple[tuple[Floats, Floats, float], ...]:
        """Center (3,), outward unit normal (3,) and radius of every opening: the inlet, then the end of every tube."""
        inlet, radius = self.parent.points_mm, self.parent.inscribed_radius_mm
        outlets = [
            (t.points_mm[-1], curves.tangents(t.points_mm[-3:])[-1], t.inscribed_radius_mm[-1]) for t in self.tubes
        ]
        return ((inlet[0], -curves.tangents(inlet[:3])[0], radius[0]), *outlets)

    @cached_property
    def sac_volume_mm3(self) -> float:
        """True volume of the sac: the part of the ellipsoids outside the parent artery; 0 without a sac."""
        return self._sac_layers[0]

    @cached_property
    def neck_area_mm2(self) -> float:
        """True area of the parent artery's wall inside the ellipsoids; 0 without a sac."""
        return self._sac_layers[1]

    @cached_property
    def _sac_layers(self) -> tuple[float, float]:
        """Return sac volume and neck area, integrated on a grid with a spacing of 1/40 of the larger semi-axis."""
        if self.sac is None:
            return 0.0, 0.0
        step = self.sac.reach_mm / 40
        low = np.min([sac.center_mm - sac.reach_mm for sac in self.sacs], axis=0) - step
        high = np.max([sac.center_mm + sac.reach_mm for sac in self.sacs], axis=0) + 2 * step
        points = _points([np.arange(a, b, step) for a, b in zip(low, high, strict=True)])
        depth = np.min([sac.implicit_mm(points)[0] for sac in self.sacs], axis=0)
        inside = np.clip(0.5 - depth / step, 0.0, 1.0)
        points, inside = points[inside > 0], inside[inside > 0]
        beyond = tube_implicit_mm(self.parent, points)[0]
        volume = float((inside * np.clip(0.5 + beyond / step, 0.0, 1.0)).sum() * step**3)
        layer = inside * np.clip(1.0 - np.abs(beyond) / step, 0.0, 1.0) / step  # a hat of unit area across the wall
        return volume, float(layer.sum() * step**3)


def tube_implicit_mm(tube: Centerline, points_mm: Floats, *, begins_inside: bool = False) -> tuple[Floats, Floats]:
    """Return the distance of points (n, 3) to the wall of a tube and the direction from its axis.

    The distance is that to the axis minus the radius at the nearest point of the axis. The ends are extended straight.
    """
    points, radius = tube.points_mm, tube.inscribed_radius_mm
    reach = np.linspace(4.0, 0.0, 40, endpoint=False)[:, None] * radius.max()
    head = points[:0] if begins_inside else points[0] - reach * curves.tangents(points[:3])[0]
    tail = points[-1] + reach[::-1] * curves.tangents(points[-3:])[-1]
    extended = np.concatenate([head, points, tail])
    abscissa, distance = curves.project(extended, points_mm)
    along = curves.arc_length(extended)
    away = points_mm - curves.interpolate(along, extended, abscissa)
    unit = away / np.maximum(distance, 1e-9)[:, None]
    return distance - np.interp(abscissa - along[len(head)], tube.abscissa_mm, radius), unit


# -- the phantoms ------------------------------------------------------------------------------------------------------


def tube(*, length_mm: float = 20.0, radius_mm: float = 2.0, end_radius_mm: float | None = None) -> Phantom:
    """Return a straight tube along z; with a radius at its outlet it is linearly tapered."""
    z = np.linspace(0.0, length_mm, int(length_mm / AXIS_STEP_MM) + 1)
    points = np.stack([np.zeros_like(z), np.zeros_like(z), z], axis=-1)
    end = radius_mm if end_radius_mm is None else end_radius_mm
    return Phantom("tube", Centerline(points, np.linspace(radius_mm, end, len(z))))


def torus_arc(*, bend_radius_mm: float = 8.0, angle_rad: float = np.pi, radius_mm: float = 2.0) -> Phantom:
    """Return part of a torus around the y axis: an artery of constant curvature."""
    angle = np.linspace(0.0, angle_rad, int(bend_radius_mm * angle_rad / AXIS_STEP_MM) + 1)
    points = bend_radius_mm * np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], axis=-1)
    return Phantom("torus arc", Centerline(points, np.full(len(angle), radius_mm)))


def siphon(*, inlet_radius_mm: float = 2.1, outlet_radius_mm: float = 1.8) -> Phantom:
    """Return a curved internal carotid artery: up, forward, back over itself and up again (a C-shaped siphon).

    The radius changes linearly along the axis.
    """
    knots = [
        (0.0, 5.0, 0.0), (0.0, 5.0, 4.0), (0.0, 4.6, 8.0), (0.2, 1.5, 11.6), (0.8, -3.2, 12.6), (1.4, -7.2, 14.0),
        (1.8, -8.6, 17.6), (1.6, -6.0, 20.8), (0.8, -1.8, 22.0), (0.0, 1.2, 24.4), (-0.2, 1.8, 28.0), (-0.2, 1.8, 32.0),
    ]  # fmt: skip
    points = spline(np.array(knots), vertical_ends=True)
    return Phantom("siphon", Centerline(points, np.linspace(inlet_radius_mm, outlet_radius_mm, len(points))))


def bifurcation(*, radius_mm: float = 1.75, daughter_radius_mm: float = 1.5, half_angle_rad: float = 0.9) -> Phantom:
    """Return a bifurcation in the x-z plane: an artery along z with two daughters of bend radius 5 mm.

    The half angle is that between each daughter and the z axis.
    """
    trunk_mm, bend_mm, leg_mm = 10.0, 5.0 * half_angle_rad, 9.0
    abscissa = np.linspace(0.0, trunk_mm + bend_mm + leg_mm, int((trunk_mm + bend_mm + leg_mm) / AXIS_STEP_MM) + 1)
    turned = np.clip((abscissa - trunk_mm) / bend_mm, 0.0, 1.0)
    heading = half_angle_rad * turned
    direction = np.stack([np.sin(heading), np.zeros_like(heading), np.cos(heading)], axis=-1)
    steps = 0.5 * (direction[1:] + direction[:-1]) * np.diff(abscissa)[:, None]
    right = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    radius = radius_mm + (daughter_radius_mm - radius_mm) * turned**2 * (3 - 2 * turned)
    after = abscissa > trunk_mm - 4 * AXIS_STEP_MM  # a tube is extended backwards along its first points
    left = Centerline(right[after] * [-1.0, 1.0, 1.0], radius[after])
    return Phantom("bifurcation", Centerline(right, radius), (left,))


def with_sac(
    phantom: Phantom,
    *,
    abscissa_mm: float,
    width_mm: float = 7.0,
    neck_mm: float = 4.5,
    elongation: float = 1.0,
    direction: Floats | None = None,
) -> Phantom:
    """Return a phantom with a sac on the wall of the parent artery, on the outer bend or in a direction (3,)."""
    parent = phantom.parent
    i = int(np.abs(parent.abscissa_mm - abscissa_mm).argmin())
    tangent = curves.tangents(parent.points_mm)[i]
    wanted = outer_side(parent, i) if direction is None else np.asarray(direction, dtype=np.float64)
    across = wanted - (wanted @ tangent) * tangent
    across /= np.linalg.norm(across)
    height = 0.5 * width_mm * elongation
    lift = height * np.sqrt(1.0 - (neck_mm / width_mm) ** 2)
    center = parent.points_mm[i] + (parent.inscribed_radius_mm[i] + lift) * across
    return replace(phantom, name=f"{phantom.name} with sac", sac=Sac(center, across, 0.5 * width_mm, height))


def with_branch(
    phantom: Phantom, *, abscissa_mm: float, direction: Floats, radius_mm: float = 0.65, length_mm: float = 12.0
) -> Phantom:
    """Return a phantom with a straight side branch in a direction (3,)."""
    start = phantom.parent.at(np.array([abscissa_mm]))[0]
    unit = np.asarray(direction, dtype=np.float64) / np.linalg.norm(direction)
    points = start + np.linspace(0.0, length_mm, int(length_mm / AXIS_STEP_MM) + 1)[:, None] * unit
    branch = Centerline(points, np.full(len(points), radius_mm))
    return replace(phantom, branches=(*phantom.branches, branch))


def demo_phantom() -> Phantom:
    """Return a curved ICA of 4.2 to 3.6 mm with a side branch and a sidewall sac of 7 mm on the outer bend."""
    healthy = with_branch(siphon(), abscissa_mm=19.0, direction=np.array([0.3, -1.0, -0.12]), length_mm=15.0)
    return replace(with_sac(healthy, abscissa_mm=27.0, neck_mm=5.5), name="demo")


def spline(knots_mm: Floats, *, vertical_ends: bool = False) -> Floats:
    """Return a smooth curve (n, 3) through knots (k, 3), sampled every `AXIS_STEP_MM`; vertical ends are along z."""
    chord = curves.arc_length(knots_mm)
    up = np.array([0.0, 0.0, 1.0])
    fine = CubicSpline(chord, knots_mm, bc_type=((1, up), (1, up)) if vertical_ends else "natural")
    return curves.resample(fine(np.linspace(0.0, chord[-1], int(chord[-1] / AXIS_STEP_MM) * 2)), AXIS_STEP_MM)


def outer_side(axis: Centerline, i: int) -> Floats:
    """Return the direction away from the center of curvature of an axis."""
    span = max(1, min(25, i, len(axis.points_mm) - 1 - i))
    bend = axis.points_mm[i - span] - 2 * axis.points_mm[i] + axis.points_mm[i + span]
    length = float(np.linalg.norm(bend))
    if length < 1e-6:
        return curves.any_perpendicular(curves.tangents(axis.points_mm)[i])
    return -bend / length


# -- surface -----------------------------------------------------------------------------------------------------------


def phantom_surface(phantom: Phantom, *, edge_mm: float = 0.25) -> Surface:
    """Return triangles on the exact wall, open and cut at a right angle at every end."""
    low, high = _box(phantom, margin_mm=4 * edge_mm)
    low, high = low - 3 * edge_mm, high + 3 * edge_mm
    ticks = [np.arange(a, b + edge_mm, edge_mm) for a, b in zip(low, high, strict=True)]
    field = _sample(phantom, ticks, band_mm=3 * edge_mm)
    # Values next to the wall are moved away from 0 to avoid slivers; the vertices are put on the wall afterwards.
    field = np.where(np.abs(field) < 0.2 * edge_mm, np.copysign(0.2 * edge_mm, field), field)
    index, faces = isosurface(-field.astype(np.float32), 0.0)
    vertices = _onto_wall(phantom, low + edge_mm * index)
    mean = smoothing.averaging(len(vertices), faces)
    for _ in range(5):  # an even distribution
        vertices = _onto_wall(phantom, 0.5 * (vertices + mean @ vertices), steps=1)
    vertices = _onto_wall(phantom, vertices)
    for normal, radius, height, across in _from_ends(phantom, vertices):  # vertices near an end are moved onto it
        near = (across < 1.5 * radius) & (np.abs(height) < 0.3 * edge_mm)
        vertices[near] -= height[near, None] * normal
    beyond = np.full(len(vertices), -1e6)
    for _, radius, height, across in _from_ends(phantom, vertices):
        near = (across < 1.5 * radius) & (height > -radius)
        beyond = np.where(near, np.maximum(beyond, height), beyond)
    beyond[np.abs(beyond) < 1e-6] = 0.0
    vertices, faces = triangles.compact(*triangles.cut(vertices, faces, beyond))
    rim = np.unique(triangles.open_edges(faces))
    vertices[rim] = _onto_wall(phantom, vertices[rim])  # at the end of a round tube they stay in the plane
    return Surface(vertices, faces)


def _onto_wall(phantom: Phantom, points: Floats, *, steps: int = 3) -> Floats:
    """Return points moved along the gradient to the zero of the implicit function."""
    for _ in range(steps):
        value, gradient = phantom.implicit_mm(points)
        points = points - value[:, None] * gradient
    return points


def _from_ends(phantom: Phantom, points: Floats) -> Iterator[tuple[Floats, float, Floats, Floats]]:
    """Yield normal and radius of every end, and the distances (n,) of points beyond its plane and from its axis."""
    for center, normal, radius in phantom.ends:
        local = points - center
        height = local @ normal
        yield normal, radius, height, np.linalg.norm(local - height[:, None] * normal, axis=1)


def _sample(phantom: Phantom, ticks: list[Floats], band_mm: float) -> Floats:
    """Return the implicit function on a grid (i, j, k), exact within `band_mm` of the wall and elsewhere right in sign.

    Blocks of samples that are all farther from the wall have the value at their center.
    """
    size = BLOCK
    shape = np.array([len(t) for t in ticks])
    middles = [t[np.minimum(np.arange(size // 2, len(t) + size // 2, size), len(t) - 1)] for t in ticks]
    coarse = phantom.implicit_mm(_points(middles))[0].reshape([len(m) for m in middles])
    field = coarse.repeat(size, 0).repeat(size, 1).repeat(size, 2)[: shape[0], : shape[1], : shape[2]]
    farthest_mm = size // 2 * float(np.linalg.norm([t[1] - t[0] for t in ticks]))
    index = np.nonzero(np.abs(field) < STEEPEST * farthest_mm + band_mm)
    field[index] = phantom.implicit_mm(np.stack([t[i] for t, i in zip(ticks, index, strict=True)], axis=-1))[0]
    return field


def _points(ticks: list[Floats]) -> Floats:
    """Return all points (n, 3) of a grid from its coordinates along each axis."""
    return np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)


def _box(phantom: Phantom, *, margin_mm: float) -> tuple[Floats, Floats]:
    """Return the lower and upper corner (3,) of a box around the phantom."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for t in phantom.tubes:
        reach = t.inscribed_radius_mm[:, None] + margin_mm
        low = np.minimum(low, (t.points_mm - reach).min(axis=0))
        high = np.maximum(high, (t.points_mm + reach).max(axis=0))
    for sac in phantom.sacs:
        radius = sac.reach_mm + margin_mm
        low, high = np.minimum(low, sac.center_mm - radius), np.maximum(high, sac.center_mm + radius)
    return low, high


# -- scan --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Scanner:
    """Properties of a synthetic 3DRA scan."""

    voxel_mm: float = 0.28
    """Edge of the cubic voxels."""
    blur_mm: float = 0.22
    """Standard deviation of the Gaussian point spread."""
    noise: float = 0.04
    """Standard deviation of the noise, as a fraction of the contrast."""
    contrast: float = 2000.0
    """Difference in intensity between lumen and tissue."""
    tissue: float = 100.0
    """Intensity of the tissue."""
    structure: float = 0.05
    """Standard deviation of slow variations of the tissue, as a fraction of the contrast."""
    margin_mm: float = 3.0
    """Width of the tissue around the vessel."""


def scan(phantom: Phantom, rng: Generator, *, scanner: Scanner = Scanner()) -> Image:
    """Return a synthetic 3DRA scan with partial volume, point spread, tissue and noise of a random generator.

    The voxels are int16, the grid is aligned with LPS, and the vessel ends leave through the border.
    """
    h = scanner.voxel_mm
    low, high = _box(phantom, margin_mm=scanner.margin_mm)
    for center, normal, _ in phantom.ends:  # the box is cut there along the axis closest to the normal
        axis = int(np.argmax(np.abs(normal)))
        if normal[axis] > 0:
            high[axis] = min(high[axis], center[axis])
        else:
            low[axis] = max(low[axis], center[axis])
    pad = int(np.ceil(4 * scanner.blur_mm / h))
    ticks = [np.arange(a + h / 2 - pad * h, b + pad * h, h) for a, b in zip(low, high, strict=True)]
    field = _sample(phantom, ticks, band_mm=3 * h)  # the gradient of a voxel near the wall reaches one voxel farther
    filled = gaussian_filter(_coverage(field, h).astype(np.float32), scanner.blur_mm / h)
    tissue, grain = (
        gaussian_filter(rng.standard_normal(field.shape, dtype=np.float32), blur) for blur in (3.0 / h, 0.5)
    )
    voxels = filled + scanner.structure * (tissue / tissue.std()) * (1 - filled) + scanner.noise * (grain / grain.std())
    inner = tuple(slice(pad, n - pad) for n in field.shape)
    affine = np.diag([h, h, h, 1.0])
    affine[:3, 3] = [t[pad] for t in ticks]
    return Image(np.round(scanner.tissue + scanner.contrast * voxels[inner]).astype(np.int16), affine, "XA")


def _coverage(field: Floats, h: float) -> Floats:
    """Return the fraction of every voxel in the lumen, from the distance at its center and a locally flat wall."""
    gradient = np.moveaxis(np.asarray(np.gradient(field, h)), 0, -1)
    near = np.nonzero(np.abs(field) < 1.5 * h)
    normal = gradient[near] / np.maximum(np.linalg.norm(gradient[near], axis=-1, keepdims=True), 1e-9)
    offsets = _points([(np.arange(4.0) - 1.5) * (h / 4)] * 3)
    value = field[near]
    filled = np.zeros(len(value))
    for offset in offsets:
        filled += np.clip(0.5 - 4 * (value + normal @ offset) / h, 0.0, 1.0)
    coverage = (field < 0).astype(np.float64)
    coverage[near] = filled / len(offsets)
    return coverage
