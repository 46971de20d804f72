"""Move a vessel with its axis: sections as rigid bodies, sacs and branches as the wall around their necks on average.

Every node of the axis has a rigid motion, a unit dual quaternion: a rotation and a shift in eight numbers. A mixture of
these is again a rigid motion, wherever the origin is (Kavan et al. 2008, ACM Trans. Graph. 27:105).
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix, diags
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy, Aneurysm, Centerline, Path
from vstent.kernels import curves
from vstent.kernels.arrays import Floats

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


class Motion(NamedTuple):
    """A smooth motion of a vessel and of all that is in it."""

    nodes_mm: Floats
    """(n, 3) nodes of the axis before."""
    of_nodes: Floats
    """(n, 8) their motions."""
    width_mm: float
    """Radius of the artery."""
    tube: Surface
    """Closed landing surface before."""
    lumen_mm: Floats
    """(v, 3) vertices of the lumen before."""
    of_lumen: Floats
    """(v, 8) their motions: on the wall of the artery those of the axis, and beyond a neck the mean around it."""

    @classmethod
    def of(cls, anatomy: Anatomy, nodes_mm: Floats, moved_mm: Floats) -> "Motion":
        """Return the motion of an artery whose axis, of the first path, has nodes (n, 3) before and after."""
        before, after = curves.tangents(nodes_mm), curves.tangents(moved_mm)
        turns = np.concatenate([1 + np.einsum("ni,ni->n", before, after)[:, None], np.cross(before, after)], axis=1)
        turns /= np.linalg.norm(turns, axis=1, keepdims=True)
        shifts_mm = moved_mm - _turned(turns, nodes_mm)
        of_nodes = np.concatenate([turns, 0.5 * _product(np.pad(shifts_mm, ((0, 0), (1, 0))), turns)], axis=1)
        lumen, tube = anatomy.vessel.lumen, anatomy.parent.landing_surface.closed
        width_mm = float(np.median(anatomy.parent.section_radius_mm))
        motion = cls(nodes_mm, of_nodes, width_mm, tube, lumen.vertices_mm, np.zeros((0, 8)))
        is_wall = tube.signed_distance(lumen.vertices_mm) < OFF_WALL_MM
        links = _links(lumen)
        piece = connected_components(diags(is_wall * 1.0) @ links @ diags(is_wall * 1.0))[1]
        is_wall &= piece == np.bincount(piece[is_wall]).argmax()  # a dome that touches the artery is not its wall
        of_lumen = motion._mixed(lumen.vertices_mm)
        inner = np.flatnonzero(~is_wall)
        if not len(inner):
            return motion._replace(of_lumen=of_lumen)
        balance = csc_matrix(diags(np.asarray(links.sum(axis=1)).ravel()) - links)[inner]
        smooth = splu(csc_matrix(balance[:, inner])).solve(-balance[:, is_wall] @ of_lumen[is_wall])
        part = connected_components(links[inner][:, inner])[1]
        rigid = np.stack([np.bincount(part, column) for column in smooth.T], axis=1) / np.bincount(part)[:, None]
        points_mm = lumen.vertices_mm[inner]
        is_beside = is_wall & (links @ (~is_wall * 1.0) > 0)
        away_mm = np.asarray(cKDTree(lumen.vertices_mm[is_beside]).query(points_mm)[0])
        off_mm = curves.lengths(_moved_mm(smooth, points_mm) - _moved_mm(rigid[part], points_mm))
        over_mm = np.full(len(rigid), SOON * width_mm)
        is_rim = away_mm < SOON * width_mm
        np.maximum.at(over_mm, part[is_rim], GENTLY * off_mm[is_rim])
        of_lumen[inner] = smooth + _step(away_mm / over_mm[part])[:, None] * (rigid[part] - smooth)
        return motion._replace(of_lumen=of_lumen)

    def of_points(self, points_mm: Floats) -> Floats:
        """Return where points (n, 3) move to, in mm: outside the artery with the nearest vertex of the lumen."""
        found = self._mixed(points_mm)
        outside = _step(self.tube.signed_distance(points_mm) / (ALONG * self.width_mm))
        nearest = cKDTree(self.lumen_mm).query(points_mm)[1]
        return _moved_mm(found + outside[:, None] * (self.of_lumen[nearest] - found), points_mm)

    def _mixed(self, points_mm: Floats) -> Floats:
        """Return the mean motions (m, 8) of the nodes of the axis near points (m, 3)."""
        k = min(NEAREST, len(self.nodes_mm))
        away_mm, nearest = map(np.asarray, cKDTree(self.nodes_mm).query(points_mm, k=k))
        weight = np.exp((away_mm[:, :1] ** 2 - away_mm**2) / (2 * (ALONG * self.width_mm) ** 2))
        weight -= weight[:, -1:]  # a node that leaves the nearest ones has no weight
        weight /= weight.sum(axis=1, keepdims=True)
        return np.einsum("mk,mkd->md", weight, self.of_nodes[nearest])


def moved(anatomy: Anatomy, motion: Motion) -> Anatomy:
    """Return an anatomy after a motion: lumen, openings, centerlines, paths, sacs and necks."""
    lumen = anatomy.vessel.lumen
    after_mm = _unfolded_mm(lumen, motion.of_lumen)

    def of_points(points_mm: Floats) -> Floats:
        """Return points (n, 3) after the motion; those on the lumen stay on their triangle."""
        found_mm = motion.of_points(points_mm)
        foot_mm, distance_mm, face = lumen.closest(points_mm)
        on = np.flatnonzero(distance_mm < ON_LUMEN_MM)
        from_mm = lumen.corners_mm[face[on]] - foot_mm[on, None]
        parts = np.cross(np.roll(from_mm, -1, axis=1), np.roll(from_mm, -2, axis=1)) @ lumen.normals[face[on], :, None]
        found_mm[on] = np.einsum("ncd,nc->nd", after_mm[lumen.faces[face[on]]], parts[..., 0]) / parts.sum(axis=1)
        return found_mm

    def of_normal(normal: Floats, point_mm: Floats) -> Floats:
        """Return a unit normal (3,) at a point after the motion."""
        turned = np.diff(motion.of_points(np.stack([point_mm, point_mm + 0.1 * normal])), axis=0)[0]
        return np.asarray(turned / np.linalg.norm(turned))

    def of_lines(lines: Iterable[Centerline]) -> tuple[Centerline, ...]:
        return tuple(replace(line, points_mm=motion.of_points(line.points_mm)) for line in lines)

    def of_sac(sac: Surface, neck_mm: Floats) -> Surface:
        """Return a sac; blood fills it, so that it keeps its volume where its neck becomes narrower."""
        own = np.flatnonzero(sac.closest(lumen.vertices_mm)[1] < ON_LUMEN_MM)
        away_mm = np.asarray(cKDTree(neck_mm).query(lumen.vertices_mm[own])[0])
        share = _step(away_mm / (SOON * motion.width_mm))[:, None]
        for _ in range(2):
            wider = np.cbrt(sac.volume_mm3 / Surface(of_points(sac.vertices_mm), sac.faces).volume_mm3) - 1
            after_mm[own] += wider * share * (after_mm[own] - after_mm[own].mean(axis=0))
        return Surface(of_points(sac.vertices_mm), sac.faces)

    def of_aneurysm(one: Aneurysm) -> Aneurysm:
        sac, plane = of_sac(one.sac, one.neck_mm), one.plane
        if plane is not None:
            normal = of_normal(plane.normal, plane.center_mm)
            plane = replace(plane, normal=normal, rim_mm=of_points(plane.rim_mm))
        return Aneurysm(sac, Surface(of_points(one.neck.vertices_mm), one.neck.faces), of_points(one.neck_mm), plane)

    def of_path(path: Path) -> Path:
        surface = path.landing_surface
        landing = Surface(motion.of_points(surface.vertices_mm), surface.faces)
        return replace(path, axis=of_lines([path.axis])[0], landing_surface=landing)

    openings = anatomy.vessel.openings
    centers_mm = motion.of_points(np.array([one.center_mm for one in openings]))
    normals = [of_normal(one.normal, one.center_mm) for one in openings]
    points_mm = motion.of_points(np.array([one.point_mm for one in anatomy.candidates]).reshape(-1, 3))
    aneurysms = tuple(map(of_aneurysm, anatomy.aneurysms))
    return replace(
        anatomy,
        vessel=replace(
            anatomy.vessel,
            lumen=Surface(after_mm, lumen.faces),
            openings=tuple(
                replace(one, center_mm=center_mm, normal=normal)
                for one, center_mm, normal in zip(openings, centers_mm, normals, strict=True)
            ),
            centerlines=of_lines(anatomy.vessel.centerlines),
        ),
        paths=tuple(map(of_path, anatomy.paths)),
        aneurysms=aneurysms,
        candidates=tuple(
            replace(one, point_mm=point_mm) for one, point_mm in zip(anatomy.candidates, points_mm, strict=True)
        ),
    )


def _unfolded_mm(surface: Surface, motions: Floats) -> Floats:
    """Return the vertices (v, 3) after motions (v, 8), smoothed where a triangle would be turned over."""
    moves_mm, links = _moved_mm(motions, surface.vertices_mm) - surface.vertices_mm, _links(surface)
    of_faces = motions[surface.faces[:, 0], :4]
    normals = _turned(of_faces / np.linalg.norm(of_faces, axis=1, keepdims=True), surface.normals)
    for _ in range(UNFOLDINGS):
        after = Surface(surface.vertices_mm + moves_mm, surface.faces)
        is_turned = np.einsum("fi,fi->f", after.normals, normals) < 0
        if not is_turned.any():
            break
        beside = np.unique(surface.faces[is_turned])
        moves_mm[beside] = (links[beside] @ moves_mm) / np.asarray(links[beside].sum(axis=1))
    return np.asarray(surface.vertices_mm + moves_mm)


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
