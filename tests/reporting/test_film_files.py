"""Films in files: the same grey in every format, the right key frames, and captions that hide nothing."""

import io

import numpy as np
import pydicom
import pytest
from PIL import Image

from vstent.angiography.curves import Curves
from vstent.angiography.film import PAPER, Film
from vstent.angiography.view import View, angles_of
from vstent.reporting.films import CAPTION_PX, GAP_PX, Shown, beside, kept_films, key_frames, key_times_s, write_films

VIEW = View(*angles_of("RAO 30 CRA 20"), np.zeros(3), 32, 48)


def film(half_life_s: float = 1.0) -> Film:
    """Return 8 s of contrast that rises for 1 s and then falls."""
    time_s = np.arange(81) / 10
    amount = np.where(time_s < 1, time_s, 0.5 ** ((time_s - 1) / half_life_s))
    shape = np.zeros((32, 48), np.float32)
    shape[8:24, 10:30] = 0.8
    return Film(VIEW, time_s, (amount[:, None, None] * shape).astype(np.float32))


def test_key_frames_are_half_peak_half_and_5_s_after():
    names, times_s = zip(*key_times_s(film()), strict=True)
    assert names == ("early", "peak", "late", "5 s after the peak")
    assert np.allclose(times_s, [0.5, 1.0, 2.0, 6.0])
    short = film()
    short = Film(VIEW, short.time_s[:30], short.absorption[:30].copy())
    assert [name for name, _ in key_times_s(short)] == ["early", "peak", "late"]


def test_films_side_by_side_keep_their_pixels_below_the_captions():
    pair = [Shown("Before", film()), Shown("Silk", film(3.0), wires=[np.full((32, 48), 0.1, np.float32)])]
    frames = beside(pair, 0.8)
    assert len(frames) == 81
    assert frames[0].shape == (32 + CAPTION_PX, 2 * 48 + GAP_PX)
    assert frames[10][CAPTION_PX + 16, 20] == 0  # the largest absorption is black
    assert frames[0][CAPTION_PX + 2, 2] == round(255 * PAPER)
    assert frames[0][CAPTION_PX + 2, 48 + GAP_PX + 2] == round(255 * PAPER * (1 - 0.1 / 0.8))
    assert frames[0][:CAPTION_PX].min() < 100  # words


def test_files_hold_the_same_grey(tmp_path):
    shown = {"bare": Shown("Before", film()), "silk": Shown("Silk", film(3.0))}
    written = write_films(tmp_path, shown)
    assert written == ["bare", "bare.dcm", "silk", "silk.dcm", "angiogram.webp", "key_frames.png", "films.json"]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(written)
    xa = pydicom.dcmread(tmp_path / "silk.dcm")
    frame = np.asarray(Image.open(tmp_path / "silk" / "frame_0041.png"))
    assert np.allclose(xa.pixel_array[40] / 4095, frame / 255, atol=0.5 / 255 + 1e-3)
    level = PAPER * (1 - 0.5 ** (3.0 / 3.0))
    assert xa.pixel_array[40][16, 20] == pytest.approx(4095 * level, abs=1)
    assert xa.FrameTime == pytest.approx(100)
    assert xa.SeriesDescription == "Virtual angiogram, Silk, RAO 30 CRA 20"
    with Image.open(tmp_path / "angiogram.webp") as animated:
        total_ms = 0
        for k in range(animated.n_frames):  # the encoder joins frames that look equal
            animated.seek(k)
            animated.load()
            total_ms += animated.info["duration"]
        assert total_ms == 8100


def test_the_report_finds_the_films_of_a_case(tmp_path):
    assert kept_films(tmp_path) is None
    shown, time_s = {"bare": Shown("Before", film())}, np.linspace(0, 1, 5)
    write_films(tmp_path / "angiogram", shown, {"Before": Curves(time_s, 40 * time_s, 50 * time_s)})
    kept = kept_films(tmp_path)
    assert kept.animation == (tmp_path / "angiogram" / "angiogram.webp").read_bytes()
    assert [one.id for one in kept.pictures] == ["key_frames", "density"]
    assert kept.pictures[0].png == key_frames([*shown.values()], float(shown["bare"].film.absorption.max())).png
    (tmp_path / "angiogram" / "angiogram.webp").write_bytes(bytes(3_000_000))
    assert kept_films(tmp_path).animation == b""  # too large for the report


def test_key_frames_are_a_picture():
    picture = key_frames([Shown("Before", film()), Shown("Silk", film(3.0))], 0.8)
    assert Image.open(io.BytesIO(picture.png)).size[0] > 1000
    assert "RAO 30 CRA 20" in picture.caption
