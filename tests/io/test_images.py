import gzip
import re
import shutil
from dataclasses import replace

import nibabel
import numpy as np
import pydicom
import pytest
import SimpleITK
from faults import scan
from scipy.spatial.transform import Rotation

from vstent.anatomy.segment import segment
from vstent.errors import InputError, ReadError, UnitError
from vstent.geometry.image import Image
from vstent.io.dicom_strip import strip_dicom
from vstent.io.dicom_writer import write_dicom
from vstent.io.files import is_surface_file
from vstent.io.images import files_of, read_image
from vstent.io.surfaces import read_surface

SPACING = np.array([0.21, 0.23, 0.37])


@pytest.fixture(scope="module")
def oblique():
    """Every voxel another value, another number of voxels and spacing on every axis, axes oblique."""
    voxels = (np.arange(9 * 8 * 7) * 13 % 2001 - 500).astype(np.int16).reshape(9, 8, 7)
    affine = np.eye(4)
    affine[:3, :3] = Rotation.from_euler("xyz", [20, -35, 50], degrees=True).as_matrix() * SPACING
    affine[:3, 3] = [-31.25, 12.5, 100.125]
    return Image(voxels, affine)


@pytest.fixture
def series(oblique, tmp_path):
    write_dicom(oblique, tmp_path / "series")
    return tmp_path / "series"


def slices(folder):
    return sorted(folder.glob("*.dcm"))


def edited(file, **values):
    dataset = pydicom.dcmread(file)
    for keyword, value in values.items():
        if value is None:
            delattr(dataset, keyword)
        else:
            setattr(dataset, keyword, value)
    dataset.save_as(file)


# -- DICOM -------------------------------------------------------------------------------------------------------------


def test_oblique_dicom_series_comes_back_exactly(oblique, series):
    image = read_image(series)
    np.testing.assert_array_equal(image.voxels, oblique.voxels)
    np.testing.assert_allclose(image.affine_mm, oblique.affine_mm, rtol=0, atol=1e-11)
    assert image.modality == "CT"


def test_the_same_image_is_written_in_the_same_bytes(oblique, series, tmp_path):
    write_dicom(oblique, tmp_path / "again")
    assert [f.read_bytes() for f in slices(series)] == [f.read_bytes() for f in slices(tmp_path / "again")]


def test_itk_reads_the_series_as_we_do(oblique, series):
    reader = SimpleITK.ImageSeriesReader()
    reader.SetFileNames(reader.GetGDCMSeriesFileNames(str(series)))
    scan = reader.Execute()
    np.testing.assert_array_equal(SimpleITK.GetArrayFromImage(scan).T, oblique.voxels)
    np.testing.assert_allclose(scan.GetSpacing(), SPACING, atol=1e-6)
    np.testing.assert_allclose(scan.TransformIndexToPhysicalPoint((8, 7, 6)), oblique.to_mm([[8, 7, 6]])[0], atol=1e-6)


def test_order_of_files_names_and_numbers_does_not_matter(oblique, series):
    order = np.random.default_rng(3).permutation(7)
    for file, k in zip(slices(series), order, strict=True):
        edited(file, InstanceNumber=int(order[k]) + 1)
        file.rename(series / f"{k:02d}_{file.stem}.dcm")
    np.testing.assert_array_equal(read_image(series).voxels, oblique.voxels)


def test_other_files_and_smaller_series_are_passed_over(oblique, series):
    write_dicom(Image(oblique.voxels[:, :, :4], oblique.affine_mm), series / "scout")
    (series / "README.txt").write_text("not an image")
    directory = pydicom.dcmread(slices(series)[0])
    for keyword in ("Rows", "Columns", "PixelData"):
        delattr(directory, keyword)
    directory.SOPClassUID = directory.file_meta.MediaStorageSOPClassUID = "1.2.840.10008.5.1.4.1.1.88.11"
    directory.save_as(series / "report.dcm")
    image = read_image(series)
    np.testing.assert_array_equal(image.voxels, oblique.voxels)
    assert re.match(
        r"2 DICOM series found\. Series 1 '.*' \(.*, 7 slices\) is used; others: 1 .*4 slices", image.notes[0]
    )


def test_one_file_stands_for_its_series(oblique, series):
    write_dicom(Image(oblique.voxels[:, :, :4], oblique.affine_mm), series.parent / "small")
    for file in slices(series.parent / "small"):
        shutil.copy(file, series / f"small_{file.name}")
    assert read_image(series / "small_IM0002.dcm").voxels.shape == (9, 8, 4)
    assert read_image(series / "IM0002.dcm").voxels.shape == (9, 8, 7)


def test_a_file_that_is_no_image_does_not_stand_for_those_beside_it(series):
    report = pydicom.dcmread(slices(series)[0])
    for keyword in ("Rows", "Columns", "PixelData"):
        delattr(report, keyword)
    report.SOPClassUID = report.file_meta.MediaStorageSOPClassUID = "1.2.840.10008.5.1.4.1.1.88.11"
    report.save_as(series / "report.dcm")
    with pytest.raises(ReadError, match="holds no DICOM images"):
        read_image(series / "report.dcm")


def test_a_series_has_the_files_of_that_series_whichever_of_them_is_given(oblique, series):
    files = slices(series)
    write_dicom(Image(oblique.voxels[:, :, :4] + 1, oblique.affine_mm), series / "other")
    slices(series / "other")[0].rename(series / "z.dcm")
    assert files_of(files[0]) == files_of(files[3]) == files
    files[2].write_bytes(files[2].read_bytes()[:200])
    assert files_of(files[0]) == [*files[:2], *files[3:]]


def test_missing_slice_is_refused_with_its_neighbours_named(series):
    slices(series)[3].unlink()
    with pytest.raises(ReadError, match=r"1 slice is missing between IM0003\.dcm and IM0005\.dcm"):
        read_image(series)


def test_an_exact_copy_of_a_slice_is_dropped_and_reported(oblique, series):
    shutil.copy(series / "IM0002.dcm", series / "copy.dcm")
    image = read_image(series)
    np.testing.assert_array_equal(image.voxels, oblique.voxels)
    assert image.notes == ("1 slice with the same position and the same pixels as another: dropped.",)


def test_two_different_slices_at_one_position_are_refused_with_both_named(series):
    shutil.copy(series / "IM0002.dcm", series / "copy.dcm")
    other = pydicom.dcmread(series / "copy.dcm")
    other.PixelData = (other.pixel_array + 1).tobytes()
    other.save_as(series / "copy.dcm")
    with pytest.raises(
        ReadError, match=r"(copy\.dcm and IM0002\.dcm|IM0002\.dcm and copy\.dcm) differ but have the same"
    ):
        read_image(series)


