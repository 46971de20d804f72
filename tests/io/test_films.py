"""Films as PNG frames, animations and DICOM XA, read back by other libraries."""

import io

import numpy as np
import pydicom
import pytest
import SimpleITK
from PIL import Image

from vstent.errors import ReadError
from vstent.io.films import animation, write_animation, write_frames
from vstent.io.xa_writer import XaHeader, study_of, write_xa

AXES = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])


def header(**more) -> XaHeader:
    return XaHeader(np.radians(-35), np.radians(12.5), AXES, 1100, 750, 0.154, 1 / 7.5, "Before", **more)


def pixels() -> np.ndarray:
    return np.random.default_rng(5).integers(0, 4096, (6, 20, 32)).astype(np.uint16)


@pytest.fixture
def xa(tmp_path):
    write_xa(tmp_path / "film.dcm", pixels(), header())
    return tmp_path / "film.dcm"


def test_pydicom_and_simpleitk_read_equal_pixels(xa):
    assert np.array_equal(pydicom.dcmread(xa).pixel_array, pixels())
    assert np.array_equal(SimpleITK.GetArrayFromImage(SimpleITK.ReadImage(str(xa))), pixels())


def test_the_header_describes_the_arm_and_the_frames(xa):
    film = pydicom.dcmread(xa)
    assert film.SOPClassUID.name == "X-Ray Angiographic Image Storage"
    assert (film.PositionerPrimaryAngle, film.PositionerSecondaryAngle) == (-35, 12.5)
    assert (film.DistanceSourceToDetector, film.DistanceSourceToPatient) == (1100, 750)
    assert list(film.ImagerPixelSpacing) == [0.154, 0.154]
    assert film.EstimatedRadiographicMagnificationFactor == pytest.approx(1100 / 750, abs=1e-6)
    assert film.FrameTime == pytest.approx(1000 / 7.5)
    assert film.FrameIncrementPointer == pydicom.tag.Tag("FrameTime")
    assert (film.NumberOfFrames, film.CineRate, film.RecommendedDisplayFrameRate) == (6, 8, 8)
    assert list(film.PatientOrientation) == ["P", "F"]
    assert list(film.ImageType) == ["DERIVED", "SECONDARY", "SINGLE PLANE"]
    assert (film.PixelIntensityRelationship, film.BurnedInAnnotation) == ("DISP", "NO")
    assert "MaskSubtractionSequence" not in film


REQUIRED = (  # types 1 and 2 of the modules of PS3.3 A.14 that apply
    "PatientName PatientID PatientBirthDate PatientSex StudyInstanceUID StudyDate StudyTime ReferringPhysicianName "
    "StudyID AccessionNumber Modality SeriesInstanceUID SeriesNumber Laterality Manufacturer InstanceNumber "
    "PatientOrientation ContrastBolusAgent FrameTime NumberOfFrames FrameIncrementPointer ImageType "
    "PixelIntensityRelationship SamplesPerPixel PhotometricInterpretation Rows Columns BitsAllocated BitsStored "
    "HighBit PixelRepresentation KVP RadiationSetting XRayTubeCurrent ExposureTime Exposure PositionerMotion "
    "PositionerPrimaryAngle PositionerSecondaryAngle SOPClassUID SOPInstanceUID"
).split()


def test_every_required_field_is_there(xa):
    film = pydicom.dcmread(xa)
    assert [name for name in REQUIRED if name not in film] == []


def test_equal_films_are_equal_bytes_and_others_have_other_numbers(xa, tmp_path):
    write_xa(tmp_path / "again.dcm", pixels(), header())
    write_xa(tmp_path / "other.dcm", pixels(), header(number=2))
    assert xa.read_bytes() == (tmp_path / "again.dcm").read_bytes()
    assert pydicom.dcmread(xa).SOPInstanceUID != pydicom.dcmread(tmp_path / "other.dcm").SOPInstanceUID


def test_a_patient_is_named_only_on_request(xa, tmp_path):
    assert (pydicom.dcmread(xa).PatientID, pydicom.dcmread(xa).PatientIdentityRemoved) == ("RESEARCH", "YES")
    real = pydicom.dcmread(xa)
    real.PatientName, real.PatientID, real.StudyInstanceUID = "Muster^Anna", "0815", "1.2.3.4"
    real.StudyDate, real.OperatorsName = "20260101", "Nobody^Else"
    real.save_as(tmp_path / "real.dcm")
    write_xa(tmp_path / "beside.dcm", pixels(), header(study=study_of(tmp_path / "real.dcm")))
    beside = pydicom.dcmread(tmp_path / "beside.dcm")
    assert (beside.PatientName, beside.PatientID, beside.StudyInstanceUID) == ("Muster^Anna", "0815", "1.2.3.4")
    assert (beside.StudyDate, beside.ContentDate) == ("20260101", "20260101")
    assert "OperatorsName" not in beside
    assert "PatientIdentityRemoved" not in beside
    (tmp_path / "no.dcm").write_bytes(b"nothing")
    with pytest.raises(ReadError, match="is not a DICOM file"):
        study_of(tmp_path / "no.dcm")


def test_values_above_12_bits_are_refused(tmp_path):
    with pytest.raises(ValueError, match="12 bits"):
        write_xa(tmp_path / "film.dcm", np.full((1, 8, 8), 4096, np.uint16), header())
    assert not list(tmp_path.iterdir())


def moving() -> np.ndarray:
    """Return frames with a dark square that moves."""
    frames = np.full((7, 24, 32), 200, np.uint8)
    for k in range(7):
        frames[k, 8:16, 3 * k : 3 * k + 8] = 10
    return frames


def test_frames_are_the_pixels(tmp_path):
    write_frames(tmp_path / "frames", list(moving()))
    write_frames(tmp_path / "frames", list(moving()[:5]))  # an earlier, longer film leaves nothing behind
    names = sorted(path.name for path in (tmp_path / "frames").iterdir())
    assert names == [f"frame_{k:04d}.png" for k in range(1, 6)]
    read = [np.asarray(Image.open(tmp_path / "frames" / name)) for name in names]
    assert np.array_equal(read, moving()[:5])
    assert [path.name for path in tmp_path.iterdir()] == ["frames"]


@pytest.mark.parametrize(("suffix", "error"), [(".png", 0), (".webp", 25)])
def test_animations_have_all_frames_and_their_duration(tmp_path, suffix, error):
    write_animation(tmp_path / f"film{suffix}", list(moving()), 1 / 7.5)
    with Image.open(tmp_path / f"film{suffix}") as film:
        assert film.n_frames == 7
        total_ms = 0
        for k in range(7):
            film.seek(k)
            film.load()
            total_ms += film.info["duration"]
            assert np.abs(np.asarray(film.convert("L")).astype(int) - moving()[k]).max() <= error
    assert total_ms == pytest.approx(7000 / 7.5, abs=1)
    assert Image.open(io.BytesIO(animation(list(moving()), 0.1))).format == "WEBP"
