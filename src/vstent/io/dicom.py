"""Read a DICOM series as an `Image`."""

import logging
import re
import struct
import warnings
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
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
    padding: list[int]
    """Smallest and largest stored value that mark pixels outside the field of view; none where not stated."""
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

    @property
    def is_inverted(self) -> bool:
        """Whether low values are bright (MONOCHROME1)."""
        return str(getattr(self.dataset, "PhotometricInterpretation", "")).strip() == "MONOCHROME1"

    @cached_property
    def place(self) -> tuple[int, ...]:
        """Position as whole multiples of `SAME_PLACE_MM`."""
        return tuple(np.round(self.position_mm / SAME_PLACE_MM).astype(int).tolist())


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
    """Return the data set of a DICOM file, also where it has no preamble or meta information; it may raise `damage`."""
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
    notes = (*notes, *of_groups, *of_copies, *of_places)
    if slices[0].is_inverted:
        notes = (*notes, "The images are MONOCHROME1 (bright means low): intensities were inverted.")
    return Image(voxels.transpose(1, 0, 2), affine, modality, notes)


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
        with warnings.catch_warnings(action="ignore"):
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
    def n_slices(self) -> int:
        """Number of slices."""
        return sum(_n_frames(dataset) for _, dataset in self.files)

    @property
    def rank(self) -> tuple[bool, bool, bool, bool, int]:
        """Suitability; the largest is read."""
        header = self.files[0][1]
        is_original = _text(getattr(header, "ImageType", None)).upper().startswith(("ORIGINAL", "NONE"))
        is_thick = False  # much thicker slices than their distance are those of a sliding projection
        with suppress(*damage()):
            across, down = np.reshape(np.array(header.ImageOrientationPatient, dtype=np.float64), (2, 3))
            places = np.array([dataset.ImagePositionPatient for _, dataset in self.files], dtype=np.float64)
            steps = np.diff(np.sort(places @ np.cross(across, down)))
            is_thick = float(header.SliceThickness) > MOST_OVERLAP * float(np.median(steps))
        is_plain = not _is_reformat(header) and not is_thick
        n_voxels = sum(_n_voxels(dataset) for _, dataset in self.files)
        return not self.flaw, self.n_slices >= FEWEST_SLICES, is_plain, is_original, n_voxels

    def __str__(self) -> str:
        """Return number, description, type and number of slices."""
        names = ("SeriesNumber", "SeriesDescription", "ImageType")
        number, title, kind = (getattr(self.files[0][1], name, None) for name in names)
        kind = _text(kind).replace("/", "\\")
        of = f"{self.n_slices} {'images: ' + self.flaw if self.flaw else 'slices'}"
        label = f"{'without number' if number is None else number}{f' {title!r}' if title else ''}"
        return f"{label} ({kind}, {of})"


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
    frames = getattr(dataset, "PerFrameFunctionalGroupsSequence", None)
    if _n_frames(dataset) > 1 and not frames:
        return "projections"
    places = [dataset, *([frames[0]] if frames else []), *getattr(dataset, "SharedFunctionalGroupsSequence", [])]
    is_placed = all(_value(places, name) is not None for name in ("ImagePositionPatient", "ImageOrientationPatient"))
    return "" if is_placed else "no position in the patient"


FLAWS: Final = {
    "segmentation": "is a DICOM segmentation, which vstent does not read. Export it as NIfTI or NRRD.",
    "colors": "is an image in colors, not a slice of a scan. Export the 3-D reconstruction.",
    "projections": "is a series of projections, not a volume. Export the 3-D reconstruction.",
}
"""What is said of images that are no slices of a volume."""