@pytest.mark.parametrize(
    ("key", "values"),
    [
        ("AcquisitionNumber", (1, 2)),
        ("TemporalPositionIdentifier", (3, 7)),
        ("AcquisitionTime", ("101500.0", "101530.5")),
        ("TriggerTime", ("0", "35.5")),
        ("EchoTime", ("3.4", "6.8")),
    ],
)
def test_of_several_acquisitions_the_brightest_is_read_unless_one_is_chosen(oblique, series, key, values):
    files = slices(series)
    for number, file in enumerate(files):
        edited(file, **{key: values[1]})
        mask = pydicom.dcmread(file)
        setattr(mask, key, values[0])
        mask.SOPInstanceUID = f"1.2.3.{number}"
        mask.PixelData = (mask.pixel_array // 4).astype(mask.pixel_array.dtype).tobytes()
        mask.save_as(series / f"mask_{file.name}")
    image = read_image(series)
    np.testing.assert_array_equal(image.voxels, oblique.voxels)
    assert "holds 2 acquisitions" in image.notes[0]
    assert "Acquisition 2 is used" in image.notes[0]
    np.testing.assert_array_equal(read_image(series, acquisition=1).voxels, oblique.voxels // 4)
    with pytest.raises(ReadError, match=r"holds 2 acquisitions \(1: .*, 7 slices; 2: .*, 7 slices\), not 3"):
        read_image(series, acquisition=3)


def test_a_series_of_one_acquisition_has_no_second(series):
    with pytest.raises(ReadError, match="acquisition 2 does not exist"):
        read_image(series, acquisition=2)


@pytest.mark.parametrize("is_signed", [0, 1])
def test_monochrome1_is_inverted(oblique, series, is_signed):
    stored = np.asarray(read_image(series).voxels)
    plain = stored.view(np.int16 if is_signed else np.uint16).astype(int)
    for file in slices(series):
        edited(file, PhotometricInterpretation="MONOCHROME1", PixelRepresentation=is_signed)
    image = read_image(series)
    assert (image.voxels + plain == (-1 if is_signed else 65535)).all()
    assert "MONOCHROME1" in image.notes[0]


def test_of_files_side_by_side_the_multi_frame_file_given_is_read_alone(series, tmp_path):
    lone = tmp_path / "enhanced.dcm"
    shutil.copy(slices(series)[0], lone)
    edited(lone, NumberOfFrames=3)
    (tmp_path / "broken.dcm").write_bytes(slices(series)[1].read_bytes()[:200])
    with pytest.raises(ReadError, match=r"enhanced\.dcm is a series of projections"):
        read_image(lone)


# -- several series, and what is no slice ------------------------------------------------------------------------------

ORIGINAL = Image((np.arange(6 * 5 * 9) * 7 % 997).astype(np.int16).reshape(6, 5, 9), np.diag([0.3, 0.3, 0.4, 1]))
"""A series of nine slices."""
LARGER = Image(np.full((12, 10, 9), 900, dtype=np.int16), np.diag([0.15, 0.15, 0.4, 1]))
"""A series of the same slices with more voxels."""


@pytest.fixture
def study(tmp_path):
    """Return the folder of a study with two series."""
    write_dicom(ORIGINAL, tmp_path / "study")
    write_dicom(LARGER, tmp_path / "study" / "b")
    for folder, number in ((tmp_path / "study", 1), (tmp_path / "study" / "b", 2)):
        for file in slices(folder):
            edited(file, ImageType=["ORIGINAL", "PRIMARY"], SeriesNumber=number, SeriesDescription=f"run {number}")
    return tmp_path / "study"


@pytest.mark.parametrize(
    "change",
    [
        {"ImageType": ["DERIVED", "SECONDARY", "MIP"]},
        {"ImageType": ["DERIVED", "PRIMARY", "AXIAL"]},
        {"ImageType": ["ORIGINAL", "PRIMARY", "PROJECTION IMAGE"]},
        {"ImageType": ["DERIVED", "SECONDARY", "REFORMATTED"], "is_same_series": True},
        {"SeriesDescription": "thick mpr cor"},
        {"SliceThickness": "3.2"},
    ],
)
def test_original_series_precede_reformats_however_large(study, change):
    is_same = change.pop("is_same_series", False)
    uid = pydicom.dcmread(slices(study)[0]).SeriesInstanceUID
    for file in slices(study / "b"):
        edited(file, **change, **({"SeriesInstanceUID": uid} if is_same else {}))
    image = read_image(study)
    np.testing.assert_array_equal(image.voxels, ORIGINAL.voxels)
    assert re.match(
        r"2 DICOM series found\. Series 1 'run 1' \(ORIGINAL.PRIMARY, 9 slices\) is used; others: 2 '", image.notes[0]
    )
    reformat = read_image(slices(study / "b")[0])
    np.testing.assert_array_equal(reformat.voxels, LARGER.voxels)
    assert len(reformat.notes) == ("SliceThickness" in change)
    if reformat.notes:
        assert "3.2 mm thick and 0.4 mm apart" in reformat.notes[0]


def test_of_two_original_series_the_larger_is_read(study):
    np.testing.assert_array_equal(read_image(study).voxels, LARGER.voxels)


def capture(file, out, **values):
    """Write a file of one image that is no slice of a volume."""
    dataset = pydicom.dcmread(file)
    for keyword in ("ImagePositionPatient", "ImageOrientationPatient", "PixelSpacing"):
        delattr(dataset, keyword)
    dataset.SOPInstanceUID = dataset.file_meta.MediaStorageSOPInstanceUID = "1.2.3"
    for keyword, value in values.items():
        setattr(dataset, keyword, value)
    dataset.save_as(out)


COLORS = {"SamplesPerPixel": 3, "PhotometricInterpretation": "RGB", "PlanarConfiguration": 0, "BitsAllocated": 8}


@pytest.mark.parametrize(
    ("values", "said", "alone"),
    [
        ({"NumberOfFrames": 120, "Modality": "XA"}, "120 images: projections", "series of projections"),
        ({**COLORS, "Modality": "OT"}, "1 images: colors", "image in colors"),
        ({"NumberOfFrames": 500, "Modality": "SEG"}, "500 images: segmentation", "DICOM segmentation"),
        ({"Modality": "DX"}, "1 images: no position in the patient", "does not state its position"),
    ],
)
@pytest.mark.parametrize("is_same", [False, True])
def test_what_is_no_slice_is_passed_over_and_named(study, values, said, alone, is_same):
    shutil.rmtree(study / "b")
    own = {} if is_same and "SamplesPerPixel" in values else {"SeriesInstanceUID": "1.2.4"}
    capture(slices(study)[0], study / "z.dcm", **values, **own, Rows=2000, Columns=2000)
    image = read_image(study)
    np.testing.assert_array_equal(image.voxels, ORIGINAL.voxels)
    assert said in image.notes[0]
    with pytest.raises(ReadError, match=alone):
        read_image(study / "z.dcm")


def test_a_folder_of_results_is_no_part_of_the_input(study):
    before, files = read_image(study), files_of(study)
    (study / "out" / ".vstent").mkdir(parents=True)
    write_dicom(LARGER, study / "out" / "films")
    (study / ".hidden.dcm").write_text("of the system")
    assert files_of(study) == files
    np.testing.assert_array_equal(read_image(study).voxels, before.voxels)


def test_a_dicomdir_stands_for_its_folder(study, tmp_path):
    from pydicom.fileset import FileSet

    medium = FileSet()
    for file in slices(study):
        dataset = pydicom.dcmread(file)
        dataset.StudyID, dataset.PatientID = "1", "p"
        medium.add(dataset)
    medium.write(tmp_path / "medium")
    medium._stage["t"].cleanup()  # its collection, whenever that is, would warn of the folder
    image = read_image(tmp_path / "medium" / "DICOMDIR")
    np.testing.assert_array_equal(image.voxels, ORIGINAL.voxels)
    assert files_of(tmp_path / "medium" / "DICOMDIR") == files_of(tmp_path / "medium")
    strip_dicom(tmp_path / "medium" / "DICOMDIR", tmp_path / "stripped.dcm")
    assert not (tmp_path / "stripped.dcm").exists()


def bare(file, *, keeps_meta, is_little=True):
    """Rewrite a file without preamble, and with or without its file meta information."""
    from pydicom.filebase import DicomBytesIO
    from pydicom.filewriter import write_dataset, write_file_meta_info

    dataset, out = pydicom.dcmread(file), DicomBytesIO()
    out.is_little_endian, out.is_implicit_VR = True, False
    if keeps_meta:
        write_file_meta_info(out, dataset.file_meta)
    out.is_little_endian, out.is_implicit_VR = is_little, not keeps_meta and is_little
    if not is_little:
        dataset.PixelData = dataset.pixel_array.astype(">i2").tobytes()
    plain = pydicom.Dataset({element.tag: element for element in dataset})
    write_dataset(out, plain)
    file.write_bytes(out.getvalue())


@pytest.mark.parametrize("suffix", [".dcm", "", ".12"])
@pytest.mark.parametrize(("keeps_meta", "is_little"), [(True, True), (False, True), (False, False)])
def test_files_without_preamble_and_meta_information_are_read(study, tmp_path, suffix, keeps_meta, is_little):
    shutil.rmtree(study / "b")
    for file in slices(study):
        bare(file, keeps_meta=keeps_meta, is_little=is_little)
        file.rename(file.with_suffix(suffix))
    image = read_image(study)
    np.testing.assert_array_equal(image.voxels, ORIGINAL.voxels)
    np.testing.assert_allclose(image.affine_mm, ORIGINAL.affine_mm, atol=1e-12)
    strip_dicom(files_of(study)[0], tmp_path / "stripped.dcm")
    np.testing.assert_array_equal(pydicom.dcmread(tmp_path / "stripped.dcm").pixel_array, ORIGINAL.voxels[:, :, 0].T)


def test_a_spacing_given_replaces_one_that_is_missing(oblique, series):
    for file in slices(series):
        edited(file, PixelSpacing=None, ImagerPixelSpacing=[0.5, 0.5])
    with pytest.raises(UnitError, match=r"does not state its pixel spacing; give --spacing"):
        read_image(series)
    image = read_image(series, spacing_mm=SPACING)
    np.testing.assert_array_equal(image.voxels, oblique.voxels)
    np.testing.assert_allclose(image.affine_mm, oblique.affine_mm, atol=1e-9)


# -- rounded headers ---------------------------------------------------------------------------------------------------


@pytest.fixture
def long_series(oblique, tmp_path):
    """Return an oblique series of 40 slices 0.37 mm apart."""
    write_dicom(Image(np.resize(oblique.voxels, (9, 8, 40)), oblique.affine_mm), tmp_path / "long")
    return tmp_path / "long"


@pytest.mark.parametrize("digits", [1, 2, 3])
@pytest.mark.parametrize("cut", [np.round, np.floor])
def test_positions_rounded_by_an_archive_are_evenly_spaced(oblique, long_series, digits, cut):
    for k, file in enumerate(slices(long_series)):
        place = cut(oblique.to_mm([[0, 0, k]])[0] * 10**digits) / 10**digits
        edited(file, ImagePositionPatient=[f"{x:.{digits}f}" for x in place])
    image = read_image(long_series)
    far = np.array([[8, 7, 39]])
    moved_mm = np.linalg.norm(image.to_mm(far) - oblique.to_mm(far))
    assert moved_mm < 2 * 10.0**-digits
    np.testing.assert_allclose(image.spacing_mm, SPACING, rtol=0.01)
    assert any(f"rounded to {10.0**-digits:g} mm" in note for note in image.notes) == (digits < 3)


@pytest.mark.parametrize(
    ("gone", "shift_mm", "words"), [((17,), 0.0, "1 slice is missing"), ((), 0.4, "out of line|apart elsewhere")]
)
def test_rounded_positions_do_not_hide_a_missing_or_shifted_slice(oblique, long_series, gone, shift_mm, words):
    for k, file in enumerate(slices(long_series)):
        place = oblique.to_mm([[0, 0, k]])[0] + (k == 9) * shift_mm
        edited(file, ImagePositionPatient=[f"{x:.1f}" for x in place])
        if k in gone:
            file.unlink()
    with pytest.raises(ReadError, match=words):
        read_image(long_series)


@pytest.mark.parametrize("digits", [2, 3, 6])
def test_directions_that_differ_in_their_last_digit_are_the_same(oblique, series, digits):
    turn = np.round((oblique.affine_mm[:3, :2] / SPACING[:2]).T.ravel(), digits)
    for k, file in enumerate(slices(series)):
        jitter = 1e-6 * (-1) ** k if digits == 6 else 0.0
        edited(file, ImageOrientationPatient=[f"{x + jitter:.8f}" for x in turn], PixelSpacing=[0.23, 0.21 + jitter])
    image = read_image(series)
    np.testing.assert_array_equal(image.voxels, oblique.voxels)
    np.testing.assert_allclose(image.affine_mm, oblique.affine_mm, atol=max(10.0**-digits * 0.23, 2e-6))


def test_two_stacks_in_one_series_are_not_odd_slices_to_remove(series):
    for file in slices(series)[::2]:
        edited(file, ImageOrientationPatient=[1, 0, 0, 0, 1, 0])
    with pytest.raises(ReadError, match=r"\d of 7 slices have another orientation .* several stacks"):
        read_image(series)


# -- faults ------------------------------------------------------------------------------------------------------------


def test_slice_at_an_uneven_distance_is_refused(oblique, series):
    edited(series / "IM0005.dcm", ImagePositionPatient=list(np.round(oblique.to_mm([[0, 0, 4.1]])[0], 8)))
    with pytest.raises(ReadError, match=r"Slice IM0005\.dcm is 0\.407 mm from IM0004\.dcm"):
        read_image(series)


def test_slice_shifted_sideways_is_refused(oblique, series):
    edited(series / "IM0005.dcm", ImagePositionPatient=list(np.round(oblique.to_mm([[2, 0, 4]])[0], 8)))
    with pytest.raises(ReadError, match=r"Slice IM0005\.dcm is 0\.420 mm out of line"):
        read_image(series)


def test_a_sheared_series_keeps_its_shear(oblique, series):
    for k, file in enumerate(slices(series)):
        edited(file, ImagePositionPatient=list(np.round(oblique.to_mm([[0, 0.5 * k, k]])[0], 8)))
    expected = oblique.affine_mm[:3, 2] + 0.5 * oblique.affine_mm[:3, 1]
    np.testing.assert_allclose(read_image(series).affine_mm[:3, 2], expected, atol=1e-8)


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"PixelSpacing": [0.2, 0.2]}, ReadError, "another pixel spacing"),
        ({"ImageOrientationPatient": [1, 0, 0, 0, 1, 0]}, ReadError, "another orientation"),
        ({"PixelSpacing": None}, UnitError, "does not state its pixel spacing"),
        ({"ImagePositionPatient": None}, ReadError, "does not state its position"),
        ({"NumberOfFrames": 3}, ReadError, "series of projections"),
    ],
)
def test_a_slice_unlike_the_others_is_named(series, change, error, words):
    edited(series / "IM0005.dcm", **change)
    with pytest.raises(error, match=rf"(?s)IM0005\.dcm.*{words}"):
        read_image(series)


