"""Find the neck: where the sac's wall, corrected for the blur of the scan, meets the parent artery.

The point spread of a scan fills the crevice between sac and artery. At the bottom of the crevice the tissue is thinner
than the blur, so the segmented wall lies outside both lumens. The sharper the crevice, the larger the error. Above a
height of 1.9 standard deviations of the blur, the artery contributes less than 3 % to the intensity at the flank (the
lower part of the sac's wall), and this contribution can be corrected. The neck is found in three steps:

1. From that height the flank is followed upwards along lines of steepest ascent.
2. Each line is continued downwards by a parabola fitted to its points.
3. The neck is the closed curve where these parabolas meet the artery.

The blur is measured in the scan. It is unknown for a vessel that is read from a surface file.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import ndtr, ndtri

from vstent.anatomy.restore.landing import Landing
from vstent.anatomy.restore.tubes import Tubes
from vstent.geometry.surface import Surface
from vstent.kernels import curves, triangles
from vstent.kernels.arrays import Floats, Ints

CLEAR: Final = 1.9
"""The flank is used only above this height, in standard deviations of the blur."""
CLEAR_EDGES: Final = 1.5
"""The flank is used only above this height, in edge lengths of the mesh: the mesh cuts off the bottom of the
crevice."""
UNREADABLE_MM: Final = 0.5
"""Height in mm above which the flank is used where the blur is unknown: 1.9 times 0.26 mm, the total blur of 3DRA scans
from voxel size, reconstruction and mesh smoothing."""
UNREADABLE_EDGES: Final = 2.2
"""The same height in edge lengths of the mesh; the larger one applies. An iso-surface has edges of 0.9 voxel, and the
blur of a scan is about one voxel."""
DEEPEST: Final = 0.45
"""Upper bound on the artery's share of the intensity at the flank."""
BAND: Final = 3.0
"""The flank is followed up to this many times the height above which it is used."""
BAND_OF_HEIGHT: Final = 0.6
"""The flank is followed over at most this fraction of the height between that level and the top of the dome."""
N_LEVELS: Final = 9
"""Number of heights at which the flank is sampled."""
DETAIL: Final = 6.0
"""Shortest wavelength kept along the neck's rim, in multiples of the height from which the flank is extrapolated."""
WAVES: Final = (4.0, 2.0, 1.4, 1.0, 0.7)
"""Factors on the number of waves kept along the rim, tried in this order until the neck has no hook."""
HOOK_RAD: Final = np.radians(40.0)
"""A neck has a hook where it turns by more than this angle, in rad, over half the height from which it is extrapolated.
Hooks arise where neighbouring flanks end on different walls: at forks, and where a branch runs along the sac."""
LOOSE_MM: Final = 0.15
"""Points of the smoothed neck that are farther than this from the artery's wall, in mm, are moved only part of the way
to it."""
REACH: Final = 3.0
"""Longest continuation of a flank, in multiples of the height from which it is extrapolated. A flank that has not met
the artery by then runs along it."""
N_STEPS: Final = 36
"""Number of steps in which the continuation of a flank is searched for the artery."""
OUTSIDE_MM: Final = 0.05
"""A continuation ends where it leaves the lumen by more than this distance, in mm: blur only adds to the lumen in a
crevice."""
BRANCH_SHARE: Final = 0.15
"""Wall less than this many branch radii above a branch's tube is the branch's own wall."""
FACING: Final = 3.0
"""Height added to wall that directly faces a branch, in radii of the branch: such wall belongs to a sac beside the
branch."""
MOUTH: Final = 0.25
"""A branch that arises from the sac is cut off where the wall is this many branch radii above the branch's own wall."""
ROOT: Final = 2.0
"""Length of a branch, in its radii, over which `MOUTH` applies. Farther along, the height from which a flank is used
applies."""


