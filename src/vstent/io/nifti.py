"""Read NIfTI-1 and NIfTI-2 files as an `Image`, with nibabel."""

import math
import zlib
from io import BufferedIOBase
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vstent.errors import ReadError, UnitError
from vstent.geometry.image import Image
from vstent.io.files import unpacked
from vstent.io.limits import MOST_BYTES, MOST_PACKED, refuse_bomb
from vstent.kernels.arrays import Floats

HEADER_BYTES: Final = {348: "NIfTI-1", 540: "NIfTI-2"}
"""Size of the header in bytes, which is also its first number, and the version with that size."""
MM_PER_UNIT: Final = {0: 1.0, 1: 1e3, 2: 1.0, 3: 1e-3}
"""Length in mm of the units of a NIfTI header, by their code; 0 states none, and is mm."""
ROUNDED: Final = 1e-7
"""Square of the scalar part of a quaternion up to which it is 0 but for rounding."""
RAS_TO_LPS: Final = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Matrix that converts RAS coordinates to LPS."""


def read_nifti(path: Path, *, has_spacing: bool) -> Image:
    """Read one volume from a NIfTI-1 or NIfTI-2 file.

    Scaled integers (``scl_slope``, ``scl_inter``) are returned as scaled values. The frame is the sform where its code
    is set, else the qform. Where neither is set, the voxel axes are taken as LPS axes.

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
    code = int(header["xyzt_units"]) % 8
    if code not in MM_PER_UNIT and not has_spacing:
        raise UnitError(f"{path.name} has the length unit {code}, which NIfTI does not define. Give --spacing in mm.")
    with np.errstate(all="ignore"):  # a frame of huge numbers is refused later
        affine, notes = _affine(header, shape, spacing)
    to_mm = np.diag([*[MM_PER_UNIT.get(code, 1.0)] * 3, 1.0])
    return Image(_scaled(_stored(header, shape, path), header), to_mm @ affine, notes=notes)


def _header(path: Path) -> Any:
    """Return nibabel's header of a file."""
    from nibabel.nifti1 import Nifti1Header
    from nibabel.nifti2 import Nifti2Header
    from nibabel.spatialimages import HeaderDataError
    from nibabel.wrapstruct import WrapStructError

    try:
        with unpacked(path) as file:
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
    announced = f"{path.name} states {' x '.join(map(str, shape))} voxels"
    if n_bytes > MOST_PACKED * path.stat().st_size:
        raise ReadError(
            f"{announced}, {n_bytes / 1e9:.3g} GB, but has {path.stat().st_size} bytes: it is damaged and breaks off. "
            "Copy or export it again."
        )
    refuse_bomb(announced, n_bytes, path.stat().st_size)
    needed, length = _begin(header, path) + n_bytes, 0
    try:
        with unpacked(path) as file:
            while length < needed and (part := file.read(1 << 22)):
                length += len(part)
    except (OSError, EOFError, zlib.error):
        length = -1
    if length < needed:
        raise ReadError(f"{path.name} is damaged: it breaks off before its end. Copy or export it again.")


def _stored(header: Any, shape: tuple[int, int, int], path: Path) -> NDArray[Any]:
    """Return the voxels (i, j, k) as stored."""
    kind = _kind(header, path)
    with unpacked(path) as file:
        _skip(file, _begin(header, path))
        data = file.read(math.prod(shape) * kind.itemsize)
    voxels = np.frombuffer(data, kind).reshape(shape, order="F")
    return voxels.astype(kind.newbyteorder("="), copy=False)


def _skip(file: BufferedIOBase, n_bytes: int) -> None:
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


def _affine(header: Any, shape: tuple[int, int, int], spacing: Floats) -> tuple[Floats, tuple[str, ...]]:
    """Return the affine (4, 4) from voxel to LPS in the unit of the file, and a note where its two frames differ."""
    sform, qform = (one if _is_frame(one) else None for one in (_sform(header), _qform(header, spacing)))
    if sform is None or qform is None:
        frame = qform if sform is None else sform
        return np.diag([*spacing, 1.0]) if frame is None else RAS_TO_LPS @ frame, ()
    corners = np.array(np.meshgrid(*[[0, n - 1] for n in shape])).reshape(3, -1)
    apart = np.linalg.norm((sform - qform)[:3, :3] @ corners + (sform - qform)[:3, 3:], axis=0).max()
    is_mirrored = np.linalg.det(sform[:3, :3]) * np.linalg.det(qform[:3, :3]) < 0
    how = "mirror each other: check left and right" if is_mirrored else f"differ by {apart / spacing.min():.0f} voxels"
    note = f"The two frames of the file (sform and qform) {how}. The sform is used."
    return RAS_TO_LPS @ sform, (note,) if is_mirrored or apart > spacing.min() else ()


def _is_frame(affine: Floats | None) -> bool:
    """Return whether an affine (4, 4) is finite and has three independent axes."""
    return affine is not None and bool(np.isfinite(affine).all()) and np.linalg.det(affine[:3, :3]) != 0


def _sform(header: Any) -> Floats | None:
    """Return the affine (4, 4) that the header states by its rows; None where it states none."""
    rows = np.stack([header[name] for name in ("srow_x", "srow_y", "srow_z")]).astype(np.float64)
    return np.concatenate([rows, [[0, 0, 0, 1]]]) if int(header["sform_code"]) > 0 else None


def _qform(header: Any, spacing: Floats) -> Floats | None:
    """Return the affine (4, 4) that the header states by a quaternion; None where it states none.

    As in the reference implementation of NIfTI (nifti1_io.c), a quaternion longer than 1 is scaled to 1, and a sign of
    0 stands for 1.
    """
    from nibabel.quaternions import quat2mat

    vector = np.array([header[f"quatern_{axis}"] for axis in "bcd"], dtype=np.float64)
    if int(header["qform_code"]) <= 0 or not np.isfinite(vector).all():
        return None
    rest = 1.0 - vector @ vector
    affine = np.eye(4)
    affine[:3, :3] = (
        quat2mat([np.sqrt(rest) if rest > ROUNDED else 0.0, *vector])
        * spacing
        * [1, 1, -1 if header["pixdim"][0] < 0 else 1]
    )
    affine[:3, 3] = [header[f"qoffset_{axis}"] for axis in "xyz"]
    return affine
