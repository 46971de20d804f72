"""Move a vessel with its axis: sections as rigid bodies, sacs and branches as the wall around their necks on average.

Every node of the axis has a rigid motion, a unit dual quaternion: a rotation and a shift in eight numbers. A mixture of
these is again a rigid motion, wherever the origin is (Kavan et al. 2008, ACM Trans. Graph. 27:105).
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix, csr_matrix, diags
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import SuperLU, splu
from scipy.spatial import cKDTree

from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy, Aneurysm, Centerline, Path
from vstent.kernels import curves
from vstent.kernels.arrays import Bools, Floats, Ints

NEAREST: Final = 16
"""Number of nodes of the axis whose motions are mixed at a point."""
ALONG: Final = 0.5
"""Width over which motions are mixed along the axis, in radii of the artery."""
SOON: Final = 0.5
"""Height over the wall over which the motion becomes that of a sac or a branch, in radii, where both are alike."""
GENTLY: Final = 5.0
"""The same height where they differ, over the distance between them."""
UNFOLDINGS: Final = 50
"""Largest number of times that moves are smoothed where triangles would be turned over."""
OFF_WALL_MM: Final = 0.25
"""Distance outside the landing surface, in mm, from which the lumen belongs to a sac or a branch."""
ON_LUMEN_MM: Final = 1e-4
"""Distance from the lumen, in mm, below which a point moves with its triangle, since sacs are cut from the lumen."""


@dataclass(frozen=True, eq=False)
class Skin:
    """How a vessel hangs on the axis of its first path: what does not depend on where the axis moves."""

    anatomy: Anatomy
    """The vessel before."""
    nodes_mm: Floats
    """(n, 3) nodes of the axis before."""

    @cached_property
    def lumen(self) -> Surface:
        """Lumen before."""
        return self.anatomy.vessel.lumen

    @cached_property
    def width_mm(self) -> float:
        """Radius of the artery."""
        return float(np.median(self.anatomy.parent.section_radius_mm))

    @cached_property
    def tube(self) -> Surface:
        """Closed landing surface before."""
        return self.anatomy.parent.landing_surface.closed

    @cached_property
    def near(self) -> cKDTree:
        """Tree of the vertices of the lumen."""
        return cKDTree(self.lumen.vertices_mm)

    @cached_property
    def links(self) -> csc_matrix:
        """Matrix (v, v) of the edges of the lumen."""
        return _links(self.lumen)

    @cached_property
    def is_wall(self) -> Bools:
        """(v,) which vertices of the lumen are the artery's wall."""
        is_wall = self.tube.signed_distance(self.lumen.vertices_mm) < OFF_WALL_MM
        piece = connected_components(diags(is_wall * 1.0) @ self.links @ diags(is_wall * 1.0))[1]
        # A dome that touches the artery is not its wall.
        return np.asarray(is_wall & (piece == np.bincount(piece[is_wall]).argmax()))

    @cached_property
    def mixed(self) -> csr_matrix:
        """Matrix (v, n) by which the lumen mixes the motions of the nodes."""
        return self.mixing(self.lumen.vertices_mm)

    @cached_property
    def beyond(self) -> tuple[Ints, SuperLU, csc_matrix, Ints, Floats]:
        """Vertices beyond the wall (w,), their balance, that of the wall, their part, and their distance from it."""
        inner, vertices_mm = np.flatnonzero(~self.is_wall), self.lumen.vertices_mm
        balance = csc_matrix(diags(np.asarray(self.links.sum(axis=1)).ravel()) - self.links)[inner]
        part = connected_components(self.links[inner][:, inner])[1]
        is_beside = self.is_wall & (self.links @ (~self.is_wall * 1.0) > 0)
        away_mm = np.asarray(cKDTree(vertices_mm[is_beside]).query(vertices_mm[inner])[0])
        return inner, splu(csc_matrix(balance[:, inner])), csc_matrix(-balance[:, self.is_wall]), part, away_mm

    @cached_property
    def sacs(self) -> tuple[tuple[Surface, Bools, Floats, tuple[Ints, Ints, Floats]], ...]:
        """Every sac, its vertices of the lumen (v,), how far they are from all others, and its own vertices on them."""
        found, vertices_mm = [], self.lumen.vertices_mm
        for sac in (one.sac for one in self.anatomy.aneurysms):
            is_own = sac.closest(vertices_mm)[1] < ON_LUMEN_MM
            away_mm = np.asarray(cKDTree(vertices_mm[~is_own]).query(vertices_mm[is_own])[0])
            share = _step(away_mm / (SOON * self.width_mm))[:, None]
            found.append((sac, is_own, share, self.on_lumen(sac.vertices_mm)))
        return tuple(found)

    def mixing(self, points_mm: Floats) -> csr_matrix:
        """Return the matrix (m, n) by which points (m, 3) mix the motions of the nodes of the axis near them."""
        k = min(NEAREST, len(self.nodes_mm))
        away_mm, nearest = map(np.asarray, cKDTree(self.nodes_mm).query(points_mm, k=k))
        weight = np.exp((away_mm[:, :1] ** 2 - away_mm**2) / (2 * (ALONG * self.width_mm) ** 2))
        weight -= weight[:, -1:]  # a node that leaves the nearest ones has no weight
        weight /= weight.sum(axis=1, keepdims=True)
        rows = np.repeat(np.arange(len(points_mm)), k)
        return csr_matrix((weight.ravel(), (rows, nearest.ravel())), shape=(len(points_mm), len(self.nodes_mm)))

    def on_lumen(self, points_mm: Floats) -> tuple[Ints, Ints, Floats]:
        """Return which points lie on the lumen (k,), the vertices of their triangles (k, 3) and the parts of these."""
        foot_mm, distance_mm, face = self.lumen.closest(points_mm)
        on = np.flatnonzero(distance_mm < ON_LUMEN_MM)
        from_mm = self.lumen.corners_mm[face[on]] - foot_mm[on, None]
        areas = np.cross(np.roll(from_mm, -1, axis=1), np.roll(from_mm, -2, axis=1))
        parts = np.einsum("ncd,nd->nc", areas, self.lumen.normals[face[on]])
        return on, self.lumen.faces[face[on]], parts / parts.sum(axis=1, keepdims=True)