class Artery(NamedTuple):
    """Arteries around a sac: the parent artery, arteries that pass beside the sac, and all other branches."""

    landings: tuple[Landing, ...]
    """Landing surfaces of the parent artery and of the arteries that leave it under the sac."""
    branches: Tubes
    """Tubes of all other branches, from where they have left the parent artery and the sac."""
    apart_mm: Floats
    """(n,) height added to the lumen's wall beside each sphere of `branches`, in mm; see the function `apart_mm`."""

    def height_mm(self, points_mm: Floats, normals: Floats | None = None) -> Floats:
        """Return the height (n,) of points (n, 3) above the walls of all arteries, in mm; negative inside."""
        # With the lumen's normals, wall that faces a branch counts as higher: it belongs to a sac beside that branch.
        first = self.landings[0].surface.closed.signed_distance(points_mm)
        height = np.minimum(first, self.above_branches_mm(points_mm, normals))
        for side in self.landings[1:]:
            away = 0.0 if normals is None else _turned_mm(side.points_mm, side.section_radius_mm, points_mm, normals)
            height = np.minimum(height, side.surface.closed.signed_distance(points_mm) + away)
        return height

    def above_branches_mm(self, points_mm: Floats, normals: Floats | None = None) -> Floats:
        """Return the height (n,) of points (n, 3) above the walls of the branches alone, in mm; negative inside."""
        height, sphere = self.branches.height_mm(points_mm)
        if not len(self.branches.radius_mm):
            return height
        radius = self.branches.radius_mm[sphere]
        height = height - BRANCH_SHARE * radius
        if normals is None:
            return height
        return height + self.apart_mm[sphere] + _turned_mm(self.branches.centers_mm[sphere], radius, points_mm, normals)

    def onto(self, points_mm: Floats) -> Floats:
        """Move points (n, 3), in mm, onto the wall of the artery nearest to them; points at a branch stay."""
        for _ in range(len(self.landings)):
            above = np.stack([landing.surface.closed.signed_distance(points_mm) for landing in self.landings])
            nearest = above.argmin(axis=0)
            moved = points_mm.copy()
            for k, landing in enumerate(self.landings):
                moved[nearest == k] = landing.surface.closest(points_mm[nearest == k])[0]
            at_branch = self.branches.height_mm(points_mm)[0] <= above.min(axis=0)
            points_mm = np.where(at_branch[:, None], points_mm, moved)
        return points_mm


def apart_mm(landings: Sequence[Landing], branches: Tubes, along_mm: Floats, low_mm: float) -> Floats:
    """Return the height (n,) added to the sac's wall beside branches, spheres at `along_mm` (n,) from their start."""
    # Beside an artery the flank is used only above low_mm, because it is extrapolated from there to the neck. The mouth
    # of a branch that arises from the sac is only capped, so a margin for the branch's own wall is enough. With the
    # full low_mm around such a branch, noise would decide whether it merges with a neck up to twice as far away.
    if not len(branches.radius_mm):
        return np.zeros(0)
    radius = branches.radius_mm
    gap_mm = np.min([one.surface.closed.signed_distance(branches.centers_mm) for one in landings], axis=0) - radius
    share = np.clip(gap_mm / low_mm, 0.0, 1.0) * np.clip(ROOT - along_mm / radius, 0.0, 1.0)
    return np.asarray(np.maximum(low_mm - MOUTH * radius, 0.0) * share)


def _turned_mm(centers_mm: Floats, radius_mm: Floats, points_mm: Floats, normals: Floats) -> Floats:
    """Return the height (n,) added to wall (n, 3) that faces a branch with spheres at each point or along a line."""
    if len(centers_mm) != len(points_mm):
        nearest = cKDTree(centers_mm).query(points_mm)[1]
        centers_mm, radius_mm = centers_mm[nearest], radius_mm[nearest]
    toward = centers_mm - points_mm
    facing = np.einsum("nd,nd->n", toward, normals) / np.maximum(np.linalg.norm(toward, axis=1), 1e-12)
    return np.asarray(FACING * radius_mm * np.maximum(facing, 0.0))


