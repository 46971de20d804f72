"""Read NRRD and MetaImage files as an `Image`, with ITK."""

import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from vstent.errors import ReadError, UnitError
from vstent.geometry.image import Image
from vstent.io.files import suffix
from vstent.io.limits import refuse_torn
from vstent.io.text_headers import fields_of, holds_segments, mm_per_unit, states_spacing, voxel_files


def read_itk(path: Path, *, has_spacing: bool) -> Image:
    """Read one volume from a NRRD or MetaImage file."""
    import SimpleITK

    fields, apart = fields_of(path), voxel_files(path)
    reader = SimpleITK.ImageFileReader()
    try:
        reader.SetFileName(str(path))
        reader.ReadImageInformation()
        _refuse_untrue(path, apart, reader)
        scan = reader.Execute()
    except RuntimeError as error:
        raise ReadError(
            f"{path.name} is damaged or not a {suffix(path)} file{_reason(error)}. Copy or export it again."
        ) from None
    if not has_spacing and not states_spacing(path, fields):
        raise UnitError(f"{path.name} does not state a voxel spacing above zero; give --spacing in mm.")
    if scan.GetDimension() == 4 and scan.GetSize()[3] == 1:
        scan = scan[:, :, :, 0]
    notes: tuple[str, ...] = ()
    n_values = scan.GetNumberOfComponentsPerPixel()
    voxels = SimpleITK.GetArrayViewFromImage(scan)
    if scan.GetDimension() == 3 and n_values > 1 and holds_segments(path):
        notes = (f"The segments in {n_values} layers of the file are united.",)
        voxels, n_values = voxels.any(axis=-1).astype(np.uint8), 1
    if scan.GetDimension() != 3 or n_values != 1 or scan.GetPixelID() < 0:
        raise ReadError(
            f"{path.name} has {scan.GetDimension()} dimensions and {n_values} values per voxel. Export one volume with "
            "one value per voxel."
        )
    unit_mm = np.ones(3) if has_spacing else np.array(mm_per_unit(path, fields))
    affine = np.eye(4)
    affine[:3, :3] = np.reshape(scan.GetDirection(), (3, 3)) * scan.GetSpacing()
    affine[:3, 3] = scan.GetOrigin()
    affine[:3] *= unit_mm[:, None]
    return Image(voxels.transpose(), affine, notes=notes)


def _refuse_untrue(path: Path, apart: list[Path], reader: Any) -> None:
    """Raise ReadError where a header states more than the files hold, because ITK would fill the rest with zeros."""
    import SimpleITK

    size = reader.GetSize()
    if min(size) < 1 or reader.GetPixelID() < 0:
        raise ReadError(f"{path.name} has no voxels of a supported type. Export it again as integers.")
    voxel = SimpleITK.Image([1] * reader.GetDimension(), reader.GetPixelID(), reader.GetNumberOfComponents())
    n_bytes = math.prod(size) * voxel.GetNumberOfComponentsPerPixel() * voxel.GetSizeOfPixelComponent()
    n_held = sum(file.stat().st_size for file in apart if os.path.isfile(file)) or path.stat().st_size
    refuse_torn(f"{path.name} states {' x '.join(map(str, size))} voxels", n_bytes, n_held)


def _reason(error: Exception) -> str:
    """Return the last plain sentence of an ITK exception in parentheses, or nothing where it gives no reason."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    last = lines[-1].split("): ", 1)[-1].rstrip(".") if lines else ""
    is_plain = "sitk::ERROR" not in last and not last.startswith("Reason:") and " " in last.strip("0123456789 ")
    return f" ({last[:150]})" if is_plain else ""
