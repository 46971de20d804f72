"""Readers and the device catalogue fed with spoilt files: a result or one sentence, never a traceback, never a hang."""

import gzip
import json
import re
import struct
import subprocess
import sys
import warnings
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from faults import image_file, scan, surface_file, vtk_image_file
from hypothesis import HealthCheck, example, given, settings, strategies as st

from vstent.children import environment
from vstent.devices.design import Braid, LaserCut
from vstent.devices.formulas import deployed_length_mm, grid
from vstent.devices.schema import parse
from vstent.errors import VstentError
from vstent.flow.waveform import Waveform, waveform_of
from vstent.geometry.image import Image
from vstent.geometry.surface import Surface
from vstent.io.archive import load_data, save_data
from vstent.io.child import WORDS
from vstent.io.dicom_writer import write_dicom
from vstent.io.images import read_image
from vstent.io.scans import read_scan
from vstent.io.surfaces import read_surface
from vstent.io.tables import read_columns

LONGEST_MS = 10_000
"""No answer may take longer."""

NASTY = [b"-1", b"0", b"nan", b"inf", b"1e400", b"4294967297", b"99999999999999999999", b"", b"\xff", b"[", b'"', b"\n"]
"""What numbers in text files are replaced by."""


@st.composite
def spoilings(draw: st.DrawFn) -> Callable[[bytes], bytes]:
    """Draw a way to spoil a file: cut, flip, insert, repeat, or replace a number in its text."""
    cut = draw(st.one_of(st.just(1.0), st.floats(0, 1)))
    edits = draw(
        st.lists(
            st.tuples(
                st.sampled_from(["flip", "insert", "drop", "repeat", "number"]),
                st.floats(0, 1, exclude_max=True),
                st.integers(0, 255),
                st.sampled_from(NASTY),
            ),
            max_size=6,
        )
    )

    def spoil(data: bytes) -> bytes:
        data = data[: int(np.ceil(cut * len(data)))]
        for kind, where, value, nasty in edits:
            data = _edited(data, kind, where, value, nasty)
        return data

    return spoil


def _edited(data: bytes, kind: str, where: float, value: int, nasty: bytes) -> bytes:
    at = int(where * where * len(data))  # headers come first
    if kind == "flip":
        return data[:at] + bytes([value]) + data[at + 1 :]
    if kind == "insert":
        return data[:at] + nasty + data[at:]
    if kind == "drop":
        return data[:at] + data[at + value :]
    if kind == "repeat":
        return data[:at] + data[at : at + value] * 3 + data[at:]
    numbers = list(re.finditer(rb"[-+0-9.]+", data[:4000]))
    if not numbers:
        return data
    match = numbers[int(where * len(numbers))]
    return data[: match.start()] + nasty + data[match.end() :]


def check(spoilt: Path, read: Callable[[Path], object]) -> None:
    """Read a file: what comes must be finite, or one line of complaint."""
    try:
        found, said = read(spoilt), "there is nothing to complain of"
    except VstentError as error:
        found, said = None, str(error)
    assert "\n" not in said
    assert len(said.split()) >= 5
    assert _is_finite(found)


def _is_finite(noun: object) -> bool:
    if isinstance(noun, np.ndarray):
        return noun.dtype.kind not in "fc" or bool(np.isfinite(noun).all())
    if is_dataclass(noun):
        return all(_is_finite(getattr(noun, field.name)) for field in fields(noun))
    if isinstance(noun, (tuple, list)):
        return all(map(_is_finite, noun))
    return not isinstance(noun, float) or np.isfinite(noun)


SLOW = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture]


@settings(max_examples=60, deadline=LONGEST_MS, suppress_health_check=SLOW)
@given(packed=st.booleans(), spoil=spoilings())
@example(packed=False, spoil=lambda data: data[:76] + struct.pack("<f", 0) + data[80:])  # a quaternion without a sign
# A quaternion longer than 1:
@example(packed=False, spoil=lambda data: data[:256] + struct.pack("<3f", 0.8, 0.8, 0) + data[268:])
@example(packed=False, spoil=lambda data: data[:123] + b"\x3d" + data[124:])  # units that are not defined
@example(packed=False, spoil=gzip.compress)
def test_nifti(packed: bool, spoil: Callable[[bytes], bytes], tmp_path: Path) -> None:
    file = tmp_path / ("a.nii.gz" if packed else "a.nii")
    data = spoil(image_file(".nii"))  # what is packed is spoilt inside, or only the packing would ever be met
    file.write_bytes(gzip.compress(data, 1) if packed else data)
    check(file, read_scan)


