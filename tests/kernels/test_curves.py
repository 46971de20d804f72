"""Polylines against circles and helices."""

import numpy as np
import pytest
from scipy.signal import savgol_filter
from scipy.special import ellipe

from vstent.kernels import curves


def helix(n: int) -> np.ndarray:
    t = np.linspace(0, 4 * np.pi, n)
    return np.stack([3 * np.cos(t), 3 * np.sin(t), 0.5 * t], axis=1)


def test_arc_length_converges_at_second_order() -> None:
    exact = 4 * np.pi * np.hypot(3, 0.5)
    errors = [abs(curves.arc_length(helix(n))[-1] - exact) for n in (100, 200, 400)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all((orders > 1.9) & (orders < 2.1))


def test_closed_rows_are_as_long_as_the_ellipse_through_them_at_fourth_order() -> None:
    exact = 4 * 3 * ellipe(1 - (2 / 3) ** 2)
    errors = []
    for n in (12, 24, 48):
        t = 2 * np.pi * np.arange(n) / n
        ellipse = np.stack([3 * np.cos(t), 2 * np.sin(t), 0 * t], axis=1)
        errors.append(np.abs(curves.closed_lengths(np.stack([ellipse, ellipse[:, [1, 2, 0]]])) - exact).max())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all((orders > 3.9) & (orders < 4.5))


def test_frames_are_orthonormal_and_turn_with_the_known_torsion() -> None:
    points = helix(2000)
    frames = curves.parallel_frames(points)
    np.testing.assert_allclose(frames @ frames.transpose(0, 2, 1), np.tile(np.eye(3), (2000, 1, 1)), atol=1e-9)
    assert np.all(np.linalg.det(frames) > 0)
    # A parallel frame turns against the Frenet frame by the integral of the torsion b / (a^2 + b^2).
    length = curves.arc_length(points)
    inward = -np.stack([points[:, 0], points[:, 1], np.zeros(2000)], axis=1) / 3
    angle = np.unwrap(np.arctan2((frames[:, 2] * inward).sum(1), (frames[:, 1] * inward).sum(1)))
    torsion = 0.5 / (3**2 + 0.5**2)
    np.testing.assert_allclose(angle[1990] - angle[10], torsion * (length[1990] - length[10]), rtol=1e-3)


def test_projection_finds_the_foot_on_a_circle() -> None:
    t = np.linspace(0, np.pi, 4000)
    circle = np.stack([5 * np.cos(t), 5 * np.sin(t), 0 * t], axis=1)
    angle = np.random.default_rng(0).uniform(0.2, 2.9, 50)
    radius = np.random.default_rng(1).uniform(3, 7, 50)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=1)
    abscissa, distance = curves.project(circle, points)
    np.testing.assert_allclose(abscissa, 5 * angle, atol=5 * np.pi / 4000)
    np.testing.assert_allclose(distance, abs(radius - 5), atol=1e-5)


def test_smoothing_keeps_what_its_penalty_does_not_see() -> None:
    x = np.linspace(0, 1, 50)
    line = np.stack([2 * x, 1 - x], axis=1)
    np.testing.assert_allclose(curves.smooth(line, np.ones(50), 1e6, order=2), line, atol=1e-6)
    parabola = x**2
    np.testing.assert_allclose(curves.smooth(parabola, np.ones(50), 1e6, order=3), parabola, atol=1e-6)


def test_smoothing_damps_a_wave_as_its_transfer_function_says() -> None:
    x = np.arange(2000)
    for wave in (20.0, 40.0, 80.0):
        k = 2 * np.pi / wave
        found = curves.smooth(np.sin(k * x), np.ones(2000), 500.0, order=2)[900:1100]
        expected = np.sin(k * x[900:1100]) / (1 + 500.0 * (2 * np.sin(k / 2)) ** 4)
        np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.parametrize("rise", [-2.0, 0.0, 1.5])
def test_curvature_and_torsion_of_a_helix(rise: float) -> None:
    radius = 5.0
    turn = np.linspace(0, 4 * np.pi, 400)
    helix = np.stack([radius * np.cos(turn), radius * np.sin(turn), rise * turn], axis=1)
    curvature, torsion = curves.curvature_and_torsion(helix, 3.0)
    # The quartic leaves out the fifth derivative: (reach / radius)^4 / 120 or so of the third.
    np.testing.assert_allclose(curvature[30:-30], radius / (radius**2 + rise**2), rtol=2e-3)
    np.testing.assert_allclose(torsion[30:-30], rise / (radius**2 + rise**2), rtol=0.02, atol=1e-6)


def test_a_straight_line_neither_bends_nor_twists() -> None:
    line = np.linspace(0, 1, 50)[:, None] * np.array([3.0, -7.0, 11.0])
    curvature, torsion = curves.curvature_and_torsion(line, 2.0)
    np.testing.assert_allclose(curvature, 0, atol=1e-9)
    np.testing.assert_allclose(torsion, 0, atol=1e-9)


@pytest.mark.parametrize(("n", "window"), [(7, 7), (50, 7), (50, 21), (60, 59)])
def test_curvature_and_torsion_come_from_the_derivatives_of_savitzky_and_golay(n: int, window: int) -> None:
    points = np.cumsum(np.random.default_rng(n).normal(size=(n, 3)), axis=0)
    step = curves.arc_length(points)[-1] / (n - 1)
    a, b, c = (savgol_filter(points, window, 4, deriv=k, delta=step, axis=0) for k in (1, 2, 3))
    cross = np.cross(a, b)
    size = np.linalg.norm(cross, axis=1)
    assert size.min() > 1e-6
    curvature, torsion = curves.curvature_and_torsion(points, window // 2 * step)
    np.testing.assert_allclose(curvature, size / np.linalg.norm(a, axis=1) ** 3, rtol=1e-9)
    wanted = np.einsum("ij,ij->i", cross, c) / size**2
    np.testing.assert_allclose(torsion, wanted, rtol=1e-9, atol=1e-10 * np.abs(wanted).max())
