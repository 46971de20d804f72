"""The pictures: what is nearer wins, veils multiply, wires have their width, and the views look where they say."""

import io

import numpy as np
import pytest
import report_case

from vstent.devices.stent import tube_faces
from vstent.geometry.surface import Surface
from vstent.kernels import raster
from vstent.reporting import figures, lettering
from vstent.reporting.scene import LineLayer, MeshLayer, Scene, View

RED, BLUE = [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]
SQUARE = np.array([[2.0, 2, 0], [14, 2, 0], [14, 14, 0], [2, 14, 0]])
SQUARE_FACES = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)


def canvas(size=16):
    return np.full((size, size), np.inf), np.ones((size, size, 3))


def painted(*triangles):
    """Paint (corners (3, 3), colour) in the order given."""
    depth, image = canvas()
    for corners, colour in triangles:
        raster.paint_triangles(
            np.array(corners, float), np.tile(colour, (3, 1)), np.array([[0, 1, 2]], np.int32), depth, image
        )
    return image


def veil(corners, faces, alpha, colour, depth, sums, clear):
    raster.veil_triangles(
        corners, np.tile(colour, (len(corners), 1)), np.full(len(corners), alpha), faces, depth, sums, clear
    )


def test_nearer_triangle_wins_in_either_order():
    far = ([[0, 0, 5], [16, 0, 5], [0, 16, 5]], RED)
    near = ([[0, 0, 4], [16, 0, 4], [0, 16, 4]], BLUE)
    for image in (painted(far, near), painted(near, far)):
        assert image[4, 4].tolist() == BLUE
        assert image[15, 15].tolist() == [1, 1, 1]


def test_crossing_triangles_meet_on_their_line():
    level = ([[0, 0, 5], [40, 0, 5], [0, 40, 5]], RED)
    tilted = ([[0, 0, 0.0], [40, 0, 25.0], [0, 40, 0.0]], BLUE)  # depth 0.625 x: nearer than 5 up to x = 8
    image = painted(level, tilted)
    assert np.allclose(image[:, :8], BLUE)
    assert np.allclose(image[:, 8:], RED)


@pytest.mark.parametrize("faces", [SQUARE_FACES, SQUARE_FACES[:, ::-1].copy(), SQUARE_FACES[:, [1, 2, 0]].copy()])
def test_neighbours_share_no_pixel_and_leave_no_seam(faces):
    # The diagonal runs through pixel centres: a careless rule would blend them twice or never.
    depth, _ = canvas()
    sums, clear = np.zeros((16, 16, 4)), np.ones((16, 16))
    veil(SQUARE, faces, 0.25, RED, depth, sums, clear)
    expected = np.ones((16, 16))
    expected[2:14, 2:14] = 0.75
    assert np.array_equal(clear, expected)


def test_veils_multiply_in_any_order_and_stay_behind_what_is_nearer():
    images = []
    for order in ((0, 1), (1, 0)):
        depth, image = canvas()
        sums, clear = np.zeros((16, 16, 4)), np.ones((16, 16))
        raster.paint_triangles(SQUARE + np.array([0, 0, 3.0]), np.tile(BLUE, (4, 1)), SQUARE_FACES[:1], depth, image)
        for which in order:
            veil(SQUARE + np.array([0, 0, (2.0, 4.0)[which]]), SQUARE_FACES, [0.5, 0.2][which], RED, depth, sums, clear)
        images.append(raster.resolve(image, sums, clear, 1))
    assert np.allclose(images[0], images[1], atol=1e-15)
    assert np.allclose(images[0][4, 12], [0.5, 0, 0.5])  # one veil (0.5) in front of blue, the other behind it
    assert np.allclose(images[0][12, 4], [1, 0.4, 0.4])  # both veils over white: 0.5 * 0.8 shines through


def test_wire_has_its_width_and_bulges_out_of_a_plane_through_its_axis():
    depth, image = canvas(64)
    plane = np.array([[0.0, 0, 1], [64, 0, 1], [64, 64, 1], [0, 64, 1]])
    raster.paint_triangles(plane, np.tile(RED, (4, 1)), SQUARE_FACES, depth, image)
    axis = np.array([[-5.0, 32, 1], [70, 32, 1]])
    raster.paint_wires(axis, np.array([0, 2], np.int32), np.array([6.0]), 0.1, np.tile(BLUE, (2, 1)), depth, image)
    rows = (image[:, 30, 2] > 0).nonzero()[0]
    assert rows.tolist() == list(range(26, 38))
    assert depth[31:33, 30] == pytest.approx(1 - 0.1 * np.sqrt(36 - 0.25))


