"""Read scans: DICOM, NIfTI, NRRD, MetaImage, VTK images and raw voxels, as an `Image` in LPS mm."""

import glob
import gzip
import math
import os
import re
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from vstent.errors import ReadError, UnitError
from vstent.geometry.image import Image
from vstent.io import dicom
from vstent.io.files import IMAGE_SUFFIXES, NIFTI_SUFFIXES, RAW_SUFFIXES, existing, is_surface_file, silenced, suffix
from vstent.io.nifti import MOST_BYTES, MOST_PACKED, read_nifti
from vstent.io.rectangular import rectangular
from vstent.io.vtk_child import read_vti

VOXEL_MM: Final = (0.01, 5.0)
"""Smallest and largest plausible voxel edge of a scan of the head, in mm."""
LONGEST_LINE: Final = 1000
"""Largest number of characters in a line of a header."""


def read_image(
    path: Path,
    *,
    spacing_mm: Sequence[float] | None = None,
    shape: Sequence[int] | None = None,
    dtype: DTypeLike | None = None,
    acquisition: int | None = None,
) -> Image:
    """Read a scan.

    Parameters
    ----------
    path : DICOM folder or file, NIfTI, NRRD, MHA, MHD, VTI or raw (also .gz).
    spacing_mm : voxel edges along i, j, k, or one number for cubes. Required for raw voxels and for headers without
        spacing; it replaces the spacing in the header.
    shape : number of voxels along i, j, k of raw voxels; i runs fastest.
    dtype : type of raw voxels; None: derived from the file size and reported in a note.
    acquisition : number of the acquisition in a DICOM series that holds several, counted from 1; None: the one with the
        brightest vessels.

    Returns
    -------
    image : Image
        Voxels (i, j, k) and the affine from voxel to LPS mm.

    Raises
    ------
    ReadError
        The file is missing, damaged, or not what its name says; a slice is missing, duplicated or misplaced.
    UnitError
        The voxel spacing is unknown or implausible.
    """
    path = existing(path)
    kind = suffix(path)
    is_series = path.is_dir() or kind == ".dcm" or dicom.is_dicom(path)
    if is_series:
        image = dicom.read_dicom(path, acquisition=acquisition)
    elif kind in RAW_SUFFIXES:
        return _read_raw(path, spacing_mm, shape, dtype)
    elif kind in NIFTI_SUFFIXES:
        image = read_nifti(path, has_spacing=spacing_mm is not None)
    elif kind == ".vti":
        image = read_vti(path)
    elif kind in IMAGE_SUFFIXES:
        image = _read_itk(path, kind, has_spacing=spacing_mm is not None)
    else:
        raise ReadError(
            f"{path.name} is not a scan that vstent reads. Give a DICOM folder or one of {', '.join(IMAGE_SUFFIXES)}."
        )
    if spacing_mm is not None:
        image = _respaced(image, _three(spacing_mm, "spacing"))
    image = _plausible(image, path)
    return image if is_series else rectangular(image)  # the affine of a tilted DICOM series is exact


def files_of(path: Path) -> list[Path]:
    """Return all files that are read when one file of a scan or surface is given.

    These are the file itself, separate voxel files that its header names, and the other files of a DICOM series.
    Missing files are left out; `read_image` reports them.
    """
    if is_surface_file(path):
        return [path]
    if dicom.is_dicom(path):
        return dicom.series_of(path)
    return [path, *(file for file in _voxel_files(path) if os.path.isfile(file))]  # accepts too long names


APART: Final = {
    **dict.fromkeys((".mha", ".mhd"), re.compile(rb"^[ \t]*elementdatafile[ \t]*=([^\0\r\n]{1,1000})", re.I | re.M)),
    **dict.fromkeys((".nrrd", ".nhdr"), re.compile(rb"^data ?file:([^\0\r\n]{1,1000})", re.I | re.M)),
}
"""Pattern of the header line that names the voxel file: a name, a file pattern, or ``LIST`` and one file per line."""


def _voxel_files(path: Path) -> list[Path]:
    """Return the voxel files that a header names, whether they exist or not."""
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


# -- headers that ITK reads --------------------------------------------------------------------------------------------


