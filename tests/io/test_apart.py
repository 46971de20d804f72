"""The child process that reads files: it cannot harm this process, and its limits are stated."""

import gzip
import os
import struct
import sys

import numpy as np
import pytest
from faults import artery, image_file, scan

from vstent.errors import ReadError, VstentError
from vstent.io import apart, child
from vstent.io.images import read_image
from vstent.io.scans import read_scan
from vstent.io.surfaces import read_surface
from vstent.io.vtk_reader import read_mesh
from vstent.io.writers import write_stl

NRRD = (
    "NRRD0005\ntype: short\ndimension: 3\nspace: left-posterior-superior\nsizes: 2 2 2\n"
    "space directions: (1,0,0) (0,1,0) (0,0,1)\nspace origin: (0,0,0)\nendian: little\nencoding: raw\n"
)


@pytest.mark.parametrize("suffix", [".nrrd", ".nhdr"])
@pytest.mark.parametrize("line", ["y{}", "y{}: 3", "units: {} 1 1"])
def test_a_header_that_crashes_its_reader_is_damaged(tmp_path, suffix, line):
    """ITK writes its message about a long line into a short buffer."""
    (tmp_path / f"a{suffix}").write_bytes((NRRD + line.format("x" * 1100) + "\n\n").encode() + bytes(16))
    with pytest.raises(ReadError, match=rf"a{suffix} is damaged.* 4 GB of memory or 8 s"):
        read_image(tmp_path / f"a{suffix}")


def test_long_lines_of_sound_headers_are_read(tmp_path):
    lines = f"# {'x' * 3000}\nSegmentation_ConversionParameters:={'y' * 3000}\n"
    (tmp_path / "a.nrrd").write_bytes((NRRD + lines + "\n").encode() + bytes(16))
    assert read_image(tmp_path / "a.nrrd").voxels.shape == (2, 2, 2)


def test_a_child_returns_what_its_readers_return(tmp_path):
    (tmp_path / "a.nrrd").write_bytes(image_file(".nrrd"))
    write_stl(tmp_path / "a.stl", artery())
    image, mesh = (
        read_image(tmp_path / "a.nrrd", spacing_mm=[0.3, 0.4, 0.5]),
        read_surface(tmp_path / "a.stl", units="mm"),
    )
    expected = read_scan(tmp_path / "a.nrrd", spacing_mm=[0.3, 0.4, 0.5])
    np.testing.assert_array_equal(image.voxels, scan().voxels)
    np.testing.assert_array_equal(image.affine_mm, expected.affine_mm)
    assert (image.notes, image.modality, image.is_oriented) == (expected.notes, "", True)
    np.testing.assert_array_equal(mesh[0].corners_mm, read_mesh(tmp_path / "a.stl").vertices[mesh[0].faces])


@pytest.fixture
def python(tmp_path, monkeypatch):
    """Let a shell script run in place of Python; ``$6`` is the folder into which the child writes."""
    (tmp_path / "a.nrrd").write_bytes(image_file(".nrrd"))

    def run(lines):
        script = tmp_path / "python"
        script.write_text(f"#!/bin/sh\n{lines}\n")
        script.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(script))

    return run


@pytest.mark.parametrize(
    ("lines", "why"),
    [
        ("echo no module >&2\nexit 1", r"no module"),
        ("kill -9 $$", "no reason stated"),
        ("exec sleep 100", r"it did not start within 1 s"),
        ('touch "$6/begun"\necho no space >&2\nexit 1', "no space"),
    ],
)
def test_a_child_that_does_not_start_is_no_fault_of_the_file(tmp_path, monkeypatch, python, lines, why):
    python(lines)
    monkeypatch.setattr(apart, "START_SECONDS", 1.0)
    monkeypatch.setattr(apart, "SECONDS", 0.1)
    with pytest.raises(VstentError, match=rf"failed \({why}\)\. Check the installation") as fault:
        read_image(tmp_path / "a.nrrd")
    assert not isinstance(fault.value, ReadError)


def test_a_child_that_dies_while_it_reads_says_that_the_file_is_damaged(tmp_path, python):
    python('touch "$6/begun"\nkill -9 $$')
    with pytest.raises(ReadError, match=r"a\.nrrd is damaged"):
        read_image(tmp_path / "a.nrrd")


def test_time_to_start_is_no_time_of_reading(tmp_path, monkeypatch, python):
    """Python starts after 4 s; reading may take 3 s."""
    monkeypatch.setattr(apart, "SECONDS", 3.0 / child.PATIENCE)
    python(f'sleep 4\nexec {sys.executable} "$@"')
    assert read_image(tmp_path / "a.nrrd").voxels.shape == scan().voxels.shape


def test_a_reader_that_waits_without_end_is_stopped(tmp_path, python):
    """The reader's time counts from the begin of reading, and it is stopped although it uses no processor."""
    wait = (
        "import sys, time, pathlib; from vstent.io import child; "
        "child.READERS['scan'] = lambda *_: time.sleep(100); "
        "child.main('scan', pathlib.Path('a.nrrd'), {}, pathlib.Path(sys.argv[1]), {'memory': 4e9, 'seconds': 0.1})"
    )
    python(f'exec {sys.executable} -c "{wait}" "$6"')
    with pytest.raises(ReadError, match=r"a\.nrrd is damaged"):
        read_image(tmp_path / "a.nrrd")


def zeros(suffix, n):
    """Return the beginning of a file that states n^3 zeros and is as long as a file in which they are packed."""
    packed = np.random.default_rng(0).bytes(n**3 // 1000)
    if suffix == ".nii.gz":
        head = bytearray(image_file(".nii")[:352])
        head[42:48], head[70:74] = struct.pack("<3h", n, n, n), struct.pack("<2h", 2, 8)
        return gzip.compress(bytes(head) + packed)
    if suffix == ".nrrd":
        head = NRRD.replace("2 2 2", f"{n} {n} {n}").replace("raw", "gzip").replace("short", "uchar")
        return head.encode() + b"\n" + gzip.compress(packed)
    head = f"ObjectType = Image\nNDims = 3\nCompressedData = True\nElementSpacing = 1 1 1\nDimSize = {n} {n} {n}\n"
    return (head + "ElementType = MET_UCHAR\nElementDataFile = LOCAL\n").encode() + packed


@pytest.mark.parametrize("suffix", [".nii.gz", ".nrrd", ".mha"])
def test_a_billion_zeros_in_a_small_file_meet_a_limit_that_is_stated(tmp_path, suffix):
    (tmp_path / f"a{suffix}").write_bytes(zeros(suffix, 1000))
    with pytest.raises(ReadError, match=r"1 GB in a file of 1 MB\. More than 0\.5 GB are read only from files packed"):
        read_scan(tmp_path / f"a{suffix}")


def test_a_named_pipe_and_a_loop_of_links_are_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "a.nii")
    (tmp_path / "b.nii").symlink_to(tmp_path / "b.nii")
    with pytest.raises(ReadError, match="is neither a file nor a folder"):
        read_image(tmp_path / "a.nii")
    with pytest.raises(ReadError, match="does not exist"):
        read_image(tmp_path / "b.nii")