class Motion(NamedTuple):
    """A smooth motion of a vessel and of all that is in it."""

    skin: Skin
    """The vessel before."""
    of_nodes: Floats
    """(n, 8) motions of the nodes of its axis."""
    of_lumen: Floats
    """(v, 8) motions of its lumen: on the wall those of the axis, and beyond a neck the mean around it."""
    after_mm: Floats
    """(v, 3) vertices of the lumen after; sacs keep their volume."""

    @classmethod
    def of(cls, skin: Skin, moved_mm: Floats) -> "Motion":
        """Return the motion of a vessel whose axis has nodes (n, 3) after it."""
        before, after = curves.tangents(skin.nodes_mm), curves.tangents(moved_mm)
        turns = np.concatenate([1 + np.einsum("ni,ni->n", before, after)[:, None], np.cross(before, after)], axis=1)
        turns /= np.linalg.norm(turns, axis=1, keepdims=True)
        shifts_mm = moved_mm - _turned(turns, skin.nodes_mm)
        of_nodes = np.concatenate([turns, 0.5 * _product(np.pad(shifts_mm, ((0, 0), (1, 0))), turns)], axis=1)
        of_lumen = skin.mixed @ of_nodes
        if not skin.is_wall.all():
            of_lumen[~skin.is_wall] = _beyond(skin, of_lumen[skin.is_wall])
        motion = cls(skin, of_nodes, of_lumen, _moved_mm(of_lumen, skin.lumen.vertices_mm))
        return motion._replace(after_mm=_unfolded_mm(skin, of_lumen, motion._filled_mm()))

    def of_points(self, points_mm: Floats) -> Floats:
        """Return where points (n, 3) move to, in mm.

        Those on the lumen stay on their triangle, others outside the artery move with the nearest vertex of the lumen.
        """
        found_mm, (on, faces, parts) = self.of_inner(points_mm), self.skin.on_lumen(points_mm)
        found_mm[on] = np.einsum("nc,ncd->nd", parts, self.after_mm[faces])
        return found_mm

    def of_inner(self, points_mm: Floats) -> Floats:
        """Return where points (n, 3) move to that do not lie on the lumen, in mm."""
        found = self.skin.mixing(points_mm) @ self.of_nodes
        outside = _step(self.skin.tube.signed_distance(points_mm) / (ALONG * self.skin.width_mm))
        beyond = np.flatnonzero(outside)
        nearest = self.skin.near.query(points_mm[beyond])[1]
        found[beyond] += outside[beyond, None] * (self.of_lumen[nearest] - found[beyond])
        return _moved_mm(found, points_mm)

    def of_normals(self, normals: Floats, points_mm: Floats) -> Floats:
        """Return unit normals (n, 3) at points (n, 3) after the motion."""
        turned = self.of_inner(points_mm + 0.1 * normals) - self.of_inner(points_mm)
        return np.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True))

    def of_line(self, line: Centerline) -> Centerline:
        """Return a line inside the lumen after the motion."""
        return replace(line, points_mm=self.of_inner(line.points_mm))

    def of_surface(self, surface: Surface) -> Surface:
        """Return a surface after the motion."""
        return Surface(self.of_points(surface.vertices_mm), surface.faces)

    def _filled_mm(self) -> Floats:
        """Return the vertices (v, 3) of the lumen with sacs as large as before: blood fills them."""
        after_mm = self.after_mm.copy()
        for sac, is_own, share, (on, faces, parts) in self.skin.sacs:
            sac_mm = self.of_inner(sac.vertices_mm)
            for _ in range(2):
                sac_mm[on] = np.einsum("nc,ncd->nd", parts, after_mm[faces])
                wider = np.cbrt(sac.volume_mm3 / Surface(sac_mm, sac.faces).volume_mm3) - 1
                after_mm[is_own] += wider * share * (after_mm[is_own] - after_mm[is_own].mean(axis=0))
        return after_mm


