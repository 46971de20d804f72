"""Parts of a mesh beyond planes, against cutting and closing the mesh, and against tubes of known volume."""

import numpy as np

from vstent.devices.stent import tube_faces
from vstent.kernels import sections, triangles

RAYS = 24


def bent_tube(points_mm: np.ndarray, radius_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """A tube in the plane y = 0 around a line (n, 3): vertices and faces, its first end closed, its last one open."""
    along = np.gradient(points_mm, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    angle = 2 * np.pi * np.arange(RAYS) / RAYS
    side = np.stack([along[:, 2], 0 * along[:, 0], -along[:, 0]], axis=1)
    rings = np.cos(angle)[None, :, None] * side[:, None] + np.sin(angle)[None, :, None] * np.array([0.0, 1.0, 0.0])
    vertices = (points_mm[:, None] + radius_mm * rings).reshape(-1, 3)
    faces = tube_faces(len(points_mm), RAYS)
    if triangles.volume(vertices[faces]) < 0:
        faces = faces[:, ::-1]
    first = next(loop for loop in triangles.boundary_loops(vertices, faces) if loop.max() < RAYS)
    return triangles.cap(vertices, faces, [first])


def cut(vertices: np.ndarray, faces: np.ndarray, seed: int, point: np.ndarray, normal: np.ndarray) -> tuple:
    """Volume and section of the part beyond a plane by cutting the mesh and closing it."""
    at = vertices[faces[seed]].mean(axis=0)
    points, kept, _ = triangles.clip(vertices, faces, -(vertices - point) @ normal)
    points, kept = triangles.part_at(points, kept, at)
    loops = triangles.boundary_loops(points, kept)
    section = sum(triangles.polygon_area_vector(points[loop]) for loop in loops)
    closed_points, closed = triangles.cap(points, kept, loops)
    return triangles.volume(closed_points[closed]), float(np.linalg.norm(section)), triangles.areas(points[kept]).sum()


def lumpy(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A closed surface: a convex hull of points on a sphere, its vertices moved along the rays to them."""
    from scipy.spatial import ConvexHull

    points = rng.normal(size=(600, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    faces = ConvexHull(points).simplices
    corners = points[faces]
    inward = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) < 0
    faces[inward] = faces[inward][:, ::-1]
    points = points * (1.0 + 0.3 * np.sin(4 * points[:, :1]) * np.cos(3 * points[:, 1:2]))
    return points + np.array([30.0, -20.0, 50.0]), faces.astype(np.int32)


def test_a_part_has_the_volume_section_and_wall_of_the_cut_mesh() -> None:
    rng = np.random.default_rng(3)
    vertices, faces = lumpy(rng)
    normals = rng.normal(size=(20, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    middle = vertices.mean(axis=0)
    for normal, offset in zip(normals, rng.uniform(-0.4, 0.4, 20), strict=True):
        height = (vertices[faces].mean(axis=1) - middle) @ normal
        opened = np.delete(faces, height.argmin(), axis=0)
        seed = int(np.delete(height, height.argmin()).argmax())
        point = middle + offset * normal
        mesh = sections.sheet(vertices, opened, np.ones((len(opened), 1)))
        measures, is_closed = sections.beyond(mesh, seed, point[None], normal[None])
        assert is_closed[0]
        np.testing.assert_allclose(measures[0], cut(vertices, opened, seed, point, normal), rtol=1e-9)


def arch(bottom_mm: float) -> np.ndarray:
    """Two legs along z at x = -5 and x = 5, joined by a half circle above z = 0; the second leg ends at -8 mm."""
    turn = np.linspace(np.pi, 0.0, 61)[1:-1]
    bend = np.stack([5 * np.cos(turn), 0 * turn, 5 * np.sin(turn)], axis=1)
    down = np.arange(0.0, -8.01, -0.5)
    up = np.linspace(bottom_mm, 0.0, 13)
    first, second = (np.stack([0 * z + x, 0 * z, z], axis=1) for x, z in ((-5.0, up), (5.0, down)))
    return np.concatenate([first, bend, second])


def test_a_pouch_behind_the_plane_belongs_to_the_part_and_an_open_leg_does_not() -> None:
    vertices, faces = bent_tube(arch(-6.0), 1.5)
    mesh = sections.sheet(vertices, faces, np.ones((len(faces), 1)))
    seed = int(vertices[faces].mean(axis=1)[:, 2].argmax())
    up = np.array([[0.0, 0.0, 1.0]])
    measures, is_closed = sections.beyond(mesh, seed, np.array([[0.0, 0.0, -2.0]]), up)
    section = 0.5 * RAYS * 1.5**2 * np.sin(2 * np.pi / RAYS)
    (end,) = triangles.boundary_loops(vertices, faces)
    whole = triangles.cap(vertices, faces, [end])
    assert is_closed[0]
    np.testing.assert_allclose(measures[0, 1], section, rtol=1e-9)
    np.testing.assert_allclose(measures[0, 0], triangles.volume(whole[0][whole[1]]) - 6.0 * section, rtol=1e-9)
    wall = triangles.areas(vertices[faces]).sum() - 6.0 * 2 * RAYS * 1.5 * np.sin(np.pi / RAYS)
    np.testing.assert_allclose(measures[0, 2], wall, rtol=1e-9)


def test_a_plane_beyond_an_open_end_cuts_nothing_off() -> None:
    vertices, faces = bent_tube(arch(-6.0), 1.5)
    mesh = sections.sheet(vertices, faces, np.ones((len(faces), 1)))
    seed = int(vertices[faces].mean(axis=1)[:, 2].argmax())
    up = np.array([[0.0, 0.0, 1.0]])
    heights = np.array([[0.0, 0.0, -9.0], [0.0, 0.0, -7.9], [0.0, 0.0, 7.0]])  # below the end, above it, above all
    assert sections.beyond(mesh, seed, heights, np.repeat(up, 3, axis=0))[1].tolist() == [False, True, False]
