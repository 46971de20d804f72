"""Projections: conservation, path lengths, magnification, and cells of two sizes."""

import numpy as np
import pytest

from vstent.angiography.projection import projector_of
from vstent.angiography.view import View, angles_of, fitted


def lattice(half_mm: float, spacing_mm: float) -> np.ndarray:
    line = np.arange(-half_mm + 0.5 * spacing_mm, half_mm, spacing_mm)
    return np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)


def ball(radius_mm: float, spacing_mm: float) -> np.ndarray:
    points = lattice(radius_mm + spacing_mm, spacing_mm)
    return points[np.linalg.norm(points, axis=1) < radius_mm]


def source_mm(arm: View) -> np.ndarray:
    return arm.isocenter_mm - arm.source_isocenter_mm * arm.axes[2]


@pytest.mark.parametrize("text", ["AP", "LAO 37 CRA 21"])
def test_the_detector_holds_the_weighted_mass(text):
    points = ball(4.0, 0.25) + np.array([25, -11, 140])
    away = points + 30 * np.array([0.3, 0.5, -0.2])  # far from the axis of the beam too
    both, mass_mg = np.concatenate([points, away]), np.random.default_rng(0).uniform(0, 300, 2 * len(points))
    arm = fitted(both, angles_of(text))
    image = projector_of(arm, both, np.full(len(both), 0.25))(mass_mg)
    from_source = both - source_mm(arm)
    depth_mm = from_source @ arm.axes[2]
    weight = (arm.source_detector_mm / depth_mm) ** 2 * np.linalg.norm(from_source, axis=1) / depth_mm
    assert image.sum() * arm.pixel_mm**2 == pytest.approx((mass_mg * weight).sum() * 0.25**3, rel=1e-4)


def test_a_sphere_has_its_mass_and_chords_and_is_magnified():
    radius_mm, spacing_mm = 4.0, 0.1
    points = ball(radius_mm, spacing_mm)
    arm = View(*angles_of("LAO 20 CRA 15"), np.zeros(3), 128, 128, 0.154)
    image = projector_of(arm, points, np.full(len(points), spacing_mm))(np.full(len(points), 100.0))
    # Mass of the sphere times the mean of magnification squared over the cosine; both vary over it by 1e-4 only.
    mass = 100 * 4 / 3 * np.pi * radius_mm**3
    assert image.sum() * arm.pixel_mm**2 == pytest.approx(mass * arm.magnification**2, rel=0.005)
    assert image[63:65, 63:65].mean() == pytest.approx(200 * radius_mm, rel=0.005)
    # Tangents from the source touch at a radius D R / sqrt(d^2 - R^2) on the detector; at 0.866 of it chords are half.
    seen_mm = arm.source_detector_mm * radius_mm / np.sqrt(arm.source_isocenter_mm**2 - radius_mm**2)
    from_middle_mm = np.abs(np.arange(128) - 63.5) * arm.pixel_mm
    area_mm2 = np.count_nonzero(image > 100 * radius_mm) * arm.pixel_mm**2
    assert area_mm2 == pytest.approx(0.75 * np.pi * seen_mm**2, rel=0.005)
    assert image[63, from_middle_mm > seen_mm + 2 * spacing_mm].max() == 0


def test_a_box_has_no_ripples():
    """Every ray through opposite faces crosses the same length; pixels are smaller and larger than the cells."""
    points = lattice(2.0, 0.25)
    for pixel_mm in (0.1, 0.154, 0.4):
        arm = View(0.0, 0.0, np.zeros(3), 80, 80, pixel_mm)
        image = projector_of(arm, points, np.full(len(points), 0.25))(np.ones(len(points)))
        reach = int(1.6 * arm.magnification / pixel_mm)
        assert np.abs(image[40 - reach : 40 + reach, 40 - reach : 40 + reach] - 4.0).max() < 0.02


def test_cells_of_two_sizes_continue_each_other():
    fine, coarse = lattice(2.0, 0.125), lattice(2.0, 0.25)
    fine, coarse = fine[fine[:, 0] < 0], coarse[coarse[:, 0] > 0]
    points = np.concatenate([fine, coarse])
    spacing = np.repeat([0.125, 0.25], [len(fine), len(coarse)])
    arm = View(0.0, 0.0, np.zeros(3), 48, 48, 0.154)
    image = projector_of(arm, points, spacing)(np.ones(len(points)))
    assert np.abs(image[12:36, 12:36] - 4.0).max() < 0.02


def test_an_oblique_cube_agrees_with_rays():
    """Brute force: 40,000 rays through one cube of 1 mm, by the slab method."""
    arm = View(*angles_of("LAO 33 CRA 28"), np.array([3.0, 2.0, 1.0]), 24, 24, 0.154)
    image = projector_of(arm, np.array([[3.0, 2.0, 1.0]]), np.ones(1))(np.ones(1))
    fine = (np.arange(240) - 119.5) * arm.pixel_mm / 10
    u, v = np.meshgrid(fine, -fine)
    rays = u[..., None] * arm.axes[0] + v[..., None] * arm.axes[1] + arm.source_detector_mm * arm.axes[2]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    start = source_mm(arm) - arm.isocenter_mm
    with np.errstate(divide="ignore"):
        slabs = np.sort(np.stack([(-0.5 - start) / rays, (0.5 - start) / rays]), axis=0)
    length = np.maximum(slabs[1].min(axis=-1) - slabs[0].max(axis=-1), 0)
    rays_of_pixels = length.reshape(24, 10, 24, 10).mean(axis=(1, 3))
    assert image.sum() == pytest.approx(rays_of_pixels.sum(), rel=1e-3)
    assert np.abs(image - rays_of_pixels).max() < 0.06