def test_resolve_averages_blocks():
    image = np.zeros((4, 4, 3))
    image[0, 0] = 1.0
    assert raster.resolve(image, np.zeros((4, 4, 4)), np.ones((4, 4)), 2)[..., 0].tolist() == [[0.25, 0], [0, 0]]


def scene_with(*layers, view):
    return Scene(panes=(("bare", "Before"),), layers=layers, scales=(), views=(view,), is_oriented=True, fade_mm=1.0)


def mesh(surface, colour, opacity=1.0, name="thing"):
    return MeshLayer(id=name, pane="", colour=colour, surface=surface, opacity=opacity)


def test_sphere_shows_as_a_disc_of_its_radius_in_its_place():
    view = View("front", np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.array([1.0, 2, 3]), 4.0)
    ball = report_case.sphere(np.array([2.0, 2.0, 4.5]), 1.0)
    scene = scene_with(mesh(ball, (0.2, 0.2, 0.2)), view=view)
    image = figures.draw(scene.layers, scene, view, (400, 400))
    dark = image[..., 0] < 0.6
    pixel = figures.span_mm(view, (400, 400)) / 400
    assert dark.sum() * pixel**2 == pytest.approx(np.pi, rel=0.01)
    row, column = np.argwhere(dark).mean(axis=0) + 0.5
    assert [(column - 200) * pixel, (200 - row) * pixel] == pytest.approx([1.0, 1.5], abs=0.01)


def test_glass_shows_what_it_holds_and_hides_nothing():
    view = View("front", np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.zeros(3), 3.0)
    glass = mesh(report_case.sphere(np.zeros(3), 2.0), (0.5, 0.5, 0.5), 0.2)
    line = {"id": "axis", "pane": "", "colour": (1.0, 0.0, 0.0)}
    points, starts = np.array([[-1.0, 0, 0], [1, 0, 0]]), np.array([0, 2], np.int32)
    wire = LineLayer(points_mm=points, starts=starts, radius_mm=np.array([0.2]), **line)
    scene = scene_with(glass, wire, view=view)
    through = figures.draw(scene.layers, scene, view, (200, 200))[100, 100]
    bare = figures.draw((wire,), scene, view, (200, 200))[100, 100]
    assert through[0] - through[2] == pytest.approx(
        0.8 * (bare[0] - bare[2]), abs=0.1
    )  # veiled: 1 - 0.2 and a little more


def test_far_wires_are_paler_than_near_ones():
    view = View("front", np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.zeros(3), 2.0)
    shades = []
    for y in (-1.0, 1.0):  # the eye is at negative y
        points, starts = np.array([[-1.0, y, 0], [1, y, 0]]), np.array([0, 2], np.int32)
        wire = LineLayer("wires", "", (0.1, 0.1, 0.1), points, starts, np.array([0.3]))
        shades.append(figures.draw((wire,), scene_with(wire, view=view), view, (100, 100))[50, 50, 0])
    assert shades[0] < 0.2 < 0.5 < shades[1]


def test_pictures_of_a_case_are_pngs_with_colour():
    from matplotlib.image import imread

    found = [plate.drawn() for plate in figures.plates(report_case.scene())]
    assert [picture.id for picture in found] == [
        "treatment",
        "streamlines",
        "shear",
        "sac_shear",
        "anatomy",
        "contour",
        "coverage",
        "wires",
    ]
    for picture in found:
        image = imread(io.BytesIO(picture.png))
        height, width = image.shape[:2]
        assert width >= 1500
        assert len(picture.png) < 2_000_000
        saturation = np.ptp(image[: int(0.85 * height), :, :3], axis=2)
        assert (saturation > 0.1).mean() > 0.01, picture.id


def test_wall_shear_of_the_panes_is_painted_on_one_scale():
    scene = report_case.scene()
    view = scene.view("profile")
    dome = {}
    for pane, _ in scene.panes:
        image = figures.draw(scene.pick(("shear",), pane), scene, view, (200, 200))
        row, column = place_of(report_case.SAC_CENTER, view, (200, 200))
        dome[pane] = image[row, column]
    colours = scene.scale("shear")
    for pane, strength in (("bare", 1.0), ("silk", 0.62), ("enterprise", 0.87)):
        expected = colours.paint(np.array([1.5 * strength]))[0]
        ratio = dome[pane] / np.maximum(expected, 0.05)
        assert np.ptp(ratio[expected > 0.1]) < 0.02, pane  # the scale's colour, dimmed evenly by the light


