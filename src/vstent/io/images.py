"""Scans -> Image: DICOM, NIfTI, NRRD, MetaImage and raw voxels, in the LPS frame and mm."""

import glob
import gzip
import math
import os
import re
import shutil
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from vstent.errors import ReadError, UnitError
from vstent.geometry.image import Image
from vstent.io import dicom
from vstent.io.files import IMAGE_SUFFIXES, RAW_SUFFIXES, existing, is_surface_file, silenced, suffix

VOXEL_MM: Final = (0.01, 5.0)
"""Voxel edges that a scan of the head can have."""
MOST_BYTES: Final = 1 << 32
"""A scan of more bytes is refused: it is none of a head, or its header lies."""
LONGEST_LINE: Final = 1000
"""Characters of a line of a header."""
MOST_PACKED: Final = 1032
"""No packer of these formats makes one byte of more."""


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
    elif kind in RAW_SUFFIXES:
        return _read_raw(path, spacing_mm, shape, dtype)
    elif kind in IMAGE_SUFFIXES:
        image = _read_itk(path, kind, has_spacing=spacing_mm is not None)
    else:
        raise ReadError(f"{path.name} is not a scan: give a DICOM folder or one of {', '.join(IMAGE_SUFFIXES)}.")
    if spacing_mm is not None:
        image = _respaced(image, _three(spacing_mm, "spacing"))
    return _plausible(image, path)


def files_of(path: Path) -> list[Path]:
    """Return the files that a scan or a surface is read from when one file is given.

    They are itself, the voxels that lie apart from their header, and the series of a DICOM file. What is missing is
    left out: `read_image` will refuse it.
    """
    if is_surface_file(path):
        return [path]
    if dicom.is_dicom(path):
        return dicom.series_of(path)
    return [path, *(file for file in _voxel_files(path) if os.path.isfile(file))]  # a name may be too long


APART: Final = {
    **dict.fromkeys((".mha", ".mhd"), re.compile(rb"^[ \t]*elementdatafile[ \t]*=([^\0\r\n]{1,1000})", re.I | re.M)),
    **dict.fromkeys((".nrrd", ".nhdr"), re.compile(rb"^data ?file:([^\0\r\n]{1,1000})", re.I | re.M)),
}
"""Line of a header that names the file of the voxels, or is ``LIST`` with files in the lines below, or a pattern."""


def _voxel_files(path: Path) -> list[Path]:
    """Files that a header names for its voxels, there or not."""
    kind = suffix(path)
    if kind not in APART:
        return []
    with path.open("rb") as file:
        line = APART[kind].search(head := file.read(65536))
    if line is None:
        return []
    name = os.fsdecode(line[1].strip())
    if name.split()[:1] == ["LIST"]:
        return [path.parent / os.fsdecode(one.strip()) for one in head[line.end() :].splitlines()]
    if "%" in name:
        place = path.parent / name.split()[0]
        slices = re.sub(r"%\d*d", "[0-9]*", glob.escape(place.name))
        return [Path(one) for one in sorted(glob.glob(os.path.join(glob.escape(str(place.parent)), slices)))]
    return [path.parent / name]


