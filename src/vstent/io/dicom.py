"""Read a DICOM series as an `Image`."""

import logging
import struct
import warnings
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vstent.errors import ReadError, UnitError
from vstent.geometry.image import Image
from vstent.io.files import silenced
from vstent.kernels.arrays import Floats
from vstent.units import counted

MOST_VOXELS: Final = 1 << 31
"""Largest number of voxels of a series; a scan of the head has fewer."""
MOST_UNPACKED: Final = 1 << 29
"""Largest unpacked size of a deflated file, in bytes."""
SPACING_TOLERANCE: Final = 0.02
"""Largest deviation of a slice from the regular grid, as a fraction of the slice distance."""


@dataclass(frozen=True, eq=False)
class _Slice:
    """One plane of voxels: a file, or one frame of a multi-frame file."""

    dataset: Any
    """Header of the file, without pixels until they are needed."""
    path: Path
    """The file."""
    frame: int | None
    """Index of the frame of a multi-frame file; None for a single-frame file."""
    position_mm: Floats
    """(3,) center of the first voxel, LPS mm."""
    orientation: Floats
    """(2, 3) unit directions of increasing column and of increasing row number."""
    pixel_mm: Floats
    """(2,) distance between columns and between rows, in mm."""
    slope: float
    """Factor from stored to rescaled values."""
    intercept: float
    """Offset added after the factor."""
    padding: tuple[int, int] | None
    """Smallest and largest stored value that mark pixels outside the field of view; None where not stated."""

    @property
    def name(self) -> str:
        """Name of the file, with the frame number of a multi-frame file."""
        return self.path.name if self.frame is None else f"{self.path.name} frame {self.frame + 1}"

    @property
    def size(self) -> tuple[int, int]:
        """Number of rows and of columns."""
        return int(self.dataset.Rows), int(self.dataset.Columns)


def is_dicom(path: Path) -> bool:
    """Return whether a file begins like DICOM: the letters DICM after a preamble of 128 bytes."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(132)[128:] == b"DICM"


def read_dicom(path: Path, *, acquisition: int | None = None) -> Image:
    """Read the largest series of a folder, or the series that one file belongs to.

    Slices are ordered by position, never by name or number. Exact copies of a slice are dropped. Where a series holds
    several acquisitions of the same slices, such as mask and fill runs, one is read: the requested one, else the one
    with the brightest vessels. MONOCHROME1 images are inverted.

    Parameters
    ----------
    path : a folder, or one file of a series; a multi-frame file is read alone.
    acquisition : number of the acquisition in a series that holds several, counted from 1.

    Returns
    -------
    Image
        Voxels (i, j, k) and the affine from voxel to LPS mm.

    Raises
    ------
    ReadError
        There is no DICOM volume, or a slice is missing, duplicated with other pixels, or misplaced.
    UnitError
        The pixel spacing is not stated.
    """
    with quiet():
        series, notes = _choose(path)
        planes, of_groups = _one_acquisition(
            [p for file, dataset in series for p in _planes(file, dataset)], acquisition
        )
        planes, of_copies = _without_copies(planes)
        slices, affine = _arrange(planes)
        voxels = np.stack([_pixels(plane) for plane in slices], axis=-1)  # (row, column, slice)
        modality = str(getattr(slices[0].dataset, "Modality", ""))
        of_colors = (INVERTED,) if _is_inverted(slices[0]) else ()
    return Image(voxels.transpose(1, 0, 2), affine, modality, (*notes, *of_groups, *of_copies, *of_colors))


INVERTED: Final = "The images are MONOCHROME1 (bright means low): intensities were inverted."
"""Note on inverted images."""


def series_of(path: Path) -> list[Path]:
    """Return the files of the series that a file belongs to, sorted; the file alone where it cannot be read."""
    try:
        with quiet():
            return sorted(file for file, _ in _choose(path)[0])
    except ReadError:
        return [path]


@contextmanager
def quiet() -> Iterator[None]:
    """Suppress pydicom's warnings about minor faults; errors are still raised."""
    logger = logging.getLogger("pydicom")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)


