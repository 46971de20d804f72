"""Read NIfTI-1 and NIfTI-2 files as an `Image`, with nibabel."""

import math
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vstent.errors import ReadError, UnitError
from vstent.geometry.image import Image
from vstent.io.files import DAMAGE, PAIR_SUFFIXES, existing, suffix, unpacked
from vstent.io.limits import MOST_BYTES, refuse_torn
from vstent.kernels.arrays import Floats

HEADER_BYTES: Final = {348: "NIfTI-1", 540: "NIfTI-2"}
"""Size of the header in bytes, which is also its first number, and the version with that size."""
MM_PER_UNIT: Final = {0: 1.0, 1: 1e3, 2: 1.0, 3: 1e-3}
"""Length in mm of the units of a NIfTI header, by their code; 0 states none, and is mm."""
MOST_RATIO: Final = 1.5
"""Largest ratio of the voxel edges of the sform to those of the header, which a gantry tilt changes."""
ROUNDED: Final = 1e-7
"""Square of the scalar part of a quaternion up to which it is 0 but for rounding."""
RAS_TO_LPS: Final = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Matrix that converts RAS coordinates to LPS."""


def read_nifti(path: Path, *, has_spacing: bool) -> Image:
    """Read one volume from a NIfTI-1 or NIfTI-2 file, or from a pair of header (``.hdr``) and voxels (``.img``).

    Scaled integers (``scl_slope``, ``scl_inter``) are returned as scaled values. The frame is the sform where its code
    is set, else the qform. Where neither is set, the voxel axes are taken as LPS axes; they have no orientation in
    an Analyze file.
    """
    head, body = pair_of(path)
    header = _header(existing(head))
    is_analyze = head != body and bytes(header["magic"])[:2] != b"ni"
    if is_analyze:  # it has other fields in the places of these
        header["sform_code"] = header["qform_code"] = header["xyzt_units"] = header["scl_slope"] = 0
    stored = _stored(header, existing(body), 0 if head != body else int(header["sizeof_hdr"]))
    stated = np.abs(np.array(header["pixdim"][1:4], dtype=np.float64))
    is_known = bool((np.isfinite(stated) & (stated > 0)).all())
    spacing = np.where(np.isfinite(stated) & (stated > 0), stated, 1.0)
    code = int(header["xyzt_units"]) % 8
    if code not in MM_PER_UNIT and not has_spacing:
        raise UnitError(f"{path.name} has the length unit {code}, which NIfTI does not define. Give --spacing in mm.")
    with np.errstate(all="ignore"):  # a frame of huge numbers is refused later
        affine, notes = _affine(header, stored.shape, spacing)
        ratio = np.linalg.norm(affine[:3, :3], axis=0) / spacing
        is_contradicted = is_known and not (np.maximum(ratio, 1 / ratio) < MOST_RATIO).all()
        has_sform = _sound(_sform(header)) is not None
    if not has_spacing and not is_known and not has_sform:
        raise UnitError(f"{path.name} does not state a voxel spacing above zero; give --spacing in mm.")
    if not has_spacing and is_contradicted and not (spacing == 1).all():
        raise UnitError(
            f"{path.name} states two voxel spacings, {_edges(spacing)} (pixdim) and {_edges(spacing * ratio)} (sform); "
            "give --spacing in mm."
        )
    to_mm = np.diag([*[MM_PER_UNIT.get(code, 1.0)] * 3, 1.0])
    slope, intercept = float(header["scl_slope"]), float(header["scl_inter"])
    intercept = intercept if np.isfinite(intercept) else 0.0
    is_scaled = slope != 0.0 and np.isfinite(slope) and (slope, intercept) != (1.0, 0.0)  # as NIfTI-1.1 defines
    voxels = (stored * slope + intercept).astype(np.float32) if is_scaled else stored
    if is_analyze:
        notes = ("Analyze files state no orientation: left, right, front and back are unknown.",)
    return Image(voxels, to_mm @ affine, notes=notes, is_oriented=not is_analyze)


def _edges(spacing: Floats) -> str:
    """Return voxel edges in words."""
    return " x ".join(f"{edge:.3g}" for edge in spacing)


def pair_of(path: Path) -> tuple[Path, Path]:
    """Return the files of header and voxels, which are one file unless the suffix is ``.hdr`` or ``.img``."""
    if suffix(path) not in PAIR_SUFFIXES:
        return path, path
    names = ((path.with_suffix(kind), path.with_suffix(kind.upper())) for kind in PAIR_SUFFIXES)
    head, body = (next((file for file in pair if file.is_file()), pair[0]) for pair in names)
    return head, body


def _header(path: Path) -> Any:
    """Return nibabel's header of a file."""
    from nibabel.nifti1 import Nifti1Header
    from nibabel.nifti2 import Nifti2Header
    from nibabel.spatialimages import HeaderDataError
    from nibabel.wrapstruct import WrapStructError

    try:
        with unpacked(path) as file:
            head = file.read(max(HEADER_BYTES))
    except DAMAGE:
        head = b""
    sizes = {int.from_bytes(head[:4], "little"), int.from_bytes(head[:4], "big")}
    size = next(iter(sizes & set(HEADER_BYTES)), 0)
    if head and size == 0:
        raise ReadError(f"{path.name} is damaged or not a NIfTI file: it has no NIfTI header. Copy or export it again.")
    if len(head) < max(size, 1):
        raise ReadError(f"{path.name} is damaged: it ends within its header. Copy or export it again.")
    try:
        return (Nifti2Header if size == max(HEADER_BYTES) else Nifti1Header)(head[:size], check=False)
    except (HeaderDataError, WrapStructError, ValueError, OverflowError):
        raise ReadError(f"{path.name} is damaged: its header contradicts itself. Copy or export it again.") from None


