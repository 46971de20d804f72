"""The bounding-box tree against brute force and exact shapes."""

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.spatial import ConvexHull
from shapes import sphere

from vstent.geometry.surface import Surface
from vstent.kernels import medial, tree, triangles


def random_soup(rng: np.random.Generator, n: int) -> Surface:
    centers = rng.uniform(-5, 5, (n, 1, 3))
    corners = centers + rng.normal(0, 0.5, (n, 3, 3))
    return Surface(corners.reshape(-1, 3), np.arange(3 * n).reshape(-1, 3))


def closest_by_sampling(corners: np.ndarray, p: np.ndarray) -> float:
    """Distance to one triangle by projecting on its plane, its edges and its corners: slow and obvious."""
    a, b, c = corners
    candidates = [np.linalg.norm(p - v) for v in corners]
    for u, v in ((a, b), (b, c), (c, a)):
        t = np.clip((p - u) @ (v - u) / ((v - u) @ (v - u)), 0, 1)
        candidates.append(np.linalg.norm(p - u - t * (v - u)))
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal)
    foot = p - ((p - a) @ normal) * normal
    weights = np.linalg.lstsq(np.stack([b - a, c - a], 1), foot - a, rcond=None)[0]
    if weights.min() >= 0 and weights.sum() <= 1:
        candidates.append(abs((p - a) @ normal))
    return min(candidates)


@pytest.mark.parametrize("n", [1, 3, 4, 5, 200])
def test_closest_point_equals_brute_force(n: int) -> None:
    rng = np.random.default_rng(n)
    soup = random_soup(rng, n)
    points = rng.uniform(-7, 7, (40, 3))
    closest, distance, face = soup.closest(points)
    brute = np.array([[closest_by_sampling(t, p) for t in soup.corners_mm] for p in points])
    np.testing.assert_allclose(distance, brute.min(axis=1), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(points - closest, axis=1), distance, atol=1e-12)
    np.testing.assert_allclose(brute[np.arange(40), face], distance, atol=1e-9)


@pytest.mark.parametrize("corners", [(0, 0, 1), (0, 1, 1), (0, 1, 0), (0, 0, 0), (0, 1, 2), (2, 0, 1), (1, 2, 0)])
def test_triangles_without_area_are_as_near_as_their_edges(corners: tuple[int, int, int]) -> None:
    on_line = np.array([[0.0, 0, 0], [3, 6, 9], [1, 2, 3]])[list(corners)]
    points = np.random.default_rng(2).uniform(-5, 12, (60, 3))
    distance = Surface(on_line, np.array([[0, 1, 2]])).closest(points)[1]
    line = on_line.min(axis=0) + np.linspace(0, 1, 20001)[:, None] * np.ptp(on_line, axis=0)
    brute = np.linalg.norm(points[:, None] - line, axis=2).min(axis=1)
    np.testing.assert_allclose(distance, brute, atol=1e-6)


def test_crossing_and_first_hit_equal_brute_force() -> None:
    rng = np.random.default_rng(7)
    soup = random_soup(rng, 150)
    starts, ends = rng.uniform(-6, 6, (2, 300, 3))
    brute = np.array(
        [
            [tree.ray_meets_triangle.py_func(s, e - s, t) for t in soup.corners_mm]
            for s, e in zip(starts, ends, strict=True)
        ]
    )
    np.testing.assert_array_equal(soup.crosses(starts, ends), brute.min(axis=1) <= 1)
    assert 50 < soup.crosses(starts, ends).sum() < 250
    length = np.linalg.norm(ends - starts, axis=1)
    hit = soup.first_hit(starts, (ends - starts) / length[:, None])
    np.testing.assert_allclose(hit, brute.min(axis=1) * length, rtol=1e-9)