def damage() -> tuple[type[Exception], ...]:
    """Return every exception that pydicom raises for files and pixels that it cannot decode."""
    from pydicom.errors import BytesLengthException, InvalidDicomError

    plain = (ArithmeticError, AttributeError, EOFError, LookupError, MemoryError, OSError, RuntimeError, TypeError)
    return (*plain, ValueError, struct.error, zlib.error, BytesLengthException, InvalidDicomError)


def _choose(path: Path) -> tuple[list[tuple[Path, Any]], tuple[str, ...]]:
    """Return the files of one series (the one with most voxels, or that of the file given) and notes."""
    found: dict[str, list[tuple[Path, Any]]] = {}
    for file, dataset in _headers(path):
        if dataset is not None:
            found.setdefault(str(getattr(dataset, "SeriesInstanceUID", "")), []).append((file, dataset))
    wanted = [key for key, files in found.items() if path.is_dir() or any(file == path for file, _ in files)]
    if not wanted:
        raise ReadError(f"{path} holds no DICOM images. Check the path, or export the series again.")
    uid = max(wanted, key=lambda key: sum(_n_voxels(dataset) for _, dataset in found[key]))
    if (n_voxels := sum(_n_voxels(dataset) for _, dataset in found[uid])) > MOST_VOXELS:
        raise ReadError(
            f"{path} states {n_voxels / 1e9:.3g} billion voxels, more than a scan of the head. Export it again."
        )
    note = f"{len(found)} DICOM series found; the largest, of {len(found[uid])} files, is used."
    return found[uid], (note,) if len(found) > 1 and path.is_dir() else ()


def _headers(path: Path) -> Iterator[tuple[Path, Any]]:
    """Yield files with their headers: all below a folder, or the given file and its neighbors.

    A multi-frame file is a volume of its own. A neighbor that cannot be read may belong to another series; where it
    belongs to this one, its slice is reported as missing later.
    """
    if path.is_dir():
        yield from ((file, _header(file)) for file in _candidates(path))
        return
    own = _header(path)
    yield path, own
    if own is not None and int(getattr(own, "NumberOfFrames", 1) or 1) > 1:
        return
    for file in _siblings(path):
        with suppress(ReadError):
            yield file, _header(file)


def _candidates(folder: Path) -> list[Path]:
    """Return all DICOM files below a folder; raise ReadError for a damaged one, whose slice would be missing."""
    files = sorted(p for p in folder.rglob("*") if not p.name.startswith("."))
    for file in files:
        if file.suffix.lower() == ".dcm" and not file.is_dir() and not is_dicom(file):
            raise ReadError(
                f"{file.name} is not a DICOM file, or its beginning is damaged. Copy it again, or remove it."
            )
    return [file for file in files if is_dicom(file)]


def _siblings(path: Path) -> list[Path]:
    """Return the other DICOM files in the folder of a file."""
    return sorted(p for p in path.parent.iterdir() if p != path and is_dicom(p))


def _header(file: Path) -> Any:
    """Return the header of an image file; None for DICOM files that are not images."""
    import pydicom

    try:
        _refuse_bomb(file)
        dataset = pydicom.dcmread(file, stop_before_pixels=True)
        is_image = "Image Storage" in dataset.file_meta.MediaStorageSOPClassUID.name
        if not is_image and "Rows" not in dataset:
            return None
        _ = dataset.SeriesInstanceUID, _n_voxels(dataset)  # faults are raised when values are first used
        return dataset
    except damage():
        raise ReadError(
            f"{file.name} is damaged. Copy it again, or remove it if it is not part of the series."
        ) from None


def _refuse_bomb(file: Path) -> None:
    """Raise ReadError for a deflated file that unpacks to more than a series holds: pydicom would unpack all of it."""
    from pydicom.filereader import read_file_meta_info
    from pydicom.uid import DeflatedExplicitVRLittleEndian

    meta = read_file_meta_info(file)
    if meta.get("TransferSyntaxUID") != DeflatedExplicitVRLittleEndian:
        return
    with file.open("rb") as stream:
        stream.seek(144 + meta.FileMetaInformationGroupLength)  # 144: preamble, magic and this element
        unpacker, length = zlib.decompressobj(-zlib.MAX_WBITS), 0
        while length <= MOST_UNPACKED and (packed := unpacker.unconsumed_tail or stream.read(1 << 16)):
            length += len(unpacker.decompress(packed, 1 << 22))
    if length > MOST_UNPACKED:
        raise ReadError(f"{file.name} unpacks to more than {MOST_UNPACKED / 1e9:.1f} GB. Export the series again.")