class Flank(NamedTuple):
    """Wall of a sac above its rim."""

    vertices_mm: Floats
    """(n, 3) vertices of the sac's wall."""
    faces: Ints
    """(m, 3) vertex indices of its faces."""
    height_mm: Floats
    """(n,) height of the vertices above the artery."""
    rim: Ints
    """(k,) closed loop of vertices on the artery's side, at the lowest height that is used."""

    def levelled(self, low_mm: float) -> "Flank":
        """Return the flank with its rim at height `low_mm`; the correction decays with the distance from the rim."""
        distance, nearest = cKDTree(self.vertices_mm[self.rim]).query(self.vertices_mm)
        missing = low_mm - self.height_mm[self.rim]
        return self._replace(height_mm=self.height_mm + missing[nearest] * np.exp(-distance / low_mm))

    def isoline(self, height_mm: float) -> Floats:
        """Return closely spaced points (j, 3) on the contour line at `height_mm`."""
        level = np.where(np.abs(self.height_mm - height_mm) < 1e-12, 1e-12, self.height_mm - height_mm)
        first, last = np.moveaxis(triangles.section(self.vertices_mm, self.faces, level), 1, 0)
        share = np.linspace(0.0, 1.0, 8, endpoint=False)[:, None, None]
        return np.asarray((first + share * (last - first)).reshape(-1, 3))


def believed_from_mm(lumen: Surface, foot_mm: Floats, most_mm: float, blur_mm: float | None) -> float:
    """Return the height in mm, at most `most_mm`, above which the flank at a bulge's foot (k, 3) is free of blur."""
    near = np.asarray(cKDTree(foot_mm).query(lumen.vertices_mm, distance_upper_bound=most_mm)[0]) < most_mm
    corners = lumen.corners_mm[near[lumen.faces].any(axis=1)]
    edge_mm = float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))
    clear_mm, edges = (UNREADABLE_MM, UNREADABLE_EDGES) if blur_mm is None else (CLEAR * blur_mm, CLEAR_EDGES)
    return min(max(clear_mm, edges * edge_mm), most_mm)


def unblurred(flank: Flank, blur_mm: float) -> Flank:
    """Return the flank with the blur of the artery below it removed."""
    # Both walls are assumed flat and parallel. At distance d from the flank and height h above the artery, the tissue
    # between them appears with the fraction Phi(d / s) - Phi(-h / s) of its own intensity, where s is the standard
    # deviation of the blur and Phi the standard normal distribution. The segmented wall lies where this fraction is
    # one half, at d = s Phi^-1(1/2 + Phi(-h / s)). The vertices are moved back by d.
    share = np.minimum(ndtr(-flank.height_mm / blur_mm), DEEPEST)
    normals = Surface(flank.vertices_mm, flank.faces).vertex_normals
    return flank._replace(vertices_mm=flank.vertices_mm - (blur_mm * ndtri(0.5 + share))[:, None] * normals)


def skirt(flank: Flank, artery: Artery, lumen: Surface, *, n_rings: int) -> Floats:
    """Continue the flank from its rim down to the artery."""
    rim_mm = flank.vertices_mm[flank.rim]
    place = curves.arc_length(np.concatenate([rim_mm, rim_mm[:1]]))
    low_mm = float(np.median(flank.height_mm[flank.rim]))
    n = max(32, round(8 * place[-1] / low_mm))
    even = curves.interpolate(place, np.concatenate([rim_mm, rim_mm[:1]]), place[-1] * np.arange(n) / n)
    n_waves = place[-1] / (DETAIL * low_mm)
    # Points up the flank from its rim, each the nearest one on the next contour line, and parabolas through them.
    high_mm = min(BAND * low_mm, low_mm + BAND_OF_HEIGHT * (float(flank.height_mm.max()) - low_mm))
    points = [even]
    for height_mm in np.linspace(low_mm, high_mm, N_LEVELS)[1:]:
        line_mm = flank.isoline(float(height_mm))
        points.append(line_mm[cKDTree(line_mm).query(points[-1])[1]])
    rise = np.stack(points)
    steps = np.linalg.norm(np.diff(rise, axis=0), axis=2)
    along = np.concatenate([np.zeros((1, n)), np.cumsum(steps, axis=0)]).T
    parabolas = np.asarray(np.linalg.pinv(along[..., None] ** np.arange(3)) @ rise.transpose(1, 0, 2))
    bend = curves.lowpass(parabolas, n_waves)
    # A sac is convex. A concave flank is the flare of its mouth, and would lead the extrapolation astray.
    outward = np.cross(np.roll(bend[:, 0], -1, axis=0) - np.roll(bend[:, 0], 1, axis=0), bend[:, 1])
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-12)
    bend[:, 2] -= np.maximum(np.einsum("nd,nd->n", bend[:, 2], outward), 0.0)[:, None] * outward
    length = curves.lowpass(_length_to_neck(bend, REACH * low_mm, artery, lumen), n_waves)
    feet = bend[:, 0] - length[:, None] * bend[:, 1] + length[:, None] ** 2 * bend[:, 2]
    where = place[:-1] * n / place[-1]
    ring = artery.onto(feet)
    for more in WAVES:
        if _sharpest_rad(ring, 0.5 * low_mm) < HOOK_RAD:
            break
        ring = _nearly(artery, curves.lowpass(ring, more * n_waves))
    neck = _nearly(artery, _between(ring, where))
    bend, length = _between(bend.reshape(n, -1), where).reshape(-1, 3, 3), _between(length[:, None], where)
    share = np.linspace(0.0, 1.0, n_rings + 1)[:, None, None]
    down = -share * length
    # The first ring is the rim itself. Its distance from the parabolas decays over the rings.
    rings = bend[:, 0] + down * bend[:, 1] + down**2 * bend[:, 2] + (1 - share) * (rim_mm - bend[:, 0])
    return np.asarray(rings + share * (neck - rings[-1]))