def test_rescale_gives_the_stored_intensities(oblique, series):
    for k, file in enumerate(slices(series)):
        edited(file, RescaleSlope=str(1 + 0.5 * (k % 2)), RescaleIntercept="-7")
    expected = oblique.voxels * (1 + 0.5 * (np.arange(7) % 2)) - 7
    np.testing.assert_allclose(read_image(series).voxels, expected, rtol=1e-6)


def padded(file, is_padding, *, value, limit=None):
    """Write `value` where `is_padding` (rows, columns), and that it stands for what is outside the field of view."""
    dataset = pydicom.dcmread(file)
    stored = dataset.pixel_array
    dataset.PixelData = np.where(is_padding, np.int16(value), stored).tobytes()
    dataset.add_new("PixelPaddingValue", "SS", value if limit is None else min(value, limit) - 5)
    if limit is not None:
        dataset.add_new("PixelPaddingRangeLimit", "SS", limit)
    dataset.save_as(file)
    return np.where(is_padding, stored[~is_padding].min(initial=0 if is_padding.all() else 9999), stored)


@pytest.mark.parametrize("limit", [None, 3001])
def test_padding_is_not_brighter_than_contrast(series, limit):
    is_padding = np.hypot(*np.mgrid[-4:4, -4:5]) > 4.5
    expected = [padded(file, is_padding, value=3000, limit=limit) for file in slices(series)]
    found = read_image(series).voxels.T
    assert found.max() <= 1500
    assert {plane.tobytes() for plane in found} == {plane.tobytes() for plane in expected}


def test_a_slice_of_padding_alone_is_zero(oblique, series):
    for file in slices(series)[:2]:
        padded(file, np.ones((8, 9), dtype=bool), value=3000)
    assert (read_image(series).voxels == 0).all(axis=(0, 1)).sum() == 2


def test_compressed_pixels_are_read(oblique, series):
    for file in slices(series):
        dataset = pydicom.dcmread(file)
        dataset.compress(pydicom.uid.RLELossless)
        dataset.save_as(file)
    np.testing.assert_array_equal(read_image(series).voxels, oblique.voxels)


