"""The neck: where the sac's flank, freed of the blur that rounds its edge, meets the parent artery.

A scan's point spread fills the crevice between sac and artery: at its bottom the tissue is thinner than the blur, so
the wall seen there lies outside of both, the more so the sharper the crevice. From a height of 1.9 standard deviations
of the blur on, the artery's share in the flank's intensity is below 3 %, and what it does to the flank can be undone.
So the flank is followed up from there along lines of steepest ascent, each line is continued downwards with its own
slope and curvature (a parabola over its length), and the neck is where those parabolas meet the artery. The blur is
the one measured in the scan; a surface does not tell it.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import ndtr, ndtri

from vstent.anatomy.restore.landing import Landing
from vstent.anatomy.restore.tubes import Tubes
from vstent.geometry.surface import Surface
from vstent.kernels import curves
from vstent.kernels.arrays import Floats, Ints

CLEAR: Final = 1.9
"""Lower down than this many standard deviations of the blur the flank is not believed..."""
CLEAR_EDGES: Final = 1.5
"""... nor lower than this many edges of the mesh, which cuts off the bottom of the crevice by itself."""
UNTOLD_MM: Final = 0.5
"""Where the blur is not known, lower down than this: 1.9 times 0.26 mm, by which 3DRA scans are blurred, voxel,
reconstruction and smoothing of the mesh together..."""
UNTOLD_EDGES: Final = 2.2
"""... nor lower than this many edges: an iso-surface has edges of 0.9 voxel, and a scan is blurred by about a voxel."""
DEEPEST: Final = 0.45
"""The artery's share in the flank's intensity is taken for no more than this."""
BAND: Final = 3.0
"""The flank is followed up to this many times the height at which it is believed..."""
BAND_OF_HEIGHT: Final = 0.6
"""... and no further than this fraction of the way from there to the dome's top."""
N_LEVELS: Final = 9
"""Heights at which the flank is followed."""
DETAIL: Final = 6.0
"""The neck follows waves along its rim longer than this many times the height from which it is extrapolated."""
WAVES: Final = (4.0, 2.0, 1.4, 1.0, 0.7)
"""Of those waves, so many times as many are left to a neck with hooks, one after the other until it has none."""
HOOK_RAD: Final = np.radians(40.0)
"""A neck that turns by more than this over half the height from which it is extrapolated has a hook there."""
LOOSE_MM: Final = 0.15
"""A neck that has lost its hooks lies where that took it, off the artery's wall, where this is further than that."""
REACH: Final = 3.0
"""A flank that has not met the artery within this many times that height lies along it."""
N_STEPS: Final = 36
"""Steps in which the continuation of a flank is searched for the artery."""
OUTSIDE_MM: Final = 0.05
"""A continuation that leaves the lumen by more than this ends there: blur adds to the lumen in a crevice."""
BRANCH_SHARE: Final = 0.15
"""A branch's own wall stands out of its tube by less than this many radii."""
FACING: Final = 3.0
"""A wall that looks straight at a branch counts as this many of its radii further away."""
MOUTH: Final = 0.25
"""A branch that leaves from the sac is cut off where the wall stands out of its own by this many of its radii..."""
ROOT: Final = 2.0
"""... but no further than this many of them along it."""


