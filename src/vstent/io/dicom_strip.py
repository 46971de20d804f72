"""Remove patient data from DICOM files: only the elements needed to read the voxels are kept."""

from pathlib import Path
from typing import Any, Final

from vstent.errors import ReadError
from vstent.io.dicom import damage, is_directory, load, quiet
from vstent.io.files import atomic

KEPT: Final = frozenset(
    """
    SOPClassUID Modality Rows Columns NumberOfFrames PixelSpacing SliceThickness SpacingBetweenSlices
    ImagePositionPatient ImageOrientationPatient BitsAllocated BitsStored HighBit PixelRepresentation SamplesPerPixel
    PhotometricInterpretation PlanarConfiguration RescaleSlope RescaleIntercept SharedFunctionalGroupsSequence
    PerFrameFunctionalGroupsSequence PlanePositionSequence PlaneOrientationSequence PixelMeasuresSequence
    PixelValueTransformationSequence PixelPaddingValue PixelPaddingRangeLimit AcquisitionNumber
    ImageType SeriesNumber TemporalPositionIdentifier TriggerTime EchoTime PixelData FloatPixelData DoubleFloatPixelData
    """.split()
)
"""Elements needed to read a volume; none identifies the patient."""
RENAMED: Final = ("SeriesInstanceUID", "SOPInstanceUID")
"""Identifiers of series and image; they are replaced by digests."""


def strip_dicom(path: Path, out: Path) -> None:
    """Write a copy of a DICOM file with only the elements needed to read its voxels; none of a DICOMDIR.

    ReadError is raised where the file is damaged.
    """
    from pydicom.dataset import FileMetaDataset
    from pydicom.uid import generate_uid

    if is_directory(path):
        return
    try:
        with quiet():
            given = load(path, with_pixels=True)
            stripped = _stripped(given)
            for name in RENAMED:
                if name in given:
                    setattr(stripped, name, generate_uid(entropy_srcs=[str(given[name].value)]))
            stripped.file_meta = FileMetaDataset()
            stripped.file_meta.TransferSyntaxUID = given.file_meta.TransferSyntaxUID
            stripped.file_meta.MediaStorageSOPClassUID = stripped.SOPClassUID
            stripped.file_meta.MediaStorageSOPInstanceUID = stripped.SOPInstanceUID
            with atomic(out) as partial:
                stripped.save_as(partial, enforce_file_format=True)
    except damage():
        raise ReadError(f"{out.name} is damaged, or not a DICOM image. Copy it again from its source.") from None


def _stripped(given: Any) -> Any:
    """Return a data set with the elements that are kept, also in sequences."""
    from pydicom.dataset import Dataset
    from pydicom.sequence import Sequence

    stripped = Dataset()
    for element in given:
        if element.keyword in KEPT:
            if element.VR == "SQ":
                element.value = Sequence([_stripped(item) for item in element.value])
            stripped.add(element)
    return stripped
