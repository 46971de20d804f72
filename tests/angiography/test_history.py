"""A stored history gives back the concentration, and a reused buffer is copied."""

import numpy as np
import pytest

from vstent.angiography.history import History, Recorder
from vstent.io.archive import load_data, save_data


def test_values_come_back_within_half_a_step():
    rng = np.random.default_rng(2)
    wanted = rng.uniform(0, 300, (5, 40)).astype(np.float32)
    buffer = np.zeros(40, np.float32)

    recorder = Recorder(300.0, "key", begin_s=0.2)
    take = recorder.watch(rng.normal(size=(40, 3)), np.full(40, 0.2))
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


def test_values_beyond_the_scale_are_cut_and_the_file_gives_it_back(tmp_path):
    recorder = Recorder(300.0, "key")
    recorder.watch(np.zeros((2, 3)), np.ones(2))(0.0, np.array([-1.0, 400.0]))
    save_data(tmp_path / "history.npz", recorder.history())
    again = load_data(tmp_path / "history.npz", History)
    assert next(again.frames())[1] == pytest.approx([0, 300])
    assert again.key == "key"
    assert not again.stored.flags.writeable
