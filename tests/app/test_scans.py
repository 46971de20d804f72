"""Slices, outlines and crop of a scan: exact, however its voxels are stored."""

from dataclasses import replace

import app_case
import numpy as np
import pytest
import report_case

from vstent.app.outlines import crossings, outlines, section
from vstent.app.scans import Scan
from vstent.errors import InputError
from vstent.geometry.image import Image
from vstent.study.keys import anatomy_keys
from vstent.study.settings import InputSettings, Settings

SPACING_MM = np.array([0.7, 0.4, 1.1])
SHAPE = (46, 62, 34)
"""Voxels around the analytic artery."""


def oblique():
    """An affine whose axes are turned against those of the patient."""
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    affine = np.eye(4)
    affine[:3, :3] = turn * SPACING_MM
    affine[:3, 3] = np.array([0.0, 0.0, 7.0]) - affine[:3, :3] @ ((np.array(SHAPE) - 1) / 2)
    return affine


@pytest.fixture(scope="module")
def image():
    voxels = np.random.default_rng(5).integers(-1024, 3000, SHAPE, dtype=np.int16)
    return Image(voxels, oblique())


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("kind", [np.int16, np.uint8, np.float32, bool])
def test_a_slice_holds_the_intensities_of_the_file(image, axis, kind):
    voxels = image.voxels > 0 if kind is bool else (image.voxels % 251).astype(kind)
    manifest, data = app_case.opened(_Answer(Scan(Image(voxels, image.affine_mm)).slice(axis, 7)))
    assert [manifest["width"], manifest["height"]] == [SHAPE[i] for i in range(3) if i != axis]
    assert manifest["values"]["type"] == ("u16" if kind is np.float32 else "u8")
    found = app_case.numbers(manifest["values"], data).reshape(manifest["height"], manifest["width"])
    exact = 0 if np.issubdtype(kind, np.integer) or kind is bool else 0.51 * 250 / 65535
    assert np.abs(found.T - np.take(voxels, 7, axis=axis)).max() <= exact


def test_a_slab_shows_its_maximum_also_at_the_border(image):
    scan = Scan(image)
    for index in (0, 20, SHAPE[0] - 1):
        manifest, data = app_case.opened(_Answer(scan.slice(0, index, 6)))
        brute = image.voxels[max(index - 6, 0) : index + 7].max(axis=0)
        found = app_case.numbers(manifest["values"], data).reshape(manifest["height"], manifest["width"])
        np.testing.assert_array_equal(found.T, brute)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_outlines_are_exact_sections_of_the_surfaces(image, axis):
    """Every end lies on an edge of the mesh and in the plane; of the spherical sac they lie on one circle."""
    index = int(image.to_index(report_case.SAC_CENTER[None])[0, axis]) + 1
    sac = report_case.anatomy().aneurysms[0].sac
    ends = section(image, sac, axis, index).reshape(-1, 2)
    assert len(ends) > 100
    points_mm = image.to_mm(np.insert(ends, axis, index, axis=1))
    np.testing.assert_allclose(sac.closest(points_mm)[1], 0, atol=1e-9)
    radius_mm = np.linalg.norm(points_mm - report_case.SAC_CENTER, axis=1)
    sag_mm = report_case.SAC_MM * (1 - np.cos(np.pi / 39))
    assert radius_mm.max() <= report_case.SAC_MM + 1e-9
    assert radius_mm.min() > report_case.SAC_MM - 2 * sag_mm


def test_wires_are_cut_where_they_cross_the_plane(image):
    stent = report_case.deployment("silk", 24).stent
    place, brute = image.to_index(stent.wire_points_mm), []
    for wire, (first, end) in enumerate(zip(stent.wire_starts[:-1], stent.wire_starts[1:], strict=True)):
        for a, b in zip(place[first : end - 1], place[first + 1 : end], strict=True):
            if (a[1] - 30 > 0) != (b[1] - 30 > 0):
                point = a + (30 - a[1]) / (b[1] - a[1]) * (b - a)
                brute.append([point[0], point[2], stent.wire_diameter_um[wire] / 1000])
    assert len(brute) > 20
    np.testing.assert_allclose(crossings(image, stent, 1, 30), brute, atol=1e-9)


def test_the_message_names_every_outline(image):
    stent = report_case.deployment("silk", 24).stent
    manifest, data = app_case.opened(_Answer(outlines(image, report_case.anatomy(), [stent], 1, 30)))
    assert set(manifest["segments"]) == {"lumen", "parent", "sac", "neck"}
    packed = app_case.numbers(manifest["segments"]["lumen"], data)
    exact = section(image, report_case.anatomy().vessel.lumen, 1, 30).reshape(-1, 4)
    np.testing.assert_allclose(packed, exact, atol=max(SHAPE) / 65535)
    np.testing.assert_allclose(app_case.numbers(manifest["wires"], data), crossings(image, stent, 1, 30), atol=1e-3)


