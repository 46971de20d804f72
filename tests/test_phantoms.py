import numpy as np
import pytest
from sac_truth import neck_center_mm

from vstent.kernels import topology, triangles
from vstent.phantoms import (
    Sac,
    Scanner,
    bifurcation,
    demo_phantom,
    phantom_surface,
    scan,
    siphon,
    torus_arc,
    tube,
    with_branch,
    with_sac,
)

STILL = Scanner(noise=0.0, structure=0.0)


def capped_volume(surface):
    vertices, faces = triangles.cap(surface.vertices_mm, surface.faces, surface.boundary_loops)
    return triangles.volume(vertices[faces])


@pytest.mark.parametrize(
    ("phantom", "volume_mm3"),
    [
        (tube(length_mm=12.0, radius_mm=2.0), np.pi * 4 * 12),
        (tube(length_mm=12.0, radius_mm=2.0, end_radius_mm=1.5), np.pi * 12 / 3 * (4 + 3 + 2.25)),
        (torus_arc(bend_radius_mm=7.0, angle_rad=2.0, radius_mm=2.0), np.pi * 4 * 14),  # Pappus
    ],
    ids=["tube", "taper", "torus"],
)
def test_surface_has_the_analytic_volume_to_second_order(phantom, volume_mm3):
    error = [abs(capped_volume(phantom_surface(phantom, edge_mm=h)) / volume_mm3 - 1) for h in (0.6, 0.3)]
    assert error[1] < 0.005
    assert error[0] / error[1] > 3.0


@pytest.mark.parametrize("phantom", [tube(), siphon(), bifurcation(), demo_phantom()], ids=lambda p: p.name)
def test_surface_lies_on_the_wall_is_a_manifold_and_is_cut_square_at_the_ends(phantom):
    surface = phantom_surface(phantom, edge_mm=0.4)
    assert np.abs(phantom.implicit_mm(surface.vertices_mm)[0]).max() < 1e-9
    edges = topology.edges_of(surface.faces)
    assert edges.n_uses.max() == 2
    assert len(topology.unzipped(surface.vertices_mm, surface.faces)[0]) == len(
        surface.vertices_mm
    )  # no pinched vertex
    assert topology.face_components(surface.faces).max() == 0
    assert capped_volume(surface) > 0
    assert surface.areas_mm2.min() > 1e-4
    loops = [surface.vertices_mm[loop] for loop in surface.boundary_loops]
    assert len(loops) == len(phantom.ends)
    for center, normal, radius in phantom.ends:
        loop = min(loops, key=lambda points: np.linalg.norm(points.mean(axis=0) - center))
        # the surface's faces run counter-clockwise seen from outside, so an end's loop runs clockwise about its normal
        np.testing.assert_allclose(triangles.polygon_area_vector(loop) / (np.pi * radius**2), -normal, atol=0.08)
        np.testing.assert_allclose((loop - center) @ normal, 0, atol=2e-3)


def test_sphere_on_a_straight_tube_has_the_volume_of_a_direct_integration():
    phantom = with_sac(tube(length_mm=30.0, radius_mm=2.0), abscissa_mm=15.0, width_mm=7.0, neck_mm=5.0)
    away = np.linalg.norm((phantom.sac.center_mm - [0, 0, 15.0])[:2])
    assert away == pytest.approx(2.0 + np.sqrt(3.5**2 - 2.5**2))
    ticks = np.linspace(-3.5, 3.5, 2801)
    x, y = np.meshgrid(ticks, ticks)
    height = 2 * np.sqrt(np.maximum(3.5**2 - x**2 - y**2, 0))
    truth = height[np.hypot(x + away, y) > 2.0].sum() * (ticks[1] - ticks[0]) ** 2
    assert phantom.sac_volume_mm3 == pytest.approx(truth, rel=1e-3)


def test_neck_on_a_straight_tube_has_the_area_of_a_direct_integration():
    phantom = with_sac(tube(length_mm=30.0, radius_mm=2.0), abscissa_mm=15.0, width_mm=7.0, neck_mm=5.0)
    away = np.linalg.norm((phantom.sac.center_mm - [0, 0, 15.0])[:2])
    angle = np.linspace(-np.pi, np.pi, 200_001)
    half = np.sqrt(np.maximum(3.5**2 - (2 * np.cos(angle) - away) ** 2 - (2 * np.sin(angle)) ** 2, 0))
    assert phantom.neck_area_mm2 == pytest.approx(2 * (2 * half).mean() * 2 * np.pi, rel=0.01)
    # on a straight tube the neck is as long as was asked for
    assert 2 * half.max() == pytest.approx(5.0, abs=1e-6)


def test_surface_of_a_sac_encloses_tube_and_sac():
    parent = tube(length_mm=16.0, radius_mm=2.0)
    phantom = with_sac(parent, abscissa_mm=8.0, width_mm=6.0, neck_mm=4.0, elongation=1.3)
    assert phantom.sac_volume_mm3 > 0.8 * 4 / 3 * np.pi * 3**2 * 3.9
    expected = np.pi * 4 * 16 + phantom.sac_volume_mm3
    assert capped_volume(phantom_surface(phantom, edge_mm=0.3)) == pytest.approx(expected, rel=0.004)


def test_sac_sits_on_the_outer_side_of_the_bend():
    phantom = with_sac(torus_arc(bend_radius_mm=8.0), abscissa_mm=4 * np.pi, width_mm=6.0)
    np.testing.assert_allclose(phantom.sac.direction, [0, 0, 1], atol=0.01)  # the middle of the half torus points to z
    np.testing.assert_allclose(neck_center_mm(phantom), [0, 0, 10.0], atol=0.05)


