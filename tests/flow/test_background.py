"""Work beside a GPU: in a thread, in order, never lost; in place without one. Flows and results are the same."""

from functools import partial
from threading import Event, get_ident

import numba
import numpy as np
import pytest
from tubes import line, tube

from vstent.flow import simulation
from vstent.flow.background import BackgroundWork
from vstent.flow.case import FlowCase
from vstent.flow.lattice.engine import LatticeBoltzmann
from vstent.flow.problem import vessel_case
from vstent.flow.settings import FlowSettings, Numerics

HERE, GPU = (Numerics(cell_size_mm=0.3), Numerics(cell_size_mm=0.3, device_gpu=True))
LONG_S = 20.0


@pytest.fixture(autouse=True)
def safe(monkeypatch: pytest.MonkeyPatch) -> None:
    """A threading layer that allows two threads, as on Linux."""
    monkeypatch.setattr(numba, "threading_layer", lambda: "omp")


def fail() -> None:
    raise OSError("no space left")


@pytest.mark.parametrize("numerics", [None, HERE])
def test_without_a_gpu_work_is_done_in_place_and_at_once(numerics: Numerics | None) -> None:
    with BackgroundWork(numerics) as background:
        assert background.begin(get_ident)() == get_ident()
        with pytest.raises(OSError, match="no space"):
            background.begin(fail)


@pytest.mark.parametrize("layer", ["workqueue", None])
def test_parallel_kernels_of_two_threads_need_a_layer_that_allows_them(
    layer: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def threading_layer() -> str:
        if layer is None:
            raise ValueError("Threading layer is not initialized.")
        return layer

    monkeypatch.setattr(numba, "threading_layer", threading_layer)
    with BackgroundWork(GPU) as background:
        assert background.begin(get_ident)() == get_ident()


def test_with_a_gpu_work_is_done_meanwhile_in_order_and_before_the_end() -> None:
    goes_on, done = Event(), []

    def first() -> int:
        assert goes_on.wait(LONG_S)  # until this thread has come further
        done.append("first")
        return get_ident()

    with BackgroundWork(GPU) as background:
        begun = background.begin(first)
        failed = background.begin(fail)
        threads = background.begin(numba.get_num_threads)
        background.begin(partial(done.append, "last"))
        assert not done
        goes_on.set()
        assert begun() != get_ident()
    assert done == ["first", "last"]
    assert threads() == numba.get_num_threads()
    with pytest.raises(OSError, match="no space"):
        failed()


def test_a_study_that_fails_does_not_lose_what_was_begun() -> None:
    goes_on, done = Event(), []

    def late() -> None:
        assert goes_on.wait(LONG_S)
        done.append("late")

    def study() -> None:
        with BackgroundWork(GPU) as background:
            background.begin(late)
            goes_on.set()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        study()
    assert done == ["late"]


def case(numerics: Numerics) -> FlowCase:
    return vessel_case(tube(line(8.0), 2.0).vessel, FlowSettings(inflow_mL_s=0.5, numerics=numerics))


class Engine(LatticeBoltzmann):
    """The embedded engine, whose preparation is recorded."""

    calls: tuple[Event, list[int]]

    def prepare(self, case: FlowCase) -> None:
        begun, threads = self.calls
        begun.set()
        threads.append(get_ident())
        super().prepare(case)


def test_the_grid_is_built_while_the_gpu_computes_the_first_guess() -> None:
    for numerics in (GPU, HERE):
        begun, threads = Engine.calls = Event(), []
        engine, flow = Engine(0.3), case(numerics)
        is_meanwhile = []
        simulation._guessed(engine, flow, lambda begun=begun, found=is_meanwhile: found.append(begun.wait(0.5)))
        assert is_meanwhile == [numerics is GPU]
        assert len(threads) == (numerics is GPU)
        assert get_ident() not in threads


def test_a_prepared_flow_is_the_same() -> None:
    prepared, plain = case(HERE), case(HERE)
    engine = LatticeBoltzmann(0.3)
    engine.prepare(prepared)
    first, second = (engine.init(one, None) for one in (prepared, plain))
    assert {"index", "depth_mm"} <= vars(first.domain).keys()
    assert "depth_mm" not in vars(second.domain)
    for _ in range(2):
        first, second = engine.step(first), engine.step(second)
    np.testing.assert_array_equal(first.populations, second.populations)
    np.testing.assert_array_equal(first.domain.depth_mm, second.domain.depth_mm)
