"""Regions with a short border, on meshes where the border is known."""

import numpy as np

from vstent.kernels import smoothing, triangles


def sheet(n: int = 61, size_mm: float = 12.0) -> tuple[np.ndarray, np.ndarray]:
    """A flat square of right triangles about the origin."""
    x = np.linspace(-size_mm / 2, size_mm / 2, n)
    vertices = np.stack([*np.meshgrid(x, x, indexing="ij"), np.zeros((n, n))], axis=-1).reshape(-1, 3)
    number = np.arange(n * n).reshape(n, n)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.concatenate([np.stack([q.ravel() for q in t], axis=1) for t in ((a, b, c), (a, c, d))])
    return vertices, faces.astype(np.int32)


def test_stiffness_is_the_dirichlet_energy_of_a_linear_function() -> None:
    vertices, faces = sheet()
    slope = vertices @ np.array([0.3, -0.4, 0.0])
    # Right angles have a cotangent of 0, which counts as 0.05: the diagonals add a twentieth of their differences.
    energy = 0.5 * slope @ (smoothing.stiffness(vertices, faces) @ slope)
    np.testing.assert_allclose(energy, 0.5 * 0.25 * 144.0, rtol=0.06)


def test_a_disc_stays_where_its_gain_balances_its_curvature_and_loses_its_spike() -> None:
    vertices, faces = sheet()
    distance = np.linalg.norm(vertices, axis=1)
    radius_mm, gamma = 3.0, 4.0
    spike = (np.abs(vertices[:, 1]) < 0.25) & (vertices[:, 0] > 0) & (vertices[:, 0] < 5.0)
    gain = gamma * np.clip(np.where(spike, 0.1, radius_mm - distance), -0.5, 0.5)
    edge = np.zeros(len(vertices), dtype=bool)
    edge[np.unique(triangles.open_edges(faces))] = True
    level = smoothing.region(vertices, faces, gain, edge, 0.5)
    cut, kept, _ = triangles.clip(vertices, faces, level)
    (loop,) = triangles.boundary_loops(cut, kept)
    # Where gain = curvature, gamma (R - r) = 1 / r: r = 2.91 mm, all around, but for the foot of the spike. It stops
    # where a step changes no vertex's side: half an edge away at most.
    found = np.linalg.norm(cut[loop], axis=1)
    assert abs(np.median(found) - 2.91) < 0.1
    assert found.min() > 2.8
    assert found.max() < 3.4
