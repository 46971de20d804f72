"""Read scans in this process: DICOM, NIfTI, NRRD, MetaImage, VTK images and raw voxels, as an `Image` in LPS mm."""

import math
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from vstent.errors import ReadError, UnitError
from vstent.geometry.image import Image
from vstent.io import dicom
from vstent.io.files import (
    DAMAGE,
    IMAGE_SUFFIXES,
    NIFTI_SUFFIXES,
    PAIR_SUFFIXES,
    RAW_SUFFIXES,
    existing,
    is_vtk_image,
    suffix,
    unpacked,
)
from vstent.io.itk import read_itk
from vstent.io.limits import MOST_BYTES
from vstent.io.nifti import read_nifti
from vstent.io.rectangular import rectangular
from vstent.io.vtk_reader import read_vtk_image

VOXEL_MM: Final = (0.01, 5.0)
"""Smallest and largest plausible voxel edge of a scan of the head, in mm."""


def read_scan(
    path: Path,
    *,
    spacing_mm: Sequence[float] | None = None,
    shape: Sequence[int] | None = None,
    dtype: DTypeLike | None = None,
    acquisition: int | None = None,
) -> Image:
    """Read a scan in this process; `vstent.io.images.read_image` has the same parameters and starts another one."""
    path = existing(path)
    kind, has_spacing = suffix(path), spacing_mm is not None
    is_series = path.is_dir() or kind == ".dcm" or dicom.is_dicom(path)
    if is_series:
        image = dicom.read_dicom(path, has_spacing=has_spacing, acquisition=acquisition)
    elif kind in RAW_SUFFIXES:
        image = _read_raw(path, shape, dtype, has_spacing=has_spacing)
    elif kind in (*NIFTI_SUFFIXES, *PAIR_SUFFIXES):
        image = read_nifti(path, has_spacing=has_spacing)
    elif kind in (".vti", ".vtr") or is_vtk_image(path):
        image = read_vtk_image(path, has_spacing=has_spacing)
    elif kind in IMAGE_SUFFIXES:
        image = read_itk(path, has_spacing=has_spacing)
    elif kind == ".zip" or zipfile.is_zipfile(path):
        raise ReadError(f"{path.name} is an archive. Unpack it, and give the folder or the file that it holds.")
    else:
        raise ReadError(
            f"{path.name} is not a scan that vstent reads. Give a DICOM folder or one of {', '.join(IMAGE_SUFFIXES)}."
        )
    if spacing_mm is not None:
        given = np.atleast_1d(np.asarray(spacing_mm, dtype=np.float64))
        if len(given) not in (1, 3) or not (np.isfinite(given) & (given > 0)).all():
            raise UnitError(
                f"The spacing must be one or three positive numbers, not {', '.join(f'{v:g}' for v in given)}; "
                "give --spacing in mm."
            )
        affine = np.array(image.affine_mm)
        affine[:3, :3] *= given / image.spacing_mm
        note = () if kind in RAW_SUFFIXES else ("The voxel spacing is the one given, not the one in the header.",)
        image = Image(image.voxels, affine, image.modality, (*image.notes, *note), image.is_oriented)
    _refuse_implausible(image, path)
    return image if is_series else rectangular(image)  # the affine of a tilted DICOM series is exact