def _nearly(artery: Artery, points_mm: Floats) -> Floats:
    """Return points (n, 3) moved onto the artery's wall; points farther off are moved only part of the way."""
    moved = artery.onto(points_mm) - points_mm
    size = np.linalg.norm(moved, axis=1, keepdims=True)
    return np.asarray(points_mm + moved / (1.0 + (size / LOOSE_MM) ** 4))


def _sharpest_rad(ring_mm: Floats, length_mm: float) -> float:
    """Return the largest angle, in rad, between successive chords of `length_mm` on a closed curve (n, 3)."""
    closed = np.concatenate([ring_mm, ring_mm[:1]])
    n = max(12, round(4.0 * float(curves.arc_length(closed)[-1]) / length_mm))
    even = curves.resample_evenly(closed, n + 1)[:-1]
    chord = np.roll(even, -4, axis=0) - even
    before = np.roll(chord, 4, axis=0)
    size = np.maximum(np.linalg.norm(chord, axis=1) * np.linalg.norm(before, axis=1), 1e-12)
    return float(np.arccos(np.clip(np.einsum("nd,nd->n", chord, before) / size, -1.0, 1.0)).max())


def _length_to_neck(bend: Floats, reach_mm: float, artery: Artery, lumen: Surface) -> Floats:
    """Return the length (n,) over which parabolas (n, 3, 3) continue down to the artery, in mm."""
    # A parabola that misses the artery ends at its lowest point inside the lumen.
    t = np.linspace(0.0, reach_mm, N_STEPS + 1)
    points = np.einsum("td,nde->nte", (-t[:, None]) ** np.arange(3), bend).reshape(-1, 3)
    height = artery.height_mm(points).reshape(len(bend), -1)
    has_left = np.logical_or.accumulate(lumen.signed_distance(points).reshape(height.shape) > OUTSIDE_MM, axis=1)
    height[:, 1:][has_left[:, 1:]] = np.inf
    has_entered = (height[:, 1:] <= 0).any(axis=1)
    after = 1 + np.where(has_entered, (height[:, 1:] <= 0).argmax(axis=1), height[:, 1:].argmin(axis=1))
    rows = np.arange(len(bend))
    above, below = np.maximum(height[rows, after - 1], 0.0), np.minimum(height[rows, after], 0.0)
    share = np.where(has_entered, above / np.maximum(above - below, 1e-12), 1.0)
    return np.asarray(t[after - 1] + share * (t[after] - t[after - 1]))


def _between(values: Floats, where: Floats) -> Floats:
    """Return values (k, d) interpolated at fractional positions (k,) on a ring of values (n, d)."""
    return curves.interpolate(np.arange(len(values) + 1.0), np.concatenate([values, values[:1]]), where)
