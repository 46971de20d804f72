"""Write a film as a DICOM X-ray angiographic (XA) multi-frame image."""

import hashlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vstent.errors import ReadError
from vstent.io.dicom_writer import put_instance, research_header
from vstent.io.files import atomic, existing
from vstent.kernels.arrays import Floats

XA_IMAGE_STORAGE: Final = "1.2.840.10008.5.1.4.1.1.12.1"
"""Storage class of X-ray angiographic images (DICOM UID)."""
BITS: Final = 12
"""Bits stored per pixel."""
STUDY_FIELDS: Final = (
    *("PatientName", "PatientID", "PatientBirthDate", "PatientSex", "AccessionNumber", "ReferringPhysicianName"),
    *("StudyInstanceUID", "StudyID", "StudyDate", "StudyTime", "StudyDescription"),
)
"""Fields that are taken from a real examination on request."""


@dataclass(frozen=True, eq=False)
class XaHeader:
    """What the header of a film states."""

    primary_rad: float
    """Primary angle of the positioner, positive LAO."""
    secondary_rad: float
    """Secondary angle of the positioner, positive CRA."""
    axes: Floats
    """(3, 3) unit rows in LPS: right and up in the picture, toward the detector."""
    source_detector_mm: float
    """Distance from source to detector."""
    source_isocenter_mm: float
    """Distance from source to isocenter."""
    pixel_mm: float
    """Edge of a pixel on the detector."""
    frame_time_s: float
    """Time from one frame to the next."""
    series: str
    """Description of the series."""
    number: int = 1
    """Number of the series."""
    derivation: str = ""
    """How the pixels were computed."""
    study: dict[str, Any] = field(default_factory=dict)
    """Fields of patient and study by keyword (`study_of`); empty: none of a patient."""


def study_of(path: Path) -> dict[str, Any]:
    """Return the fields of patient and study of a DICOM file, for a film that is to lie beside it.

    ReadError is raised where the file does not exist or is not DICOM.
    """
    from pydicom import dcmread
    from pydicom.errors import InvalidDicomError

    try:
        header = dcmread(existing(path), stop_before_pixels=True, specific_tags=list(STUDY_FIELDS))
    except InvalidDicomError:
        raise ReadError(f"{path} is not a DICOM file. Give one file of the examination.") from None
    return {name: header.get(name) for name in STUDY_FIELDS if header.get(name) is not None}


def write_xa(path: Path, pixels: NDArray[np.uint16], header: XaHeader) -> None:
    """Write a film as one XA multi-frame file; equal films give equal bytes.

    The image is marked as derived and for research. It names no patient unless `XaHeader.study` does. The pixels
    (f, rows, columns) are from 0 to 4095, black to white; ValueError is raised for larger ones.
    """
    from pydicom.tag import Tag

    if pixels.max(initial=0) >= 1 << BITS:
        raise ValueError(f"a film of {BITS} bits holds values below {1 << BITS}")
    digest = hashlib.sha256(pixels.tobytes() + repr(header).encode()).hexdigest()
    film = research_header(XA_IMAGE_STORAGE, digest)
    put_instance(film, digest, "instance")
    film.PatientName, film.PatientID = "Research^vstent", "RESEARCH"
    for name, value in header.study.items():
        setattr(film, name, value)
    if not header.study:
        film.PatientIdentityRemoved, film.DeidentificationMethod = "YES", "computed: no field of a patient was read"
    film.Modality = "XA"
    film.ManufacturerModelName = "vstent virtual angiogram, research only"
    film.SeriesDescription, film.SeriesNumber, film.InstanceNumber = header.series, header.number, 1
    film.SeriesDate = film.AcquisitionDate = film.ContentDate = film.StudyDate
    film.SeriesTime = film.AcquisitionTime = film.ContentTime = film.StudyTime
    film.ImageType = ["DERIVED", "SECONDARY", "SINGLE PLANE"]
    film.DerivationDescription = header.derivation
    film.ImageComments = "Computed from a flow simulation, for research only"
    film.BurnedInAnnotation, film.LossyImageCompression = "NO", "00"
    film.ContrastBolusAgent, film.ContrastBolusIngredient = "Computed contrast agent", "IODINE"
    # Modules X-Ray Acquisition and XA Positioner; no radiation was used, so that exposure is empty.
    film.KVP = film.XRayTubeCurrent = film.ExposureTime = film.Exposure = None
    film.RadiationSetting, film.PositionerMotion = "GR", "STATIC"
    film.PositionerPrimaryAngle = f"{np.degrees(header.primary_rad):.4f}"
    film.PositionerSecondaryAngle = f"{np.degrees(header.secondary_rad):.4f}"
    film.DistanceSourceToDetector = f"{header.source_detector_mm:.4f}"
    film.DistanceSourceToPatient = f"{header.source_isocenter_mm:.4f}"
    film.EstimatedRadiographicMagnificationFactor = f"{header.source_detector_mm / header.source_isocenter_mm:.6f}"
    film.ImagerPixelSpacing = [f"{header.pixel_mm:.6f}"] * 2
    film.PatientOrientation = [_letters(header.axes[0]), _letters(-header.axes[1])]
    # Modules Image Pixel, Multi-frame, Cine, X-Ray Image and VOI LUT.
    film.SamplesPerPixel, film.PhotometricInterpretation = 1, "MONOCHROME2"
    film.NumberOfFrames, film.Rows, film.Columns = pixels.shape
    film.BitsAllocated, film.BitsStored, film.HighBit, film.PixelRepresentation = 16, BITS, BITS - 1, 0
    film.PixelIntensityRelationship = "DISP"  # subtracted and ready for display; no Modality LUT belongs to it
    film.FrameIncrementPointer = Tag("FrameTime")
    film.FrameTime = f"{1000.0 * header.frame_time_s:.6f}"
    film.CineRate = film.RecommendedDisplayFrameRate = max(1, round(1.0 / header.frame_time_s))
    film.PreferredPlaybackSequencing = 0
    film.WindowCenter, film.WindowWidth = str(1 << (BITS - 1)), str(1 << BITS)
    film.PixelData = np.ascontiguousarray(pixels, dtype="<u2").tobytes()
    with atomic(path) as partial:
        film.save_as(partial, enforce_file_format=True, overwrite=True)


def _letters(direction: Floats) -> str:
    """Return the letters of a direction in LPS, the largest component first; small ones are left out."""
    order = [k for k in np.argsort(-np.abs(direction)) if abs(direction[k]) > 0.1]
    return "".join(("LR", "PA", "HF")[k][int(direction[k] < 0)] for k in order)