def test_enhanced_multi_frame_file_is_the_same_volume(oblique, series, tmp_path):
    from pydicom.dataset import Dataset

    order = [4, 1, 0, 6, 2, 3, 5]
    whole = pydicom.dcmread(series / "IM0001.dcm")
    shared, measures, plane, value = Dataset(), Dataset(), Dataset(), Dataset()
    measures.PixelSpacing, plane.ImageOrientationPatient = whole.PixelSpacing, whole.ImageOrientationPatient
    value.RescaleSlope, value.RescaleIntercept = "2", "3"
    shared.PixelMeasuresSequence, shared.PlaneOrientationSequence = [measures], [plane]
    shared.PixelValueTransformationSequence = [value]
    frames = []
    for k in order:
        position, frame = Dataset(), Dataset()
        position.ImagePositionPatient = pydicom.dcmread(slices(series)[k]).ImagePositionPatient
        frame.PlanePositionSequence = [position]
        frames.append(frame)
    whole.SharedFunctionalGroupsSequence, whole.PerFrameFunctionalGroupsSequence = [shared], frames
    whole.NumberOfFrames = len(order)
    whole.PixelData = oblique.voxels.T[order].astype("<i2").tobytes()
    for keyword in (
        "PixelSpacing",
        "ImagePositionPatient",
        "ImageOrientationPatient",
        "RescaleSlope",
        "RescaleIntercept",
    ):
        delattr(whole, keyword)
    whole.save_as(tmp_path / "enhanced.dcm")
    image = read_image(tmp_path / "enhanced.dcm")
    np.testing.assert_array_equal(image.voxels, 2 * oblique.voxels.astype(int) + 3)
    np.testing.assert_allclose(image.affine_mm, oblique.affine_mm, atol=1e-11)


def test_writing_refuses_what_a_series_cannot_hold(oblique, tmp_path):
    mirrored = Image(oblique.voxels, oblique.affine_mm @ np.diag([1, 1, -1, 1]))
    with pytest.raises(ValueError, match="right-handed"):
        write_dicom(mirrored, tmp_path / "a")
    with pytest.raises(ValueError, match="16 bits"):
        write_dicom(Image(oblique.voxels.astype(float) * 100, oblique.affine_mm), tmp_path / "a")
    assert list(tmp_path.iterdir()) == []


# -- NIfTI, NRRD, MetaImage --------------------------------------------------------------------------------------------


def itk_scan(image):
    scan = SimpleITK.GetImageFromArray(np.ascontiguousarray(image.voxels.T))
    scan.SetSpacing([float(v) for v in image.spacing_mm])
    scan.SetOrigin([float(v) for v in image.affine_mm[:3, 3]])
    scan.SetDirection([float(v) for v in (image.affine_mm[:3, :3] / image.spacing_mm).ravel()])
    return scan


@pytest.mark.parametrize("suffix", [".nii", ".nii.gz", ".nrrd", ".nhdr", ".mha", ".mhd"])
def test_headers_keep_the_oblique_frame_in_lps(oblique, tmp_path, suffix):
    SimpleITK.WriteImage(itk_scan(oblique), str(tmp_path / f"scan{suffix}"))
    image = read_image(tmp_path / f"scan{suffix}")
    np.testing.assert_array_equal(image.voxels, oblique.voxels)
    # NIfTI keeps its frame as single-precision quaternions
    np.testing.assert_allclose(image.affine_mm, oblique.affine_mm, atol=2e-5 if "nii" in suffix else 1e-9)


@pytest.mark.parametrize(("suffix", "line"), [(".mha", b"ElementSpacing"), (".nrrd", b"space directions")])
def test_header_without_spacing_is_refused_unless_it_is_given(oblique, tmp_path, suffix, line):
    file = tmp_path / f"scan{suffix}"
    plain = Image(oblique.voxels, np.eye(4))
    SimpleITK.WriteImage(itk_scan(plain), str(file))
    head, _, rest = file.read_bytes().partition(line)
    file.write_bytes(head + rest.partition(b"\n")[2])
    if suffix == ".nrrd":
        file.write_bytes(
            file.read_bytes().replace(b"space: left-posterior-superior\n", b"").replace(b"space origin", b"#")
        )
    with pytest.raises(UnitError, match="give --spacing"):
        read_image(file)
    image = read_image(file, spacing_mm=[0.3])
    np.testing.assert_allclose(image.spacing_mm, 0.3)
    np.testing.assert_array_equal(image.voxels, oblique.voxels)


@pytest.mark.parametrize("suffix", [".nii", ".nii.gz", ".nrrd", ".mha"])
def test_a_file_that_breaks_off_is_refused(oblique, tmp_path, suffix):
    file = tmp_path / f"scan{suffix}"
    SimpleITK.WriteImage(itk_scan(oblique), str(file), suffix != ".mha")
    file.write_bytes(file.read_bytes()[:-40])
    with pytest.raises(ReadError, match="is damaged"):
        read_image(file)


@pytest.mark.parametrize("wanted", [".nii", ".nii.gz", ".NII.gz"])
def test_a_nifti_file_is_read_and_not_one_beside_it_that_differs_in_its_suffix(oblique, tmp_path, wanted):
    for suffix in (".nii", ".nii.gz", ".hdr"):
        shifted = Image(oblique.voxels + (1000 if suffix == wanted.lower() else 0), oblique.affine_mm)
        SimpleITK.WriteImage(itk_scan(shifted), str(tmp_path / f"scan{suffix}"))
    (tmp_path / f"scan{wanted.lower()}").rename(tmp_path / f"scan{wanted}")
    np.testing.assert_array_equal(read_image(tmp_path / f"scan{wanted}").voxels, oblique.voxels + 1000)


def nifti_of(image, version=1, *, edges=None, **fields):
    """Return a NIfTI image of nibabel in RAS with the voxels and, unless others are given, the frame of an image."""
    kind = nibabel.Nifti1Image if version == 1 else nibabel.Nifti2Image
    affine = np.diag([-1.0, -1.0, 1.0, 1.0]) @ image.affine_mm
    if edges is not None:
        affine[:3, :3] = np.diag([-1.0, -1.0, 1.0]) @ edges
    made = kind(np.asarray(image.voxels), None)
    made.header.set_sform(affine, code=fields.pop("code", 1))
    made.header["qform_code"] = 0
    made.header["pixdim"][1:4] = np.linalg.norm(affine[:3, :3], axis=0)
    for key, value in fields.items():
        made.header[key] = value
    return made


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz"])
def test_both_versions_of_nifti_are_read(oblique, tmp_path, version, name):
    nibabel.save(nifti_of(oblique, version), tmp_path / name)
    image = read_image(tmp_path / name)
    np.testing.assert_array_equal(image.voxels, oblique.voxels)
    np.testing.assert_allclose(image.affine_mm, oblique.affine_mm, atol=2e-6 if version == 1 else 1e-12)
    assert image.notes == ()


@pytest.mark.parametrize("kind", [np.uint8, np.int16, np.uint16, np.int32, np.float32])
@pytest.mark.parametrize(("slope", "intercept"), [(0.5, -100.0), (2.0, 0.0), (0.0, 7.0), (1.0, 3.0)])
def test_scaled_nifti_voxels_are_what_they_stand_for(oblique, tmp_path, kind, slope, intercept):
    stored = (oblique.voxels % 200).astype(kind)
    made = nifti_of(Image(stored, oblique.affine_mm))
    nibabel.save(made, tmp_path / "a.nii")
    data = bytearray((tmp_path / "a.nii").read_bytes())
    data[112:120] = np.array([slope, intercept], "<f4").tobytes()
    (tmp_path / "a.nii").write_bytes(bytes(data))
    expected = stored * slope + intercept if slope else stored
    np.testing.assert_allclose(read_image(tmp_path / "a.nii").voxels, expected, rtol=1e-6)


@pytest.mark.parametrize("unit", ["meter", "mm", "micron"])
def test_nifti_units_become_mm(oblique, tmp_path, unit):
    factor = {"meter": 1e-3, "mm": 1.0, "micron": 1e3}[unit]
    affine = np.diag([factor] * 3 + [1.0]) @ oblique.affine_mm
    made = nifti_of(Image(oblique.voxels, affine))
    made.header.set_xyzt_units(unit)
    nibabel.save(made, tmp_path / "a.nii")
    np.testing.assert_allclose(read_image(tmp_path / "a.nii").affine_mm, oblique.affine_mm, atol=1e-5)


@pytest.mark.parametrize(("name", "packs"), [("a.nii.gz", bytes), ("a.nii", gzip.compress)])
def test_the_first_bytes_say_whether_nifti_is_packed(oblique, tmp_path, name, packs):
    nibabel.save(nifti_of(oblique), tmp_path / "plain.nii")
    (tmp_path / name).write_bytes(packs((tmp_path / "plain.nii").read_bytes()))
    np.testing.assert_array_equal(read_image(tmp_path / name).voxels, oblique.voxels)


