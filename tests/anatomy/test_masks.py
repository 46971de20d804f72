"""Masks and label maps, and which of two vessels is kept."""

from dataclasses import replace

import numpy as np
import pytest
from faults import artery
from scipy.ndimage import gaussian_filter
from tubes import line, tube

from vstent import phantoms
from vstent.anatomy.bulge import BULGING, prominence, prominence_of_surface
from vstent.anatomy.masks import MARGIN, prepared
from vstent.anatomy.repair import repair
from vstent.anatomy.segment import segment
from vstent.geometry.image import Image
from vstent.geometry.surface import Surface


@pytest.fixture(scope="module")
def mask():
    """Return a mask of the demo's artery with its sac; both ends leave the image."""
    scanner = phantoms.Scanner(voxel_mm=0.4, noise=0.0, structure=0.0)
    image = phantoms.scan(phantoms.demo_phantom(), np.random.default_rng(0), scanner=scanner)
    return Image((image.voxels > 1100).astype(np.uint8), image.affine_mm)


@pytest.fixture(scope="module")
def wall(mask):
    return segment(mask).lumen


def in_sac(mask):
    sac = phantoms.demo_phantom().sac
    points = mask.to_mm(np.argwhere(np.ones(mask.voxels.shape))).reshape(*mask.voxels.shape, 3)
    return np.linalg.norm(points - sac.center_mm, axis=-1) < sac.height_radius_mm + 0.5


@pytest.mark.parametrize("labels", [(1, 2), (2, 1), (3, 40)])
@pytest.mark.parametrize("kind", [np.uint8, np.int16, np.float32])
def test_the_labels_of_artery_and_sac_are_united(mask, labels, kind):
    values = np.where(mask.voxels == 0, 0, np.where(in_sac(mask), labels[1], labels[0])).astype(kind)
    image = prepared(replace(mask, voxels=values), is_united=True)
    np.testing.assert_array_equal(image.voxels, mask.voxels)
    low, high = sorted(labels)
    assert image.notes == (f"The image is a label map: its 2 labels ({low}, {high}) are united.",)


def test_a_label_map_has_the_wall_of_its_mask(mask, wall):
    labelled = replace(mask, voxels=mask.voxels + (mask.voxels & in_sac(mask)).astype(np.uint8))
    found = segment(labelled).lumen
    np.testing.assert_array_equal(found.vertices_mm, wall.vertices_mm)
    alone = segment(labelled, threshold=1.5)  # a threshold selects among the labels
    assert alone.lumen.area_mm2 < 0.5 * wall.area_mm2


@pytest.mark.parametrize("levels", [2, 4, 20])
def test_the_levels_of_a_blurred_mask_are_no_labels(mask, levels):
    blurred = replace(mask, voxels=np.rint(levels * gaussian_filter(mask.voxels.astype(float), 0.8)).astype(np.uint8))
    assert prepared(blurred, is_united=True) is blurred


def test_a_scan_and_a_mask_that_no_side_grazes_are_left_alone(mask):
    image = phantoms.scan(phantoms.demo_phantom(), np.random.default_rng(0), scanner=phantoms.Scanner(voxel_mm=0.5))
    for one in (image, mask, replace(mask, voxels=5 * mask.voxels + 3)):
        assert prepared(one, is_united=True) is one


def cropped(mask, sides):
    """Return a mask cropped to its voxels at the sides (axis, end)."""
    index = np.argwhere(mask.voxels)
    low, high = np.zeros(3, int), np.array(mask.voxels.shape)
    for axis, end in sides:
        low[axis], high[axis] = (low[axis], index[:, axis].max() + 1) if end else (index[:, axis].min(), high[axis])
    affine = mask.affine_mm.copy()
    affine[:3, 3] = mask.to_mm(low[None])[0]
    return Image(mask.voxels[tuple(map(slice, low, high))], affine)


EVERY = [(axis, end) for axis in range(3) for end in (0, 1)]


