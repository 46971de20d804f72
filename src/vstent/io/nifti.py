"""Read NIfTI-1 and NIfTI-2 files as an `Image`, with nibabel."""

import gzip
import math
import zlib
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from vstent.errors import ReadError, UnitError
from vstent.geometry.image import Image
from vstent.io.files import suffix
from vstent.kernels.arrays import Floats

HEADER_BYTES: Final = {348: "NIfTI-1", 540: "NIfTI-2"}
"""Size of the header in bytes, which is also its first number, and the version with that size."""
MOST_BYTES: Final = 1 << 32
"""Largest scan that is read, in bytes; a scan of the head is smaller."""
MOST_PACKED: Final = 1032
"""Largest compression ratio that gzip reaches."""
MM_PER_UNIT: Final = {"meter": 1e3, "mm": 1.0, "micron": 1e-3, "unknown": 1.0}
"""Length units of a NIfTI header in mm."""
RAS_TO_LPS: Final = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Matrix that converts RAS coordinates to LPS."""


def read_nifti(path: Path, *, has_spacing: bool) -> Image:
    """Read one volume from a NIfTI-1 or NIfTI-2 file.

    Scaled integers (``scl_slope``, ``scl_inter``) are returned as scaled values. The frame is the sform where its code
    is set, else the qform. Where neither is set, the voxel axes are taken as LPS axes.

    Parameters
    ----------
    path : the file, ``.nii`` or ``.nii.gz``.
    has_spacing : whether the caller replaces the spacing, so that the header need not state it.

    Returns
    -------
    image : Image
        Voxels (i, j, k) and the affine from voxel to LPS mm.

    Raises
    ------
    ReadError
        The file is truncated, or not a NIfTI file, or holds something other than one volume of single values.
    UnitError
        The header does not state the voxel spacing.
    """
    header = _header(path)
    shape = _shape(header, path)
    _check_length(header, shape, path)
    spacing = np.abs(np.array(header["pixdim"][1:4], dtype=np.float64))
    if not has_spacing and not (np.isfinite(spacing).all() and (spacing > 0).all()):
        raise UnitError(f"{path.name} does not state a voxel spacing above zero; give --spacing in mm.")
    spacing = np.where(np.isfinite(spacing) & (spacing > 0), spacing, 1.0)
    return Image(_scaled(_stored(header, shape, path), header), _affine_mm(header, spacing), notes=())


@contextmanager
def _opened(path: Path) -> Any:
    """Open a file, unpacked where it is compressed."""
    with gzip.open(path) if suffix(path) == ".nii.gz" else path.open("rb") as file:
        yield file


def _header(path: Path) -> Any:
    """Return nibabel's header of a file."""
    from nibabel.nifti1 import Nifti1Header
    from nibabel.nifti2 import Nifti2Header
    from nibabel.spatialimages import HeaderDataError
    from nibabel.wrapstruct import WrapStructError

    try:
        with _opened(path) as file:
            head = file.read(max(HEADER_BYTES))
    except (OSError, EOFError, zlib.error):
        raise ReadError(f"{path.name} is damaged: it ends within its header. Copy or export it again.") from None
    sizes = {int.from_bytes(head[:4], "little"), int.from_bytes(head[:4], "big")}
    size = next(iter(sizes & set(HEADER_BYTES)), 0)
    if size == 0:
        raise ReadError(f"{path.name} is damaged or not a NIfTI file: it has no NIfTI header. Copy or export it again.")
    if len(head) < size:
        raise ReadError(f"{path.name} is damaged: it ends within its header. Copy or export it again.")
    try:
        return (Nifti2Header if size == max(HEADER_BYTES) else Nifti1Header)(head[:size], check=False)
    except (HeaderDataError, WrapStructError, ValueError, OverflowError):
        raise ReadError(f"{path.name} is damaged: its header contradicts itself. Copy or export it again.") from None


def _shape(header: Any, path: Path) -> tuple[int, int, int]:
    """Return the number of voxels along i, j, k."""
    n_axes = int(header["dim"][0])
    if not 1 <= n_axes <= 7 or min(int(n) for n in header["dim"][1 : n_axes + 1]) < 1:
        raise ReadError(f"{path.name} is damaged: its header states no size. Copy or export it again.")
    sizes = [int(n) for n in header["dim"][1 : n_axes + 1]]
    if math.prod(sizes[3:]) > 1 or len(sizes) < 3:
        raise ReadError(
            f"{path.name} has {n_axes} dimensions ({' x '.join(map(str, sizes))}). Export one three-dimensional volume."
        )
    return sizes[0], sizes[1], sizes[2]


