"""Bare meshes: loops, caps, clips."""

import numpy as np
from scipy.spatial import ConvexHull

from vstent.devices.stent import tube_faces
from vstent.geometry.surface import Surface
from vstent.kernels import triangles


def tube(radius: float = 2.0, length: float = 10.0, rows: int = 41, columns: int = 48) -> Surface:
    angle = 2 * np.pi * np.arange(columns) / columns
    z = np.linspace(0, length, rows)
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    points = np.concatenate([np.tile(ring, (rows, 1)), np.repeat(z, columns)[:, None]], axis=1)
    return Surface(points, tube_faces(rows, columns))


def polygon_area(radius: float, columns: int) -> float:
    return 0.5 * columns * radius**2 * np.sin(2 * np.pi / columns)


def test_a_capped_tube_has_the_volume_of_its_prism() -> None:
    surface = tube()
    assert len(surface.boundary_loops) == 2
    vertices, faces = triangles.cap(surface.vertices_mm, surface.faces, surface.boundary_loops)
    closed = Surface(vertices, faces)
    assert closed.boundary_loops == ()
    np.testing.assert_allclose(closed.volume_mm3, 10 * polygon_area(2, 48), rtol=1e-12)
    np.testing.assert_allclose(closed.area_mm2 - surface.area_mm2, 2 * polygon_area(2, 48), rtol=1e-12)


def test_a_clip_keeps_exactly_the_part_below_the_plane() -> None:
    surface = tube()
    normal = np.array([0.3, 0.1, 1.0]) / np.linalg.norm([0.3, 0.1, 1.0])
    height = (surface.vertices_mm - [0, 0, 4.13]) @ normal
    below = Surface(*triangles.clip(surface.vertices_mm, surface.faces, height)[:2])
    above = Surface(*triangles.clip(surface.vertices_mm, surface.faces, -height)[:2])
    np.testing.assert_allclose(below.area_mm2 + above.area_mm2, surface.area_mm2, rtol=1e-12)
    assert len(below.boundary_loops) == len(above.boundary_loops) == 2
    closed = Surface(*triangles.cap(below.vertices_mm, below.faces, below.boundary_loops))
    # An oblique cut through the axis at z takes off what a square cut there does.
    np.testing.assert_allclose(closed.volume_mm3, 4.13 * polygon_area(2, 48), rtol=2e-3)


def test_area_and_centroid_of_a_polygon_in_space() -> None:
    flat = np.array([[0, 0], [4, 0], [4, 1], [1, 1], [1, 3], [0, 3]], dtype=float)
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    points = np.column_stack([flat, np.full(6, 2.0)]) @ turn.T
    np.testing.assert_allclose(np.linalg.norm(triangles.polygon_area_vector(points)), 6.0)
    exact = np.array([(4 * 2.0 + 2 * 0.5) / 6, (4 * 0.5 + 2 * 2.0) / 6, 2.0]) @ turn.T
    np.testing.assert_allclose(triangles.polygon_centroid(points), exact)


def test_samples_lie_on_the_surface_and_cover_it() -> None:
    surface = tube(rows=3, columns=12)
    points, normals = triangles.sample(surface.vertices_mm, surface.faces, coarsest=0.3)
    assert surface.closest(points)[1].max() < 1e-12
    on_wall = np.random.default_rng(0).dirichlet(np.ones(3), len(surface.faces))
    probes = np.einsum("fk,fkd->fd", on_wall, surface.corners_mm)
    gaps = np.linalg.norm(points[:, None] - probes[None], axis=2).min(axis=0)
    assert gaps.max() < 0.3 * np.sqrt(3)
    assert np.einsum("ij,ij->i", normals, points * [1, 1, 0]).min() > 0


def test_smooth_normals_are_exact_on_any_mesh_of_a_sphere() -> None:
    points = np.random.default_rng(1).normal(size=(60, 3))
    points *= 3.0 / np.linalg.norm(points, axis=1, keepdims=True)
    faces = ConvexHull(points).simplices
    outward = np.einsum("ij,ij->i", triangles.normals(points[faces]), points[faces].mean(axis=1)) > 0
    faces = np.where(outward[:, None], faces, faces[:, ::-1]).astype(np.int32)
    np.testing.assert_allclose(triangles.smooth_normals(points, faces), points / 3.0, atol=1e-9)


def test_barycentric_weights_give_the_point_back() -> None:
    rng = np.random.default_rng(2)
    corners, weight = rng.normal(size=(50, 3, 3)), rng.dirichlet(np.ones(3), 50)
    points = np.einsum("nk,nkd->nd", weight, corners)
    np.testing.assert_allclose(triangles.barycentric(corners, points), weight, atol=1e-9)
