"""Flow engines: one protocol, one driver (init / step / terminate / result).

An engine turns a FlowCase into a FlowField. It only knows how to begin, how to advance to the next check, what it has
left to go, and how to say its result; the loop, its limit, the clock, the check for divergence and the progress are
the driver's.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, ClassVar, Generic, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from vstent.errors import FlowError
from vstent.flow.case import FlowCase, FlowField

State = TypeVar("State")
Saved: TypeAlias = dict[str, NDArray[Any]]
"""A run under way, as named arrays."""

SAVE_EVERY_S = 20.0
"""Time between saved states of a run: no more is lost when it is stopped."""
SAVE_SHARE = 0.05
"""Most of the time that saving may take: what is slow to save is saved more seldom."""


@dataclass(frozen=True)
class Progress:
    """How far a computation has come."""

    fraction: float
    """Estimated part of the way done, 0 to 1."""
    residual: float
    """Largest fraction that any monitored quantity has left to go."""
    seconds_left: float
    """Estimated time to the end."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """What the driver knows at the end."""

    is_converged: bool
    """Whether the tolerance was reached before the limit."""
    residual: tuple[float, ...]
    """Residual at every check."""
    seconds: float
    """Time from the beginning to the end."""
    loop_seconds: float
    """Time in the steps alone."""


@dataclass(frozen=True, eq=False)
class Bookmark:
    """Where a run left off, and where it leaves word how far it has come."""

    saved: Saved | None
    """What the run saved last; None: it begins."""
    save: Callable[[Saved], None]
    """Takes the state of the run from time to time."""


class DivergenceError(FlowError):
    """A run has grown without bounds."""


@dataclass(frozen=True)
class AbstractEngine(ABC, Generic[State]):
    """A way to compute a flow; made with a cell size and a folder."""

    cell_size_mm: float
    """Edge of a cell."""
    folder: Path | None = None
    """The engine's own folder for this one run, not there yet: what it writes lies there, and what lies there of the
    same run it may go on from. None: it is asked to do without."""

    outer: FlowField | None = None
    """The flow all over, on wider cells, where only the close-up of the sac is to be computed; None: the whole vessel
    is."""

    coarsening: ClassVar[float | None] = None
    """Cells of a first guess by the same engine over those of the answer; None: it finds its own way from the start."""
    refined_by: ClassVar[tuple[str, ...]] = ("cell_size_mm",)
    """Settings that the result converges with as they become smaller; the cell size is the first."""
    closes_up: ClassVar[bool] = False
    """Whether it can be given an `outer` flow."""
    runs_on_gpu: ClassVar[bool] = False
    """Whether it heeds ``device_gpu``; where it does not, it is not asked."""

    def cost(self, case: FlowCase) -> str:
        """Say in a sentence what a flow will cost.

        Raises
        ------
        FlowError
            When it does not fit in the free memory.
        """
        return "The run time with this engine is not known in advance."

    def calmer(self, case: FlowCase) -> FlowCase | None:
        """Return how to try once more what diverged; None: not at all."""
        return None

    @abstractmethod
    def init(self, case: FlowCase, start: FlowField | None) -> State:
        """Build the domain and the first guess: at rest, or a field on any grid."""

    @abstractmethod
    def step(self, state: State) -> State:
        """Advance by a few seconds, no further than to the next check."""

    @abstractmethod
    def terminate(self, state: State) -> float | None:
        """Return the largest fraction that any monitored quantity has left to go; nan when diverged.

        None between checks.
        """

    @abstractmethod
    def save(self, state: State) -> Saved | None:
        """Return the run as arrays; None: what lies in the engine's folder is enough to go on."""

    @abstractmethod
    def resume(self, case: FlowCase, saved: Saved) -> State:
        """Return the run as it was saved: what follows is the same to the last bit."""

    @abstractmethod
    def trouble(self, state: State) -> str:
        """Say in one sentence why the run diverged, the last good state, and what to do."""

    @abstractmethod
    def max_checks(self, state: State) -> int:
        """Return the limit of the loop."""

    @abstractmethod
    def result(self, state: State, outcome: Outcome) -> FlowField:
        """Return the field reached."""


def run(
    engine: AbstractEngine[State],
    case: FlowCase,
    *,
    start: FlowField | None = None,
    progress: Callable[[Progress], None] | None = None,
    bookmark: Bookmark | None = None,
) -> FlowField:
    """Drive an engine until its residual is below the case's tolerance or its limit is reached.

    Raises
    ------
    DivergenceError
        When the computation diverges.
    """
    began = perf_counter()
    saved = None if bookmark is None else bookmark.saved
    state = engine.init(case, start) if saved is None else engine.resume(case, saved)
    residual = [] if saved is None else saved["residual"].tolist()
    before, loop_before = (0.0, 0.0) if saved is None else saved["seconds"].tolist()
    limit, tolerance = engine.max_checks(state), case.settings.settled_below
    saver, loop_began = _Saver(bookmark), perf_counter()

    def seconds() -> tuple[float, float]:
        return before + perf_counter() - began, loop_before + perf_counter() - loop_began

    while len(residual) < limit and not (residual and residual[-1] < tolerance):
        state = _step(engine, state)
        reached = engine.terminate(state)
        if reached is not None:
            if np.isnan(reached):
                raise DivergenceError(engine.trouble(state))
            residual.append(reached)
            if progress is not None:
                progress(_progress(residual, limit, tolerance, seconds()[1]))
        if saver.is_due():
            saver.save(engine.save(state), residual=residual, seconds=seconds())
    return engine.result(state, Outcome(residual[-1] < tolerance, tuple(residual), *seconds()))


class _Saver:
    """Saves a run every so often."""

    def __init__(self, bookmark: Bookmark | None) -> None:
        self._bookmark = bookmark
        self._due_s = perf_counter() + SAVE_EVERY_S

    def is_due(self) -> bool:
        return self._bookmark is not None and perf_counter() >= self._due_s

    def save(self, saved: Saved | None, **more: Sequence[float]) -> None:
        began = perf_counter()
        if self._bookmark is not None and saved is not None:
            self._bookmark.save(saved | {name: np.array(values) for name, values in more.items()})
        now = perf_counter()
        self._due_s = now + max(SAVE_EVERY_S, (now - began) / SAVE_SHARE)


def _step(engine: AbstractEngine[State], state: State) -> State:
    """Step; Ctrl-C that arrives inside a compiled kernel comes out of it as a SystemError and is put right."""
    try:
        return engine.step(state)
    except SystemError as error:
        if isinstance(error.__cause__ or error.__context__, KeyboardInterrupt):
            raise KeyboardInterrupt from error
        raise


def _progress(residual: list[float], limit: int, tolerance: float, seconds: float) -> Progress:
    """Extrapolate the residual's decay over the last half of the checks."""
    done = len(residual)
    total = float(limit)
    half = residual[done // 2 :]
    if len(half) >= 3 and np.isfinite(half).all():
        rate = np.log(max(half[0], 1e-12) / max(half[-1], 1e-12)) / (len(half) - 1)
        if rate > 0:
            total = min(total, done + max(0.0, np.log(residual[-1] / tolerance) / rate))
    return Progress(done / max(total, done), residual[-1], seconds * (total / done - 1))
