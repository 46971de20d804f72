"""Write an `Image` as a DICOM series, the input of ``vstent demo``."""

import hashlib
import shutil
import tempfile
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vstent.geometry.image import Image
from vstent.io.dicom_header import put_instance, research_header

CT_IMAGE_STORAGE: Final = "1.2.840.10008.5.1.4.1.1.2"
"""Storage class in which reconstructed rotational angiograms are commonly exported (DICOM UID)."""


def write_dicom(image: Image, folder: Path, *, description: str = "3DRA of a phantom, research only") -> None:
    """Write a scan as an anonymous series of single-frame files, one per k.

    Equal images give equal bytes. The folder is complete or does not exist; an existing one is replaced.

    Parameters
    ----------
    image : the scan.
    folder : the folder to write.
    description : description of study and series.

    Raises
    ------
    ValueError
        The axes are not perpendicular and right-handed, or the voxels do not fit into 16 bits.
    """
    spacing, axes = image.spacing_mm, image.affine_mm[:3, :3] / image.spacing_mm
    if not np.allclose(axes.T @ axes, np.eye(3), atol=1e-6) or np.linalg.det(axes) < 0:
        raise ValueError("a DICOM series needs perpendicular, right-handed axes")
    voxels = _int16(image.voxels)
    digest = hashlib.sha256(voxels.tobytes() + image.affine_mm.tobytes()).hexdigest()
    folder = Path(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    building = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        plane = _dataset(digest, description)
        plane.ImageOrientationPatient = [_decimal(v) for v in (*axes[:, 0], *axes[:, 1])]
        plane.PixelSpacing = [_decimal(spacing[1]), _decimal(spacing[0])]
        plane.SliceThickness = plane.SpacingBetweenSlices = _decimal(spacing[2])
        for k in range(voxels.shape[2]):
            _number(plane, digest, k)
            plane.ImagePositionPatient = [_decimal(v) for v in image.to_mm(np.array([[0, 0, k]]))[0]]
            _put_pixels(plane, voxels[:, :, k].T)
            plane.save_as(building / f"IM{k + 1:04d}.dcm", enforce_file_format=True)
        building.chmod(0o755)
        shutil.rmtree(folder, ignore_errors=True)
        building.replace(folder)
    finally:
        shutil.rmtree(building, ignore_errors=True)


def _int16(voxels: NDArray[Any]) -> NDArray[np.int16]:
    """Return voxels rounded to 16-bit integers; ValueError is raised where they do not fit."""
    rounded = np.round(voxels) if voxels.dtype.kind == "f" else voxels
    if not np.isfinite(rounded).all() or rounded.min() < -32768 or rounded.max() > 32767:
        raise ValueError("a DICOM series of 16 bits holds values from -32768 to 32767 only")
    return rounded.astype(np.int16)


def _decimal(value: float) -> str:
    """Return the shortest decimal string of at most 16 characters (DICOM's DS)."""
    from pydicom.valuerep import format_number_as_ds

    return format_number_as_ds(float(value) + 0.0)


def _dataset(digest: str, description: str) -> Any:
    """Return the header that all slices share, without geometry and pixels."""
    from pydicom.uid import generate_uid

    plane = research_header(CT_IMAGE_STORAGE, digest)
    plane.FrameOfReferenceUID = generate_uid(entropy_srcs=[digest, "frame"])
    plane.PatientName, plane.PatientID = "Phantom^vstent", "PHANTOM"
    plane.PositionReferenceIndicator = plane.PatientPosition = ""
    plane.PatientIdentityRemoved, plane.DeidentificationMethod = "YES", "synthetic: there is no patient"
    plane.ImageType = ["DERIVED", "SECONDARY", "AXIAL"]
    plane.Modality = "CT"
    plane.StudyDescription = plane.SeriesDescription = description
    plane.ImageComments = "Synthetic phantom, for research only"
    plane.SeriesNumber = 1
    plane.KVP = None
    return plane


def _number(plane: Any, digest: str, k: int) -> None:
    """Make a header that of slice `k`."""
    put_instance(plane, digest, "instance", str(k))
    plane.InstanceNumber = k + 1


def _put_pixels(plane: Any, pixels: NDArray[np.int16]) -> None:
    """Store values (rows, columns) unscaled: slope 1, intercept 0."""
    plane.SamplesPerPixel, plane.PhotometricInterpretation = 1, "MONOCHROME2"
    plane.Rows, plane.Columns = pixels.shape
    plane.BitsAllocated, plane.BitsStored, plane.HighBit, plane.PixelRepresentation = 16, 16, 15, 1
    plane.RescaleIntercept, plane.RescaleSlope, plane.RescaleType = "0", "1", "US"
    low, high = int(pixels.min()), int(pixels.max())
    plane.WindowCenter, plane.WindowWidth = str((low + high) // 2), str(max(1, high - low))
    plane.PixelData = np.ascontiguousarray(pixels, dtype="<i2").tobytes()
