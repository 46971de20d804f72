"""Films: absorption, frames in time, grey levels and wires."""

import numpy as np
import pytest

from vstent.angiography.film import PAPER, WIRE_PER_MM, film_of, iodine_cm2_g, levels_of, window_of, wire_shadow
from vstent.angiography.projection import projector_of
from vstent.angiography.view import View, angles_of, fitted
from vstent.devices.catalogue import find_design
from vstent.devices.stent import Stent
from vstent.errors import InputError


def slab() -> tuple[np.ndarray, View]:
    """Return a slab 2 mm thick along the beam at a grid spacing of 0.25 mm, and a frontal view of its middle."""
    line = np.arange(-1.875, 2, 0.25)
    points = np.stack(np.meshgrid(line, line[np.abs(line) < 1], line, indexing="ij"), axis=-1).reshape(-1, 3)
    return points, View(0.0, 0.0, np.zeros(3), 16, 16, 0.154)


def film(frames, rate_Hz=10.0):
    points, arm = slab()
    return film_of(frames, projector_of(arm, points, np.full(len(points), 0.25)), frame_rate_Hz=rate_Hz)


def test_absorption_is_that_of_beer_and_lambert():
    points, _ = slab()
    dense = film([(0.0, np.full(len(points), 300.0))]).absorption[0]
    # 300 mg/mL over 2 mm are 0.06 g/cm2 of iodine; 12.32 cm2/g at 50 keV.
    assert np.allclose(dense, 0.06 * 12.32, rtol=2e-3)
    assert iodine_cm2_g(50.0) == pytest.approx(12.32)
    assert 3.510 < iodine_cm2_g(70.0) < 7.579
    assert iodine_cm2_g(70.0) == pytest.approx(np.sqrt(7.579 * 3.510), rel=0.05)


def test_frames_come_at_the_frame_rate_whatever_the_steps_are():
    points, _ = slab()
    times = [0.0, 0.07, 0.11, 0.32, 0.5, 0.501, 0.83, 1.0]
    shot = film([(t, np.full(len(points), 100 * t)) for t in times], 8.0)
    assert np.allclose(shot.time_s, np.arange(9) / 8)
    assert np.allclose(shot.absorption[:, 8, 8], shot.absorption[-1, 8, 8] * shot.time_s, atol=1e-6)
    assert shot.frame_rate_Hz == pytest.approx(8)
    assert shot.at(0.4) == 3


def test_grey_falls_linearly_from_paper_to_black():
    points, _ = slab()
    shot = film([(t, np.full(len(points), 100 * t)) for t in (0.0, 1.0)], 4.0)
    window = window_of([shot])
    levels = np.array([frame[8, 8] for frame in levels_of(shot, window)])
    assert np.allclose(levels, PAPER * (1 - shot.time_s), atol=2e-3)
    with_both = next(levels_of(shot, window, wires=[np.full((16, 16), 0.1, np.float32)], vessel=np.ones((16, 16))))
    assert np.allclose(with_both, PAPER * (1 - 0.1 / window - 0.06), atol=1e-6)


def test_wires_absorb_by_their_volume():
    design = find_design("silk")
    angle = np.linspace(0, 2 * np.pi, 40)
    ring = np.stack([2 * np.cos(angle), 2 * np.sin(angle), 0 * angle], axis=1)
    line = np.stack([0 * angle, 0 * angle, np.linspace(-3, 3, 40)], axis=1)
    stent = Stent(
        design, design.sizes[0], np.zeros((2, 3, 3)), np.zeros(2), np.concatenate([ring, line]), [0, 40, 80], [50, 30]
    )
    arm = fitted(stent.wire_points_mm, angles_of("LAO 30 CRA 40"))
    image = wire_shadow(arm, stent)
    lengths = [np.linalg.norm(np.diff(wire, axis=0), axis=1).sum() for wire in (ring, line)]
    volume_mm3 = np.pi / 4 * (0.05**2 * lengths[0] + 0.03**2 * lengths[1])
    assert image.sum() * arm.pixel_mm**2 == pytest.approx(WIRE_PER_MM * volume_mm3 * arm.magnification**2, rel=1e-3)
    assert not np.any(
        image[np.linalg.norm(np.indices(image.shape).T - 0.5 * (np.array(image.shape) - 1), axis=2).T > 60]
    )


def test_rates_and_energies_out_of_range_are_refused():
    with pytest.raises(InputError, match="frame rate is 0 per second"):
        film([(0.0, np.zeros(1))], 0.0)
    with pytest.raises(InputError, match="20 keV is outside the table"):
        iodine_cm2_g(20.0)