def _n_voxels(dataset: Any) -> int:
    """Return the number of voxels of a file."""
    return int(dataset.Rows) * int(dataset.Columns) * int(getattr(dataset, "NumberOfFrames", 1) or 1)


def _planes(file: Path, dataset: Any) -> list[_Slice]:
    """Return the slices of one file: itself, or its frames."""
    try:
        return _frames(file, dataset)
    except damage():
        raise ReadError(
            f"{file.name} is damaged: its position, orientation or pixel spacing cannot be read. Export it again."
        ) from None


def _frames(file: Path, dataset: Any) -> list[_Slice]:
    """Return the slices of one file; ReadError is raised for a series of projections."""
    if "PerFrameFunctionalGroupsSequence" not in dataset:
        if int(getattr(dataset, "NumberOfFrames", 1) or 1) > 1:
            raise ReadError(f"{file.name} is a series of projections, not a volume. Export the 3-D reconstruction.")
        return [_plane(file, dataset, None, [dataset])]
    shared = list(getattr(dataset, "SharedFunctionalGroupsSequence", []))
    frames = dataset.PerFrameFunctionalGroupsSequence
    return [_plane(file, dataset, k, [frame, *shared, dataset]) for k, frame in enumerate(frames)]


_GROUP: Final = {
    "ImagePositionPatient": "PlanePositionSequence",
    "ImageOrientationPatient": "PlaneOrientationSequence",
    "PixelSpacing": "PixelMeasuresSequence",
    "RescaleSlope": "PixelValueTransformationSequence",
    "RescaleIntercept": "PixelValueTransformationSequence",
}
"""Sequences in which enhanced multi-frame files keep attributes that single-frame files have at the top level."""


def _value(places: list[Any], keyword: str) -> Any:
    """Return an attribute from the first place that states it; None where none does."""
    for place in places:
        group = getattr(place, _GROUP[keyword], None)
        value = getattr(group[0] if group else place, keyword, None)
        if value is not None:
            return value
    return None


def _plane(file: Path, dataset: Any, frame: int | None, places: list[Any]) -> _Slice:
    """Return one slice with its position, orientation, spacing and scaling."""
    name = file.name if frame is None else f"{file.name} frame {frame + 1}"
    position, orientation = _value(places, "ImagePositionPatient"), _value(places, "ImageOrientationPatient")
    pixel = _value(places, "PixelSpacing")
    if position is None or orientation is None:
        raise ReadError(
            f"Slice {name} does not state its position in the patient. Export the 3-D reconstruction as DICOM."
        )
    if pixel is None:
        raise UnitError(f"Slice {name} does not state its pixel spacing. Export it again with PixelSpacing.")
    return _Slice(
        dataset,
        file,
        frame,
        np.asarray(position, dtype=np.float64).reshape(3),
        np.asarray(orientation, dtype=np.float64).reshape(2, 3),
        np.asarray(pixel, dtype=np.float64).reshape(2)[::-1],
        float(_value(places, "RescaleSlope") or 1.0),
        float(_value(places, "RescaleIntercept") or 0.0),
        _padding(dataset),
    )


def _padding(dataset: Any) -> tuple[int, int] | None:
    """Return the range of stored values outside the field of view; None where it is not stated."""
    value = getattr(dataset, "PixelPaddingValue", None)
    if value is None:
        return None
    ends = int(value), int(getattr(dataset, "PixelPaddingRangeLimit", value))
    return min(ends), max(ends)


# -- acquisitions and copies ----------------------------------------------------------------------------------------