def _choose(path: Path) -> tuple[list[tuple[Path, Any]], tuple[str, ...]]:
    """Return the files of one series (that of the file given, or the most suitable one) and notes."""
    found: dict[tuple[str, bool, bool], list[tuple[Path, Any]]] = {}
    try:
        for file, dataset in _headers(path):
            if dataset is not None:
                # A series may hold scouts, projections and captures of the screen beside its slices.
                key = str(getattr(dataset, "SeriesInstanceUID", "")), _is_reformat(dataset), _flaw(dataset) == "colors"
                found.setdefault(key, []).append((file, dataset))
        every = []
        for files in found.values():
            flaws = {_flaw(dataset) for _, dataset in files}
            every.append(_Series(files, "" if "" in flaws else min(flaws)))
        wanted = [series for series in every if path.is_dir() or any(file == path for file, _ in series.files)]
        if not wanted:
            raise ReadError(f"{path} holds no DICOM images. Check the path, or export the series again.")
        chosen = max(wanted, key=lambda series: series.rank)
        if chosen.flaw in FLAWS:
            raise ReadError(f"{chosen.files[0][0].name} {FLAWS[chosen.flaw]}")
        n_bytes = sum(
            _n_voxels(image) * int(getattr(image, "BitsAllocated", 16) or 16) // 8 for _, image in chosen.files
        )
        n_held = sum(file.stat().st_size for file, _ in chosen.files)
        refuse_bomb(f"{path} states {counted(chosen.n_slices, 'slice')}", n_bytes, n_held)
        if len(every) < 2 or not path.is_dir():
            return chosen.files, ()
        others = "; ".join(str(series) for series in every if series is not chosen)
        note = f"{len(every)} DICOM series found. Series {chosen} is used; others: {others}."
        return chosen.files, (f"{note} To use another one, give one of its files.",)
    except damage():  # pydicom raises faults of a header when its values are used
        raise ReadError(f"{path} holds a DICOM file with a damaged header. Copy it again, or remove it.") from None


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
    if own is None or _n_frames(own) < 2:
        for file in sorted(path.parent.iterdir()):
            with suppress(ReadError):
                if file != path and is_dicom(file):
                    yield file, _header(file)