def _stored(header: Any, path: Path, least: int) -> NDArray[Any]:
    """Return the voxels (i, j, k) as stored, which begin at byte `least` or later."""
    from nibabel.nifti1 import data_type_codes
    from nibabel.spatialimages import HeaderDataError

    n_axes = int(header["dim"][0])
    sizes = [int(n) for n in header["dim"][1 : n_axes + 1]]
    if not 1 <= n_axes <= 7 or min(sizes) < 1:
        raise ReadError(f"{path.name} is damaged: its header states no size. Copy or export it again.")
    announced = " x ".join(map(str, sizes))
    if math.prod(sizes[3:]) > 1 or n_axes < 3:
        raise ReadError(f"{path.name} has {n_axes} dimensions ({announced}). Export one three-dimensional volume.")
    announced = f"{path.name} states {' x '.join(map(str, sizes[:3]))} voxels"
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
    n_bytes, begin = math.prod(sizes) * kind.itemsize, float(header["vox_offset"])
    refuse_torn(announced, n_bytes, path.stat().st_size)
    if not least <= begin <= MOST_BYTES:
        raise ReadError(f"{path.name} is damaged: its voxels would begin at byte {begin:g}. Copy or export it again.")
    try:
        with unpacked(path) as file:
            file.seek(int(begin))
            data = file.read(n_bytes)
    except DAMAGE:
        data = b""
    if len(data) < n_bytes:
        raise ReadError(f"{path.name} is damaged: it breaks off before its end. Copy or export it again.")
    return np.frombuffer(data, kind).reshape(sizes[:3], order="F").astype(kind.newbyteorder("="), copy=False)


def _affine(header: Any, shape: tuple[int, ...], spacing: Floats) -> tuple[Floats, tuple[str, ...]]:
    """Return the affine (4, 4) from voxel to LPS in the unit of the file, and a note where its two frames differ."""
    sform, qform = _sound(_sform(header)), _sound(_qform(header, spacing))
    if sform is None or qform is None:
        frame = qform if sform is None else sform
        return np.diag([*spacing, 1.0]) if frame is None else RAS_TO_LPS @ frame, ()
    corners = np.array(np.meshgrid(*[[0, n - 1] for n in shape])).reshape(3, -1)
    apart = np.linalg.norm((sform - qform)[:3, :3] @ corners + (sform - qform)[:3, 3:], axis=0).max()
    is_mirrored = np.linalg.det(sform[:3, :3]) * np.linalg.det(qform[:3, :3]) < 0
    how = "mirror each other: check left and right" if is_mirrored else f"differ by {apart / spacing.min():.0f} voxels"
    note = f"The two frames of the file (sform and qform) {how}. The sform is used."
    return RAS_TO_LPS @ sform, (note,) if is_mirrored or apart > spacing.min() else ()


def _sound(frame: Floats | None) -> Floats | None:
    """Return a frame (4, 4) that is finite and has three independent axes; else None."""
    return frame if frame is not None and np.isfinite(frame).all() and np.linalg.det(frame[:3, :3]) != 0 else None


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
    sign = -1 if header["pixdim"][0] < 0 else 1
    affine = np.eye(4)
    affine[:3, :3] = quat2mat([np.sqrt(rest) if rest > ROUNDED else 0.0, *vector]) * spacing * [1, 1, sign]
    affine[:3, 3] = [header[f"qoffset_{axis}"] for axis in "xyz"]
    return affine
