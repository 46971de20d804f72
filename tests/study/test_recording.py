"""Contrast is recorded once for a flow and an injection, and found again."""

from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from vstent.angiography.angiogram import Angiogram, AngiogramSettings
from vstent.angiography.curves import Curves
from vstent.angiography.history import History
from vstent.errors import InputError, ReadError
from vstent.study import contrast
from vstent.study.contrast import angiogram_of, stents_of
from vstent.study.keys import angiogram_key
from vstent.study.store import Key, Store

POINTS = np.stack([np.arange(6.0), np.zeros(6), np.zeros(6)], axis=1)


GRID = SimpleNamespace(centers_mm=POINTS, cell_size_mm=1.0)
CARRIER = SimpleNamespace(levels=(GRID,), finest=GRID, inflow_mL_s=4.0, phases=())


FLOW = Key(12 * "a", 12 * "b")
"""Key of a flow."""


class StoreWithFlow(Store):
    """The store of a case whose flow is `CARRIER`."""

    def find(self, name: str, key: Key, kind: type) -> object:
        return CARRIER if name == "flow silk" else super().find(name, key, kind)


class StoppedError(Exception):
    """A march was stopped."""


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Windows of the angiograms that are computed, of three frames each; one of 1 s stops after the first."""
    windows = []

    def marched(anatomy: object, field: object, settings: AngiogramSettings, *, watch, progress) -> Angiogram:
        windows.append(settings.window_s)
        take = watch(POINTS, np.ones(6))
        for k in range(3):
            take(0.1 * k, np.full(6, 75.0 * k))
            if settings.window_s == 1.0:
                raise StoppedError
        values = {"curves": Curves(*np.zeros((3, 3))), "measures": {"contrast_peak_s": settings.window_s}, "advice": ""}
        return Angiogram(**{one.name: values.get(one.name, np.zeros(0)) for one in fields(Angiogram)})

    monkeypatch.setattr(contrast, "angiogram", marched)
    return windows


def of(store: Store, window_s: float) -> tuple[Angiogram, History]:
    return angiogram_of(store.folder, None, "silk", FLOW, AngiogramSettings(window_s=window_s), store)


def test_contrast_is_recorded_once_for_an_injection(tmp_path: Path, computed: list[float]) -> None:
    store = StoreWithFlow(tmp_path)
    earlier = store.path("contrast silk", Key(12 * "c", 12 * "b"))
    earlier.write_bytes(b"")
    (first, recorded), (again, found) = of(store, 6.0), of(store, 6.0)
    assert computed == [6.0]
    assert np.array_equal(found.stored, recorded.stored)
    assert again.measures == first.measures == {"contrast_peak_s": 6.0}
    assert store.path("contrast silk", angiogram_key(FLOW, AngiogramSettings(window_s=6.0))).exists()
    assert not earlier.exists()
    _, other = of(store, 8.0)
    assert computed == [6.0, 8.0]
    # 3 of 4 mL/s are agent of 300 mg/mL, so that 225 mg/mL enter.
    assert other.most_mg_mL == pytest.approx(225)
    assert [values[0] for _, values in other.frames()] == pytest.approx([0, 75, 150], abs=1)


def test_what_is_recorded_is_kept_only_when_the_march_ends(tmp_path: Path, computed: list[float]) -> None:
    with pytest.raises(StoppedError):
        of(StoreWithFlow(tmp_path), 1.0)
    assert list(tmp_path.iterdir()) == []


def test_where_there_is_no_flow_nothing_is_recorded(tmp_path: Path, computed: list[float]) -> None:
    with pytest.raises(InputError, match="holds no flow of silk"):
        of(Store(tmp_path), 6.0)
    assert computed == []
    assert list(tmp_path.iterdir()) == []


def test_a_folder_without_a_run_is_refused(tmp_path):
    with pytest.raises(ReadError, match="not a case folder with a finished run"):
        stents_of(tmp_path, ())