def test_sign_is_exact_everywhere_around_a_closed_surface() -> None:
    ball = sphere(2.0)
    rng = np.random.default_rng(1)
    points = rng.normal(size=(4000, 3))
    points *= rng.uniform(0.2, 3.5, (4000, 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    signed = ball.signed_distance(points)
    exact = np.linalg.norm(points, axis=1) - 2.0
    sagitta = 2.0 * (1 - np.cos(np.pi / 24))
    assert np.abs(signed - exact).max() < 1.5 * sagitta
    clear = np.abs(exact) > 2 * sagitta
    np.testing.assert_array_equal(np.sign(signed[clear]), np.sign(exact[clear]))


def test_face_order_does_not_matter() -> None:
    rng = np.random.default_rng(3)
    soup = random_soup(rng, 100)
    shuffled = Surface(soup.vertices_mm, soup.faces[rng.permutation(100)])
    points = rng.uniform(-7, 7, (100, 3))
    np.testing.assert_array_equal(soup.closest(points)[1], shuffled.closest(points)[1])


def test_any_ray_tells_inside_as_the_signed_distance_does() -> None:
    rng = np.random.default_rng(5)
    ball = sphere(3.0)
    points = rng.uniform(-4, 4, (2000, 3))
    directions = rng.normal(size=(2000, 3))
    is_inside = ball.signed_distance(points) < 0
    assert 0.1 < is_inside.mean() < 0.9
    np.testing.assert_array_equal(tree.sees_inside(ball.tree, points, directions), is_inside)


def test_rays_enter_no_empty_box() -> None:
    # 33 triangles fill 33 of 64 leaves: the empty ones must cost a ray nothing.
    ray_tree = tree.build(*(lambda s: (s.vertices_mm, s.faces))(random_soup(np.random.default_rng(2), 33)))
    is_empty = np.isinf(ray_tree.low).any(axis=1)
    assert is_empty.sum() == 31 + 15 + 7 + 3 + 1
    inverse = np.array([0.3, -0.8, 1e200])
    for node in np.flatnonzero(is_empty):
        assert tree._entry(np.zeros(3), inverse, ray_tree.low, ray_tree.high, node) == np.inf


def test_inscribed_radius_equals_brute_force_over_all_bulging_triangles() -> None:
    rng = np.random.default_rng(11)
    ball = sphere(2.0, rings=9, sectors=14)
    wall = Surface(ball.vertices_mm * [1.0, 1.0, 1.5] + rng.normal(0, 0.05, ball.vertices_mm.shape), ball.faces)
    points = rng.uniform(-0.9, 0.9, (30, 3))
    every = np.arange(len(wall.faces))
    rise = np.stack([_rise(wall, k, (k + 1) % 3) for k in range(3)], axis=1)
    assert rise.max() > 0.1
    for p, found in zip(points, wall.inscribed_radius(points), strict=True):
        feet = np.array([Surface(t, np.array([[0, 1, 2]])).closest(p[None])[0][0] for t in wall.corners_mm])
        weight = triangles.barycentric(wall.corners_mm[every], feet)
        bulge = 0.5 * (weight * np.roll(weight, -1, axis=1) * rise).sum(axis=1)
        assert found == pytest.approx((np.linalg.norm(p - feet, axis=1) + bulge).min(), abs=1e-9)


def _rise(wall: Surface, a: int, b: int) -> np.ndarray:
    edge = wall.corners_mm[:, b] - wall.corners_mm[:, a]
    return np.einsum("fd,fd->f", wall.smooth_normals[:, b] - wall.smooth_normals[:, a], edge)


def test_inscribed_radius_of_a_coarse_ball_is_the_balls_own() -> None:
    coarse, fine = (sphere(2.0, rings=n, sectors=2 * n) for n in (12, 24))
    middle = np.zeros((1, 3))
    errors = [abs(wall.inscribed_radius(middle)[0] - 2.0) for wall in (coarse, fine)]
    assert errors[0] < 0.03 * abs(coarse.closest(middle)[1][0] - 2.0)
    assert np.log2(errors[0] / errors[1]) > 3.5


def test_a_crease_stays_a_crease() -> None:
    corners = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    faces = ConvexHull(corners).simplices
    normal = np.cross(corners[faces[:, 1]] - corners[faces[:, 0]], corners[faces[:, 2]] - corners[faces[:, 0]])
    is_outward = np.einsum("ij,ij->i", normal, corners[faces].mean(axis=1)) > 0
    box = Surface(corners, np.where(is_outward[:, None], faces, faces[:, ::-1]))
    points = np.random.default_rng(0).uniform(-0.9, 0.9, (20, 3))
    np.testing.assert_allclose(box.inscribed_radius(points), 1 - np.abs(points).max(axis=1), atol=1e-12)


def test_the_widest_sphere_of_a_section_is_that_of_linear_programming() -> None:
    rng = np.random.default_rng(4)
    angle = np.sort(rng.uniform(0, 2 * np.pi, (20, 24)), axis=1)
    slope = rng.uniform(0.9, 1.0, (20, 24, 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    distance = 2.0 + rng.normal(0, 0.01, (20, 24))
    shift = medial.widest_in_section(distance, slope, 0.0, np.full(20, 0.02))
    reached = (distance - np.einsum("nkd,nd->nk", slope, shift)).min(axis=1)
    for k in range(20):
        best = linprog([0, 0, -1], np.column_stack([slope[k], np.ones(24)]), distance[k], bounds=(None, None))
        assert reached[k] == pytest.approx(-best.fun, abs=1e-4)
    # What it does not gain by half of the way it leaves.
    unmoved = medial.widest_in_section(distance, 0.4 * slope, 0.5, np.full(20, 0.02))
    np.testing.assert_allclose(unmoved, 0.0, atol=1e-3)