ACQUISITION_KEYS: Final = {
    "AcquisitionNumber": "acquisition number",
    "TemporalPositionIdentifier": "temporal position",
    "AcquisitionTime": "acquisition time",
    "TriggerTime": "trigger time",
    "EchoTime": "echo time",
    "ContentTime": "content time",
    "ImageType": "image type",
}
"""Attributes that may distinguish the acquisitions of a series, in the order in which they are tried: display names."""
SAME_PLACE_MM: Final = 1e-3
"""Resolution in mm at which slice positions are compared."""
BRIGHT_QUANTILE: Final = 0.999
"""Quantile of the values of a slice that measures the brightness of its vessels."""
SLICES_LOOKED_AT: Final = 5
"""Number of slices of an acquisition whose brightness is averaged."""


def _places(planes: list[_Slice]) -> list[tuple[int, ...]]:
    """Return the position of every slice as whole multiples of `SAME_PLACE_MM`."""
    return [tuple(np.round(plane.position_mm / SAME_PLACE_MM).astype(int).tolist()) for plane in planes]


def _one_acquisition(planes: list[_Slice], wanted: int | None) -> tuple[list[_Slice], tuple[str, ...]]:
    """Return the slices of one acquisition and a note, where a series holds several of the same slices."""
    key, groups = _acquisitions(planes)
    if len(groups) < 2:
        if wanted not in (None, 1):
            raise ReadError(f"The series holds one acquisition: acquisition {wanted} does not exist. Give 1 or none.")
        return planes, ()
    names = [
        f"{number}: {ACQUISITION_KEYS[key]} {name}, {len(one)} slices" for number, (name, one) in enumerate(groups, 1)
    ]
    listed = "; ".join(names)
    if wanted is not None and not 1 <= wanted <= len(groups):
        raise ReadError(
            f"The series holds {len(groups)} acquisitions ({listed}), not {wanted}. Give one of these numbers."
        )
    chosen = int(np.argmax([_brightness(one) for _, one in groups])) if wanted is None else wanted - 1
    why = "chosen because its vessels are the brightest; choose another by its number (--acquisition)"
    note = f"The series holds {len(groups)} acquisitions ({listed}). Acquisition {chosen + 1} is used"
    return groups[chosen][1], (f"{note}, as requested." if wanted is not None else f"{note}, {why}.",)


def _acquisitions(planes: list[_Slice]) -> tuple[str, list[tuple[str, list[_Slice]]]]:
    """Return the attribute that distinguishes acquisitions and the slices by its values; no groups where there is one.

    It is the first attribute that divides slices of the same position so that every group has each position once.
    """
    if len(set(_places(planes))) == len(planes):
        return "", []
    for key in ACQUISITION_KEYS:
        groups: dict[str, list[_Slice]] = {}
        for plane in planes:
            groups.setdefault(_text(getattr(plane.dataset, key, None)), []).append(plane)
        shared = set.intersection(*(set(_places(one)) for one in groups.values()))
        if len(groups) > 1 and shared and all(len(set(_places(one))) == len(one) for one in groups.values()):
            return key, sorted(groups.items(), key=lambda item: _sortable(item[0]))
    return "", []


def _text(value: Any) -> str:
    """Return the value of an attribute as text."""
    if value is None:
        return "none"
    return str(value) if isinstance(value, str) or not hasattr(value, "__iter__") else "/".join(map(str, value))


def _sortable(name: str) -> tuple[float, str]:
    """Return a key that sorts numbers before other texts."""
    try:
        return float(name), name
    except ValueError:
        return float("inf"), name


def _brightness(planes: list[_Slice]) -> float:
    """Return the brightness of the vessels in the middle slices of an acquisition."""
    normal = np.cross(*planes[0].orientation)
    order = np.argsort([plane.position_mm @ normal for plane in planes])
    middle = np.unique(np.linspace(0.25, 0.75, SLICES_LOOKED_AT) * (len(planes) - 1)).round().astype(int)
    return float(np.mean([np.quantile(_pixels(planes[order[i]]), BRIGHT_QUANTILE) for i in middle]))


