"""Read a DICOM series as an `Image`."""

import logging
import re
import struct
import warnings
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vstent.errors import ReadError, UnitError
from vstent.geometry.image import Image
from vstent.io.files import IMAGE_SUFFIXES, SURFACE_SUFFIXES, files_in, suffix
from vstent.io.limits import refuse_bomb
from vstent.kernels.arrays import Floats
from vstent.units import counted

MOST_UNPACKED: Final = 1 << 29
"""Largest unpacked size of a deflated file, in bytes."""
SPACING_TOLERANCE: Final = 0.02
"""Largest deviation of a slice from the regular grid, as a fraction of the slice distance."""
ROUNDED: Final = 0.6
"""Largest deviation of a rounded number from a fitted line, in units of its last digit."""
MOST_OVERLAP: Final = 2.5
"""Largest usual ratio of the thickness of slices to their distance; it is 2 where half of each slice overlaps."""
SAME: Final = 1e-3
"""Largest difference of directions of unit length, and of pixel spacings relative to each other, within a series."""
SKEWED: Final = 0.03
"""Largest error of the product of two directions of two digits."""
MOST_ODD: Final = 0.25
"""Largest fraction of slices that may be called odd ones; more are another stack."""


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
    thickness_mm: float
    """Thickness; 0 where not stated."""
    rounding_mm: float
    """Last digit to which the position is written, in mm."""

    @property
    def name(self) -> str:
        """Name of the file, with the frame number of a multi-frame file."""
        return self.path.name if self.frame is None else f"{self.path.name} frame {self.frame + 1}"

    @property
    def size(self) -> tuple[int, int]:
        """Number of rows and of columns."""
        return int(self.dataset.Rows), int(self.dataset.Columns)


BARE: Final = re.compile(rb"[\x02\x08]\0.\0([A-Z]{2}|.{2}\0\0)|\0[\x02\x08]\0.[A-Z]{2}", re.DOTALL)
"""First bytes of a file without preamble: an element of group 2 or 8, with a value of less than 64 kB."""
DIRECTORY: Final = "1.2.840.10008.1.3.10"
"""Storage class of a DICOMDIR."""


def is_dicom(path: Path) -> bool:
    """Return whether a file begins like DICOM: the letters DICM after 128 bytes, or at once with an element.

    Files without the letters must not have the suffix of another format.
    """
    if not path.is_file():
        return False
    with path.open("rb") as file:
        head = file.read(132)
    may_be_bare = suffix(path) == ".dcm" or suffix(path) not in (*SURFACE_SUFFIXES, *IMAGE_SUFFIXES)
    return head[128:] == b"DICM" or (may_be_bare and BARE.match(head) is not None)


def is_directory(path: Path) -> bool:
    """Return whether a file is a DICOMDIR, the list of the files on a medium."""
    if not is_dicom(path):
        return False
    with suppress(*damage()), quiet():
        return bool(load(path).file_meta.MediaStorageSOPClassUID == DIRECTORY)
    return False


def load(path: Path, *, with_pixels: bool = False) -> Any:
    """Return the data set of a DICOM file, also where it has no preamble or no file meta information.

    Parameters
    ----------
    path : the file.
    with_pixels : whether the pixel data are read.

    Raises
    ------
    Exception
        One of `damage`.
    """
    import pydicom

    dataset = pydicom.dcmread(path, stop_before_pixels=not with_pixels, force=True)
    meta = dataset.file_meta
    if "TransferSyntaxUID" not in meta:
        is_implicit, is_little = dataset.original_encoding
        explicit = pydicom.uid.ExplicitVRLittleEndian if is_little else pydicom.uid.ExplicitVRBigEndian
        meta.TransferSyntaxUID = pydicom.uid.ImplicitVRLittleEndian if is_implicit else explicit
    if "MediaStorageSOPClassUID" not in meta:
        meta.MediaStorageSOPClassUID = dataset.get("SOPClassUID", pydicom.uid.UID(""))
    return dataset


