"""Contrast is recorded once for a flow and an injection, and found again."""

from types import SimpleNamespace

import numpy as np
import pytest

from vstent.angiography.angiogram import AngiogramSettings
from vstent.errors import ReadError
from vstent.study.films import Recording, stents_of
from vstent.study.store import Key, Store

POINTS = np.stack([np.arange(6.0), np.zeros(6), np.zeros(6)], axis=1)


GRID = SimpleNamespace(centers_mm=POINTS, cell_size_mm=1.0)
CARRIER = SimpleNamespace(levels=(GRID,), finest=GRID, inflow_mL_s=4.0, phases=())


FLOW = Key(12 * "a", 12 * "b")
"""Key of a flow."""


@pytest.fixture
def store(tmp_path):
    """The store of a case."""
    return Store(tmp_path)


def record(recording, store) -> bool:
    """Record three frames; return whether frames were wanted."""
    with recording("silk", FLOW, store, lambda: CARRIER) as watch:
        if watch is not None:
            take = watch(POINTS, np.ones(6))
            for k in range(3):
                take(0.1 * k, np.full(6, 75.0 * k))
        return watch is not None


def test_contrast_is_recorded_once_for_an_injection(store):
    first, again, other = (Recording(AngiogramSettings(window_s=window)) for window in (6.0, 6.0, 8.0))
    earlier = store.path("contrast silk", Key(12 * "c", 12 * "b"))
    earlier.write_bytes(b"")
    assert record(first, store)
    assert not record(again, store)
    assert np.array_equal(again.histories["silk"].stored, first.histories["silk"].stored)
    assert store.path("contrast silk", FLOW).exists()
    assert not earlier.exists()
    assert record(other, store)
    # 3 of 4 mL/s are agent of 300 mg/mL, so that 225 mg/mL enter.
    assert other.histories["silk"].most_mg_mL == pytest.approx(225)
    assert [values[0] for _, values in other.histories["silk"].frames()] == pytest.approx([0, 75, 150], abs=1)


def test_what_is_recorded_is_kept_only_when_the_march_ends(store):
    class StoppedError(Exception):
        pass

    recording = Recording(AngiogramSettings())

    def march():
        with recording("silk", FLOW, store, lambda: CARRIER) as watch:
            watch(POINTS, np.ones(6))(0.0, np.zeros(6))
            raise StoppedError

    with pytest.raises(StoppedError):
        march()
    assert list(store.folder.iterdir()) == []
    assert recording.histories == {}


def test_where_there_is_no_flow_nothing_is_recorded(store):
    recording = Recording(AngiogramSettings())
    with recording("silk", FLOW, store, lambda: None) as watch:
        assert watch is None
    assert recording.histories == {}


def test_a_folder_without_a_run_is_refused(tmp_path):
    with pytest.raises(ReadError, match="not a case folder with a finished run"):
        stents_of(tmp_path, ())