def test_a_cropped_scan_is_a_part_that_lies_where_it_lay(image):
    corners = image.to_mm(np.array([[30.2, 10.0, 20.0], [5.0, 49.7, 3.0]]))
    part = image.cropped(corners)
    np.testing.assert_array_equal(part.voxels, image.voxels[5:31, 10:51, 3:21])
    np.testing.assert_allclose(part.to_mm(np.array([[1.0, 2, 3]])), image.to_mm(np.array([[6.0, 12, 6]])), atol=1e-9)
    assert part.notes[-1] == "The scan is cropped to 26 x 41 x 18 of 46 x 62 x 34 voxels."
    with pytest.raises(InputError, match="fewer than 8 voxels along an axis"):
        image.cropped(corners[[0, 0]])


def test_keys_change_with_the_crop_box():
    cropped = Settings(input=InputSettings(crop_mm=((0.0, 0, 0), (9.0, 9, 9))))
    before, after = (anatomy_keys("source", settings) for settings in (Settings(), cropped))
    assert {name for name in before if before[name].given != after[name].given} == {"vessel", "anatomy"}
    assert {name: key.code for name, key in before.items()} == {name: key.code for name, key in after.items()}


class _Answer:
    def __init__(self, content):
        self.content = content


def turned_scan(degrees):
    """A scan turned about the axis from right to left, whose intensities are linear in the position."""
    angle = np.radians(degrees)
    turn = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    affine = np.eye(4)
    affine[:3, :3] = turn * SPACING_MM
    affine[:3, 3] = [-20.0, 5.0, 40.0]
    empty = Image(np.zeros(SHAPE, dtype=np.float32), affine)
    places_mm = empty.to_mm(np.moveaxis(np.indices(SHAPE), 0, -1).reshape(-1, 3))
    return Image((100 + places_mm @ SLOPE).reshape(SHAPE).astype(np.float32), affine)


SLOPE = np.array([1.0, -2.0, 0.5])
"""Change of the intensity per mm."""


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_anatomical_planes_of_an_oblique_scan_hold_its_intensities(axis):
    """Interpolation is exact for a linear intensity; outside the scan there is its lowest value."""
    image = turned_scan(16.0)
    scan = Scan(image)
    assert scan.told()["oblique_deg"] == pytest.approx([0.0, 16.0, 16.0], abs=1e-6)
    grid = scan.upright
    assert grid.spacing_mm.tolist() == pytest.approx(SPACING_MM.tolist())
    index = grid.shape[axis] // 2
    manifest, data = app_case.opened(_Answer(scan.slice(axis, index, is_upright=True)))
    found = app_case.numbers(manifest["values"], data).reshape(manifest["height"], manifest["width"]).T
    place = np.moveaxis(np.indices(found.shape), 0, -1).reshape(-1, 2)
    places_mm = grid.affine_mm[:3, 3] + grid.spacing_mm * np.insert(place, axis, index, axis=1)
    inside = image.to_index(places_mm)
    is_in = ((inside >= 0) & (inside <= np.array(SHAPE) - 1)).all(axis=1)
    step = (image.voxels.max() - image.voxels.min()) / 65535
    assert is_in.mean() > 0.4
    np.testing.assert_allclose(found.ravel()[is_in], (100 + places_mm @ SLOPE)[is_in], atol=step + 1e-4)
    is_out = ((inside < -1) | (inside > SHAPE)).any(axis=1)
    assert found.ravel()[is_out] == pytest.approx(float(image.voxels.min()), abs=float(step))
    ends_mm = image.to_mm(np.array([[0.0, 0, 0], np.array(SHAPE) - 1.0]))
    assert (grid.to_index(ends_mm) > -1e-9).all()
    assert (grid.to_index(ends_mm) < np.array(grid.shape)).all()


def test_a_slab_of_anatomical_planes_is_the_maximum_of_its_slices():
    scan = Scan(turned_scan(16.0))

    def values(index, slab):
        manifest, data = app_case.opened(_Answer(scan.slice(2, index, slab, is_upright=True)))
        return app_case.numbers(manifest["values"], data)

    np.testing.assert_array_equal(values(15, 2), np.max([values(index, 0) for index in range(13, 18)], axis=0))


def test_a_straight_scan_and_one_without_orientation_keep_their_slices():
    assert Scan(turned_scan(0.3)).upright is None
    assert Scan(replace(turned_scan(16.0), is_oriented=False)).upright is None
    permuted = turned_scan(90.0)
    assert Scan(permuted).upright is None


def test_outlines_of_an_anatomical_plane_lie_in_it():
    """The spherical sac gives circles about its center, at a place of the patient and not of the file."""
    grid = Scan(turned_scan(16.0)).upright
    sac = report_case.anatomy().aneurysms[0].sac
    index = round(float(grid.to_index(report_case.SAC_CENTER[None])[0, 1]))
    pieces = section(grid, sac, 1, index).reshape(-1, 2)
    points_mm = grid.affine_mm[:3, 3] + grid.spacing_mm * np.insert(pieces, 1, index, axis=1)
    radius_mm = np.linalg.norm(points_mm - report_case.SAC_CENTER, axis=1)
    np.testing.assert_allclose(radius_mm, report_case.SAC_MM, atol=0.02)
