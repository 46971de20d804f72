"""The header that every DICOM file of vstent has: derived, for research, of no patient."""

from typing import Any, Final

MOMENT: Final = ("20000101", "120000")
"""Date and time in files, because equal content must give equal bytes."""


def research_header(sop_class: str, digest: str) -> Any:
    """Return a dataset with identifiers, empty patient fields and one moment, for files of one series."""
    from pydicom.dataset import Dataset, FileMetaDataset
    from pydicom.uid import ExplicitVRLittleEndian, generate_uid

    found = Dataset()
    found.SOPClassUID = sop_class
    found.StudyInstanceUID = generate_uid(entropy_srcs=[digest, "study"])
    found.SeriesInstanceUID = generate_uid(entropy_srcs=[digest, "series"])
    found.file_meta = FileMetaDataset()
    found.file_meta.MediaStorageSOPClassUID = found.SOPClassUID
    found.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    found.PatientBirthDate = found.PatientSex = found.AccessionNumber = found.ReferringPhysicianName = ""
    found.StudyID = found.Laterality = ""
    found.StudyDate = found.SeriesDate = found.AcquisitionDate = found.ContentDate = MOMENT[0]
    found.StudyTime = found.SeriesTime = found.AcquisitionTime = found.ContentTime = MOMENT[1]
    found.Manufacturer, found.BodyPartExamined, found.AcquisitionNumber = "vstent", "HEAD", 1
    return found


def put_instance(found: Any, *entropy: str) -> None:
    """Set the identifier of one file; it follows from the words given."""
    from pydicom.uid import generate_uid

    found.SOPInstanceUID = generate_uid(entropy_srcs=list(entropy))
    found.file_meta.MediaStorageSOPInstanceUID = found.SOPInstanceUID