def _kind(header: Any, path: Path) -> np.dtype[Any]:
    """Return the type of the stored voxels, byte order included."""
    from nibabel.nifti1 import data_type_codes
    from nibabel.spatialimages import HeaderDataError

    try:
        kind = np.dtype(header.get_data_dtype())
    except KeyError:
        raise ReadError(
            f"{path.name} is damaged: it states voxel type {int(header['datatype'])}, which NIfTI does not define. "
            "Copy or export it again."
        ) from None
    except HeaderDataError:
        label = data_type_codes.label[int(header["datatype"])]
        raise ReadError(f"{path.name}: voxels of type {label} are not supported. Export it as integers.") from None
    if kind.kind not in "iuf" or kind.itemsize > 8:
        raise ReadError(f"{path.name}: voxels of type {kind} are not supported. Export one value per voxel.")
    return kind


def _begin(header: Any, path: Path) -> int:
    """Return the position of the first voxel in bytes."""
    begin = float(header["vox_offset"])
    if not int(header["sizeof_hdr"]) <= begin <= MOST_BYTES:
        raise ReadError(f"{path.name} is damaged: its voxels would begin at byte {begin:g}. Copy or export it again.")
    return int(begin)


def _check_length(header: Any, shape: tuple[int, int, int], path: Path) -> None:
    """Raise ReadError where the file is shorter than its header states, before memory is allocated."""
    n_bytes = math.prod(shape) * _kind(header, path).itemsize
    stated = f"{path.name} states {' x '.join(map(str, shape))} voxels, {n_bytes / 1e9:.3g} GB"
    if n_bytes > MOST_PACKED * path.stat().st_size:
        raise ReadError(
            f"{stated}, but has {path.stat().st_size} bytes: it is damaged and breaks off. Copy or export it again."
        )
    if n_bytes > MOST_BYTES:
        raise ReadError(f"{stated}, which is more than a scan of the head. Export the part around the aneurysm.")
    needed, length = _begin(header, path) + n_bytes, 0
    try:
        with _opened(path) as file:
            while length < needed and (part := file.read(1 << 22)):
                length += len(part)
    except (OSError, EOFError, zlib.error):
        length = -1
    if length < needed:
        raise ReadError(f"{path.name} is damaged: it breaks off before its end. Copy or export it again.")


def _stored(header: Any, shape: tuple[int, int, int], path: Path) -> NDArray[Any]:
    """Return the voxels (i, j, k) as stored."""
    kind = _kind(header, path)
    with _opened(path) as file:
        _skip(file, _begin(header, path))
        data = file.read(math.prod(shape) * kind.itemsize)
    voxels = np.frombuffer(data, kind).reshape(shape, order="F")
    return voxels.astype(kind.newbyteorder("="), copy=False)


def _skip(file: IO[bytes], n_bytes: int) -> None:
    """Read and discard bytes."""
    while n_bytes > 0 and (part := file.read(min(n_bytes, 1 << 22))):
        n_bytes -= len(part)


def _scaled(stored: NDArray[Any], header: Any) -> NDArray[Any]:
    """Return the rescaled voxels; a slope that is zero or not finite means no scaling (NIfTI-1.1)."""
    slope, intercept = float(header["scl_slope"]), float(header["scl_inter"])
    intercept = intercept if np.isfinite(intercept) else 0.0
    if slope == 0.0 or not np.isfinite(slope) or (slope == 1.0 and intercept == 0.0):
        return stored
    return (stored * slope + intercept).astype(np.float32)


def _affine_mm(header: Any, spacing: Floats) -> Floats:
    """Return the affine (4, 4) from voxel to LPS mm."""
    to_mm = np.diag([*[MM_PER_UNIT.get(header.get_xyzt_units()[0], 1.0)] * 3, 1.0])
    sform, qform = header.get_sform(coded=True), header.get_qform(coded=True)
    for affine, code in (sform, qform):
        if code and affine is not None and np.isfinite(affine).all() and np.linalg.det(affine[:3, :3]) != 0:
            return np.asarray(RAS_TO_LPS @ to_mm @ affine)
    return np.asarray(to_mm @ np.diag([*spacing, 1.0]))