def _read_itk(path: Path, kind: str, *, has_spacing: bool) -> Image:
    """Return the image in a file that ITK reads."""
    import SimpleITK

    if kind in (".mha", ".mhd"):
        _refuse_odd_meta(path)
    reader = SimpleITK.ImageFileReader()
    try:
        with silenced():
            reader.SetFileName(str(path))
            reader.ReadImageInformation()
            _refuse_untrue(path, kind, reader)
            scan = reader.Execute()
    except RuntimeError as error:
        raise ReadError(
            f"{path.name} is damaged or not a {kind} file{_reason(error)}. Copy or export it again."
        ) from None
    if not has_spacing and not _states_spacing(path, kind):
        raise UnitError(f"{path.name} does not state a voxel spacing above zero; give --spacing in mm.")
    if scan.GetDimension() == 4 and scan.GetSize()[3] == 1:
        scan = scan[:, :, :, 0]
    if scan.GetDimension() != 3 or scan.GetNumberOfComponentsPerPixel() != 1 or scan.GetPixelID() < 0:
        raise ReadError(
            f"{path.name} has {scan.GetDimension()} dimensions and {scan.GetNumberOfComponentsPerPixel()} values per "
            "voxel. Export one volume with one value per voxel."
        )
    affine = np.eye(4)
    affine[:3, :3] = np.reshape(scan.GetDirection(), (3, 3)) * scan.GetSpacing()
    affine[:3, 3] = scan.GetOrigin()
    return Image(SimpleITK.GetArrayViewFromImage(scan).transpose(), affine)


def _refuse_odd_meta(path: Path) -> None:
    """Raise ReadError for a MetaImage header with contradicting counts, because ITK crashes on those."""
    with path.open("rb") as file:
        head = file.read(65536).partition(b"ElementDataFile")[0]
    pairs = [line.partition(b"=") for line in head.splitlines()]
    values = {key.strip().lower(): value.split() for key, _, value in pairs}
    n_axes = {b"2": 2, b"3": 3, b"4": 4}.get(b" ".join(values.get(b"ndims", [])), 0)
    counts = {b"dimsize": n_axes, b"elementspacing": n_axes, b"transformmatrix": n_axes**2, b"offset": n_axes}
    wrong = [key for key, n in counts.items() if key in values and len(values[key]) != n]
    if len(values) < len(pairs) or n_axes == 0 or wrong or any(len(line) > LONGEST_LINE for line in head.splitlines()):
        raise ReadError(f"{path.name} is damaged: its header contradicts itself. Copy or export it again.")


def _refuse_untrue(path: Path, kind: str, reader: Any) -> None:
    """Raise ReadError where a header states more than the file holds, because ITK would fill the rest with zeros."""
    import SimpleITK

    size = reader.GetSize()
    if min(size) < 1 or reader.GetPixelID() < 0:
        raise ReadError(f"{path.name} has no voxels of a supported type. Export it again as integers.")
    voxel = SimpleITK.Image([1] * reader.GetDimension(), reader.GetPixelID(), reader.GetNumberOfComponents())
    n_bytes = math.prod(size) * voxel.GetNumberOfComponentsPerPixel() * voxel.GetSizeOfPixelComponent()
    announced = f"{path.name} states {' x '.join(map(str, size))} voxels, {n_bytes / 1e9:.3g} GB"
    n_held = path.stat().st_size
    if kind not in (".nhdr", ".mhd") and n_bytes > MOST_PACKED * n_held:
        raise ReadError(f"{announced}, but has {n_held} bytes: it is damaged and breaks off. Copy or export it again.")
    if n_bytes > MOST_BYTES:
        raise ReadError(f"{announced}, which is more than a scan of the head. Export the part around the aneurysm.")


def _reason(error: Exception) -> str:
    """Return the last plain sentence of an ITK exception in parentheses, or nothing where it gives no reason."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    last = lines[-1].split("): ", 1)[-1].rstrip(".") if lines else ""
    says_little = (
        not last or "sitk::ERROR" in last or last.startswith("Reason:") or " " not in last.strip("0123456789 ")
    )
    return "" if says_little else f" ({last[:150]})"


def _states_spacing(path: Path, kind: str) -> bool:
    """Return whether the header states the voxel spacing; ITK assumes 1 mm where it does not."""
    with path.open("rb") as file:
        head = file.read(65536)
    text = head.split(b"\n\n")[0] if kind in (".nrrd", ".nhdr") else head.split(b"ElementDataFile")[0]
    keys = (b"spacings:", b"space directions:") if kind in (".nrrd", ".nhdr") else (b"elementspacing", b"elementsize")
    return any(line.strip().lower().startswith(keys) and _may_be_spacing(line) for line in text.splitlines())


def _may_be_spacing(line: bytes) -> bool:
    """Return whether a header line holds numbers and no negative edge, whose sign ITK would drop."""
    key, _, values = line.lower().replace(b"=", b":").partition(b":")
    is_edges = b"directions" not in key
    return b"nan" not in values and not (is_edges and any(word.startswith(b"-") for word in values.split()))


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
        with gzip.open(path) if suffix(path) == ".raw.gz" else path.open("rb") as file:
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
