"""DICOM series <-> Image."""

import logging
import struct
import warnings
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vstent.errors import ReadError, UnitError
from vstent.geometry.image import Image
from vstent.io.files import silenced
from vstent.kernels.arrays import Floats

MOST_VOXELS: Final = 1 << 31
"""A series of more voxels is none of a head, or its headers lie."""
MOST_UNPACKED: Final = 1 << 29
"""Bytes that a packed (deflated) file may hold."""
SPACING_TOLERANCE: Final = 0.02
"""Slices may lie this fraction of their distance off the regular grid."""


@dataclass(frozen=True, eq=False)
class _Slice:
    """One plane of voxels: a file, or a frame of one."""

    dataset: Any
    path: Path
    frame: int | None
    position_mm: Floats
    orientation: Floats
    """(2, 3) directions in which columns and rows are counted."""
    pixel_mm: Floats
    """(2,) distance between columns and between rows."""
    slope: float
    intercept: float
    padding: tuple[int, int] | None
    """Least and largest stored value of what is outside the field of view, where that is stated."""

    @property
    def name(self) -> str:
        """File, and frame if there are several."""
        return self.path.name if self.frame is None else f"{self.path.name} frame {self.frame + 1}"

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns."""
        return int(self.dataset.Rows), int(self.dataset.Columns)


def is_dicom(path: Path) -> bool:
    """Tell whether a file begins like DICOM: four letters after a preamble of 128 bytes."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(132)[128:] == b"DICM"


def read_dicom(path: Path) -> Image:
    """Read the largest series of a folder, or the series that one file belongs to.

    The order of the slices and the distance between them come from their positions, never from names or numbers.

    Raises
    ------
    ReadError
        No DICOM volume is there, or a slice is missing, double, or out of line.
    UnitError
        The size of the pixels is not stated.
    """
    with quiet():
        series, note = _choose(path)
        slices = [plane for file, dataset in series for plane in _planes(file, dataset)]
        slices, affine = _arrange(slices)
        voxels = np.stack([_pixels(plane) for plane in slices], axis=-1)  # (row, column, slice)
        modality = str(getattr(slices[0].dataset, "Modality", ""))
    return Image(voxels.transpose(1, 0, 2), affine, modality, note)


def series_of(path: Path) -> list[Path]:
    """Return the files of the series that a file belongs to, by name; that file alone where one cannot be read."""
    try:
        with quiet():
            return sorted(file for file, _ in _choose(path)[0])
    except ReadError:
        return [path]


@contextmanager
def quiet() -> Iterator[None]:
    """Keep pydicom's remarks on small faults to itself: what matters is raised."""
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
    """Give all that pydicom raises for files and pixels that it cannot decode."""
    from pydicom.errors import BytesLengthException, InvalidDicomError

    plain = (ArithmeticError, AttributeError, EOFError, LookupError, MemoryError, OSError, RuntimeError, TypeError)
    return (*plain, ValueError, struct.error, zlib.error, BytesLengthException, InvalidDicomError)


def _choose(path: Path) -> tuple[list[tuple[Path, Any]], tuple[str, ...]]:
    """Files of one series: the one with most voxels, or that of the file given."""
    folder = path if path.is_dir() else path.parent
    found: dict[str, list[tuple[Path, Any]]] = {}
    for file in _candidates(folder) if path.is_dir() else [path, *_siblings(path)]:
        dataset = _header(file)
        if dataset is not None:
            found.setdefault(str(getattr(dataset, "SeriesInstanceUID", "")), []).append((file, dataset))
    wanted = [key for key, files in found.items() if path.is_dir() or any(file == path for file, _ in files)]
    if not wanted:
        raise ReadError(f"{path} holds no DICOM images; check the path, or export the series again.")
    uid = max(wanted, key=lambda key: sum(_n_voxels(dataset) for _, dataset in found[key]))
    if (n_voxels := sum(_n_voxels(dataset) for _, dataset in found[uid])) > MOST_VOXELS:
        raise ReadError(
            f"{path} announces {n_voxels / 1e9:.3g} billion voxels, more than any scan of a head; export it again."
        )
    note = f"{len(found)} DICOM series found; the one of {len(found[uid])} files taken." if len(found) > 1 else ""
    return found[uid], (note,) if note else ()


def _candidates(folder: Path) -> list[Path]:
    """All DICOM files below a folder; one that only bears the name is damaged, and its slice would be missing."""
    files = sorted(p for p in folder.rglob("*") if not p.name.startswith("."))
    for file in files:
        if file.suffix.lower() == ".dcm" and not file.is_dir() and not is_dicom(file):
            raise ReadError(f"{file.name} is no DICOM file, or its beginning is damaged; copy it again, or remove it.")
    return [file for file in files if is_dicom(file)]


