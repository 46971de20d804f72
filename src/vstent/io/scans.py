"""Read scans in this process: DICOM, NIfTI, NRRD, MetaImage, VTK images and raw voxels, as an `Image` in LPS mm."""

import math
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from vstent.errors import ReadError, UnitError
from vstent.geometry.image import Image
from vstent.io import dicom
from vstent.io.files import IMAGE_SUFFIXES, NIFTI_SUFFIXES, RAW_SUFFIXES, existing, is_vtk_image, suffix, unpacked
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
        return _read_raw(path, spacing_mm, shape, dtype)
    elif kind in NIFTI_SUFFIXES:
        image = read_nifti(path, has_spacing=has_spacing)
    elif kind == ".vti" or is_vtk_image(path):
        image = read_vtk_image(path, has_spacing=has_spacing)
    elif kind in IMAGE_SUFFIXES:
        image = read_itk(path, has_spacing=has_spacing)
    else:
        raise ReadError(
            f"{path.name} is not a scan that vstent reads. Give a DICOM folder or one of {', '.join(IMAGE_SUFFIXES)}."
        )
    if spacing_mm is not None:
        image = _respaced(image, _three(spacing_mm, "spacing"))
    image = _plausible(image, path)
    return image if is_series else rectangular(image)  # the affine of a tilted DICOM series is exact


def _three(values: Sequence[float], what: str) -> NDArray[np.float64]:
    """Return one or three positive numbers as three; UnitError is raised for others."""
    given = np.atleast_1d(np.asarray(values, dtype=np.float64))
    if len(given) not in (1, 3) or not (np.isfinite(given) & (given > 0)).all():
        raise UnitError(
            f"The {what} must be one or three positive numbers, not {', '.join(f'{v:g}' for v in given)}; "
            "give --spacing in mm."
        )
    return np.broadcast_to(given, (3,)).astype(np.float64)


def _respaced(image: Image, spacing_mm: NDArray[np.float64]) -> Image:
    """Return an image with another voxel spacing."""
    affine = np.array(image.affine_mm)
    affine[:3, :3] *= spacing_mm / image.spacing_mm
    return Image(
        image.voxels,
        affine,
        image.modality,
        (*image.notes, "The voxel spacing is the one given, not the one in the header."),
    )


def _plausible(image: Image, path: Path) -> Image:
    """Return an image; an error is raised where its spacing, size, values or byte order are implausible."""
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
        swapped = _roughness(middle.byteswap())
        if swapped < min(SMOOTH, _roughness(middle) / SWAPPED_ROUGHNESS):
            raise ReadError(f"{path.name}: the voxels have the wrong byte order. Export it again.")
    return image


# -- raw voxels --------------------------------------------------------------------------------------------------------


def _read_raw(
    path: Path, spacing_mm: Sequence[float] | None, shape: Sequence[int] | None, dtype: DTypeLike | None
) -> Image:
    """Return the image in a file of raw voxels."""
    if spacing_mm is None:
        raise UnitError(f"{path.name} has no header that states the voxel spacing; give --spacing in mm.")
    if shape is None or len(shape) != 3 or min(shape) < 1:
        raise ReadError(f"{path.name} has no header that states the number of voxels; give --shape NI,NJ,NK.")
    spacing = _three(spacing_mm, "spacing")
    n = math.prod(shape)
    data = _bytes(path, n * LARGEST_VOXEL)
    kind, note = (np.dtype(dtype), ()) if dtype is not None else _guessed_dtype(data, n, path)
    if len(data) != n * kind.itemsize:
        raise ReadError(
            f"{path.name} holds {len(data)} bytes, but {' x '.join(map(str, shape))} voxels of {kind.name} are "
            f"{n * kind.itemsize}; check --shape."
        )
    voxels = np.frombuffer(data, kind).reshape(tuple(shape)[::-1]).transpose()
    affine = np.diag([*spacing, 1.0])
    image = Image(voxels.astype(kind.newbyteorder("="), copy=False), affine, notes=note, is_oriented=False)
    return _plausible(image, path)


SWAPPED_ROUGHNESS: Final = 2.0
"""Ratio of the roughness as stored to the roughness with swapped bytes above which the byte order is wrong."""
SMOOTH: Final = 0.1
"""Largest roughness of a scan in the right byte order, including noise."""
LARGEST_VOXEL: Final = 8
"""Bytes of the largest voxel type."""


def _bytes(path: Path, most: int) -> bytes:
    """Return the unpacked content of a file, but at most `most` + 1 bytes."""
    try:
        with unpacked(path) if suffix(path) == ".raw.gz" else path.open("rb") as file:
            return file.read(min(most, MOST_BYTES) + 1)
    except (OSError, EOFError, zlib.error):
        raise ReadError(f"{path.name} is damaged: it cannot be unpacked. Copy it again.") from None


def _guessed_dtype(data: bytes, n: int, path: Path) -> tuple[np.dtype[Any], tuple[str, ...]]:
    """Return the voxel type that matches the file size, in the byte order with smoother rows, and a note on it."""
    candidates = {1: ("u1",), 2: ("<i2", ">i2"), 4: ("<f4", ">f4", "<i4", ">i4")}.get(len(data) // n if n else 0, ())
    if not candidates or len(data) % n:
        raise ReadError(
            f"{path.name} holds {len(data)} bytes, which is not 1, 2 or 4 for each of {n} voxels; check --shape."
        )
    best = min(candidates, key=lambda kind: _roughness(np.frombuffer(data, kind)))
    kind = np.dtype(best)
    return kind, (f"Raw voxels are read as {kind.newbyteorder('=').name} ({_order(best)}).",)


def _order(kind: str) -> str:
    """Return the byte order of a voxel type as text."""
    return {"<": "little-endian", ">": "big-endian"}.get(kind[0], "one byte each")


def _roughness(values: NDArray[Any]) -> float:
    """Return the mean step between neighbors divided by the range; infinite for values that no scanner produces."""
    sample = values[: 1 << 20].astype(np.float64) if values.dtype.itemsize > 1 else values[:2]
    if not np.isfinite(sample).all() or np.abs(sample).max(initial=0) > 1e9:
        return np.inf
    if values.dtype.kind == "f" and 0 < np.abs(sample).max(initial=0) < 1e-30:
        return np.inf  # small integers read as floats
    return float(np.abs(np.diff(sample)).mean() / max(float(np.ptp(sample)), 1e-300))