def _without_copies(planes: list[_Slice]) -> tuple[list[_Slice], tuple[str, ...]]:
    """Return slices without exact copies (same position, same pixels), and a note where there are any."""
    kept: dict[tuple[int, ...], _Slice] = {}
    others: list[_Slice] = []
    dropped = 0
    for place, plane in zip(_places(planes), planes, strict=True):
        first = kept.setdefault(place, plane)
        if first is plane:
            continue
        if np.array_equal(_pixels(first), _pixels(plane)):
            dropped += 1
        else:
            others.append(plane)
    note = f"{counted(dropped, 'slice')} with the same position and the same pixels as another: dropped."
    return [*kept.values(), *others], (note,) if dropped else ()


# -- geometry ----------------------------------------------------------------------------------------------------------


def _arrange(slices: list[_Slice]) -> tuple[list[_Slice], Floats]:
    """Return slices sorted along their normal, and the affine from (column, row, slice) to LPS mm."""
    if len(slices) < 2:
        raise ReadError(
            f"Slice {slices[0].name} is alone, and one slice is not a volume. Give the folder of the whole series."
        )
    _refuse_odd(slices)
    across, down = slices[0].orientation
    normal = np.cross(across, down)
    height = np.array([plane.position_mm @ normal for plane in slices])
    order = np.argsort(height, kind="stable")
    slices = [slices[i] for i in order]
    _refuse_gaps(slices, height[order])
    position = np.array([plane.position_mm for plane in slices])
    step = (position[-1] - position[0]) / (len(slices) - 1)
    _refuse_offsets(
        slices, position - position[0] - np.arange(len(slices))[:, None] * step, float(np.linalg.norm(step))
    )
    affine = np.eye(4)
    affine[:3, 0] = across * slices[0].pixel_mm[0]
    affine[:3, 1] = down * slices[0].pixel_mm[1]
    affine[:3, 2] = step
    affine[:3, 3] = position[0]
    return slices, affine


def _refuse_odd(slices: list[_Slice]) -> None:
    """Raise ReadError where a slice differs in size, pixel spacing or orientation from the majority."""
    for what, values in (
        ("size", [plane.size for plane in slices]),
        ("pixel spacing", [tuple(np.round(plane.pixel_mm, 5)) for plane in slices]),
        ("orientation", [tuple(np.round(plane.orientation.ravel(), 4) + 0.0) for plane in slices]),
    ):
        usual = Counter(values).most_common(1)[0][0]
        odd = [plane.name for plane, value in zip(slices, values, strict=True) if value != usual]
        if odd:
            raise ReadError(
                f"Slice {odd[0]} has another {what} than the rest of its series ({len(odd)} such). Remove it."
            )
    across, down = slices[0].orientation
    if not all(np.isfinite([*p.position_mm, *p.orientation.ravel(), *p.pixel_mm]).all() for p in slices):
        raise ReadError(
            "A slice has a position, orientation or pixel spacing that is not a number. Export the series again."
        )
    if abs(across @ across - 1) > 1e-3 or abs(down @ down - 1) > 1e-3 or abs(across @ down) > 1e-3:
        raise ReadError(f"Slice {slices[0].name} has rows and columns that are not perpendicular. Export it again.")


def _refuse_gaps(slices: list[_Slice], height: Floats) -> None:
    """Raise ReadError where slices are missing, at the same position, or unevenly spaced."""
    steps = np.diff(height)
    usual = float(np.median(steps))
    for i, step in enumerate(steps):
        before, after = slices[i].name, slices[i + 1].name
        if step < 0.01 * usual or usual <= 0:
            raise ReadError(
                f"Slices {before} and {after} differ but have the same position ({height[i]:.3f} mm). Keep one of them."
            )
        if step > 1.5 * usual:
            missing = round(step / usual) - 1
            raise ReadError(
                f"{missing} slice{'s are' if missing > 1 else ' is'} missing between {before} and {after} "
                f"({height[i]:.3f} to {height[i + 1]:.3f} mm, elsewhere {usual:.3f} mm apart). Export the series again."
            )
        if abs(step - usual) > SPACING_TOLERANCE * usual:
            raise ReadError(
                f"Slice {after} is {step:.3f} mm from {before}, but slices are {usual:.3f} mm apart elsewhere. "
                "Export the series with equal distances."
            )


