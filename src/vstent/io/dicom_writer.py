"""Write DICOM files, marked as derived and for research: an `Image` as a series, the input of ``vstent demo``."""

import hashlib
from pathlib import Path
from typing import Any, Final

import numpy as np

from vstent.geometry.image import Image
from vstent.io.files import atomic_folder

CT_IMAGE_STORAGE: Final = "1.2.840.10008.5.1.4.1.1.2"
"""Storage class in which reconstructed rotational angiograms are commonly exported (DICOM UID)."""
MOMENT: Final = ("20000101", "120000")
"""Date and time in files, because equal content must give equal bytes."""


def write_dicom(image: Image, folder: Path, *, description: str = "3DRA of a phantom, research only") -> None:
    """Write a scan as an anonymous series of single-frame files, one per k; equal images give equal bytes.

    ValueError is raised where the axes are not perpendicular and right-handed, or the voxels do not fit into 16 bits.
    """
    from pydicom.uid import generate_uid
    from pydicom.valuerep import format_number_as_ds

    def decimals(values: Any) -> list[str]:
        """Return the shortest decimal strings of at most 16 characters (DICOM's DS)."""
        return [format_number_as_ds(float(value) + 0.0) for value in values]

    spacing, axes = image.spacing_mm, image.affine_mm[:3, :3] / image.spacing_mm
    if not np.allclose(axes.T @ axes, np.eye(3), atol=1e-6) or np.linalg.det(axes) < 0:
        raise ValueError("a DICOM series needs perpendicular, right-handed axes")
    voxels = np.round(image.voxels) if image.voxels.dtype.kind == "f" else image.voxels
    if not np.isfinite(voxels).all() or voxels.min() < -32768 or voxels.max() > 32767:
        raise ValueError("a DICOM series of 16 bits holds values from -32768 to 32767 only")
    voxels = voxels.astype(np.int16)
    digest = hashlib.sha256(voxels.tobytes() + image.affine_mm.tobytes()).hexdigest()
    plane = research_header(CT_IMAGE_STORAGE, digest)
    plane.FrameOfReferenceUID = generate_uid(entropy_srcs=[digest, "frame"])
    plane.PatientName, plane.PatientID = "Phantom^vstent", "PHANTOM"
    plane.PositionReferenceIndicator = plane.PatientPosition = ""
    plane.PatientIdentityRemoved, plane.DeidentificationMethod = "YES", "synthetic: there is no patient"
    plane.ImageType, plane.Modality, plane.SeriesNumber, plane.KVP = ["DERIVED", "SECONDARY", "AXIAL"], "CT", 1, None
    plane.StudyDescription = plane.SeriesDescription = description
    plane.ImageComments = "Synthetic phantom, for research only"
    plane.ImageOrientationPatient = decimals([*axes[:, 0], *axes[:, 1]])
    plane.PixelSpacing = decimals(spacing[1::-1])
    plane.SliceThickness = plane.SpacingBetweenSlices = decimals(spacing[2:])[0]
    plane.SamplesPerPixel, plane.PhotometricInterpretation = 1, "MONOCHROME2"
    plane.Columns, plane.Rows, n_slices = voxels.shape
    plane.BitsAllocated, plane.BitsStored, plane.HighBit, plane.PixelRepresentation = 16, 16, 15, 1
    plane.RescaleIntercept, plane.RescaleSlope, plane.RescaleType = "0", "1", "US"
    with atomic_folder(folder) as building:
        for k in range(n_slices):
            put_instance(plane, digest, "instance", str(k))
            plane.InstanceNumber = k + 1
            plane.ImagePositionPatient = decimals(image.to_mm(np.array([[0, 0, k]]))[0])
            low, high = int(voxels[:, :, k].min()), int(voxels[:, :, k].max())
            plane.WindowCenter, plane.WindowWidth = str((low + high) // 2), str(max(1, high - low))
            plane.PixelData = np.ascontiguousarray(voxels[:, :, k].T, dtype="<i2").tobytes()
            plane.save_as(building / f"IM{k + 1:04d}.dcm", enforce_file_format=True)


def research_header(sop_class: str, digest: str) -> Any:
    """Return a dataset with identifiers, empty patient fields and one moment, for files of one series."""
    from pydicom.dataset import Dataset, FileMetaDataset
    from pydicom.uid import ExplicitVRLittleEndian, generate_uid

    header = Dataset()
    header.SOPClassUID = sop_class
    header.StudyInstanceUID = generate_uid(entropy_srcs=[digest, "study"])
    header.SeriesInstanceUID = generate_uid(entropy_srcs=[digest, "series"])
    header.file_meta = FileMetaDataset()
    header.file_meta.MediaStorageSOPClassUID = header.SOPClassUID
    header.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    header.PatientBirthDate = header.PatientSex = header.AccessionNumber = header.ReferringPhysicianName = ""
    header.StudyID = header.Laterality = ""
    header.StudyDate = header.SeriesDate = header.AcquisitionDate = header.ContentDate = MOMENT[0]
    header.StudyTime = header.SeriesTime = header.AcquisitionTime = header.ContentTime = MOMENT[1]
    header.Manufacturer, header.BodyPartExamined, header.AcquisitionNumber = "vstent", "HEAD", 1
    return header


def put_instance(header: Any, *entropy: str) -> None:
    """Set the identifier of one file; it follows from the words given."""
    from pydicom.uid import generate_uid

    header.SOPInstanceUID = generate_uid(entropy_srcs=list(entropy))
    header.file_meta.MediaStorageSOPInstanceUID = header.SOPInstanceUID
