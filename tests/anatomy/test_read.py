"""One function reads a scan, a mask or a surface: what each option does to the vessel that comes out."""

import nibabel
import numpy as np
import pytest

from vstent.anatomy.read import read_vessel
from vstent.anatomy.repair import repair
from vstent.anatomy.segment import segment
from vstent.errors import ReadError, UnitError
from vstent.geometry.surface import Surface
from vstent.io.images import read_image
from vstent.io.writers import write_stl
from vstent.kernels import triangles
from vstent.phantoms import Scanner, phantom_surface, scan, tube

RADIUS_MM, LENGTH_MM, VOXEL_MM = 1.5, 10.0, 0.25
TUBE = phantom_surface(tube(length_mm=LENGTH_MM, radius_mm=RADIUS_MM))


def mean_radius_mm(vessel):
    """Radius of the tube of the same volume."""
    vertices, faces = triangles.cap(vessel.lumen.vertices_mm, vessel.lumen.faces, vessel.lumen.boundary_loops)
    length_mm = np.ptp(vertices[:, 2])
    return np.sqrt(triangles.volume(vertices[faces]) / (np.pi * length_mm))


@pytest.fixture(scope="module")
def image():
    return scan(tube(length_mm=LENGTH_MM, radius_mm=RADIUS_MM), np.random.default_rng(2), scanner=Scanner(VOXEL_MM))


@pytest.fixture(scope="module")
def raw(image, tmp_path_factory):
    """The scan as voxels without a header."""
    file = tmp_path_factory.mktemp("raw") / "scan.raw"
    file.write_bytes(np.ascontiguousarray(image.voxels.T.astype("<i2")).tobytes())
    return file


def test_a_surface_is_scaled_turned_and_repaired(tmp_path):
    inside_out = Surface(TUBE.vertices_mm * [-0.1, -0.1, 0.1], TUBE.faces[:, ::-1])  # cm, RAS
    write_stl(tmp_path / "a.stl", inside_out)
    vessel = read_vessel(str(tmp_path / "a.stl"), units="cm", frame="ras")
    assert vessel.notes == ("The surface was inside out; all faces were reversed.",)
    assert mean_radius_mm(vessel) == pytest.approx(RADIUS_MM, rel=0.01)
    assert (vessel.voxel_mm, vessel.openings, vessel.centerlines) == (None, (), ())
    with pytest.raises(UnitError, match="Give another unit"):
        read_vessel(tmp_path / "a.stl", units="m")


def test_of_several_pieces_the_one_near_the_point_is_kept(tmp_path):
    away = Surface(0.7 * TUBE.vertices_mm + [20.0, 0, 0], TUBE.faces)
    both = np.concatenate([TUBE.vertices_mm, away.vertices_mm])
    write_stl(tmp_path / "a.stl", Surface(both, np.concatenate([TUBE.faces, away.faces + len(TUBE.vertices_mm)])))
    assert read_vessel(tmp_path / "a.stl", units="mm").lumen.vertices_mm[:, 0].max() < 2.0
    assert read_vessel(tmp_path / "a.stl", units="mm", at_mm=[20.0, 0, 3.0]).lumen.vertices_mm[:, 0].min() > 18.0


def test_a_scan_is_what_its_parts_make_of_it(image, raw):
    """Cropped, segmented at a threshold and repaired."""
    given = {"spacing_mm": [VOXEL_MM], "shape": image.voxels.shape}
    corners_mm = VOXEL_MM * np.array([[0.0, 0, 8], [*np.array(image.voxels.shape[:2]) - 1, 30]])
    vessel = read_vessel(raw, **given, crop_mm=corners_mm, threshold=900.0, at_mm=corners_mm.mean(axis=0))
    parts = segment(read_image(raw, **given).cropped(corners_mm), threshold=900.0, at_mm=corners_mm.mean(axis=0))
    lumen, repairs = repair(parts.lumen)
    np.testing.assert_array_equal(vessel.lumen.vertices_mm, lumen.vertices_mm)
    assert vessel.notes == (*parts.notes, *repairs)
    assert any("cropped to" in note for note in vessel.notes)
    assert any(note.startswith("Threshold 900 as given") for note in vessel.notes)
    assert (vessel.is_oriented, vessel.voxel_mm) == (False, pytest.approx(VOXEL_MM))
    assert np.ptp(vessel.lumen.vertices_mm[:, 2]) == pytest.approx(22 * VOXEL_MM, abs=0.01)
    with pytest.raises(UnitError, match="--spacing"):
        read_vessel(raw, shape=image.voxels.shape)


def test_a_mask_is_read_like_a_scan(image, tmp_path):
    mask = (np.asarray(image.voxels) > 1000).astype(np.uint8)
    nibabel.save(nibabel.Nifti1Image(mask, np.diag([-1.0, -1.0, 1.0, 1.0]) @ image.affine_mm), tmp_path / "mask.nii.gz")
    vessel = read_vessel(tmp_path / "mask.nii.gz")
    assert mean_radius_mm(vessel) == pytest.approx(RADIUS_MM, abs=0.5 * VOXEL_MM)
    assert vessel.is_oriented


def test_what_is_not_there_is_named(tmp_path):
    for name in ("nowhere.stl", "nowhere"):
        with pytest.raises(ReadError, match=f"{name} does not exist"):
            read_vessel(tmp_path / name)