def test_ellipsoid_is_exact_on_its_surface_and_a_sphere_everywhere():
    sac = Sac(np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.6, 0.8]), 2.0, 3.5)
    value, _ = sac.implicit_mm(np.array([sac.center_mm + 3.5 * sac.direction, sac.center_mm + np.array([2.0, 0, 0])]))
    np.testing.assert_allclose(value, 0, atol=1e-12)
    ball = Sac(np.zeros(3), np.array([0.0, 0.0, 1.0]), 2.0, 2.0)
    points = np.random.default_rng(0).normal(size=(200, 3)) * 3
    value, gradient = ball.implicit_mm(points)
    np.testing.assert_allclose(value, np.linalg.norm(points, axis=1) - 2.0, atol=1e-12)
    np.testing.assert_allclose(gradient, points / np.linalg.norm(points, axis=1, keepdims=True), atol=1e-12)


@pytest.mark.parametrize("voxel_mm", [0.2, 0.33])
def test_scan_keeps_the_amount_of_contrast(voxel_mm):
    image = scan(
        tube(length_mm=10.0, radius_mm=2.0),
        np.random.default_rng(0),
        scanner=Scanner(voxel_mm, 0.2, 0.0, structure=0.0),
    )
    depth_mm = image.voxels.shape[2] * voxel_mm
    filled = ((image.voxels - 100.0) / 2000.0).sum() * voxel_mm**3
    assert filled == pytest.approx(np.pi * 4 * depth_mm, rel=3e-3)


def test_scan_of_a_wall_is_the_blurred_step():
    from scipy.special import ndtr

    phantom = tube(length_mm=6.0, radius_mm=6.0)
    image = scan(phantom, np.random.default_rng(0), scanner=Scanner(0.2, 0.3, 0.0, structure=0.0))
    points = image.to_mm(np.argwhere(np.ones(image.voxels.shape)))
    depth = 6.0 - np.linalg.norm(points[:, :2], axis=1)
    blur = np.sqrt(0.3**2 + 0.2**2 / 12)  # point spread and voxel
    curved = 0.3**2 / (2 * 6.0)  # the wall of a blurred cylinder looks smaller by blur^2 / 2 R
    np.testing.assert_allclose((image.voxels.ravel() - 100) / 2000, ndtr((depth - curved) / blur), atol=0.012)


def test_noise_has_the_strength_asked_for_and_follows_the_generator():
    phantom = tube(length_mm=8.0)
    quiet = scan(phantom, np.random.default_rng(5), scanner=STILL)
    loud = scan(phantom, np.random.default_rng(5), scanner=Scanner(noise=0.05, structure=0.0))
    assert np.std(loud.voxels.astype(float) - quiet.voxels) == pytest.approx(0.05 * 2000, rel=0.05)
    again = scan(phantom, np.random.default_rng(5), scanner=Scanner(noise=0.05, structure=0.0))
    np.testing.assert_array_equal(again.voxels, loud.voxels)


def test_every_end_leaves_the_demo_scan_through_its_border():
    phantom = demo_phantom()
    image = scan(phantom, np.random.default_rng(0), scanner=STILL)
    assert max(image.voxels.shape) <= 160
    for center, _, _ in phantom.ends:
        nearest = np.clip(np.round(image.to_index(center[None])[0]).astype(int), 0, np.array(image.voxels.shape) - 1)
        assert image.voxels[tuple(nearest)] > 1800
        assert ((nearest == 0) | (nearest == np.array(image.voxels.shape) - 1)).any()
    border = np.ones(image.voxels.shape, dtype=bool)
    border[1:-1, 1:-1, 1:-1] = False
    expected = sum(np.pi * radius**2 for *_, radius in phantom.ends) / 0.28**2
    assert (image.voxels[border] > 1100).sum() == pytest.approx(expected, rel=0.1)  # and nothing else does


def test_demo_is_a_curved_carotid_with_a_branch_and_a_sidewall_sac():
    phantom = demo_phantom()
    curvature = np.linalg.norm(np.gradient(np.gradient(phantom.parent.points_mm[::25], axis=0), axis=0), axis=1)
    assert 3.0 < 1.0 / curvature[2:-2].max() < 8.0  # tightest bend radius in mm: points are 1 mm apart
    assert 2 * phantom.branches[0].inscribed_radius_mm[0] == pytest.approx(1.3)
    assert phantom.sac.width_radius_mm == 3.5
    assert 4.0 < np.sqrt(4 * phantom.neck_area_mm2 / np.pi) < 5.0


def test_branch_is_part_of_the_lumen_up_to_its_outlet():
    phantom = with_branch(
        tube(length_mm=20.0), abscissa_mm=10.0, direction=np.array([1.0, 0, 0]), radius_mm=0.7, length_mm=9.0
    )
    value, _ = phantom.implicit_mm(np.array([[8.0, 0, 10.0], [8.0, 0.7, 10.0], [8.0, 0, 11.0]]))
    np.testing.assert_allclose(value, [-0.7, 0, 0.3], atol=1e-9)
    # The parent's wall stands sqrt(4 - y^2) off its axis, in the mean over the branch's section 2 - 0.49 / 16.
    surface = phantom_surface(phantom)
    assert capped_volume(surface) == pytest.approx(np.pi * 4 * 20 + np.pi * 0.49 * (9 - 2 + 0.49 / 16), rel=4e-3)
    assert surface.vertices_mm[:, 0].min() > -2.001  # it does not come out behind the parent