def read_dicom(path: Path, *, has_spacing: bool = False, acquisition: int | None = None) -> Image:
    """Read one series of a folder, or the series that one file belongs to.

    Of several series in a folder, original ones precede reformats and projections; the one with most voxels is read.
    Files that are no slices of a volume are passed over. Slices are ordered by position, never by name or number. Exact
    copies of a slice are dropped. Where a series holds several acquisitions of the same slices, such as mask and fill
    runs, one is read: the requested one, else the one with the brightest vessels. MONOCHROME1 images are inverted.

    Raises
    ------
    ReadError
        There is no DICOM volume, or a slice is missing, duplicated with other pixels, or misplaced.
    UnitError
        The pixel spacing is not stated.
    """
    with quiet():
        series, notes = _choose(path.parent if is_directory(path) else path)
        planes, of_groups = _one_acquisition(
            [p for file, dataset in series for p in _planes(file, dataset, has_spacing=has_spacing)], acquisition
        )
        planes, of_copies = _without_copies(planes)
        slices, affine, of_places = _arrange(planes)
        voxels = np.stack([_pixels(plane) for plane in slices], axis=-1)  # (row, column, slice)
        modality = str(getattr(slices[0].dataset, "Modality", ""))
        of_colors = (INVERTED,) if _is_inverted(slices[0]) else ()
    notes = (*notes, *of_groups, *of_copies, *of_places, *of_colors)
    return Image(voxels.transpose(1, 0, 2), affine, modality, notes)


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


class _Series(NamedTuple):
    """Files that belong together."""

    files: list[tuple[Path, Any]]
    """Paths and headers."""
    flaw: str
    """Reason why it is no volume; empty where it may be one."""

    @property
    def header(self) -> Any:
        """Header of the first file."""
        return self.files[0][1]

    @property
    def n_slices(self) -> int:
        """Number of slices."""
        return sum(int(getattr(dataset, "NumberOfFrames", 1) or 1) for _, dataset in self.files)

    @property
    def rank(self) -> tuple[bool, bool, bool, bool, int]:
        """Suitability; the largest is read."""
        kind = _text(getattr(self.header, "ImageType", None)).upper()
        is_original = kind.startswith(("ORIGINAL", "NONE"))
        n_voxels = sum(_n_voxels(dataset) for _, dataset in self.files)
        is_plain = not _is_reformat(self.header) and not self.is_thick
        return not self.flaw, self.n_slices >= FEWEST_SLICES, is_plain, is_original, n_voxels

    @property
    def is_thick(self) -> bool:
        """Whether slices are much thicker than their distance, as those of a sliding projection."""
        with suppress(*damage()):
            across, down = np.reshape(np.array(self.header.ImageOrientationPatient, dtype=np.float64), (2, 3))
            places = [np.array(one.ImagePositionPatient, dtype=np.float64) for _, one in self.files]
            steps = np.diff(np.sort(np.stack(places) @ np.cross(across, down)))
            return float(self.header.SliceThickness) > MOST_OVERLAP * float(np.median(steps))
        return False

    def __str__(self) -> str:
        """Return number, description, type and number of slices."""
        number, title = (getattr(self.header, name, None) for name in ("SeriesNumber", "SeriesDescription"))
        kind = _text(getattr(self.header, "ImageType", None)).replace("/", "\\")
        of = f"{self.n_slices} {'images: ' + self.flaw if self.flaw else 'slices'}"
        return f"{'without number' if number is None else number}{f' {title!r}' if title else ''} ({kind}, {of})"


FEWEST_SLICES: Final = 8
"""Series of fewer slices, such as scouts, are read only where there is no longer one."""
REFORMATS: Final = ("MIP", "MPR", "MINIP", "MIN IP", "MAX IP", "PROJECTION", "REFORMAT", "LOCALIZER", "SCOUT", "VRT")
"""Words in the image type or the description of a series that was computed from another one, or shows where it lies."""


