"""Scans -> Image: DICOM, NIfTI, NRRD, MetaImage and raw voxels, in the LPS frame and mm."""

import gzip
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from vstent.errors import ReadError, UnitError
from vstent.image import Image
from vstent.io import dicom
from vstent.io.files import IMAGE_SUFFIXES, existing, silenced, suffix

VOXEL_MM: Final = (0.01, 5.0)
"""Voxel edges that a scan of the head can have."""


def read_image(
    path: Path,
    *,
    spacing_mm: Sequence[float] | None = None,
    shape: Sequence[int] | None = None,
    dtype: DTypeLike | None = None,
) -> Image:
    """Read a scan.

    Parameters
    ----------
    path : DICOM folder or file, NIfTI, NRRD, MHA, MHD or raw (also .gz).
    spacing_mm : voxel edges along i, j, k (one number: cubes); needed for raw voxels and for headers without spacing,
        and overrules the header where given.
    shape : numbers of voxels along i, j, k; for raw voxels, i running fastest.
    dtype : of raw voxels; guessed from the file's size, and said in a note, where not given.

    Returns
    -------
    image : voxels (i, j, k) and the affine from voxel to LPS mm.

    Raises
    ------
    ReadError
        The file is missing, damaged, or not what its name says; a slice is missing, double or out of line.
    UnitError
        The distance between voxels is not known, or not one that a scan can have.
    """
    path = existing(path)
    kind = suffix(path)
    if path.is_dir() or kind == ".dcm" or dicom.is_dicom(path):
        image = dicom.read_dicom(path)
    elif kind in (".raw", ".raw.gz"):
        return _read_raw(path, spacing_mm, shape, dtype)
    elif kind in IMAGE_SUFFIXES:
        image = _read_itk(path, kind, has_spacing=spacing_mm is not None)
    else:
        raise ReadError(f"{path.name} is not a scan: give a DICOM folder or one of {', '.join(IMAGE_SUFFIXES)}.")
    if spacing_mm is not None:
        image = _respaced(image, _three(spacing_mm, "spacing"))
    return _plausible(image, path)


def _three(values: Sequence[float], what: str) -> NDArray[np.float64]:
    given = np.atleast_1d(np.asarray(values, dtype=np.float64))
    if len(given) not in (1, 3) or not (np.isfinite(given) & (given > 0)).all():
        raise UnitError(f"The {what} must be one or three positive numbers, not {', '.join(f'{v:g}' for v in given)}.")
    return np.broadcast_to(given, (3,)).astype(np.float64)


def _respaced(image: Image, spacing_mm: NDArray[np.float64]) -> Image:
    affine = np.array(image.affine_mm)
    affine[:3, :3] *= spacing_mm / image.spacing_mm
    return Image(image.voxels, affine, image.modality, (*image.notes, "Spacing as given, not as in the header."))


def _plausible(image: Image, path: Path) -> Image:
    low, high = VOXEL_MM
    if not ((image.spacing_mm >= low) & (image.spacing_mm <= high)).all():
        size = " x ".join(f"{v:.4g}" for v in image.spacing_mm)
        raise UnitError(f"{path.name} has voxels of {size} mm, which no scan of a head has; give --spacing in mm.")
    if min(image.voxels.shape) < 2:
        raise ReadError(
            f"{path.name} has {' x '.join(map(str, image.voxels.shape))} voxels: a flat picture is no volume."
        )
    if image.voxels.dtype.kind == "f" and not np.isfinite(image.voxels).all():
        raise ReadError(f"{path.name} has voxels that are not numbers; export it again with integers.")
    return image


# -- headers that ITK reads --------------------------------------------------------------------------------------------


def _read_itk(path: Path, kind: str, *, has_spacing: bool) -> Image:
    import SimpleITK

    if kind == ".nii.gz":
        _refuse_torn(path, kind)
    try:
        with silenced():
            scan = SimpleITK.ReadImage(str(path))
    except RuntimeError as error:
        raise ReadError(f"{path.name} is damaged or not a {kind} file{_reason(error)}.") from None
    if not has_spacing and not _states_spacing(path, kind):
        raise UnitError(f"{path.name} does not say how far its voxels are apart; give --spacing in mm.")
    if kind == ".nii":
        _refuse_torn(path, kind, 352 + scan.GetNumberOfPixels() * scan.GetSizeOfPixelComponent())
    if scan.GetDimension() == 4 and scan.GetSize()[3] == 1:
        scan = scan[:, :, :, 0]
    if scan.GetDimension() != 3 or scan.GetNumberOfComponentsPerPixel() != 1 or scan.GetPixelID() < 0:
        raise ReadError(
            f"{path.name} has {scan.GetDimension()} dimensions and {scan.GetNumberOfComponentsPerPixel()} values per "
            "voxel; export one volume of single values."
        )
    affine = np.eye(4)
    affine[:3, :3] = np.reshape(scan.GetDirection(), (3, 3)) * scan.GetSpacing()
    affine[:3, 3] = scan.GetOrigin()
    return Image(SimpleITK.GetArrayViewFromImage(scan).transpose(), affine)