MANY = """
import sys
from pathlib import Path
from vstent.io import child
for folder in sys.argv[2:]:
    path = next(Path(folder).glob("a.*"))
    child.main(sys.argv[1], path, {}, Path(folder), {"memory": 6e9, "seconds": 300.0})
"""
"""Reads many files in one child, which is faster than one child for each."""
TEXT = {".nrrd": b"encoding:", ".nhdr": b"encoding:", ".mha": b"DimSize", ".mhd": b"DimSize"}
"""A line of a header, by the suffix of the file."""


def long_line(suffix: str) -> Callable[[bytes], bytes]:
    """Return a way to spoil a header with a line of 1,100 letters, on which ITK's own message overflows."""
    return lambda data: data.replace(TEXT[suffix], b"y" * 1100 + b": 3\n" + TEXT[suffix], 1)


def check_many(what: str, files: list[tuple[str, bytes]], folder: Path) -> None:
    """Read files in a child: it answers for each, or dies at one of which `read_image` and `read_surface` complain."""
    places = [folder / str(number) for number in range(len(files))]
    for place, (suffix, data) in zip(places, files, strict=True):
        place.mkdir(exist_ok=True)
        for old in place.iterdir():
            old.unlink()
        (place / f"a{suffix}").write_bytes(data)
    while places:
        command = [sys.executable, "-c", MANY, what, *map(str, places)]
        done = subprocess.run(command, env=environment(), capture_output=True, check=False)
        assert done.returncode <= 0, done.stderr  # a library may crash; no error may be uncaught
        while places and (places[0] / WORDS).exists():
            check_answer(places.pop(0))
        if places:  # it died at this one
            check(next(places.pop(0).glob("a.*")), read_image if what == "scan" else read_surface)


def check_answer(place: Path) -> None:
    """Check what a child has written about a file."""
    words = json.loads((place / WORDS).read_text())
    assert words.get("error", "ReadError") in ("ReadError", "UnitError", "Limit")
    said = words.get("sentence", "there is nothing to complain of")
    assert "\n" not in said
    assert len(said.split()) >= 5
    # The vertices of a surface are checked by `read_surface`.
    assert all(_is_finite(np.load(file)) for file in place.glob("*.npy") if file.stem != "vertices")


def scan_data(suffix: str, packed: bool) -> bytes:
    """Return a sound scan; the voxels of a detached header are missing."""
    if suffix in (".nhdr", ".mhd"):
        attached = image_file({".nhdr": ".nrrd", ".mhd": ".mha"}[suffix])
        end = b"\n\n" if suffix == ".nhdr" else b"ElementDataFile"
        return attached.partition(end)[0] + (b"\ndata file: a.raw\n" if suffix == ".nhdr" else end + b" = a.raw\n")
    return vtk_image_file(suffix) if suffix in (".vti", ".vtk") else image_file(suffix, packed=packed)


SCANS = st.sampled_from([".nrrd", ".nhdr", ".mha", ".mhd", ".vti", ".vtk"])


@settings(max_examples=4, deadline=None, suppress_health_check=SLOW)
@given(spoilt=st.lists(st.tuples(SCANS, st.booleans(), spoilings()), min_size=12, max_size=12))
@example(spoilt=[(suffix, False, long_line(suffix)) for suffix in TEXT])
def test_scans(spoilt: list[tuple[str, bool, Callable[[bytes], bytes]]], tmp_path: Path) -> None:
    check_many("scan", [(suffix, spoil(scan_data(suffix, packed))) for suffix, packed, spoil in spoilt], tmp_path)


@settings(max_examples=25, deadline=LONGEST_MS, suppress_health_check=SLOW)
@given(index=st.integers(0, 2), spoil=spoilings())
def test_dicom_series(index: int, spoil: Callable[[bytes], bytes], tmp_path: Path) -> None:
    write_dicom(Image(scan().voxels[:, :, :3], scan().affine_mm), tmp_path / "series")
    file = sorted((tmp_path / "series").iterdir())[index]
    file.write_bytes(spoil(file.read_bytes()))
    check(tmp_path / "series", read_scan)