def place_of(point_mm, view, size_px):
    pixel = figures.span_mm(view, size_px) / size_px[0]
    x, y, _ = (point_mm - view.center_mm) @ view.axes.T
    return int(size_px[1] / 2 - y / pixel), int(size_px[0] / 2 + x / pixel)


@pytest.mark.parametrize("toward", [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (-0.6, 0.8, 0.0)])
def test_a_contour_is_looked_at_from_the_side_of_its_gap(toward):
    angle, height_mm = np.meshgrid(2 * np.pi * np.arange(48) / 48, np.arange(0, 20.5, 0.5))
    ring = np.stack([2 * np.cos(angle), 2 * np.sin(angle), height_mm], axis=2).reshape(-1, 3)
    gap_mm = np.maximum(ring @ np.array(toward) - 1.2, 0.0)
    tube = Surface(ring, tube_faces(41, 48))
    contour = MeshLayer("contour", "silk", (0.3, 0.3, 0.3), tube, scale="wall_gap", values=gap_mm)
    view = figures.gap_view(contour, scene_of_view((1.0, 0.0, 0.0)))
    np.testing.assert_allclose(view.axes[2], toward, atol=1e-9)
    np.testing.assert_allclose(view.axes @ view.axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(view.axes) == pytest.approx(1.0)
    assert np.linalg.norm(ring - view.center_mm, axis=1).max() >= view.radius_mm * 0.9


def scene_of_view(toward):
    """A view along `toward` with the z axis up."""
    up = np.array([0.0, 0.0, 1.0])
    return View("profile", np.stack([np.cross(up, toward), up, toward]), np.zeros(3), 10.0)


@pytest.mark.parametrize(
    ("low", "high", "wanted"),
    [(0, 0.4, 0.05), (0, 1, 0.2), (-0.1, 2.3, 0.5), (0.3, 0.31, 0.002), (0, 9000, 2000), (12, 13.5, 0.2)],
)
def test_ticks_are_the_multiples_of_a_round_step_within_the_scale(low, high, wanted):
    found = lettering.ticks(low, high)
    multiples = np.round(np.array(found) / wanted)
    np.testing.assert_allclose(multiples * wanted, found, atol=1e-12)
    np.testing.assert_array_equal(np.diff(multiples), 1)
    assert found[0] - wanted < low - 1e-9 <= found[0]
    assert found[-1] <= high + 1e-9 < found[-1] + wanted
    assert 3 < len(found) <= lettering.TICKS
    assert "-0" not in map(str, found)


def test_a_scale_of_one_value_has_no_ticks():
    assert lettering.ticks(1.0, 1.0) == []


def test_the_color_bar_shows_its_colors_and_the_length_bar_its_length():
    picture = lettering.blank(400, 200)
    colors = np.linspace(0, 1, 256)[:, None] * [1.0, 0.5, 0.0]
    lettering.color_bar(picture, colors, (0.0, 1.0), "Speed [m/s]")
    row = np.asarray(picture)[200 - 60, 120:280]
    np.testing.assert_allclose(row, 255 * np.linspace(0, 1, 160)[:, None] * [1.0, 0.5, 0.0], atol=2)
    panel = lettering.blank(400, 120)
    lettering.length_bar(panel, 40.0, (0, 0), (400, 120))
    assert (np.asarray(panel)[114, :, 0] < 60).sum() == pytest.approx(100, abs=2)  # 10 mm of 40 mm


def test_coils_hide_no_stent_that_is_seen_from_the_sac():
    def lines(name: str, radius_mm: float) -> LineLayer:
        return LineLayer(name, "one", (0, 0, 0), np.eye(3)[:2], np.array([0, 2], np.int32), np.array([radius_mm]))

    strut, coil, neck = lines("wires", 0.04), lines("wires", 0.15), lines("neck", 0.08)
    views = [View(name, np.eye(3), np.zeros(3), 1.0) for name in ("profile", "neck")]

    def shots(*layers: LineLayer) -> list[tuple[LineLayer | MeshLayer, ...]]:
        panes = (("bare", ""), ("one", ""))
        scene = Scene(panes, layers, (), tuple(views), is_oriented=True, fade_mm=1.0)
        return [shot.layers for shot in figures.wire_shots(scene, "one")]

    assert shots(strut, coil, neck) == [(strut, coil, neck), (strut, neck)]
    assert shots(coil, neck) == [(coil, neck), (coil, neck)]