def _siblings(path: Path) -> list[Path]:
    return sorted(p for p in path.parent.iterdir() if p != path and is_dicom(p))


def _header(file: Path) -> Any:
    """Everything before the pixels of an image file; None for DICOM files that are no images."""
    import pydicom

    try:
        _refuse_bomb(file)
        dataset = pydicom.dcmread(file, stop_before_pixels=True)
        is_image = "Image Storage" in dataset.file_meta.MediaStorageSOPClassUID.name
        if not is_image and "Rows" not in dataset:
            return None
        _ = dataset.SeriesInstanceUID, _n_voxels(dataset)  # values are decoded, and faults met, on first use
        return dataset
    except damage():
        raise ReadError(
            f"{file.name} is damaged; copy it again, or remove it if it is not part of the series."
        ) from None


def _refuse_bomb(file: Path) -> None:
    """Refuse a deflated file that unpacks to more than a series holds: pydicom would unpack it whole."""
    from pydicom.filereader import read_file_meta_info
    from pydicom.uid import DeflatedExplicitVRLittleEndian

    meta = read_file_meta_info(file)
    if meta.get("TransferSyntaxUID") != DeflatedExplicitVRLittleEndian:
        return
    with file.open("rb") as stream:
        stream.seek(144 + meta.FileMetaInformationGroupLength)  # preamble, magic and this element go before
        unpacker, length = zlib.decompressobj(-zlib.MAX_WBITS), 0
        while length <= MOST_UNPACKED and (packed := unpacker.unconsumed_tail or stream.read(1 << 16)):
            length += len(unpacker.decompress(packed, 1 << 22))
    if length > MOST_UNPACKED:
        raise ReadError(f"{file.name} unpacks to more than {MOST_UNPACKED / 1e9:.1f} GB; export the series again.")


def _n_voxels(dataset: Any) -> int:
    return int(dataset.Rows) * int(dataset.Columns) * int(getattr(dataset, "NumberOfFrames", 1) or 1)


def _planes(file: Path, dataset: Any) -> list[_Slice]:
    """Slices of one file: itself, or its frames."""
    try:
        return _frames(file, dataset)
    except damage():
        raise ReadError(f"{file.name} is damaged: its position, orientation or pixel size cannot be read.") from None


def _frames(file: Path, dataset: Any) -> list[_Slice]:
    if "PerFrameFunctionalGroupsSequence" not in dataset:
        if int(getattr(dataset, "NumberOfFrames", 1) or 1) > 1:
            raise ReadError(f"{file.name} is a run of projections, not a volume; export the 3-D reconstruction.")
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
"""Where enhanced multi-frame files keep what single-frame files hold at the top."""


def _value(places: list[Any], keyword: str) -> Any:
    for place in places:
        group = getattr(place, _GROUP[keyword], None)
        value = getattr(group[0] if group else place, keyword, None)
        if value is not None:
            return value
    return None


def _plane(file: Path, dataset: Any, frame: int | None, places: list[Any]) -> _Slice:
    name = file.name if frame is None else f"{file.name} frame {frame + 1}"
    position, orientation = _value(places, "ImagePositionPatient"), _value(places, "ImageOrientationPatient")
    pixel = _value(places, "PixelSpacing")
    if position is None or orientation is None:
        raise ReadError(
            f"Slice {name} does not say where it lies in the patient; export the 3-D reconstruction as DICOM."
        )
    if pixel is None:
        raise UnitError(f"Slice {name} does not say how large its pixels are; export it again with PixelSpacing.")
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
    value = getattr(dataset, "PixelPaddingValue", None)
    if value is None:
        return None
    ends = int(value), int(getattr(dataset, "PixelPaddingRangeLimit", value))
    return min(ends), max(ends)


# -- geometry ----------------------------------------------------------------------------------------------------------