def framed(oblique, tmp_path, **fields):
    """Write a NIfTI file with a quaternion, and return it after some bytes of its header were changed."""
    made = nifti_of(oblique, code=fields.pop("code", 0))
    made.header.set_qform(np.diag([-1.0, -1.0, 1.0, 1.0]) @ oblique.affine_mm, code=1)
    made.header.set_xyzt_units("mm")
    for key, value in fields.items():
        made.header[key] = value
    (tmp_path / "a.nii").write_bytes(made.header.binaryblock + bytes(4) + np.asarray(oblique.voxels).tobytes(order="F"))
    data = bytearray((tmp_path / "a.nii").read_bytes())
    data[108:112], data[344:348] = np.float32(352).tobytes(), b"n+1\0"
    (tmp_path / "a.nii").write_bytes(bytes(data))
    return tmp_path / "a.nii"


@pytest.mark.parametrize("sign", [0.0, 1.0, 0.5])
def test_a_quaternion_needs_no_sign(oblique, tmp_path, sign):
    pixdim = [sign, *SPACING, 1, 1, 1, 1]
    image = read_image(framed(oblique, tmp_path, pixdim=pixdim))
    np.testing.assert_allclose(image.affine_mm, oblique.affine_mm, atol=2e-6)


def test_the_sign_of_a_quaternion_mirrors_the_third_axis(oblique, tmp_path):
    image = read_image(framed(oblique, tmp_path, pixdim=[-1.0, *SPACING, 1, 1, 1, 1]))
    np.testing.assert_allclose(image.affine_mm, oblique.affine_mm @ np.diag([1, 1, -1, 1]), atol=2e-6)


@pytest.mark.parametrize("length", [1 + 1e-7, 1 + 1e-4, 1.2])
def test_a_quaternion_that_rounds_to_more_than_1_is_scaled(oblique, tmp_path, length):
    turned = dict(zip(("quatern_b", "quatern_c", "quatern_d"), length * np.array([0.6, 0.0, 0.8]), strict=True))
    image = read_image(framed(oblique, tmp_path, **turned))
    half_turn = Rotation.from_rotvec(np.pi * np.array([0.6, 0.0, 0.8])).as_matrix()
    expected = np.diag([-1.0, -1.0, 1.0]) @ half_turn * SPACING
    np.testing.assert_allclose(image.affine_mm[:3, :3], expected, atol=1e-6)


@pytest.mark.parametrize("time", [0, 8, 24, 56, 128])
def test_units_of_time_do_not_matter_and_undefined_lengths_are_refused(oblique, tmp_path, time):
    image = read_image(framed(oblique, tmp_path, xyzt_units=2 + time))
    np.testing.assert_allclose(image.affine_mm, oblique.affine_mm, atol=2e-6)
    file = framed(oblique, tmp_path, xyzt_units=5 + time)
    with pytest.raises(UnitError, match="length unit 5, which NIfTI does not define"):
        read_image(file)
    np.testing.assert_allclose(read_image(file, spacing_mm=[0.5]).spacing_mm, 0.5)


@pytest.mark.parametrize("fields", [{"quatern_b": np.nan}, {"pixdim": [7, *SPACING, 1, 1, 1, 1]}, {"quatern_c": 9.0}])
def test_beside_a_sound_sform_a_faulty_quaternion_does_not_matter(oblique, tmp_path, fields):
    image = read_image(framed(oblique, tmp_path, code=1, **fields))
    np.testing.assert_allclose(image.affine_mm, oblique.affine_mm, atol=2e-6)


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({}, ""),
        ({"pixdim": [-1.0, *SPACING, 1, 1, 1, 1]}, "mirror each other: check left and right"),
        ({"qoffset_x": 99.0}, "differ by"),
    ],
)
def test_two_frames_that_differ_are_reported(oblique, tmp_path, fields, said):
    image = read_image(framed(oblique, tmp_path, code=1, **fields))
    np.testing.assert_allclose(image.affine_mm, oblique.affine_mm, atol=2e-6)
    assert [said in note for note in image.notes] == ([True] if said else [])


def test_nifti_without_a_frame_has_its_voxel_axes(oblique, tmp_path):
    nibabel.save(nifti_of(oblique, code=0), tmp_path / "a.nii")
    expected = np.diag([*oblique.spacing_mm, 1.0])
    np.testing.assert_allclose(read_image(tmp_path / "a.nii").affine_mm, expected, rtol=1e-6)


def blob(shape=(30, 28, 26)):
    """Return a smooth blob (i, j, k) off the center."""
    i, j, k = np.meshgrid(*[np.arange(n) for n in shape], indexing="ij")
    return (1000 * np.exp(-((i - 16) ** 2 + (j - 12) ** 2 + (k - 14) ** 2) / 30)).astype(np.float32)


def blob_in_mm(image):
    """Return integral and center of mass in mm of an image's values."""
    weight = image.voxels.ravel().astype(float)
    index = np.stack(np.unravel_index(np.arange(weight.size), image.voxels.shape), axis=1)
    volume = abs(np.linalg.det(image.affine_mm[:3, :3]))
    return weight.sum() * volume, np.average(image.to_mm(index), axis=0, weights=weight)


@pytest.mark.parametrize("suffix", [".nii", ".nrrd"])
@pytest.mark.parametrize("shear", [0.2, -0.15])
@pytest.mark.parametrize("place", [(0, 1), (1, 2), (0, 2)])
def test_a_large_shear_is_resampled_and_keeps_volume_and_place(tmp_path, suffix, shear, place):
    edges = np.diag([0.4, 0.5, 0.6])
    edges[place] = shear * edges[place[1], place[1]]
    sheared = Image(blob(), np.block([[edges, np.array([[5.0], [-7], [9]])], [np.zeros((1, 3)), 1]]))
    if suffix == ".nii":
        nibabel.save(nifti_of(sheared), tmp_path / "a.nii")
    else:
        SimpleITK.WriteImage(itk_scan(sheared), str(tmp_path / "a.nrrd"))
    image = read_image(tmp_path / f"a{suffix}")
    axes = image.affine_mm[:3, :3] / image.spacing_mm
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-9)
    whole, center = blob_in_mm(sheared)
    found, moved = blob_in_mm(image)
    assert found == pytest.approx(whole, rel=2e-3)
    np.testing.assert_allclose(moved, center, atol=0.01)
    assert "not perpendicular" in image.notes[-1]
    assert "resampled" in image.notes[-1]


def test_a_small_shear_takes_the_nearest_frame_and_says_how_far_it_moves(tmp_path):
    edges = np.diag([0.5, 0.5, 0.5])
    edges[0, 1] += 0.004 * 0.5
    sheared = Image(blob(), np.block([[edges, np.zeros((3, 1))], [np.zeros((1, 3)), 1]]))
    nibabel.save(nifti_of(sheared), tmp_path / "a.nii")
    image = read_image(tmp_path / "a.nii")
    np.testing.assert_array_equal(image.voxels, sheared.voxels)
    axes = image.affine_mm[:3, :3] / image.spacing_mm
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-9)
    corners = np.array(np.meshgrid(*[[0, n - 1] for n in image.voxels.shape])).reshape(3, -1).T
    moved_mm = np.linalg.norm(image.to_mm(corners) - sheared.to_mm(corners), axis=1).max()
    assert f"by at most {moved_mm:.2f} mm" in image.notes[-1]


@pytest.mark.parametrize("field", [("dim", [3, 10, 0, 5, 1, 1, 1, 1]), ("datatype", 2048), ("vox_offset", 1e12)])
def test_a_nifti_header_that_cannot_be_is_refused(oblique, tmp_path, field):
    made = nifti_of(oblique)
    head = made.header.copy()
    head[field[0]] = field[1]
    (tmp_path / "a.nii").write_bytes(head.binaryblock + bytes(4) + np.asarray(oblique.voxels).tobytes(order="F"))
    with pytest.raises(ReadError, match=r"a\.nii"):
        read_image(tmp_path / "a.nii")