class Artery(NamedTuple):
    """What is not sac: the parent artery, the arteries that pass the sac beside it, and all other branches."""

    landings: tuple[Landing, ...]
    """The parent artery, and those that part from it under the sac."""
    branches: Tubes
    """All other branches, where they have left the parent artery and the sac."""
    apart_mm: Floats
    """(n,) by how much the lumen's wall beside each sphere of the branches counts as further away, see `apart_mm`."""

    def height_mm(self, points_mm: Floats, normals: Floats | None = None) -> Floats:
        """How far points (n, 3) stand out of all arteries' walls, negative inside.

        With `normals` (n, 3) the points are the lumen's wall: a wall that looks at a branch belongs to a sac beside it.
        """
        height = np.minimum(self._above(self.landings[0], points_mm), self.above_branches_mm(points_mm, normals))
        for side in self.landings[1:]:
            away = 0.0 if normals is None else _turned_mm(side.points_mm, side.section_radius_mm, points_mm, normals)
            height = np.minimum(height, self._above(side, points_mm) + away)
        return height

    def above_branches_mm(self, points_mm: Floats, normals: Floats | None = None) -> Floats:
        """How far points (n, 3) stand out of the branches' walls alone, likewise."""
        height, sphere = self.branches.height_mm(points_mm)
        if not len(self.branches.radius_mm):
            return height
        height = height - BRANCH_SHARE * self.branches.radius_mm[sphere]
        if normals is None:
            return height
        height = height + self.apart_mm[sphere]
        branches = self.branches.centers_mm[sphere], self.branches.radius_mm[sphere]
        return height + _turned_mm(*branches, points_mm, normals)

    def onto(self, points_mm: Floats) -> Floats:
        """Move points (n, 3) onto the wall of the artery that they are in, or nearest to; those at a branch stay."""
        for _ in range(len(self.landings)):
            above = np.stack([self._above(landing, points_mm) for landing in self.landings])
            nearest = above.argmin(axis=0)
            moved = points_mm.copy()
            for k, landing in enumerate(self.landings):
                moved[nearest == k] = landing.surface.closest(points_mm[nearest == k])[0]
            at_branch = self.branches.height_mm(points_mm)[0] <= above.min(axis=0)
            points_mm = np.where(at_branch[:, None], points_mm, moved)
        return points_mm

    @staticmethod
    def _above(landing: Landing, points_mm: Floats) -> Floats:
        return landing.solid.signed_distance(points_mm)


def apart_mm(landings: Sequence[Landing], branches: Tubes, along_mm: Floats, low_mm: float) -> Floats:
    """By how much a flank counts as further from the spheres (n,) of branches that begin apart from all arteries.

    Beside an artery a flank is believed from `low_mm` on, for from there it is continued to the neck. The mouth of a
    branch that leaves from the sac is only closed: its own wall is enough to keep off. Were `low_mm` cut off around it
    as well, a branch up to twice as far from the neck would be one with it, or not, as the noise has it. Further along
    than `ROOT` radii, `along_mm` (n,) from where it begins, all of a branch is cut off, however uneven its wall is.
    """
    if not len(branches.radius_mm):
        return np.zeros(0)
    radius = branches.radius_mm
    gap_mm = np.min([one.solid.signed_distance(branches.centers_mm) for one in landings], axis=0) - radius
    share = np.clip(gap_mm / low_mm, 0.0, 1.0) * np.clip(ROOT - along_mm / radius, 0.0, 1.0)
    return np.asarray(np.maximum(low_mm - MOUTH * radius, 0.0) * share)


def _turned_mm(centers_mm: Floats, radius_mm: Floats, points_mm: Floats, normals: Floats) -> Floats:
    """By how much walls (n, 3) that look at a branch count as further away; its centers are theirs, or a line's."""
    if len(centers_mm) != len(points_mm):
        nearest = cKDTree(centers_mm).query(points_mm)[1]
        centers_mm, radius_mm = centers_mm[nearest], radius_mm[nearest]
    toward = centers_mm - points_mm
    facing = np.einsum("nd,nd->n", toward, normals) / np.maximum(np.linalg.norm(toward, axis=1), 1e-12)
    return np.asarray(FACING * radius_mm * np.maximum(facing, 0.0))


