"""Readers and the device catalogue fed with spoilt files: a result or one sentence, never a traceback, never a hang."""

import gzip
import re
import warnings
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from faults import image_file, scan, surface_file
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from vstent.devices.design import Braid, LaserCut
from vstent.devices.formulas import deployed_length_mm, grid
from vstent.devices.schema import parse
from vstent.errors import VstentError
from vstent.flow.waveform import Waveform, waveform_of
from vstent.geometry.image import Image
from vstent.geometry.surface import Surface
from vstent.io.archive import load_data, save_data
from vstent.io.dicom_writer import write_dicom
from vstent.io.images import read_image
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
@given(suffix=st.sampled_from([".nii", ".nii.gz", ".nrrd", ".mha"]), packed=st.booleans(), spoil=spoilings())
def test_scans(suffix: str, packed: bool, spoil: Callable[[bytes], bytes], tmp_path: Path) -> None:
    file = tmp_path / f"a{suffix}"
    data = image_file(suffix, packed=packed)
    # What is packed is spoilt inside too, or only the packing would ever be met.
    is_inner = suffix == ".nii.gz" and packed
    file.write_bytes(gzip.compress(spoil(gzip.decompress(data)), 1) if is_inner else spoil(data))
    check(file, read_image)


@settings(max_examples=25, deadline=LONGEST_MS, suppress_health_check=SLOW)
@given(index=st.integers(0, 2), spoil=spoilings())
def test_dicom_series(index: int, spoil: Callable[[bytes], bytes], tmp_path: Path) -> None:
    write_dicom(Image(scan().voxels[:, :, :3], scan().affine_mm), tmp_path / "series")
    file = sorted((tmp_path / "series").iterdir())[index]
    file.write_bytes(spoil(file.read_bytes()))
    check(tmp_path / "series", read_image)


@settings(max_examples=25, deadline=LONGEST_MS, suppress_health_check=SLOW)
@given(is_packed=st.booleans(), shape=st.tuples(*[st.integers(-2, 10**7)] * 3), spoil=spoilings())
def test_raw_volumes(
    is_packed: bool, shape: tuple[int, int, int], spoil: Callable[[bytes], bytes], tmp_path: Path
) -> None:
    data = scan().voxels.tobytes(order="F")
    file = tmp_path / ("a.raw.gz" if is_packed else "a.raw")
    file.write_bytes(spoil(gzip.compress(data, 1) if is_packed else data))
    for sizes in ((20, 20, 44), shape):
        check(file, lambda path, sizes=sizes: read_image(path, spacing_mm=[0.5], shape=sizes))


def spoilt_surface(suffix: str, text: bool, spoil: Callable[[bytes], bytes], folder: Path) -> None:
    """Spoil a surface file and read it."""
    file = folder / f"a{suffix}"
    file.write_bytes(spoil(surface_file(suffix, text=text)))
    check(file, read_surface)


SURFACES = st.sampled_from([".stl", ".ply", ".vtk", ".vtp", ".obj"])


@settings(max_examples=8, deadline=2 * LONGEST_MS, suppress_health_check=SLOW)
@given(suffix=SURFACES, text=st.booleans(), spoil=spoilings())
def test_surfaces(suffix: str, text: bool, spoil: Callable[[bytes], bytes], tmp_path: Path) -> None:
    spoilt_surface(suffix, text, spoil, tmp_path)


@pytest.mark.validation
@settings(max_examples=150, deadline=2 * LONGEST_MS, suppress_health_check=SLOW)
@given(suffix=SURFACES, text=st.booleans(), spoil=spoilings())
def test_many_surfaces(suffix: str, text: bool, spoil: Callable[[bytes], bytes], tmp_path: Path) -> None:
    spoilt_surface(suffix, text, spoil, tmp_path)


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
