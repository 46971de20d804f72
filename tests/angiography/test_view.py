"""C-arm geometry: the signs of DICOM, magnification, and what is refused."""

import numpy as np
import pytest

from vstent.angiography.view import View, angles_of, axes_of, fitted
from vstent.errors import InputError

LEFT, FRONT, HEAD = np.array([1.0, 0, 0]), np.array([0, -1.0, 0]), np.array([0, 0, 1.0])


def view(text: str, **more) -> View:
    return View(*angles_of(text), np.zeros(3), 101, 101, 0.2, **more)


def where(text: str, point_mm: np.ndarray) -> tuple[float, float, float]:
    """Return how far a point lies to the right and up in the picture, in pixels, and its magnification."""
    pixels, magnification = view(text).pixels_of(point_mm[None])
    return pixels[0, 1] - 50, 50 - pixels[0, 0], magnification[0]


def test_frontal_view_shows_the_patients_left_on_the_right_and_the_head_up():
    assert np.allclose(axes_of(0.0, 0.0), [LEFT, HEAD, FRONT])
    right, up, _ = where("AP", 2 * LEFT + 3 * HEAD)
    assert np.allclose([right, up], np.array([2, 3]) * (1100 / 750) / 0.2)


def test_lao_90_has_the_detector_at_the_patients_left_and_the_face_on_the_left():
    right, up, magnification = where("LAO 90", 7 * LEFT)
    assert np.allclose([right, up], 0)
    assert magnification == pytest.approx(1100 / 757)  # toward the detector: magnified less
    assert where("LAO 90", 7 * FRONT)[0] == pytest.approx(-7 * 1100 / 750 / 0.2)
    assert where("RAO 90", 7 * LEFT)[2] == pytest.approx(1100 / 743)
    assert where("RAO 90", 7 * FRONT)[0] == pytest.approx(7 * 1100 / 750 / 0.2)


def test_cranial_tilt_moves_the_front_down_and_brings_the_head_to_the_detector():
    _, up, _ = where("CRA 30", 5 * FRONT)
    assert up < 0 < where("CAU 30", 5 * FRONT)[1]
    assert where("CRA 30", 5 * HEAD)[2] < 1100 / 750 < where("CAU 30", 5 * HEAD)[2]


@pytest.mark.parametrize("text", ["LAO 30 CRA 10", "RAO 110 CAU 45", "CRA 90", "RAO 0.5"])
def test_axes_are_a_right_handed_frame(text):
    axes = axes_of(*angles_of(text))
    assert np.allclose(axes @ axes.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(axes) == pytest.approx(1)


def test_words_of_a_direction():
    assert view("lao30, cra 10").name == "LAO 30 CRA 10"
    assert view("CAU 20 RAO 45").name == "RAO 45 CAU 20"
    assert view("lateral").name == "LAO 90 CRA 0"
    assert angles_of("AP") == (0.0, 0.0)


@pytest.mark.parametrize("text", ["", "30", "LAO", "LAO 30 RAO 20", "LEFT 30", "LAO 30 CRA 10 deg", "CRA 10 CRA 20"])
def test_what_is_no_direction_is_refused(text):
    with pytest.raises(InputError, match="not a C-arm direction"):
        angles_of(text)


def test_angles_and_distances_out_of_range_are_refused():
    with pytest.raises(InputError, match="LAO or RAO angle is 181 degrees"):
        angles_of("LAO 181")
    with pytest.raises(InputError, match="CRA or CAU angle is 91"):
        angles_of("CRA 91")
    with pytest.raises(InputError, match="source-isocenter distance is 1200 mm"):
        view("AP", source_isocenter_mm=1200)
    with pytest.raises(InputError, match="detector pixel"):
        View(0, 0, np.zeros(3), 64, 64, 0.0)
    with pytest.raises(InputError, match="lies within the vessel"):
        view("AP").pixels_of(np.array([[0.0, 745, 0]]))
    with pytest.raises(InputError, match="larger detector pixel"):
        fitted(np.array([[-150.0, 0, 0], [150, 0, 0]]), (0, 0))


def test_a_fitted_detector_shows_every_point():
    points_mm = np.random.default_rng(3).uniform(-12, 15, (400, 3)) + np.array([30, -20, 100])
    arm = fitted(points_mm, angles_of("RAO 35 CRA 20"))
    pixels, _ = arm.pixels_of(points_mm)
    assert pixels.min() > 0
    assert (pixels.max(axis=0) < [arm.rows - 1, arm.columns - 1]).all()