def _arrange(slices: list[_Slice]) -> tuple[list[_Slice], Floats]:
    """Sort slices along their normal, and give the affine from (column, row, slice) to LPS mm."""
    if len(slices) < 2:
        raise ReadError(
            f"Slice {slices[0].name} is alone: one slice is no volume; give the folder of the whole series."
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
    """All slices must have the size, pixels and orientation of the majority."""
    for what, values in (
        ("size", [plane.size for plane in slices]),
        ("pixel spacing", [tuple(np.round(plane.pixel_mm, 5)) for plane in slices]),
        ("orientation", [tuple(np.round(plane.orientation.ravel(), 4) + 0.0) for plane in slices]),
    ):
        usual = Counter(values).most_common(1)[0][0]
        odd = [plane.name for plane, value in zip(slices, values, strict=True) if value != usual]
        if odd:
            raise ReadError(
                f"Slice {odd[0]} has another {what} than the rest of its series ({len(odd)} such); remove it."
            )
    across, down = slices[0].orientation
    if not all(np.isfinite([*p.position_mm, *p.orientation.ravel(), *p.pixel_mm]).all() for p in slices):
        raise ReadError(
            "A slice has a position, orientation or pixel size that is not a number; export the series again."
        )
    if abs(across @ across - 1) > 1e-3 or abs(down @ down - 1) > 1e-3 or abs(across @ down) > 1e-3:
        raise ReadError(f"Slice {slices[0].name} has rows and columns that are not perpendicular; export it again.")


def _refuse_gaps(slices: list[_Slice], height: Floats) -> None:
    steps = np.diff(height)
    usual = float(np.median(steps))
    for i, step in enumerate(steps):
        before, after = slices[i].name, slices[i + 1].name
        if step < 0.01 * usual or usual <= 0:
            raise ReadError(
                f"Slices {before} and {after} lie at the same place ({height[i]:.3f} mm); keep one of them."
            )
        if step > 1.5 * usual:
            missing = round(step / usual) - 1
            raise ReadError(
                f"{missing} slice{'s are' if missing > 1 else ' is'} missing between {before} and {after} "
                f"({height[i]:.3f} to {height[i + 1]:.3f} mm, elsewhere {usual:.3f} mm apart); export the series again."
            )
        if abs(step - usual) > SPACING_TOLERANCE * usual:
            raise ReadError(
                f"Slice {after} lies {step:.3f} mm after {before}, but slices are {usual:.3f} mm apart elsewhere; "
                "export the series with equal distances."
            )


def _refuse_offsets(slices: list[_Slice], offset_mm: Floats, step_mm: float) -> None:
    distance = np.linalg.norm(offset_mm, axis=1)
    worst = int(distance.argmax())
    if distance[worst] > max(SPACING_TOLERANCE * step_mm, 1e-3):
        raise ReadError(
            f"Slice {slices[worst].name} lies {distance[worst]:.3f} mm out of line with the others; export again."
        )


# -- pixels ------------------------------------------------------------------------------------------------------------


def _pixels(plane: _Slice) -> NDArray[Any]:
    """Rescaled values (rows, columns) of one slice."""
    pixels = _decoded(plane)
    if pixels.shape != plane.size:
        raise ReadError(
            f"Slice {plane.name} holds {pixels.shape} values where {plane.size} were announced; export it again."
        )
    if plane.padding:
        pixels = _without_padding(pixels, plane.padding)
    if plane.slope == 1.0 and plane.intercept == 0.0:
        return pixels
    if plane.slope.is_integer() and plane.intercept.is_integer() and pixels.dtype.kind in "iu":
        return pixels.astype(np.int32) * int(plane.slope) + int(plane.intercept)
    return (pixels * plane.slope + plane.intercept).astype(np.float32)


def _without_padding(stored: NDArray[Any], padding: tuple[int, int]) -> NDArray[Any]:
    """Stored values (rows, columns), with the least of the others, or 0, where there is padding and no tissue.

    What stands for "outside the field of view" may be above all contrast (DICOM PS3.3, C.7.5.1.1.2).
    """
    is_padding = (stored >= padding[0]) & (stored <= padding[1])
    rest = stored[~is_padding]
    return np.where(is_padding, rest.min() if rest.size else stored.dtype.type(0), stored)


def _decoded(plane: _Slice) -> NDArray[Any]:
    try:
        if "PixelData" not in plane.dataset:
            _load_pixels(plane)
        array = plane.dataset.pixel_array
    except damage():
        array = _decoded_by_gdcm(plane)
    return array if plane.frame is None or array.ndim == 2 else array[plane.frame]


def _load_pixels(plane: _Slice) -> None:
    """Read the pixel data into the header read before."""
    import pydicom

    full = pydicom.dcmread(plane.path)
    for keyword in ("PixelData", "FloatPixelData", "DoubleFloatPixelData"):
        if keyword in full:
            plane.dataset[keyword] = full[keyword]
    plane.dataset.file_meta = full.file_meta


def _decoded_by_gdcm(plane: _Slice) -> NDArray[Any]:
    """Decode what pydicom alone cannot (JPEG, JPEG-LS, JPEG 2000): stored values, before rescaling."""
    import SimpleITK

    try:
        with silenced():
            scan = SimpleITK.ReadImage(str(plane.path))
    except RuntimeError:
        raise ReadError(
            f"The pixels of slice {plane.name} are damaged or in a format that is not known; "
            "copy it again, or export the series uncompressed."
        ) from None
    array = SimpleITK.GetArrayFromImage(scan)
    stored = (array - plane.intercept) / plane.slope  # GDCM has rescaled
    return stored if plane.frame is not None else stored[0]