def _is_reformat(dataset: Any) -> bool:
    """Return whether an image is a reformat, projection or scout of another series."""
    words = _text(getattr(dataset, "ImageType", None)), str(getattr(dataset, "SeriesDescription", ""))
    return re.search(rf"\b({'|'.join(REFORMATS)})", " ".join(words).upper().replace("_", " ")) is not None


def _flaw(dataset: Any) -> str:
    """Return why an image is no slice of a volume; empty where it may be one."""
    if getattr(dataset, "Modality", "") == "SEG":
        return "segmentation"
    if int(getattr(dataset, "SamplesPerPixel", 1) or 1) > 1:
        return "colors"
    n_frames = int(getattr(dataset, "NumberOfFrames", 1) or 1)
    frames = getattr(dataset, "PerFrameFunctionalGroupsSequence", None)
    if n_frames > 1 and not frames:
        return "projections"
    places = [dataset, *([frames[0]] if frames else []), *getattr(dataset, "SharedFunctionalGroupsSequence", [])]
    is_placed = all(_value(places, name) is not None for name in ("ImagePositionPatient", "ImageOrientationPatient"))
    return "" if is_placed else "no position in the patient"


def _choose(path: Path) -> tuple[list[tuple[Path, Any]], tuple[str, ...]]:
    """Return the files of one series (that of the file given, or the most suitable one) and notes."""
    try:
        return _chosen(path)
    except damage():  # pydicom raises faults of a header when its values are used
        raise ReadError(f"{path} holds a DICOM file with a damaged header. Copy it again, or remove it.") from None