class Flank(NamedTuple):
    """The sac's wall above its rim."""

    vertices_mm: Floats
    """(n, 3) vertices of the sac's wall."""
    faces: Ints
    """(m, 3) its faces."""
    height_mm: Floats
    """(n,) how far the vertices stand out of the artery."""
    rim: Ints
    """(k,) closed loop of vertices on the artery's side, at the lowest height that is believed."""

    def levelled(self, low_mm: float) -> "Flank":
        """The flank with heights that are `low_mm` along the whole rim, and as they were far from it."""
        distance, nearest = cKDTree(self.vertices_mm[self.rim]).query(self.vertices_mm)
        missing = low_mm - self.height_mm[self.rim]
        return self._replace(height_mm=self.height_mm + missing[nearest] * np.exp(-distance / low_mm))

    def isoline(self, height_mm: float) -> Floats:
        """Points (j, 3) close together along the line of one height."""
        points = self.vertices_mm
        level = np.where(np.abs(self.height_mm - height_mm) < 1e-12, 1e-12, self.height_mm - height_mm)
        is_above = level[self.faces] > 0
        cut = np.flatnonzero((is_above.sum(axis=1) % 3) != 0)
        is_lone = np.where((is_above[cut].sum(axis=1) == 1)[:, None], is_above[cut], ~is_above[cut])
        lone = (is_lone.argmax(axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(self.faces[cut], lone, axis=1).T
        ends = [
            points[a] + (level[a] / (level[a] - level[other]))[:, None] * (points[other] - points[a])
            for other in (b, c)
        ]
        share = np.linspace(0.0, 1.0, 8, endpoint=False)[:, None, None]
        return np.asarray((ends[0] + share * (ends[1] - ends[0])).reshape(-1, 3))


def believed_from_mm(lumen: Surface, foot_mm: Floats, most_mm: float, blur_mm: float | None) -> float:
    """Height from which on the flank around a bulge's foot (k, 3) is free of blur; no more than `most_mm`."""
    near = np.asarray(cKDTree(foot_mm).query(lumen.vertices_mm, distance_upper_bound=most_mm)[0]) < most_mm
    corners = lumen.corners_mm[near[lumen.faces].any(axis=1)]
    edge_mm = float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))
    if blur_mm is None:
        return min(max(UNTOLD_MM, UNTOLD_EDGES * edge_mm), most_mm)
    return min(max(CLEAR * blur_mm, CLEAR_EDGES * edge_mm), most_mm)


def unblurred(flank: Flank, blur_mm: float) -> Flank:
    """The flank where it was before the blur.

    At a distance d beside the flank and h above the artery the tissue between them is seen as Phi(d / s) - Phi(-h / s)
    of its own intensity, s the blur's standard deviation, as if both walls were flat and parallel. The wall is seen
    where that is one half: at d = s Phi^-1(1/2 + Phi(-h / s)).
    """
    share = np.minimum(ndtr(-flank.height_mm / blur_mm), DEEPEST)
    normals = Surface(flank.vertices_mm, flank.faces).vertex_normals
    return flank._replace(vertices_mm=flank.vertices_mm - (blur_mm * ndtri(0.5 + share))[:, None] * normals)


def skirt(flank: Flank, artery: Artery, lumen: Surface, *, n_rings: int) -> Floats:
    """Continue the flank to the artery: rings (n_rings + 1, k, 3) from the rim's vertices down to the neck.

    Parameters
    ----------
    flank : the wall above the rim.
    artery : what the flank stands on.
    lumen : the closed lumen, which the continuation does not leave.
    n_rings : strips of triangles between rim and neck.
    """
    rim_mm = flank.vertices_mm[flank.rim]
    place = curves.arc_length(np.concatenate([rim_mm, rim_mm[:1]]))
    low_mm = float(np.median(flank.height_mm[flank.rim]))
    n = max(32, round(8 * place[-1] / low_mm))
    even = curves.interpolate(place, np.concatenate([rim_mm, rim_mm[:1]]), place[-1] * np.arange(n) / n)
    n_waves = place[-1] / (DETAIL * low_mm)
    bend = _convex(curves.lowpass(_parabolas(_rise(flank, even, low_mm)), n_waves))
    length = curves.lowpass(_length_to_neck(bend, REACH * low_mm, artery, lumen), n_waves)
    feet = bend[:, 0] - length[:, None] * bend[:, 1] + length[:, None] ** 2 * bend[:, 2]
    where = place[:-1] * n / place[-1]
    neck = _nearly(artery, _between(_settled(artery, feet, low_mm, n_waves), where))
    bend, length = _between(bend.reshape(n, -1), where).reshape(-1, 3, 3), _between(length[:, None], where)
    share = np.linspace(0.0, 1.0, n_rings + 1)[:, None, None]
    down = -share * length
    # The rings begin at the rim itself and forget its distance from the parabola on the way.
    rings = bend[:, 0] + down * bend[:, 1] + down**2 * bend[:, 2] + (1 - share) * (rim_mm - bend[:, 0])
    return np.asarray(rings + share * (neck - rings[-1]))