def moved(motion: Motion) -> Anatomy:
    """Return the anatomy after a motion: lumen, openings, centerlines, paths, sacs and necks."""
    anatomy = motion.skin.anatomy

    def of_aneurysm(one: Aneurysm) -> Aneurysm:
        plane = one.plane
        if plane is not None:
            normal = motion.of_normals(plane.normal[None], plane.center_mm[None])[0]
            plane = replace(plane, normal=normal, rim_mm=motion.of_points(plane.rim_mm))
        sac, neck = map(motion.of_surface, (one.sac, one.neck))
        return Aneurysm(sac, neck, motion.of_points(one.neck_mm), plane)

    def of_path(path: Path) -> Path:
        landing_surface = motion.of_surface(path.landing_surface)
        return replace(path, axis=motion.of_line(path.axis), landing_surface=landing_surface)

    vessel = anatomy.vessel
    centers_mm, normals = (
        np.array([getattr(one, name) for one in vessel.openings]) for name in ("center_mm", "normal")
    )
    openings = zip(vessel.openings, motion.of_points(centers_mm), motion.of_normals(normals, centers_mm), strict=True)
    points_mm = motion.of_points(np.array([one.point_mm for one in anatomy.candidates]).reshape(-1, 3))
    return replace(
        anatomy,
        vessel=replace(
            vessel,
            lumen=Surface(motion.after_mm, vessel.lumen.faces),
            openings=tuple(replace(one, center_mm=center_mm, normal=normal) for one, center_mm, normal in openings),
            centerlines=tuple(map(motion.of_line, vessel.centerlines)),
        ),
        paths=tuple(map(of_path, anatomy.paths)),
        aneurysms=tuple(map(of_aneurysm, anatomy.aneurysms)),
        candidates=tuple(
            replace(one, point_mm=point_mm) for one, point_mm in zip(anatomy.candidates, points_mm, strict=True)
        ),
    )