def _refuse_torn(path: Path, kind: str, n_bytes: int = 348) -> None:
    """Refuse a NIfTI file that breaks off before `n_bytes`: ITK reads zeros there."""
    length = 0
    try:
        with gzip.open(path) if kind == ".nii.gz" else path.open("rb") as file:
            while part := file.read(1 << 22):
                length += len(part)
    except (OSError, EOFError, zlib.error):
        length = -1
    if length < n_bytes:
        raise ReadError(f"{path.name} is damaged: it breaks off before its end; copy it again.")


def _reason(error: Exception) -> str:
    """Return the last plain sentence of an ITK exception in brackets, where it says more than that it failed."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    last = lines[-1].split("): ", 1)[-1].rstrip(".") if lines else ""
    return "" if not last or "sitk::ERROR" in last or last.startswith("Reason:") else f" ({last[:150]})"


def _states_spacing(path: Path, kind: str) -> bool:
    """Tell whether the header says how far voxels are apart; ITK takes 1 mm where it does not."""
    with path.open("rb") as file:
        head = file.read(65536)
    if kind in (".nii", ".nii.gz"):
        return _nifti_spacing(head if kind == ".nii" else zlib.decompressobj(31).decompress(head, 4096))
    text = head.split(b"\n\n")[0] if kind in (".nrrd", ".nhdr") else head.split(b"ElementDataFile")[0]
    keys = (b"spacings:", b"space directions:") if kind in (".nrrd", ".nhdr") else (b"elementspacing", b"elementsize")
    return any(line.strip().lower().startswith(keys) and b"nan" not in line.lower() for line in text.splitlines())


def _nifti_spacing(head: bytes) -> bool:
    for order in ("<", ">"):
        size = int(np.frombuffer(head[:4].ljust(4, b"\0"), order + "i4")[0])
        if size == 348 and len(head) >= 92:
            return bool((np.abs(np.frombuffer(head[80:92], order + "f4")) > 0).all())
        if size == 540 and len(head) >= 168:
            return bool((np.abs(np.frombuffer(head[112:136], order + "f8")) > 0).all())
    return True  # not NIfTI at all: ITK will say so


# -- raw voxels --------------------------------------------------------------------------------------------------------


def _read_raw(
    path: Path, spacing_mm: Sequence[float] | None, shape: Sequence[int] | None, dtype: DTypeLike | None
) -> Image:
    if spacing_mm is None:
        raise UnitError(f"{path.name} has no header, so its voxels have no size; give --spacing in mm.")
    if shape is None or len(shape) != 3 or min(shape) < 1:
        raise ReadError(f"{path.name} has no header; give the number of voxels with --shape NI,NJ,NK.")
    spacing = _three(spacing_mm, "spacing")
    data = _bytes(path)
    n = int(np.prod(np.asarray(shape, dtype=np.int64)))
    kind, note = (np.dtype(dtype), ()) if dtype is not None else _guessed_dtype(data, n, path)
    if len(data) != n * kind.itemsize:
        raise ReadError(
            f"{path.name} holds {len(data)} bytes, but {' x '.join(map(str, shape))} voxels of {kind.name} are "
            f"{n * kind.itemsize}; check --shape."
        )
    voxels = np.frombuffer(data, kind).reshape(tuple(shape)[::-1]).transpose()
    affine = np.diag([*spacing, 1.0])
    return _plausible(Image(voxels.astype(kind.newbyteorder("="), copy=False), affine, notes=note), path)


def _bytes(path: Path) -> bytes:
    data = path.read_bytes()
    if suffix(path) != ".raw.gz":
        return data
    try:
        return gzip.decompress(data)
    except (OSError, EOFError, zlib.error):
        raise ReadError(f"{path.name} is damaged: it cannot be unpacked.") from None


def _guessed_dtype(data: bytes, n: int, path: Path) -> tuple[np.dtype[Any], tuple[str, ...]]:
    """Guess the kind of number from the bytes per voxel; the byte order is the one with the smoother rows."""
    candidates = {1: ("u1",), 2: ("<i2", ">i2"), 4: ("<f4", ">f4", "<i4", ">i4")}.get(len(data) // n if n else 0, ())
    if not candidates or len(data) % n:
        raise ReadError(
            f"{path.name} holds {len(data)} bytes, which is not 1, 2 or 4 for each of {n} voxels; check --shape."
        )
    best = min(candidates, key=lambda kind: _roughness(np.frombuffer(data, kind)))
    kind = np.dtype(best)
    return kind, (f"Raw voxels taken for {kind.newbyteorder('=').name} ({_order(best)}).",)


def _order(kind: str) -> str:
    return {"<": "little-endian", ">": "big-endian"}.get(kind[0], "one byte each")


def _roughness(values: NDArray[Any]) -> float:
    """Mean step between neighbours over the spread of the middle 98 %; infinite for values that no scanner gives."""
    sample = values[: 1 << 20].astype(np.float64) if values.dtype.itemsize > 1 else values[:2]
    if not np.isfinite(sample).all() or np.abs(sample).max(initial=0) > 1e9:
        return np.inf
    if values.dtype.kind == "f" and 0 < np.abs(sample).max(initial=0) < 1e-30:
        return np.inf  # small integers read as floats
    return float(np.abs(np.diff(sample)).mean() / max(float(np.ptp(sample)), 1e-300))