def _chosen(path: Path) -> tuple[list[tuple[Path, Any]], tuple[str, ...]]:
    """Return what `_choose` does; faults of headers are raised as they are."""
    found: dict[tuple[str, bool, bool], list[tuple[Path, Any]]] = {}
    for file, dataset in _headers(path):
        if dataset is not None:
            # A series may hold scouts, projections and captures of the screen beside its slices.
            key = str(getattr(dataset, "SeriesInstanceUID", "")), _is_reformat(dataset), _flaw(dataset) == "colors"
            found.setdefault(key, []).append((file, dataset))
    flaws = {key: {_flaw(dataset) for _, dataset in files} for key, files in found.items()}
    every = [_Series(files, "" if "" in flaws[key] else min(flaws[key])) for key, files in found.items()]
    wanted = [one for one in every if path.is_dir() or any(file == path for file, _ in one.files)]
    if not wanted:
        raise ReadError(f"{path} holds no DICOM images. Check the path, or export the series again.")
    chosen = max(wanted, key=lambda one: one.rank)
    _refuse_flaw(chosen)
    n_bytes = sum(_n_voxels(one) * int(getattr(one, "BitsAllocated", 16) or 16) // 8 for _, one in chosen.files)
    refuse_bomb(f"{path} states {counted(chosen.n_slices, 'slice')}", n_bytes, _size(file for file, _ in chosen.files))
    if len(every) < 2 or not path.is_dir():
        return chosen.files, ()
    others = "; ".join(str(one) for one in every if one is not chosen)
    return chosen.files, (
        f"{len(every)} DICOM series found. Series {chosen} is used; others: {others}. To use another one, give one of "
        "its files.",
    )


def _refuse_flaw(series: _Series) -> None:
    """Raise ReadError where the best series is no volume."""
    name = series.files[0][0].name
    if series.flaw == "segmentation":
        raise ReadError(f"{name} is a DICOM segmentation, which vstent does not read. Export it as NIfTI or NRRD.")
    if series.flaw == "colors":
        raise ReadError(f"{name} is an image in colors, not a slice of a scan. Export the 3-D reconstruction.")
    if series.flaw == "projections":
        raise ReadError(f"{name} is a series of projections, not a volume. Export the 3-D reconstruction.")


def _size(files: Iterable[Path]) -> int:
    """Return the size of files in bytes."""
    return sum(file.stat().st_size for file in files)


def _headers(path: Path) -> Iterator[tuple[Path, Any]]:
    """Yield files with their headers: all below a folder, or the given file and its neighbors.

    A multi-frame file is a volume of its own. A neighbor that cannot be read may belong to another series; where it
    belongs to this one, its slice is reported as missing later.
    """
    if path.is_dir():
        yield from ((file, _header(file)) for file in candidates(path))
        return
    own = _header(path)
    yield path, own
    if own is not None and int(getattr(own, "NumberOfFrames", 1) or 1) > 1:
        return
    for file in _siblings(path):
        with suppress(ReadError):
            yield file, _header(file)


def candidates(path: Path) -> list[Path]:
    """Return the DICOM files below a folder, or below that of a DICOMDIR, without folders of results.

    Raises
    ------
    ReadError
        A file has the suffix of DICOM but not its content: its slice would be missing.
    """
    found = []
    for file in files_in(path if path.is_dir() else path.parent):
        if is_dicom(file):
            found.append(file)
        elif file.suffix.lower() == ".dcm":
            raise ReadError(
                f"{file.name} is not a DICOM file, or its beginning is damaged. Copy it again, or remove it."
            )
    return found


def _siblings(path: Path) -> list[Path]:
    """Return the other DICOM files in the folder of a file."""
    return sorted(p for p in path.parent.iterdir() if p != path and is_dicom(p))


def _header(file: Path) -> Any:
    """Return the header of an image file; None for DICOM files that are not images."""
    try:
        _refuse_bomb(file)
        dataset = load(file)
        is_image = "Image Storage" in dataset.file_meta.MediaStorageSOPClassUID.name
        if not is_image and "Rows" not in dataset:
            return None
        _ = dataset.SeriesInstanceUID, _n_voxels(dataset), _flaw(dataset)  # faults are raised at the first use
        return dataset
    except damage():
        raise ReadError(
            f"{file.name} is damaged. Copy it again, or remove it if it is not part of the series."
        ) from None


def _refuse_bomb(file: Path) -> None:
    """Raise ReadError for a deflated file that unpacks to more than a series holds: pydicom would unpack all of it."""
    from pydicom.filereader import read_file_meta_info
    from pydicom.uid import DeflatedExplicitVRLittleEndian

    with file.open("rb") as stream:
        if stream.read(132)[128:] != b"DICM":
            return  # without this beginning, a file does not state that it is deflated
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


def _planes(file: Path, dataset: Any, *, has_spacing: bool) -> list[_Slice]:
    """Return the slices of one file: itself, or its frames."""
    try:
        return _frames(file, dataset, has_spacing=has_spacing)
    except damage():
        raise ReadError(
            f"{file.name} is damaged: its position, orientation or pixel spacing cannot be read. Export it again."
        ) from None


def _frames(file: Path, dataset: Any, *, has_spacing: bool) -> list[_Slice]:
    """Return the slices of one file; ReadError is raised for a series of projections."""
    if "PerFrameFunctionalGroupsSequence" not in dataset:
        if int(getattr(dataset, "NumberOfFrames", 1) or 1) > 1:
            raise ReadError(f"{file.name} is a series of projections, not a volume. Export the 3-D reconstruction.")
        return [_plane(file, dataset, None, [dataset], has_spacing=has_spacing)]
    shared = list(getattr(dataset, "SharedFunctionalGroupsSequence", []))
    frames = dataset.PerFrameFunctionalGroupsSequence
    places = [[frame, *shared, dataset] for frame in frames]
    return [_plane(file, dataset, k, place, has_spacing=has_spacing) for k, place in enumerate(places)]


_GROUP: Final = {
    "ImagePositionPatient": "PlanePositionSequence",
    "ImageOrientationPatient": "PlaneOrientationSequence",
    "PixelSpacing": "PixelMeasuresSequence",
    "SliceThickness": "PixelMeasuresSequence",
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


def _plane(file: Path, dataset: Any, frame: int | None, places: list[Any], *, has_spacing: bool) -> _Slice:
    """Return one slice with its position, orientation, spacing and scaling."""
    name = file.name if frame is None else f"{file.name} frame {frame + 1}"
    position, orientation = _value(places, "ImagePositionPatient"), _value(places, "ImageOrientationPatient")
    pixel = _value(places, "PixelSpacing")
    if position is None or orientation is None:
        raise ReadError(
            f"Slice {name} does not state its position in the patient. Export the 3-D reconstruction as DICOM."
        )
    if pixel is None and not has_spacing:
        raise UnitError(f"Slice {name} does not state its pixel spacing; give --spacing in mm.")
    return _Slice(
        dataset,
        file,
        frame,
        np.asarray(position, dtype=np.float64).reshape(3),
        np.asarray(orientation, dtype=np.float64).reshape(2, 3),
        np.asarray([1.0, 1.0] if pixel is None else pixel, dtype=np.float64).reshape(2)[::-1],
        float(_value(places, "RescaleSlope") or 1.0),
        float(_value(places, "RescaleIntercept") or 0.0),
        _padding(dataset),
        float(_value(places, "SliceThickness") or 0.0),
        _rounding_mm(position),
    )


def _rounding_mm(position: Any) -> float:
    """Return the last digit to which a position is written, in mm."""
    words = [str(getattr(value, "original_string", value)).strip() for value in position]
    return float(min(10.0 ** -len(word.partition(".")[2]) if "e" not in word.lower() else 0.0 for word in words))


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


def _arrange(slices: list[_Slice]) -> tuple[list[_Slice], Floats, tuple[str, ...]]:
    """Return slices sorted along their normal, the affine from (column, row, slice) to LPS mm, and notes."""
    if len(slices) < 2:
        raise ReadError(
            f"Slice {slices[0].name} is alone, and one slice is not a volume. Give the folder of the whole series."
        )
    across, down = _common_directions(slices)
    normal = np.cross(across, down)
    height = np.array([plane.position_mm @ normal for plane in slices])
    order = np.argsort(height, kind="stable")
    slices = [slices[i] for i in order]
    position = np.array([plane.position_mm for plane in slices])
    step = (position[-1] - position[0]) / (len(slices) - 1)
    step_mm, rounding_mm = float(np.linalg.norm(step)), min(plane.rounding_mm for plane in slices)
    notes = _overlap_note(slices[0], step_mm)
    try:
        _refuse_gaps(slices, height[order])
        _refuse_offsets(slices, position - position[0] - np.arange(len(slices))[:, None] * step, step_mm)
    except ReadError:
        if not _fits_rounded(position, rounding_mm):
            raise
        rounded = f"The slice positions are rounded to {rounding_mm:g} mm"
        notes = (*notes, f"{rounded}: an even distance of {step_mm:.4g} mm is used.")
    affine = np.eye(4)
    affine[:3, 0] = across * slices[0].pixel_mm[0]
    affine[:3, 1] = down * slices[0].pixel_mm[1]
    affine[:3, 2] = step
    affine[:3, 3] = position[0]
    return slices, affine, notes


def _fits_rounded(position_mm: Floats, rounding_mm: float) -> bool:
    """Return whether positions (n, 3) are evenly spaced on a line but for the rounding of their digits."""
    number = np.arange(len(position_mm), dtype=np.float64)
    design = np.stack([np.ones_like(number), number], axis=1)
    line = np.linalg.lstsq(design, position_mm)[0]
    step_mm = float(np.linalg.norm(line[1]))
    # The deviation of a missing slice is at least a quarter of the slice distance.
    most_mm = min(ROUNDED * rounding_mm + SPACING_TOLERANCE * step_mm, 0.24 * step_mm)
    return bool(np.abs(position_mm - design @ line).max() <= most_mm)


def _overlap_note(plane: _Slice, step_mm: float) -> tuple[str, ...]:
    """Return a note on slices that are much thicker than the distance between them."""
    if plane.thickness_mm <= MOST_OVERLAP * step_mm:
        return ()
    return (
        f"The slices are {plane.thickness_mm:.3g} mm thick and {step_mm:.3g} mm apart: they are averages or "
        "projections, in which vessels and sac are wider. Use the original series.",
    )


def _common_directions(slices: list[_Slice]) -> Floats:
    """Return the directions (2, 3) of rows and columns; ReadError is raised where a slice differs from the others."""
    tilt, pixel = (np.array([getattr(p, name).ravel() for p in slices]) for name in ("orientation", "pixel_mm"))
    if not np.isfinite(np.concatenate([tilt, pixel, [p.position_mm for p in slices]], axis=1)).all():
        raise ReadError(
            "A slice has a position, orientation or pixel spacing that is not a number. Export the series again."
        )
    usual = Counter(plane.size for plane in slices).most_common(1)[0][0]
    for what, is_odd in (
        ("size", np.array([plane.size != usual for plane in slices])),
        ("pixel spacing", (np.abs(pixel - np.median(pixel, axis=0)) > SAME * np.median(pixel, axis=0)).any(axis=1)),
        ("orientation", (np.abs(tilt - np.median(tilt, axis=0)) > SAME).any(axis=1)),
    ):
        if is_odd.sum() > MOST_ODD * len(slices):
            raise ReadError(
                f"{is_odd.sum()} of {len(slices)} slices have another {what} than the others: the series holds several "
                "stacks. Export one of them as a series of its own."
            )
        if is_odd.any():
            raise ReadError(
                f"Slice {slices[int(is_odd.argmax())].name} has another {what} than the rest of its series "
                f"({is_odd.sum()} such). Remove it."
            )
    across, down = np.median(tilt, axis=0).reshape(2, 3)
    skew = max(abs(across @ across - 1), abs(down @ down - 1), abs(across @ down))
    if skew > SKEWED:
        raise ReadError(f"Slice {slices[0].name} has rows and columns that are not perpendicular. Export it again.")
    if skew > 1e-3:  # directions of two or three digits
        left, _, right = np.linalg.svd(np.stack([across, down]), full_matrices=False)
        return np.asarray(left @ right)
    return np.stack([across, down])


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
    for i, step in enumerate(steps):  # a missing slice is the better reason where both are found
        if abs(step - usual) > SPACING_TOLERANCE * usual:
            raise ReadError(
                f"Slice {slices[i + 1].name} is {step:.3f} mm from {slices[i].name}, but slices are {usual:.3f} mm "
                "apart elsewhere. Export the series with equal distances."
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
        if not any(keyword in plane.dataset for keyword in PIXELS):
            _load_pixels(plane)
        array = plane.dataset.pixel_array
    except damage():
        array = _decoded_by_gdcm(plane)
    return array if plane.frame is None or array.ndim == 2 else array[plane.frame]


PIXELS: Final = ("PixelData", "FloatPixelData", "DoubleFloatPixelData")
"""Elements that hold pixels."""


def _load_pixels(plane: _Slice) -> None:
    """Add the pixel data to the header of a slice."""
    full = load(plane.path, with_pixels=True)
    for keyword in PIXELS:
        if keyword in full:
            plane.dataset[keyword] = full[keyword]
    plane.dataset.file_meta = full.file_meta


def _decoded_by_gdcm(plane: _Slice) -> NDArray[Any]:
    """Return stored values of images that pydicom cannot decode alone (JPEG, JPEG-LS, JPEG 2000)."""
    import SimpleITK

    try:
        scan = SimpleITK.ReadImage(str(plane.path))
    except RuntimeError:
        raise ReadError(
            f"The pixels of slice {plane.name} are damaged or in a format that is not supported. "
            "Copy it again, or export the series uncompressed."
        ) from None
    array = SimpleITK.GetArrayFromImage(scan)
    stored = (array - plane.intercept) / plane.slope  # GDCM returns rescaled values
    return stored if plane.frame is not None else stored[0]
