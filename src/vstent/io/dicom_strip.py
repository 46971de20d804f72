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

    Parameters
    ----------
    path : the file.
    out : the copy to write.

    Raises
    ------
    ReadError
        The file is damaged.
    """
    import pydicom

    if is_directory(path):
        return
    try:
        with quiet():
            given = load(path, with_pixels=True)
            kept = _kept(given)
            for name in RENAMED:
                if name in given:
                    setattr(kept, name, pydicom.uid.generate_uid(entropy_srcs=[str(given[name].value)]))
            kept.file_meta = _meta(given, kept)
            with atomic(out) as partial:
                kept.save_as(partial, enforce_file_format=True)
    except damage():
        raise ReadError(f"{out.name} is damaged, or not a DICOM image. Copy it again from its source.") from None


def _kept(given: Any) -> Any:
    """Return the elements of a data set that are kept, also in sequences."""
    from pydicom.dataset import Dataset
    from pydicom.sequence import Sequence

    kept = Dataset()
    for element in given:
        if element.keyword not in KEPT:
            continue
        if element.VR == "SQ":
            element.value = Sequence([_kept(item) for item in element.value])
        kept.add(element)
    return kept


def _meta(given: Any, kept: Any) -> Any:
    """Return the file meta information of a stripped file."""
    from pydicom.dataset import FileMetaDataset
    from pydicom.uid import ImplicitVRLittleEndian

    meta = FileMetaDataset()
    meta.TransferSyntaxUID = getattr(given.file_meta, "TransferSyntaxUID", ImplicitVRLittleEndian)
    meta.MediaStorageSOPClassUID = kept.SOPClassUID
    meta.MediaStorageSOPInstanceUID = kept.SOPInstanceUID
    return meta