def test_vtk_images_are_read_with_their_frame(oblique, tmp_path):
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

    data = vtkImageData()
    data.SetDimensions(oblique.voxels.shape)
    data.SetSpacing(oblique.spacing_mm)
    data.SetOrigin(oblique.affine_mm[:3, 3])
    data.SetDirectionMatrix((oblique.affine_mm[:3, :3] / oblique.spacing_mm).ravel())
    data.GetPointData().SetScalars(numpy_to_vtk(np.asarray(oblique.voxels).ravel(order="F"), deep=True))
    writer = vtkXMLImageDataWriter()
    writer.SetFileName(str(tmp_path / "a.vti"))
    writer.SetInputData(data)
    writer.Write()
    image = read_image(tmp_path / "a.vti")
    np.testing.assert_array_equal(image.voxels, oblique.voxels)
    np.testing.assert_allclose(image.affine_mm, oblique.affine_mm, atol=1e-9)
    (tmp_path / "b.vti").write_bytes((tmp_path / "a.vti").read_bytes()[:300])
    with pytest.raises(ReadError, match=r"b\.vti is damaged"):
        read_image(tmp_path / "b.vti")


def vtk_image(image, path, *, is_legacy=False):
    """Write a VTK image along the axes; return its file."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkStructuredPoints
    from vtkmodules.vtkIOLegacy import vtkStructuredPointsWriter
    from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

    data = vtkStructuredPoints()
    data.SetDimensions(image.voxels.shape)
    data.SetSpacing(image.spacing_mm)
    data.SetOrigin(image.affine_mm[:3, 3])
    data.GetPointData().SetScalars(numpy_to_vtk(np.asarray(image.voxels).ravel(order="F"), deep=True))
    writer = vtkStructuredPointsWriter() if is_legacy else vtkXMLImageDataWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(data)
    if is_legacy:
        writer.SetFileTypeToBinary()
    writer.Write()
    return path


@pytest.fixture(scope="module")
def upright(oblique):
    """Return the scan along the axes of the patient."""
    return Image(oblique.voxels, np.block([[np.diag(SPACING), np.ones((3, 1))], [np.zeros((1, 3)), 1]]))


@pytest.mark.parametrize("writer", ["VTK", "ITK"])
def test_an_image_in_legacy_vtk_format_is_a_scan(upright, tmp_path, writer):
    if writer == "VTK":
        vtk_image(upright, tmp_path / "a.vtk", is_legacy=True)
    else:
        SimpleITK.WriteImage(itk_scan(upright), str(tmp_path / "a.vtk"))
    assert not is_surface_file(tmp_path / "a.vtk")
    image = read_image(tmp_path / "a.vtk")
    np.testing.assert_array_equal(image.voxels, upright.voxels)
    np.testing.assert_allclose(image.affine_mm, upright.affine_mm, atol=1e-5)
    with pytest.raises(ReadError, match="is a scan, not a surface"):
        read_surface(tmp_path / "a.vtk")


def header_with(tmp_path, upright, suffix, spacing):
    """Return a scan in whose header the words of the spacing are replaced."""
    file = tmp_path / f"a{suffix}"
    if suffix in (".vti", ".vtk"):
        vtk_image(upright, file, is_legacy=suffix == ".vtk")
        old = rb' Spacing="[^"]*"' if suffix == ".vti" else rb"SPACING [^\n]*\n"
    else:
        SimpleITK.WriteImage(itk_scan(upright), str(file))
        old = rb"ElementSpacing = [^\n]*\n" if suffix == ".mha" else rb"space directions: [^\n]*\n"
    data, n = re.subn(old, spacing.encode(), file.read_bytes(), count=1)
    assert n == 1
    file.write_bytes(data)
    return file


@pytest.mark.parametrize(
    ("suffix", "spacing"),
    [
        (".vti", ""),
        (".vti", ' Spacings="0.2 0.2 0.4"'),
        (".vti", ' spacing="0.2 0.2 0.4"'),
        (".vti", ' Spacing="0,28 0,28 0,28"'),
        (".vti", ' Spacing="nan 1 1"'),
        (".vti", ' Spacing="0.28"'),
        (".vti", ' Spacing="0.28 0.28 0"'),
        (".vti", ' Spacing="inf 0.28 0.28"'),
        (".vti", ' Spacing="1_0 1_0 1_0"'),
        (".vtk", ""),
        (".vtk", "SPACINGS 0.2 0.2 0.4\n"),
        (".vtk", "SPACING 0,2 0,2 0,4\n"),
        (".mha", ""),
        (".mha", "elementspacing = 0.2 0.2 0.4\n"),
        (".mha", "ELEMENTSPACING = 0.2 0.2 0.4\n"),
        (".mha", "ElementSpacings = 0.2 0.2 0.4\n"),
        (".mha", "written by a script\nElementSpacing = 0.2 0.2 0.4\n"),
        (".mha", "ElementSpacing = nan 0.2 0.4\n"),
        (".mha", "ElementSpacing = 0.2 0.2 0.4\nElementSpacing = 1 1 1\n"),
        (".mha", "ElementSpacing = 0,2 0,2 0,4\n"),
        (".nrrd", "space directions: (0.2,0,0) (0,0.2,0) none\n"),
        (".nrrd", "space directions: none (0,0.2,0) (0,0,0.4)\n"),
        (".nrrd", "space directions: (0.2,0,0) (0,nan,0) (0,0,0.4)\n"),
        (".nrrd", "# space directions: (0.2,0,0) (0,0.2,0) (0,0,0.4)\n"),
        (".nrrd", "spacings: 0.2 0.2 nan\n"),
    ],
)
def test_a_spacing_that_is_not_known_is_an_error(upright, tmp_path, suffix, spacing):
    file = header_with(tmp_path, upright, suffix, spacing)
    with pytest.raises(InputError) as caught:
        read_image(file)
    assert re.search("does not state a voxel spacing|is damaged|which readers skip|twice", str(caught.value))


@pytest.mark.parametrize("key", ["Offset", "TransformMatrix"])
@pytest.mark.parametrize("spoil", [b"a note\n%s", b"%s"])
def test_a_place_that_itk_skips_is_an_error(upright, tmp_path, key, spoil):
    file = tmp_path / "a.mha"
    SimpleITK.WriteImage(itk_scan(upright), str(file))
    name = key.encode() if spoil != b"%s" else key.lower().encode()
    file.write_bytes(file.read_bytes().replace(key.encode(), spoil % name, 1))
    with pytest.raises(ReadError, match="the line 'a note'" if spoil != b"%s" else f"Write {key}"):
        read_image(file)


@pytest.mark.parametrize(
    ("unit", "mm"), [("cm", 10.0), ("m", 1e3), ("um", 1e-3), ("\u00b5m", 1e-3), ("mm", 1.0), ("", 1.0)]
)
@pytest.mark.parametrize("suffix", [".nrrd", ".mha", "spacings.nrrd"])
def test_units_in_a_header_are_obeyed(upright, tmp_path, suffix, unit, mm):
    affine = upright.affine_mm.copy()
    affine[:3] /= mm
    file = tmp_path / f"a{suffix}"
    SimpleITK.WriteImage(itk_scan(Image(upright.voxels, affine)), str(file))
    words = " ".join([f'"{unit}"'] * 3)
    data = file.read_bytes()
    if suffix == ".mha":
        data = data.replace(b"DimSize", f"DistanceUnits = {unit}\nDimSize".encode())
    elif suffix == ".nrrd":
        data = data.replace(b"kinds:", f"space units: {words}\nkinds:".encode())
    else:
        lengths = " ".join(f"{v:.9g}" for v in SPACING / mm)
        data = re.sub(rb"space: [^\n]*\n|space origin: [^\n]*\n", b"", data)
        data = re.sub(rb"space directions: [^\n]*\n", f"spacings: {lengths}\nunits: {words}\n".encode(), data)
    file.write_bytes(data)
    if suffix == ".mha" and not unit:
        return  # MetaImage has no such empty field
    image = read_image(file)
    np.testing.assert_allclose(image.spacing_mm, SPACING, rtol=1e-6)
    if suffix != "spacings.nrrd":
        np.testing.assert_allclose(image.affine_mm, upright.affine_mm, rtol=1e-6)


def test_an_unknown_unit_is_an_error_unless_the_spacing_is_given(upright, tmp_path):
    file = header_with(
        tmp_path, upright, ".nrrd", 'space units: "pixel" "pixel" "pixel"\nspace directions: (1,0,0) (0,1,0) (0,0,1)\n'
    )
    with pytest.raises(UnitError, match='lengths in "pixel"'):
        read_image(file)
    np.testing.assert_allclose(read_image(file, spacing_mm=[0.2]).spacing_mm, 0.2)


OUTSIDE = [
    "/etc/passwd",
    "../a.raw",
    "in/../../a.raw",
    r"C:\\a.raw",
    r"..\a.raw",
    "../s%02d.raw 0 3 1",
    "LIST\n../a.raw",
]


@pytest.mark.parametrize("name", OUTSIDE)
@pytest.mark.parametrize("suffix", [".mhd", ".mha", ".nhdr", ".nrrd"])
def test_only_voxel_files_beside_a_header_are_read(tmp_path, suffix, name):
    (tmp_path / "here").mkdir()
    (tmp_path / "a.raw").write_bytes(bytes(128))
    scan = tmp_path / "here" / f"scan{suffix}"
    scan.write_text(
        META.format(f"ElementDataFile = {name}\n") if suffix[1] == "m" else NRRD.format(f"data file: {name}\n")
    )
    for read in (read_image, files_of):
        with pytest.raises(ReadError, match=r"Only files beside it or below are read"):
            read(scan)


@pytest.mark.parametrize("separator", [" : ", ":", "=", " = "])
def test_every_separator_of_a_header_is_watched(tmp_path, separator):
    scan = tmp_path / "scan.mhd"
    scan.write_text(META.format(f"ElementDataFile{separator}/etc/passwd\n"))
    with pytest.raises(ReadError, match=r"Only files beside it"):
        read_image(scan)


def test_a_header_that_does_not_end_is_damaged(tmp_path):
    scan = tmp_path / "scan.nrrd"
    scan.write_bytes(NRRD.format("# ").encode() + b"x" * (1 << 20) + b"\ndata file: /etc/passwd\n")
    with pytest.raises(ReadError, match="its header does not end"):
        read_image(scan)


def test_segments_in_several_layers_are_united(upright, tmp_path):
    layers = np.stack([upright.voxels > 900, upright.voxels < -300], axis=-1).astype(np.uint8)
    scan = SimpleITK.GetImageFromArray(np.ascontiguousarray(layers.transpose(2, 1, 0, 3)), isVector=True)
    scan.SetSpacing(SPACING.tolist())
    SimpleITK.WriteImage(scan, str(tmp_path / "a.seg.nrrd"))
    file = tmp_path / "a.seg.nrrd"
    with pytest.raises(ReadError, match="2 values per voxel"):
        read_image(file)
    file.write_bytes(file.read_bytes().replace(b"\n\n", b"\nSegment0_Layer:=0\nSegment1_Layer:=1\n\n", 1))
    image = read_image(file)
    np.testing.assert_array_equal(image.voxels, layers.any(axis=-1))
    assert image.notes == ("The segments in 2 layers of the file are united.",)


META = "ObjectType = Image\nNDims = 3\nElementSpacing = 1 1 1\nDimSize = 4 4 4\nElementType = MET_SHORT\n{}"
NRRD = "NRRD0004\ntype: short\ndimension: 3\nsizes: 4 4 4\nendian: little\nencoding: raw\nspacings: 1 1 1\n{}"
VOXELS_APART = {
    "one file": ("my voxels.raw", ["my voxels.raw"]),
    "a list": ("LIST\nin/s 0.raw\nin/s 1.raw\nin/s 2.raw\nin/s 3.raw", [f"in/s {k}.raw" for k in range(4)]),
    "a pattern": ("s%02d.raw 0 3 1", [f"s{k:02d}.raw" for k in range(4)]),
}


@pytest.mark.parametrize("name", VOXELS_APART)
@pytest.mark.parametrize(
    ("suffix", "head"),
    [
        (".mhd", META.format("ElementDataFile = ")),
        (".mha", META.format("elementdatafile=")),
        (".nhdr", NRRD.format("data file: ")),
        (".nrrd", NRRD.format("datafile: ")),
    ],
)
def test_voxels_apart_from_their_header_are_among_the_files(tmp_path, suffix, head, name):
    voxels = np.arange(64, dtype="<i2").reshape(4, 4, 4)
    said, parts = VOXELS_APART[name]
    (tmp_path / "in").mkdir()
    (tmp_path / "s.raw").write_bytes(b"none of them")
    for part, data in zip(parts, np.split(voxels, len(parts), axis=0), strict=True):
        (tmp_path / part).write_bytes(data.tobytes())
    scan = tmp_path / f"scan{suffix}"
    scan.write_text(f"{head}{said}\n")
    if suffix != ".mha":  # ITK knows its keys in one spelling
        np.testing.assert_array_equal(read_image(scan).voxels, voxels.T)
    assert files_of(scan) == [scan, *(tmp_path / part for part in parts)]
    (tmp_path / parts[-1]).unlink()
    assert files_of(scan) == [scan, *(tmp_path / part for part in parts[:-1])]


@pytest.mark.parametrize("name", ["scan.mha", "scan.nrrd", "scan.nii.gz", "scan.raw", "artery.stl"])
def test_what_holds_its_voxels_itself_is_one_file(oblique, tmp_path, name):
    (tmp_path / name).write_text("ElementDataFile of nobody")
    if name in ("scan.mha", "scan.nrrd", "scan.nii.gz"):
        SimpleITK.WriteImage(itk_scan(oblique), str(tmp_path / name))
    assert files_of(tmp_path / name) == [tmp_path / name]


@pytest.mark.parametrize("name", ["", "gone.raw", "a\0b", "%d\0/%d", "%d" + "/x" * 5000, "x" * 60_000, ".", "100%"])
def test_odd_names_of_voxels_are_not_among_the_files(tmp_path, name):
    scan = tmp_path / "scan.mhd"
    scan.write_text(META.format(f"ElementDataFile = {name}\n"))
    assert files_of(scan) == [scan]


def test_nifti_without_pixel_sizes_is_refused(oblique, tmp_path):
    file = tmp_path / "scan.nii"
    SimpleITK.WriteImage(itk_scan(oblique), str(file))
    data = bytearray(file.read_bytes())
    data[80:92] = bytes(12)
    file.write_bytes(bytes(data))
    np.testing.assert_allclose(read_image(file).affine_mm, oblique.affine_mm, atol=1e-5)  # of its sform
    data[254:256] = bytes(2)  # which it no longer has
    file.write_bytes(bytes(data))
    with pytest.raises(UnitError, match="does not state a voxel spacing"):
        read_image(file)


def test_nifti_with_two_spacings_is_refused(oblique, tmp_path):
    file = tmp_path / "scan.nii"
    SimpleITK.WriteImage(itk_scan(oblique), str(file))
    data = bytearray(file.read_bytes())
    for edge, is_refused in ((1.0, False), (3.0, True)):  # 1 mm is what a header holds before it is set
        data[80:92] = np.full(3, edge, dtype="<f4").tobytes()
        file.write_bytes(bytes(data))
        if is_refused:
            with pytest.raises(UnitError, match=r"states two voxel spacings, 3 x 3 x 3 \(pixdim\) and .* \(sform\)"):
                read_image(file)
        else:
            np.testing.assert_allclose(read_image(file).affine_mm, oblique.affine_mm, atol=1e-5)


def test_a_spacing_in_a_comment_is_not_known(upright, tmp_path):
    file = header_with(tmp_path, upright, ".vti", "")
    text = file.read_bytes().replace(b"<ImageData", b'<!-- <ImageData Spacing="0.2 0.2 0.4"> --><ImageData', 1)
    file.write_bytes(text)
    with pytest.raises(UnitError, match="does not state a voxel spacing"):
        read_image(file)


@pytest.mark.parametrize(("size_mm", "ok"), [(1e-4, False), (0.15, True), (30.0, False)])
def test_voxels_that_no_scan_has_are_refused(oblique, tmp_path, size_mm, ok):
    SimpleITK.WriteImage(itk_scan(Image(oblique.voxels, np.diag([size_mm] * 3 + [1.0]))), str(tmp_path / "a.mha"))
    if ok:
        np.testing.assert_allclose(read_image(tmp_path / "a.mha").spacing_mm, size_mm)
    else:
        with pytest.raises(UnitError, match="no scan of a head has"):
            read_image(tmp_path / "a.mha")


def test_colours_and_time_are_refused(tmp_path):
    SimpleITK.WriteImage(
        SimpleITK.GetImageFromArray(np.zeros((3, 4, 5, 3), np.uint8), isVector=True), str(tmp_path / "rgb.nrrd")
    )
    with pytest.raises(ReadError, match="3 values per voxel"):
        read_image(tmp_path / "rgb.nrrd", spacing_mm=[1])
    SimpleITK.WriteImage(
        SimpleITK.GetImageFromArray(np.zeros((2, 3, 4, 5), np.int16), isVector=False), str(tmp_path / "t.nii")
    )
    with pytest.raises(ReadError, match="4 dimensions"):
        read_image(tmp_path / "t.nii", spacing_mm=[1])


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz", "a.nrrd", "a.mha", "a.mhd", "a.xyz", "a.dcm"])
def test_text_is_refused_in_one_sentence_and_silence(tmp_path, capfd, name):
    (tmp_path / name).write_text("this is not an image, whatever its name says")
    with pytest.raises(ReadError, match=name) as caught:
        read_image(tmp_path / name)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


def test_nothing_there_is_refused(tmp_path):
    with pytest.raises(ReadError, match="does not exist"):
        read_image(tmp_path / "nowhere")
    with pytest.raises(ReadError, match="no DICOM images"):
        read_image(tmp_path)


# -- raw ---------------------------------------------------------------------------------------------------------------


def test_raw_voxels_have_no_orientation_and_no_result_of_them_states_one(tmp_path):
    """Left and right cannot be known: neither the scan nor the vessel found in it says that they are."""
    grid = np.indices((24, 24, 24)) - 11.5
    voxels = np.where(np.hypot(grid[0], grid[1]) < 6, 900, 100).astype(np.int16)
    (tmp_path / "a.raw").write_bytes(voxels.transpose().tobytes())
    image = read_image(tmp_path / "a.raw", spacing_mm=[0.5], shape=voxels.shape)
    assert not image.is_oriented
    assert not segment(image, threshold=500.0).is_oriented
    assert segment(replace(image, is_oriented=True), threshold=500.0).is_oriented


@pytest.mark.parametrize("kind", ["u1", "<i2", ">i2", "<f4", ">f4"])
def test_raw_voxels_run_fastest_along_i_and_their_kind_is_guessed(tmp_path, kind):
    i, j, k = np.meshgrid(np.arange(6), np.arange(5), np.arange(4), indexing="ij")
    expected = i + 20 * j + 30 * k + (0.5 if "f" in kind else 0)
    (tmp_path / "a.raw").write_bytes(expected.astype(kind).tobytes(order="F"))
    image = read_image(tmp_path / "a.raw", shape=(6, 5, 4), spacing_mm=[0.2, 0.3, 0.4])
    np.testing.assert_array_equal(image.voxels, expected)
    np.testing.assert_allclose(image.spacing_mm, [0.2, 0.3, 0.4])
    assert image.voxels.dtype == np.dtype(kind).newbyteorder("=")
    assert np.dtype(kind).newbyteorder("=").name in image.notes[0]


def test_raw_needs_spacing_shape_and_as_many_bytes(tmp_path):
    file = tmp_path / "a.raw"
    file.write_bytes(bytes(120))
    with pytest.raises(UnitError, match="--spacing"):
        read_image(file, shape=(6, 5, 4))
    with pytest.raises(ReadError, match="--shape"):
        read_image(file, spacing_mm=[0.3])
    with pytest.raises(ReadError, match="120 bytes"):
        read_image(file, shape=(7, 5, 4), spacing_mm=[0.3])
    with pytest.raises(ReadError, match=r"int16 are 240"):
        read_image(file, shape=(6, 5, 4), spacing_mm=[0.3], dtype="i2")
    with pytest.raises(UnitError, match="positive"):
        read_image(file, shape=(6, 5, 4), spacing_mm=[0.3, -1, 0.3])


def test_real_raw_scan(shared_data):
    image = read_image(shared_data / "philips_3dra_256.raw.gz", shape=(256, 256, 256), spacing_mm=[0.43])
    assert image.voxels.dtype == np.uint8
    i, j, k = np.ogrid[:256, :256, :256]
    in_sac = (i - 110) ** 2 + (j - 106) ** 2 + (k - 160) ** 2 < 9**2
    assert np.mean(image.voxels[in_sac] > 120) > 0.98


@pytest.mark.parametrize("given", [".img", ".hdr"])
@pytest.mark.parametrize("is_analyze", [False, True])
def test_a_pair_of_header_and_voxels_is_read_from_either_file(tmp_path, given, is_analyze):
    from nibabel import Nifti1Pair, Spm99AnalyzeImage

    affine = np.array([[-0.3, 0, 0, 4], [0, -0.4, 0, 5], [0, 0, 0.5, 6], [0, 0, 0, 1.0]])  # RAS
    kind = Spm99AnalyzeImage if is_analyze else Nifti1Pair
    kind(np.asarray(scan().voxels, dtype=np.int16), affine).to_filename(tmp_path / "a.img")
    (tmp_path / "a.mat").unlink(missing_ok=True)
    image = read_image(tmp_path / f"a{given}")
    np.testing.assert_array_equal(image.voxels, scan().voxels)
    np.testing.assert_allclose(image.spacing_mm, [0.3, 0.4, 0.5], rtol=1e-6)
    assert image.is_oriented is not is_analyze
    assert len(image.notes) == is_analyze
    if not is_analyze:
        np.testing.assert_allclose(image.affine_mm, np.diag([-1, -1, 1, 1]) @ affine, atol=1e-6)
    assert set(files_of(tmp_path / f"a{given}")) == {tmp_path / "a.hdr", tmp_path / "a.img"}
    (tmp_path / "a.img").write_bytes((tmp_path / "a.img").read_bytes()[:-1])
    with pytest.raises(ReadError, match="breaks off"):
        read_image(tmp_path / f"a{given}")
    (tmp_path / f"a{'.hdr' if given == '.img' else '.img'}").unlink()
    with pytest.raises(ReadError, match="does not exist"):
        read_image(tmp_path / f"a{given}")


@pytest.mark.parametrize("is_even", [True, False])
@pytest.mark.parametrize("suffix", [".vtr", ".vtk"])
def test_rectilinear_grids_with_even_steps_are_scans(tmp_path, suffix, is_even):
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkRectilinearGrid
    from vtkmodules.vtkIOLegacy import vtkRectilinearGridWriter
    from vtkmodules.vtkIOXML import vtkXMLRectilinearGridWriter

    voxels, data = np.asarray(scan().voxels), vtkRectilinearGrid()
    data.SetDimensions(voxels.shape)
    places = [
        first + step * np.arange(n) for first, step, n in zip((1, 2, 3), (0.3, 0.4, 0.5), voxels.shape, strict=True)
    ]
    if not is_even:
        places[1][3] += 0.01
    for put, values in zip((data.SetXCoordinates, data.SetYCoordinates, data.SetZCoordinates), places, strict=True):
        put(numpy_to_vtk(values, deep=True))
    data.GetPointData().SetScalars(numpy_to_vtk(voxels.ravel(order="F"), deep=True))
    writer = (vtkXMLRectilinearGridWriter if suffix == ".vtr" else vtkRectilinearGridWriter)()
    writer.SetInputData(data)
    writer.SetFileName(str(tmp_path / f"a{suffix}"))
    writer.Write()
    if not is_even:
        with pytest.raises(ReadError, match="uneven spacing"):
            read_image(tmp_path / f"a{suffix}")
        return
    image = read_image(tmp_path / f"a{suffix}")
    np.testing.assert_array_equal(image.voxels, voxels)
    np.testing.assert_allclose(
        image.affine_mm, [[0.3, 0, 0, 1], [0, 0.4, 0, 2], [0, 0, 0.5, 3], [0, 0, 0, 1]], atol=1e-6
    )