def _settled(artery: Artery, feet_mm: Floats, low_mm: float, n_waves: float) -> Floats:
    """Points (n, 3) of a ring on the artery near those given, with no more of their waves than leave it without hooks.

    Where arteries meet, and where a branch runs along the sac, neighbouring flanks may end on different walls.
    """
    ring = artery.onto(feet_mm)
    for more in WAVES:
        if _sharpest_rad(ring, 0.5 * low_mm) < HOOK_RAD:
            break
        ring = _nearly(artery, curves.lowpass(ring, more * n_waves))
    return ring


def _nearly(artery: Artery, points_mm: Floats) -> Floats:
    """Move points (n, 3) close to the artery's wall onto it; those further off go a smaller part of the way."""
    moved = artery.onto(points_mm) - points_mm
    size = np.linalg.norm(moved, axis=1, keepdims=True)
    return np.asarray(points_mm + moved / (1.0 + (size / LOOSE_MM) ** 4))


def _sharpest_rad(ring_mm: Floats, length_mm: float) -> float:
    """Largest turn of a closed curve (n, 3) from one piece of a given length to the next."""
    closed = np.concatenate([ring_mm, ring_mm[:1]])
    n = max(12, round(4.0 * float(curves.arc_length(closed)[-1]) / length_mm))
    even = curves.resample_evenly(closed, n + 1)[:-1]
    chord = np.roll(even, -4, axis=0) - even
    before = np.roll(chord, 4, axis=0)
    size = np.maximum(np.linalg.norm(chord, axis=1) * np.linalg.norm(before, axis=1), 1e-12)
    return float(np.arccos(np.clip(np.einsum("nd,nd->n", chord, before) / size, -1.0, 1.0)).max())


def _rise(flank: Flank, starts_mm: Floats, low_mm: float) -> Floats:
    """Points (levels, n, 3) up the flank from its rim: each the nearest one on the next line of equal height."""
    high_mm = min(BAND * low_mm, low_mm + BAND_OF_HEIGHT * (float(flank.height_mm.max()) - low_mm))
    points = [starts_mm]
    for height_mm in np.linspace(low_mm, high_mm, N_LEVELS)[1:]:
        line_mm = flank.isoline(float(height_mm))
        points.append(line_mm[cKDTree(line_mm).query(points[-1])[1]])
    return np.stack(points)


def _parabolas(points_mm: Floats) -> Floats:
    """Coefficients (n, 3, 3) of 1, t, t^2 of lines of points (levels, n, 3), t their length, by least squares."""
    steps = np.linalg.norm(np.diff(points_mm, axis=0), axis=2)
    length = np.concatenate([np.zeros((1, steps.shape[1])), np.cumsum(steps, axis=0)]).T
    return np.asarray(np.linalg.pinv(length[..., None] ** np.arange(3)) @ points_mm.transpose(1, 0, 2))


def _convex(bend: Floats) -> Floats:
    """Parabolas (n, 3, 3) around a ring, straightened where they are hollow: a sac is convex, its flare is not sac."""
    along = np.roll(bend[:, 0], -1, axis=0) - np.roll(bend[:, 0], 1, axis=0)
    outward = np.cross(along, bend[:, 1])
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-12)
    hollow = np.maximum(np.einsum("nd,nd->n", bend[:, 2], outward), 0.0)
    straight = bend.copy()
    straight[:, 2] -= hollow[:, None] * outward
    return straight


def _length_to_neck(bend: Floats, reach_mm: float, artery: Artery, lumen: Surface) -> Floats:
    """Length (n,) of the continuation of parabolas (n, 3, 3) down to where they enter the artery.

    One that misses it ends at its lowest point in the lumen.
    """
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
    """Values (k, d) at fractional places (k,) on a ring of values (n, d)."""
    return curves.interpolate(np.arange(len(values) + 1.0), np.concatenate([values, values[:1]]), where)
