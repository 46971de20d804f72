"""Weighted sums around nodes, against the same sums over all pairs."""

import numpy as np
import pytest

from vstent.flow.sampling import surface_samples
from vstent.geometry.surface import Surface
from vstent.kernels import nearby


def weights(nodes: np.ndarray, points: np.ndarray, reach: float) -> np.ndarray:
    """Weights (n, p) of all points for all nodes."""
    distance = np.linalg.norm(nodes[:, None] - points, axis=2)
    return np.where(distance < reach, (1 - (distance / reach) ** 2) ** 2, 0.0)


@pytest.mark.parametrize("stretch", [[1, 1, 1], [200, 1, 1], [1, 0, 0], [0, 0, 0]])
@pytest.mark.parametrize("reach", [0.02, 0.3, 5.0])
def test_sums_are_those_over_all_pairs(stretch, reach):
    rng = np.random.default_rng(3)
    nodes, points = (rng.uniform(-1, 1, (n, 3)) * stretch for n in (150, 400))
    points[:20] = 3 * np.array(stretch) + 1  # outside all boxes
    points[20:40] = nodes[:20]
    values = rng.normal(size=(400, 2))
    np.testing.assert_allclose(
        nearby.sums(nodes, points, values, reach), weights(nodes, points, reach) @ values, rtol=1e-12, atol=1e-12
    )


@pytest.mark.parametrize(("spacing", "reach"), [(0.1, 0.4), (0.5, 0.45), (9.0, 2.0), (0.05, 0.06)])
def test_areas_are_those_of_all_samples(spacing, reach):
    rng = np.random.default_rng(4)
    surface = Surface(rng.uniform(-1, 1, (60, 3)), rng.permuted(np.tile(np.arange(60), (40, 1)), axis=1)[:, :3])
    samples, area = surface_samples(surface, spacing)
    wanted = weights(surface.vertices_mm, samples, reach) @ np.linalg.norm(area, axis=1)
    found = nearby.areas(surface.vertices_mm, surface.corners_mm, spacing, reach)
    np.testing.assert_allclose(found, wanted, rtol=1e-11, atol=1e-13)


def test_areas_with_a_wide_reach_are_the_whole_area():
    surface = Surface(np.eye(3), np.array([[0, 1, 2]]))
    found = nearby.areas(surface.vertices_mm, surface.corners_mm, 0.1, 1e6)
    np.testing.assert_allclose(found, surface.area_mm2, rtol=1e-9)