def _beyond(skin: Skin, of_wall: Floats) -> Floats:
    """Return the motions (w, 8) of the lumen beyond the wall, of the wall (u, 8): smooth at necks, then rigid."""
    inner, balance, of_rim, part, away_mm = skin.beyond
    smooth, points_mm = balance.solve(of_rim @ of_wall), skin.lumen.vertices_mm[inner]
    rigid = np.stack([np.bincount(part, column) for column in smooth.T], axis=1) / np.bincount(part)[:, None]
    off_mm = curves.lengths(_moved_mm(smooth, points_mm) - _moved_mm(rigid[part], points_mm))
    over_mm = np.full(len(rigid), SOON * skin.width_mm)
    is_rim = away_mm < SOON * skin.width_mm
    np.maximum.at(over_mm, part[is_rim], GENTLY * off_mm[is_rim])
    return np.asarray(smooth + _step(away_mm / over_mm[part])[:, None] * (rigid[part] - smooth))


def _unfolded_mm(skin: Skin, of_lumen: Floats, after_mm: Floats) -> Floats:
    """Return vertices (v, 3) after motions (v, 8), smoothed where a triangle would be turned over."""
    moves_mm, faces = after_mm - skin.lumen.vertices_mm, skin.lumen.faces
    of_faces = of_lumen[faces[:, 0], :4]
    normals = _turned(of_faces / np.linalg.norm(of_faces, axis=1, keepdims=True), skin.lumen.normals)
    for _ in range(UNFOLDINGS):
        after = Surface(skin.lumen.vertices_mm + moves_mm, faces)
        is_turned = np.einsum("fi,fi->f", after.normals, normals) < 0
        if not is_turned.any():
            break
        beside = np.unique(faces[is_turned])
        moves_mm[beside] = (skin.links[beside] @ moves_mm) / np.asarray(skin.links[beside].sum(axis=1))
    return np.asarray(skin.lumen.vertices_mm + moves_mm)


def _step(x: Floats) -> Floats:
    """Return a smooth step (n,) from 0 below 0 to 1 above 1."""
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(x * x * (3 - 2 * x))


def _links(surface: Surface) -> csc_matrix:
    """Return the matrix (v, v) of the edges of a surface, each with the inverse of its length."""
    a, b = surface.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).T
    weight = 1 / np.maximum(curves.lengths(surface.vertices_mm[a] - surface.vertices_mm[b]), 1e-9)
    size = len(surface.vertices_mm)
    one_way = coo_matrix((weight, (a, b)), shape=(size, size))
    return csc_matrix(one_way + one_way.T)


def _product(p: Floats, q: Floats) -> Floats:
    """Return the products (n, 4) of quaternions, real part first."""
    real = p[:, :1] * q[:, :1] - np.einsum("ni,ni->n", p[:, 1:], q[:, 1:])[:, None]
    return np.concatenate([real, p[:, :1] * q[:, 1:] + q[:, :1] * p[:, 1:] + np.cross(p[:, 1:], q[:, 1:])], axis=1)


def _turned(turns: Floats, points_mm: Floats) -> Floats:
    """Return points (n, 3) after rotations by unit quaternions (n, 4)."""
    aside = np.cross(turns[:, 1:], points_mm)
    return np.asarray(points_mm + 2 * (turns[:, :1] * aside + np.cross(turns[:, 1:], aside)))


def _moved_mm(motions: Floats, points_mm: Floats) -> Floats:
    """Return points (n, 3) after mixed motions (n, 8), in mm."""
    turns, duals = np.split(motions / np.linalg.norm(motions[:, :4], axis=1, keepdims=True), 2, axis=1)
    back = turns * np.array([1.0, -1.0, -1.0, -1.0])
    return _turned(turns, points_mm) + 2 * _product(duals, back)[:, 1:]