@settings(max_examples=25, deadline=LONGEST_MS, suppress_health_check=SLOW)
@given(is_packed=st.booleans(), shape=st.tuples(*[st.integers(-2, 10**7)] * 3), spoil=spoilings())
def test_raw_volumes(
    is_packed: bool, shape: tuple[int, int, int], spoil: Callable[[bytes], bytes], tmp_path: Path
) -> None:
    data = scan().voxels.tobytes(order="F")
    file = tmp_path / ("a.raw.gz" if is_packed else "a.raw")
    file.write_bytes(spoil(gzip.compress(data, 1) if is_packed else data))
    for sizes in ((20, 20, 44), shape):
        check(file, lambda path, sizes=sizes: read_scan(path, spacing_mm=[0.5], shape=sizes))


SURFACES = st.sampled_from([".stl", ".ply", ".vtk", ".vtp", ".obj"])
SPOILT_SURFACES = st.lists(st.tuples(SURFACES, st.booleans(), spoilings()), min_size=8, max_size=8)


@settings(max_examples=3, deadline=None, suppress_health_check=SLOW)
@given(spoilt=SPOILT_SURFACES)
@example(
    spoilt=[
        (".stl", True, bytes.upper),
        (".ply", False, lambda data: data.replace(b"element face", b"element tristrips")),
    ]
)
def test_surfaces(spoilt: list[tuple[str, bool, Callable[[bytes], bytes]]], tmp_path: Path) -> None:
    check_many("mesh", [(suffix, spoil(surface_file(suffix, text=text))) for suffix, text, spoil in spoilt], tmp_path)


@pytest.mark.validation
@settings(max_examples=40, deadline=None, suppress_health_check=SLOW)
@given(spoilt=SPOILT_SURFACES)
def test_many_surfaces(spoilt: list[tuple[str, bool, Callable[[bytes], bytes]]], tmp_path: Path) -> None:
    check_many("mesh", [(suffix, spoil(surface_file(suffix, text=text))) for suffix, text, spoil in spoilt], tmp_path)


PULSE = "time,flow\n" + "".join(f"{0.05 * k:.2f},{3 + np.sin(k):.4f}\n" for k in range(20))


@settings(max_examples=60, deadline=LONGEST_MS, suppress_health_check=SLOW)
@given(spoil=spoilings())
def test_pulses(spoil: Callable[[bytes], bytes], tmp_path: Path) -> None:
    file = tmp_path / "pulse.csv"
    file.write_bytes(spoil(PULSE.encode()))

    def read(path: Path) -> Waveform:
        return waveform_of(*read_columns(path, 2).T)

    check(file, read)


@settings(max_examples=60, deadline=LONGEST_MS, suppress_health_check=SLOW)
@given(spoil=spoilings())
def test_kept_stages(spoil: Callable[[bytes], bytes], tmp_path: Path) -> None:
    noun = Surface(np.eye(4, 3), [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    save_data(tmp_path / "sound.npz", noun)
    file = tmp_path / "kept.npz"
    file.write_bytes(spoil((tmp_path / "sound.npz").read_bytes()))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of zipfile, about names that occur twice
        check(file, lambda path: load_data(path, Surface))


CATALOGUE = (
    files("vstent.devices").joinpath("catalogue.toml").read_bytes().partition(b'[[device]]\nkey = "pipeline"')[0]
)
"""A braid and a laser-cut device."""


@settings(max_examples=100, deadline=LONGEST_MS, suppress_health_check=SLOW)
@given(spoil=spoilings())
def test_catalogues(spoil: Callable[[bytes], bytes], tmp_path: Path) -> None:
    text = spoil(CATALOGUE).decode("utf-8", errors="replace")

    def read(_: Path) -> tuple[Braid | LaserCut, ...]:
        designs = tuple(parse(text).values())
        for design in designs:
            for size in design.sizes:  # whatever is accepted can be worked with
                assert grid(design, size).rows >= 2
                assert deployed_length_mm(design, size, size.diameter_mm) > 0
        return designs

    check(tmp_path, read)