@pytest.mark.parametrize("sides", [EVERY, [(1, 1)], [(0, 0), (0, 1)]], ids=["all", "one", "two"])
def test_a_mask_cropped_to_its_segment_is_closed_at_its_sides_and_open_at_its_ends(mask, wall, sides):
    tight = cropped(mask, sides)
    image = prepared(tight, is_united=True)
    assert "grazes the side" in image.notes[0]
    np.testing.assert_allclose(image.to_mm(np.argwhere(image.voxels)), mask.to_mm(np.argwhere(mask.voxels)), atol=1e-9)
    assert max(np.subtract(image.voxels.shape, tight.voxels.shape)) <= 2 * MARGIN
    found = segment(tight).lumen
    assert len(found.boundary_loops) == len(wall.boundary_loops)
    assert found.area_mm2 == pytest.approx(wall.area_mm2, rel=1e-6)


def healthy(offset_mm):
    """Return a healthy artery that is longer than the demo's."""
    straight = tube(line(80.0, 0.8), 2.4, 2.2, around=24).parent.landing_surface
    return Surface(straight.vertices_mm + offset_mm, straight.faces)


@pytest.mark.parametrize("is_reversed", [False, True])
def test_of_two_vessels_in_one_surface_the_one_with_the_bulge_is_kept(is_reversed):
    """Also where the file is inside out."""
    parts = [healthy(np.array([30.0, 0, 0])), artery()]
    faces = np.concatenate([parts[0].faces, parts[1].faces + len(parts[0].vertices_mm)])
    both = Surface(np.concatenate([one.vertices_mm for one in parts]), faces[:, ::-1] if is_reversed else faces)
    assert parts[0].area_mm2 > 1.3 * parts[1].area_mm2
    kept, notes = repair(both)
    assert kept.area_mm2 == pytest.approx(artery().area_mm2, rel=1e-6)
    assert any("with a bulge was kept" in note and "choose another piece" in note for note in notes)
    other, _ = repair(both, at_mm=np.array([30.0, 0, 5.0]))
    assert other.area_mm2 == pytest.approx(parts[0].area_mm2, rel=1e-6)


def test_of_two_vessels_in_one_mask_the_one_with_the_bulge_is_kept(mask, wall):
    i, j = np.indices(mask.voxels.shape[:2])[:, :, :, None] - 12
    tall = np.broadcast_to(i**2 + j**2 < 81, mask.voxels.shape).astype(np.uint8)
    image = replace(mask, voxels=np.concatenate([mask.voxels, tall]))
    assert tall.sum() > 1.5 * mask.voxels.sum()
    found = segment(image)
    assert found.lumen.area_mm2 == pytest.approx(wall.area_mm2, rel=1e-5)
    assert any("Another object" in note for note in found.notes)


@pytest.mark.parametrize(
    ("phantom", "has_bulge"),
    [
        (phantoms.demo_phantom(), True),
        (phantoms.with_sac(phantoms.tube(length_mm=30.0), abscissa_mm=15.0, width_mm=6.0, neck_mm=3.5), True),
        (phantoms.tube(length_mm=40.0), False),
        (phantoms.tube(length_mm=40.0, radius_mm=2.4, end_radius_mm=1.4), False),
        (phantoms.torus_arc(), False),
        (phantoms.siphon(), False),
        (phantoms.bifurcation(), False),
    ],
    ids=["demo", "sac", "tube", "cone", "arc", "siphon", "fork"],
)
def test_bulges_are_told_from_arteries(phantom, has_bulge):
    assert (prominence_of_surface(phantoms.phantom_surface(phantom, edge_mm=0.8)) >= BULGING) == has_bulge


def test_a_sphere_alone_is_no_vessel_with_a_bulge():
    inside = np.linalg.norm(np.indices((30, 30, 30)) - 14.5, axis=0) < 12
    assert prominence(inside, np.full(3, 0.3)) == 1.0