def candidates(path: Path) -> list[Path]:
    """Return the DICOM files below a folder, or below that of a DICOMDIR, without folders of results.

    ReadError is raised where a file has the suffix of DICOM but not its content: its slice would be missing.
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


def _n_frames(dataset: Any) -> int:
    """Return the number of frames of a file."""
    return int(getattr(dataset, "NumberOfFrames", 1) or 1)


def _n_voxels(dataset: Any) -> int:
    """Return the number of voxels of a file."""
    return int(dataset.Rows) * int(dataset.Columns) * _n_frames(dataset)


def _planes(file: Path, dataset: Any, *, has_spacing: bool) -> list[_Slice]:
    """Return the slices of one file: itself, or its frames."""
    try:
        if "PerFrameFunctionalGroupsSequence" in dataset:
            shared = list(getattr(dataset, "SharedFunctionalGroupsSequence", []))
            places = [[frame, *shared, dataset] for frame in dataset.PerFrameFunctionalGroupsSequence]
            return [_plane(file, dataset, k, place, has_spacing=has_spacing) for k, place in enumerate(places)]
        if _n_frames(dataset) > 1:
            raise ReadError(f"{file.name} {FLAWS['projections']}")
        return [_plane(file, dataset, None, [dataset], has_spacing=has_spacing)]
    except damage():
        raise ReadError(
            f"{file.name} is damaged: its position, orientation or pixel spacing cannot be read. Export it again."
        ) from None


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
    padding = getattr(dataset, "PixelPaddingValue", None)
    ends = () if padding is None else (int(padding), int(getattr(dataset, "PixelPaddingRangeLimit", padding)))
    words = [str(getattr(value, "original_string", value)).strip() for value in position]
    rounding_mm = min(10.0 ** -len(word.partition(".")[2]) if "e" not in word.lower() else 0.0 for word in words)
    return _Slice(
        dataset,
        file,
        frame,
        np.asarray(position, dtype=np.float64).reshape(3),
        np.asarray(orientation, dtype=np.float64).reshape(2, 3),
        np.asarray([1.0, 1.0] if pixel is None else pixel, dtype=np.float64).reshape(2)[::-1],
        float(_value(places, "RescaleSlope") or 1.0),
        float(_value(places, "RescaleIntercept") or 0.0),
        sorted(ends),
        float(_value(places, "SliceThickness") or 0.0),
        float(rounding_mm),
    )


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


def _one_acquisition(planes: list[_Slice], wanted: int | None) -> tuple[list[_Slice], tuple[str, ...]]:
    """Return the slices of one acquisition and a note, where a series holds several of the same slices."""
    key, groups = _acquisitions(planes)
    if len(groups) < 2:
        if wanted not in (None, 1):
            raise ReadError(f"The series holds one acquisition: acquisition {wanted} does not exist. Give 1 or none.")
        return planes, ()
    listed = "; ".join(
        f"{number}: {ACQUISITION_KEYS[key]} {name}, {len(group)} slices"
        for number, (name, group) in enumerate(groups, 1)
    )
    if wanted is not None and not 1 <= wanted <= len(groups):
        raise ReadError(
            f"The series holds {len(groups)} acquisitions ({listed}), not {wanted}. Give one of these numbers."
        )
    chosen = int(np.argmax([_brightness(group) for _, group in groups])) if wanted is None else wanted - 1
    why = ", as requested"
    if wanted is None:
        why = ", chosen because its vessels are the brightest; choose another by its number (--acquisition)"
    note = f"The series holds {len(groups)} acquisitions ({listed}). Acquisition {chosen + 1} is used{why}."
    return groups[chosen][1], (note,)


def _acquisitions(planes: list[_Slice]) -> tuple[str, list[tuple[str, list[_Slice]]]]:
    """Return the attribute that distinguishes acquisitions and the slices by its values; no groups where there is one.

    It is the first attribute that divides slices of the same position so that every group has each position once.
    """
    for key in ACQUISITION_KEYS if len({plane.place for plane in planes}) < len(planes) else ():
        groups: dict[str, list[_Slice]] = {}
        for plane in planes:
            groups.setdefault(_text(getattr(plane.dataset, key, None)), []).append(plane)
        places = [{plane.place for plane in group} for group in groups.values()]
        is_divided = all(len(own) == len(group) for own, group in zip(places, groups.values(), strict=True))
        if len(groups) > 1 and is_divided and set.intersection(*places):
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
    unique: dict[tuple[int, ...], _Slice] = {}
    others: list[_Slice] = []
    dropped = 0
    for plane in planes:
        first = unique.setdefault(plane.place, plane)
        if first is not plane and np.array_equal(_pixels(first), _pixels(plane)):
            dropped += 1
        elif first is not plane:
            others.append(plane)
    note = f"{counted(dropped, 'slice')} with the same position and the same pixels as another: dropped."
    return [*unique.values(), *others], (note,) if dropped else ()


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
    notes: tuple[str, ...] = ()
    if slices[0].thickness_mm > MOST_OVERLAP * step_mm:
        notes = (
            f"The slices are {slices[0].thickness_mm:.3g} mm thick and {step_mm:.3g} mm apart: they are averages or "
            "projections, in which vessels and sac are wider. Use the original series.",
        )
    try:
        _refuse_uneven(slices, height[order], position - position[0] - np.arange(len(slices))[:, None] * step, step_mm)
    except ReadError:
        design = np.stack([np.ones(len(slices)), np.arange(len(slices))], axis=1)
        line = np.linalg.lstsq(design, position)[0]
        fitted_mm = float(np.linalg.norm(line[1]))
        # The deviation of a missing slice is at least a quarter of the slice distance.
        most_mm = min(ROUNDED * rounding_mm + SPACING_TOLERANCE * fitted_mm, 0.24 * fitted_mm)
        if not np.abs(position - design @ line).max() <= most_mm:
            raise
        rounded = f"The slice positions are rounded to {rounding_mm:g} mm"
        notes = (*notes, f"{rounded}: an even distance of {step_mm:.4g} mm is used.")
    affine = np.eye(4)
    affine[:3, 0] = across * slices[0].pixel_mm[0]
    affine[:3, 1] = down * slices[0].pixel_mm[1]
    affine[:3, 2] = step
    affine[:3, 3] = position[0]
    return slices, affine, notes


def _common_directions(slices: list[_Slice]) -> Floats:
    """Return the directions (2, 3) of rows and columns; ReadError is raised where a slice differs from the others."""
    tilt, pixel = (np.array([getattr(p, name).ravel() for p in slices]) for name in ("orientation", "pixel_mm"))
    if not np.isfinite(np.concatenate([tilt, pixel, [p.position_mm for p in slices]], axis=1)).all():
        raise ReadError(
            "A slice has a position, orientation or pixel spacing that is not a number. Export the series again."
        )
    sizes = np.array([plane.size for plane in slices])
    usual = Counter(plane.size for plane in slices).most_common(1)[0][0]
    for what, is_odd in (
        ("size", (sizes != usual).any(axis=1)),
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


def _refuse_uneven(slices: list[_Slice], height: Floats, offset_mm: Floats, step_mm: float) -> None:
    """Raise ReadError where slices are missing, at the same position, unevenly spaced, or out of line."""
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
    distance = np.linalg.norm(offset_mm, axis=1)
    worst = int(distance.argmax())
    if distance[worst] > max(SPACING_TOLERANCE * step_mm, 1e-3):
        raise ReadError(
            f"Slice {slices[worst].name} is {distance[worst]:.3f} mm out of line with the others. Export again."
        )


# -- pixels ------------------------------------------------------------------------------------------------------------


def _pixels(plane: _Slice) -> NDArray[Any]:
    """Return the rescaled values (rows, columns) of one slice; high values are bright."""
    pixels = _stored(plane)
    if pixels.shape != plane.size:
        raise ReadError(
            f"Slice {plane.name} holds {pixels.shape} values where its header states {plane.size}. Export it again."
        )
    if plane.padding:
        # The padding value may be brighter than any contrast (DICOM PS3.3, C.7.5.1.1.2).
        is_padding = (pixels >= plane.padding[0]) & (pixels <= plane.padding[1])
        inside = pixels[~is_padding] if not is_padding.all() else np.zeros(1, pixels.dtype)
        pixels = np.where(is_padding, inside.max() if plane.is_inverted else inside.min(), pixels)
    if plane.is_inverted and pixels.dtype.kind == "f":
        pixels = -pixels
    elif plane.is_inverted:
        is_signed, bits = int(getattr(plane.dataset, "PixelRepresentation", 0)), int(plane.dataset.BitsStored)
        top = -1 if is_signed else (1 << bits) - 1
        pixels = (top - pixels.astype(np.int64)).astype(np.int32 if bits > 15 else pixels.dtype)
    if plane.slope == 1.0 and plane.intercept == 0.0:
        return pixels
    if plane.slope.is_integer() and plane.intercept.is_integer() and pixels.dtype.kind in "iu":
        return pixels.astype(np.int32) * int(plane.slope) + int(plane.intercept)
    return (pixels * plane.slope + plane.intercept).astype(np.float32)


PIXELS: Final = ("PixelData", "FloatPixelData", "DoubleFloatPixelData")
"""Elements that hold pixels."""


def _stored(plane: _Slice) -> NDArray[Any]:
    """Return the stored values (rows, columns) of one slice."""
    try:
        if not any(keyword in plane.dataset for keyword in PIXELS):
            full = load(plane.path, with_pixels=True)
            for keyword in PIXELS:
                if keyword in full:
                    plane.dataset[keyword] = full[keyword]
            plane.dataset.file_meta = full.file_meta
        array = plane.dataset.pixel_array
    except damage():
        array = _decoded_by_gdcm(plane)
    return array if plane.frame is None or array.ndim == 2 else array[plane.frame]


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
    stored = (SimpleITK.GetArrayFromImage(scan) - plane.intercept) / plane.slope  # GDCM returns rescaled values
    return stored if plane.frame is not None else stored[0]