def _three(values: Sequence[float], what: str) -> NDArray[np.float64]:
    given = np.atleast_1d(np.asarray(values, dtype=np.float64))
    if len(given) not in (1, 3) or not (np.isfinite(given) & (given > 0)).all():
        raise UnitError(
            f"The {what} must be one or three positive numbers, not {', '.join(f'{v:g}' for v in given)}; "
            "give --spacing in mm."
        )
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
    if image.voxels.dtype.kind in "iu" and image.voxels.dtype.itemsize == 2:
        middle = np.ravel(image.voxels[:, :, image.voxels.shape[2] // 2], order="F")
        swapped = _roughness(middle.byteswap())
        if swapped < min(SMOOTH, _roughness(middle) / SWAPPED_ROUGHNESS):
            raise ReadError(f"{path.name} has voxels whose bytes are in the other order; export it again.")
    return image


# -- headers that ITK reads --------------------------------------------------------------------------------------------


def _read_itk(path: Path, kind: str, *, has_spacing: bool) -> Image:
    import SimpleITK

    if kind in (".mha", ".mhd"):
        _refuse_odd_meta(path)
    reader = SimpleITK.ImageFileReader()
    try:
        with silenced(), _alone(path, kind) as lone:
            reader.SetFileName(str(lone))
            reader.ReadImageInformation()
            _refuse_untrue(path, kind, reader)
            scan = reader.Execute()
    except RuntimeError as error:
        raise ReadError(
            f"{path.name} is damaged or not a {kind} file{_reason(error)}; copy it again or export it anew."
        ) from None
    if not has_spacing and not _states_spacing(path, kind):
        raise UnitError(f"{path.name} does not say how far its voxels are apart, above zero; give --spacing in mm.")
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


@contextmanager
def _alone(path: Path, kind: str) -> Iterator[Path]:
    """Give a name of a NIfTI file in a folder of its own: beside `a.nii.gz` ITK would take the voxels of `a.nii`."""
    if kind not in (".nii", ".nii.gz"):
        yield path
        return
    with TemporaryDirectory(prefix="vstent-") as folder:
        lone = Path(folder) / f"scan{kind}"
        try:
            lone.symlink_to(path.resolve())
        except OSError:  # Windows lets few users make links
            shutil.copyfile(path, lone)
        yield lone


def _refuse_odd_meta(path: Path) -> None:
    """Refuse a MetaImage header whose counts contradict each other: ITK crashes on those."""
    with path.open("rb") as file:
        head = file.read(65536).partition(b"ElementDataFile")[0]
    pairs = [line.partition(b"=") for line in head.splitlines()]
    values = {key.strip().lower(): value.split() for key, _, value in pairs}
    n_axes = {b"2": 2, b"3": 3, b"4": 4}.get(b" ".join(values.get(b"ndims", [])), 0)
    counts = {b"dimsize": n_axes, b"elementspacing": n_axes, b"transformmatrix": n_axes**2, b"offset": n_axes}
    wrong = [key for key, n in counts.items() if key in values and len(values[key]) != n]
    if len(values) < len(pairs) or n_axes == 0 or wrong or any(len(line) > LONGEST_LINE for line in head.splitlines()):
        raise ReadError(f"{path.name} is damaged: its header contradicts itself; copy it again or export it anew.")


def _refuse_untrue(path: Path, kind: str, reader: Any) -> None:
    """Refuse a header that announces more than the file holds, before memory is asked for: ITK may read zeros there."""
    import SimpleITK

    size = reader.GetSize()
    if min(size) < 1 or reader.GetPixelID() < 0:
        raise ReadError(f"{path.name} has no voxels of a known kind; copy it again or export it anew.")
    voxel = SimpleITK.Image([1] * reader.GetDimension(), reader.GetPixelID(), reader.GetNumberOfComponents())
    n_bytes = math.prod(size) * voxel.GetNumberOfComponentsPerPixel() * voxel.GetSizeOfPixelComponent()
    announced = f"{path.name} announces {' x '.join(map(str, size))} voxels, {n_bytes / 1e9:.3g} GB"
    n_held = path.stat().st_size
    if kind not in (".nhdr", ".mhd") and n_bytes > MOST_PACKED * n_held:
        raise ReadError(f"{announced}, but has {n_held} bytes: it is damaged and breaks off; copy it again.")
    if n_bytes > MOST_BYTES:
        raise ReadError(f"{announced}, more than any scan of a head; export the part about the aneurysm.")
    if kind in (".nii", ".nii.gz"):
        _refuse_torn(path, kind, _nifti_begin(path, kind) + n_bytes)


def _refuse_torn(path: Path, kind: str, n_bytes: int) -> None:
    """Refuse a NIfTI file that breaks off before `n_bytes`."""
    length = 0
    try:
        with gzip.open(path) if kind == ".nii.gz" else path.open("rb") as file:
            while length <= n_bytes and (part := file.read(1 << 22)):
                length += len(part)
    except (OSError, EOFError, zlib.error):
        length = -1
    if length < n_bytes:
        raise ReadError(f"{path.name} is damaged: it breaks off before its end; copy it again.")


def _reason(error: Exception) -> str:
    """Return the last plain sentence of an ITK exception in brackets, where it says more than that it failed."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    last = lines[-1].split("): ", 1)[-1].rstrip(".") if lines else ""
    says_little = (
        not last or "sitk::ERROR" in last or last.startswith("Reason:") or " " not in last.strip("0123456789 ")
    )
    return "" if says_little else f" ({last[:150]})"


def _states_spacing(path: Path, kind: str) -> bool:
    """Tell whether the header says how far voxels are apart; ITK takes 1 mm where it does not."""
    if kind in (".nii", ".nii.gz"):
        head, order = _nifti_head(path, kind)
        edges = head[80:92], f"{order}f4"
        if len(head) >= NIFTI_2:
            edges = head[112:136], f"{order}f8"
        return bool((np.abs(np.frombuffer(*edges)) > 0).all())
    with path.open("rb") as file:
        head = file.read(65536)
    text = head.split(b"\n\n")[0] if kind in (".nrrd", ".nhdr") else head.split(b"ElementDataFile")[0]
    keys = (b"spacings:", b"space directions:") if kind in (".nrrd", ".nhdr") else (b"elementspacing", b"elementsize")
    return any(line.strip().lower().startswith(keys) and _may_be_spacing(line) for line in text.splitlines())


def _may_be_spacing(line: bytes) -> bool:
    """Tell whether a line of a header holds numbers, and no edge below zero: ITK drops the sign."""
    key, _, values = line.lower().replace(b"=", b":").partition(b":")
    is_edges = b"directions" not in key
    return b"nan" not in values and not (is_edges and any(word.startswith(b"-") for word in values.split()))


NIFTI_2: Final = 540
"""Bytes of a NIfTI-2 header; one of NIfTI-1 has 348."""


def _nifti_head(path: Path, kind: str) -> tuple[bytes, str]:
    """Return the header of a NIfTI file that ITK has accepted, and its byte order."""
    try:
        with gzip.open(path) if kind == ".nii.gz" else path.open("rb") as file:
            head = file.read(NIFTI_2)
    except (OSError, EOFError, zlib.error):
        raise ReadError(f"{path.name} is damaged: it breaks off in its header; copy it again.") from None
    order = "<" if int.from_bytes(head[:4], "little") in (348, NIFTI_2) else ">"
    size = int.from_bytes(head[:4], "little" if order == "<" else "big")
    return head[: NIFTI_2 if size == NIFTI_2 else 348], order


def _nifti_begin(path: Path, kind: str) -> int:
    """Return where the voxels begin."""
    head, order = _nifti_head(path, kind)
    place = (head[168:176], f"{order}i8") if len(head) == NIFTI_2 else (head[108:112], f"{order}f4")
    begin = float(np.frombuffer(*place)[0])
    if not len(head) + 4 <= begin <= MOST_BYTES:
        raise ReadError(f"{path.name} is damaged: its voxels would begin at byte {begin:g}; copy it again.")
    return int(begin)


# -- raw voxels --------------------------------------------------------------------------------------------------------


def _read_raw(
    path: Path, spacing_mm: Sequence[float] | None, shape: Sequence[int] | None, dtype: DTypeLike | None
) -> Image:
    if spacing_mm is None:
        raise UnitError(f"{path.name} has no header, so its voxels have no size; give --spacing in mm.")
    if shape is None or len(shape) != 3 or min(shape) < 1:
        raise ReadError(f"{path.name} has no header; give the number of voxels with --shape NI,NJ,NK.")
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
    return _plausible(Image(voxels.astype(kind.newbyteorder("="), copy=False), affine, notes=note), path)


SWAPPED_ROUGHNESS: Final = 2.0
"""Voxels so many times as rough as with their bytes swapped are in the wrong order; in the right one they are less."""
SMOOTH: Final = 0.1
"""Scans are this smooth in the right order, noise included; patterns and pure noise are in neither."""
LARGEST_VOXEL: Final = 8
"""Bytes of the largest kind of voxel."""


def _bytes(path: Path, most: int) -> bytes:
    """Return what a file holds, unpacked, but not much more than `most` bytes of it."""
    try:
        with gzip.open(path) if suffix(path) == ".raw.gz" else path.open("rb") as file:
            return file.read(min(most, MOST_BYTES) + 1)
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