def _refuse_implausible(image: Image, path: Path) -> None:
    """Raise an error where the spacing, size, values or byte order of an image are implausible."""
    low, high = VOXEL_MM
    if not ((image.spacing_mm >= low) & (image.spacing_mm <= high)).all():
        size = " x ".join(f"{v:.4g}" for v in image.spacing_mm)
        raise UnitError(f"{path.name} has voxels of {size} mm, which no scan of a head has; give --spacing in mm.")
    if min(image.voxels.shape) < 2:
        raise ReadError(
            f"{path.name} has {' x '.join(map(str, image.voxels.shape))} voxels: a single plane is not a volume."
        )
    if image.voxels.dtype.kind == "f" and not np.isfinite(image.voxels).all():
        raise ReadError(f"{path.name} contains voxels that are not numbers (NaN). Export it again as integers.")
    if image.voxels.dtype.kind in "iu" and image.voxels.dtype.itemsize == 2:
        middle = np.ravel(image.voxels[:, :, image.voxels.shape[2] // 2], order="F")
        if _roughness(middle.byteswap()) < min(SMOOTH, _roughness(middle) / SWAPPED_ROUGHNESS):
            raise ReadError(f"{path.name}: the voxels have the wrong byte order. Export it again.")


# -- raw voxels --------------------------------------------------------------------------------------------------------

SWAPPED_ROUGHNESS: Final = 2.0
"""Ratio of the roughness as stored to the roughness with swapped bytes above which the byte order is wrong."""
SMOOTH: Final = 0.1
"""Largest roughness of a scan in the right byte order, including noise."""
LARGEST_VOXEL: Final = 8
"""Bytes of the largest voxel type."""
RAW_TYPES: Final = {1: ("u1",), 2: ("<i2", ">i2"), 4: ("<f4", ">f4", "<i4", ">i4")}
"""Usual types of raw voxels, by their number of bytes."""


def _read_raw(path: Path, shape: Sequence[int] | None, dtype: DTypeLike | None, *, has_spacing: bool) -> Image:
    """Return the image in a file of raw voxels, with a spacing of 1 mm.

    Without a type, it is the one that matches the size of the file, in the byte order with smoother rows.
    """
    if not has_spacing:
        raise UnitError(f"{path.name} has no header that states the voxel spacing; give --spacing in mm.")
    if shape is None or len(shape) != 3 or min(shape) < 1:
        raise ReadError(f"{path.name} has no header that states the number of voxels; give --shape NI,NJ,NK.")
    n = math.prod(shape)
    try:
        with unpacked(path) if suffix(path) == ".raw.gz" else path.open("rb") as file:
            data = file.read(min(n * LARGEST_VOXEL, MOST_BYTES) + 1)
    except DAMAGE:
        raise ReadError(f"{path.name} is damaged: it cannot be unpacked. Copy it again.") from None
    notes: tuple[str, ...] = ()
    if dtype is None:
        candidates = RAW_TYPES.get(len(data) // n, ()) if len(data) % n == 0 else ()
        if not candidates:
            raise ReadError(
                f"{path.name} holds {len(data)} bytes, which is not 1, 2 or 4 for each of {n} voxels; check --shape."
            )
        best = min(candidates, key=lambda kind: _roughness(np.frombuffer(data, kind)))
        order = {"<": "little-endian", ">": "big-endian"}.get(best[0], "one byte each")
        notes = (f"Raw voxels are read as {np.dtype(best).newbyteorder('=').name} ({order}).",)
        dtype = best
    kind = np.dtype(dtype)
    if len(data) != n * kind.itemsize:
        raise ReadError(
            f"{path.name} holds {len(data)} bytes, but {' x '.join(map(str, shape))} voxels of {kind.name} are "
            f"{n * kind.itemsize}; check --shape."
        )
    voxels = np.frombuffer(data, kind).reshape(tuple(shape)[::-1]).transpose()
    return Image(voxels.astype(kind.newbyteorder("="), copy=False), np.eye(4), notes=notes, is_oriented=False)


def _roughness(values: NDArray[Any]) -> float:
    """Return the mean step between neighbors divided by the range; infinite for values that no scanner produces."""
    sample = values[: 1 << 20].astype(np.float64) if values.dtype.itemsize > 1 else values[:2]
    if not np.isfinite(sample).all() or np.abs(sample).max(initial=0) > 1e9:
        return np.inf
    if values.dtype.kind == "f" and 0 < np.abs(sample).max(initial=0) < 1e-30:
        return np.inf  # small integers read as floats
    return float(np.abs(np.diff(sample)).mean() / max(float(np.ptp(sample)), 1e-300))