def _refuse_offsets(slices: list[_Slice], offset_mm: Floats, step_mm: float) -> None:
    """Raise ReadError where a slice is off the line of the others."""
    distance = np.linalg.norm(offset_mm, axis=1)
    worst = int(distance.argmax())
    if distance[worst] > max(SPACING_TOLERANCE * step_mm, 1e-3):
        raise ReadError(
            f"Slice {slices[worst].name} is {distance[worst]:.3f} mm out of line with the others. Export again."
        )


# -- pixels ------------------------------------------------------------------------------------------------------------


def _pixels(plane: _Slice) -> NDArray[Any]:
    """Return the rescaled values (rows, columns) of one slice; high values are bright."""
    pixels = _decoded(plane)
    if pixels.shape != plane.size:
        raise ReadError(
            f"Slice {plane.name} holds {pixels.shape} values where its header states {plane.size}. Export it again."
        )
    if plane.padding:
        pixels = _without_padding(pixels, plane.padding, is_inverted=_is_inverted(plane))
    if _is_inverted(plane):
        pixels = _inverted(pixels, plane.dataset)
    if plane.slope == 1.0 and plane.intercept == 0.0:
        return pixels
    if plane.slope.is_integer() and plane.intercept.is_integer() and pixels.dtype.kind in "iu":
        return pixels.astype(np.int32) * int(plane.slope) + int(plane.intercept)
    return (pixels * plane.slope + plane.intercept).astype(np.float32)


def _without_padding(stored: NDArray[Any], padding: tuple[int, int], *, is_inverted: bool) -> NDArray[Any]:
    """Return stored values (rows, columns) with pixels outside the field of view set to the darkest value inside, or 0.

    The padding value may be brighter than any contrast (DICOM PS3.3, C.7.5.1.1.2).
    """
    is_padding = (stored >= padding[0]) & (stored <= padding[1])
    rest = stored[~is_padding]
    if not rest.size:
        return np.where(is_padding, stored.dtype.type(0), stored)
    return np.where(is_padding, rest.max() if is_inverted else rest.min(), stored)


def _is_inverted(plane: _Slice) -> bool:
    """Return whether low values of a slice are bright (MONOCHROME1)."""
    return str(getattr(plane.dataset, "PhotometricInterpretation", "")).strip() == "MONOCHROME1"


def _inverted(stored: NDArray[Any], dataset: Any) -> NDArray[Any]:
    """Return the stored values of a MONOCHROME1 image inverted within their number of bits."""
    if stored.dtype.kind == "f":
        return -stored
    is_signed, bits = int(getattr(dataset, "PixelRepresentation", 0)), int(dataset.BitsStored)
    top = -1 if is_signed else (1 << bits) - 1
    return (top - stored.astype(np.int64)).astype(np.int32 if bits > 15 else stored.dtype)


def _decoded(plane: _Slice) -> NDArray[Any]:
    """Return the stored values (rows, columns) of one slice."""
    try:
        if "PixelData" not in plane.dataset:
            _load_pixels(plane)
        array = plane.dataset.pixel_array
    except damage():
        array = _decoded_by_gdcm(plane)
    return array if plane.frame is None or array.ndim == 2 else array[plane.frame]


def _load_pixels(plane: _Slice) -> None:
    """Add the pixel data to the header of a slice."""
    import pydicom

    full = pydicom.dcmread(plane.path)
    for keyword in ("PixelData", "FloatPixelData", "DoubleFloatPixelData"):
        if keyword in full:
            plane.dataset[keyword] = full[keyword]
    plane.dataset.file_meta = full.file_meta


def _decoded_by_gdcm(plane: _Slice) -> NDArray[Any]:
    """Return stored values of images that pydicom cannot decode alone (JPEG, JPEG-LS, JPEG 2000)."""
    import SimpleITK

    try:
        with silenced():
            scan = SimpleITK.ReadImage(str(plane.path))
    except RuntimeError:
        raise ReadError(
            f"The pixels of slice {plane.name} are damaged or in a format that is not supported. "
            "Copy it again, or export the series uncompressed."
        ) from None
    array = SimpleITK.GetArrayFromImage(scan)
    stored = (array - plane.intercept) / plane.slope  # GDCM returns rescaled values
    return stored if plane.frame is not None else stored[0]
