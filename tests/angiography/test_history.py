"""A stored history gives back the concentration, and a reused buffer is copied."""

from types import SimpleNamespace

import numpy as np
import pytest

from vstent.angiography.filming import projectors_of
from vstent.angiography.history import History, Recorder
from vstent.angiography.view import View
from vstent.io.archive import load_data, save_data


def flow(centers_mm: np.ndarray, spacing_mm: float) -> SimpleNamespace:
    grid = SimpleNamespace(centers_mm=centers_mm, cell_size_mm=spacing_mm)
    return SimpleNamespace(levels=(grid,), finest=grid)


def test_cells_have_the_value_of_their_block():
    """Eight cells are marched as one, whose center is that of its blood; a cell far from all others holds nothing."""
    cube = np.stack(np.meshgrid([0.0, 1], [0.0, 1], [0.0, 1], indexing="ij"), axis=-1).reshape(-1, 3)
    single, lost = np.array([[2.0, 0, 0], [2, 1, 1]]), np.array([[9.0, 9, 9]])
    recorder = Recorder(flow(np.concatenate([cube, single, lost]), 1.0), 300.0)
    recorder.watch(np.concatenate([cube.mean(axis=0)[None], single]), np.array([2.0, 1, 1]))(0.0, np.zeros(3))
    kept = recorder.history()
    assert kept.block.tolist() == [0] * 8 + [1, 2]
    assert kept.points_mm.shape == (10, 3)
    arm = View(0.0, 0.0, np.array([1.0, 0.5, 0.5]), 40, 40, 0.2)
    image = projectors_of(arm, {"bare": kept})["bare"](np.array([1.0, 0.0, 0.0]))
    assert image.sum() * 0.2**2 == pytest.approx(8 * arm.magnification**2, rel=2e-3)


def test_values_come_back_within_half_a_step():
    rng = np.random.default_rng(2)
    wanted = rng.uniform(0, 300, (5, 40)).astype(np.float32)
    buffer = np.zeros(40, np.float32)

    points = np.stack([np.arange(40.0), np.zeros(40), np.zeros(40)], axis=1)
    recorder = Recorder(flow(points, 1.0), 300.0, begin_s=0.2)
    take = recorder.watch(points, np.ones(40))
    for k, row in enumerate(wanted):
        buffer[:] = row
        take(0.1 * k, buffer)
    kept = recorder.history()
    wanted = wanted[2:]  # the injection starts at 0.2 s
    times, values = zip(*kept.frames(), strict=True)
    assert np.allclose(times, 0.1 * np.arange(3))
    error = np.abs(np.array(values) - wanted)
    assert error.max() <= 300 / 255 * 1.001
    assert error[wanted < 3].max(initial=0) < 0.13  # finer near zero


def test_no_cell_of_a_wide_block_is_lost():
    """Of a block of 4 x 4 x 4 cells at the wall only a corner and the far edge are blood."""
    corner = np.array([[0.0, 0, 0], [3, 3, 0], [3, 3, 1], [3, 3, 2], [3, 3, 3]])
    whole = np.stack(np.meshgrid(*3 * [np.arange(4.0, 8)], indexing="ij"), axis=-1).reshape(-1, 3)
    recorder = Recorder(flow(np.concatenate([corner, whole]), 1.0), 300.0)
    edges = np.cbrt([len(corner), len(whole)])
    recorder.watch(np.stack([corner.mean(axis=0), whole.mean(axis=0)]), edges)(0.0, np.zeros(2))
    assert len(recorder.history().points_mm) == 5 + 64


def test_values_beyond_the_scale_are_cut_and_the_file_gives_it_back(tmp_path):
    points = np.array([[0.0, 0, 0], [1, 0, 0]])
    recorder = Recorder(flow(points, 1.0), 300.0)
    recorder.watch(points, np.ones(2))(0.0, np.array([-1.0, 400.0]))
    save_data(tmp_path / "history.npz", recorder.history())
    again = load_data(tmp_path / "history.npz", History)
    assert next(again.frames())[1] == pytest.approx([0, 300])
    assert not again.stored.flags.writeable
