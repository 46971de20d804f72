"""Flow engines: the abstract base class and the loop that drives every engine.

An engine turns a `FlowCase` into a `FlowField`. It defines how to start, how to advance to the next check, how large
the residual is, and how to return the result. The loop with its limit, the timing, the check for divergence and the
progress reports are in `run`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
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
"""State of an unfinished run, as named arrays."""

SAVE_EVERY_S = 20.0
"""Minimum time between saved states of a run, s: the most that an interruption loses, unless saving is slow."""
SAVE_SHARE = 0.05
"""Maximum share of the run time spent on saving: states that are slow to save are saved less often."""


@dataclass(frozen=True)
class Progress:
    """Progress of a computation."""

    fraction: float
    """Estimated completed fraction, 0 to 1."""
    residual: float
    """Largest expected remaining change of any monitored quantity, as a fraction."""
    seconds_left: float
    """Estimated remaining run time."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """What the driver loop passes to the engine at the end of a run."""

    is_converged: bool
    """Whether the tolerance was reached before the limit."""
    residual: tuple[float, ...]
    """Residual at every check."""
    seconds: float
    """Run time from start to end."""
    loop_seconds: float
    """Run time of the loop alone."""


class DivergenceError(FlowError):
    """A computation diverged."""


@dataclass(frozen=True)
class AbstractEngine(ABC, Generic[State]):
    """Base class of flow engines; an engine is created with a grid spacing and a folder."""

    cell_size_mm: float
    """Grid spacing."""
    folder: Path | None = None
    """The engine's own folder for this run, which may not exist yet. The engine may resume from files of the same
    run there. None: no folder is available."""

    coarsening: ClassVar[float | None] = None
    """Grid spacing of the coarse run that provides a first guess, over that of the result; None: no coarse run."""
    refined_by: ClassVar[tuple[str, ...]] = ("cell_size_mm",)
    """Settings whose reduction makes the result converge; the grid spacing comes first."""
    has_levels: ClassVar[bool] = False
    """Whether the engine supports a finer grid in a part of the vessel (`Numerics.refine`)."""
    runs_on_gpu: ClassVar[bool] = False
    """Whether the engine supports the setting ``device_gpu``."""

    has_all_ends: ClassVar[bool] = False
    """Whether the engine supports resistances at the outlets and velocity profiles that change in a pulse."""

    def cost(self, case: FlowCase) -> str:
        """Return a sentence on the expected run time and memory.

        Raises
        ------
        FlowError
            The case does not fit in the free memory.
        """
        return "The run time and memory of this engine cannot be estimated in advance."

    def memory_bytes(self, case: FlowCase) -> float | None:
        """Return the expected peak memory of a flow; None: unknown."""
        return None

    def calmer(self, case: FlowCase) -> FlowCase | None:
        """Return a modified case to retry after divergence; None: do not retry."""
        return None

    def prepare(self, case: FlowCase) -> None:
        """Build what `init` needs and the start does not change; called in another thread while a GPU computes."""

    @abstractmethod
    def init(self, case: FlowCase, start: FlowField | None) -> State:
        """Build the domain and the initial state: at rest, or from a field on any grid."""

    @abstractmethod
    def step(self, state: State) -> State:
        """Advance by a few seconds of run time, at most to the next check."""

    @abstractmethod
    def terminate(self, state: State) -> float | None:
        """Return the residual: the largest expected remaining change of any monitored quantity, as a fraction.

        nan when the flow has diverged, None between checks.
        """

    @abstractmethod
    def save(self, state: State) -> Saved | None:
        """Return the state as arrays; None: the files in the engine's folder suffice to resume."""

    @abstractmethod
    def resume(self, case: FlowCase, saved: Saved) -> State:
        """Restore a saved state; the run then gives the same result to the last bit."""

    @abstractmethod
    def trouble(self, state: State) -> str:
        """Return a sentence on a diverged run: the likely cause, the last good state, and what to do."""

    @abstractmethod
    def max_checks(self, state: State) -> int:
        """Return the maximum number of checks."""

    @abstractmethod
    def result(self, state: State, outcome: Outcome) -> FlowField:
        """Return the computed flow."""


def run(
    engine: AbstractEngine[State],
    case: FlowCase,
    *,
    start: FlowField | None = None,
    progress: Callable[[Progress], None] | None = None,
    saved: Saved | None = None,
    save: Callable[[Saved], None] | None = None,
) -> FlowField:
    """Run an engine until its residual is below the case's tolerance or its maximum number of checks is reached.

    It starts from rest or from a flow on any grid, or resumes from a saved state. `progress` is called at every check,
    `save` with the state from time to time. A diverging computation raises a DivergenceError.
    """
    began = perf_counter()
    state = engine.init(case, start) if saved is None else engine.resume(case, saved)
    residual = [] if saved is None else saved["residual"].tolist()
    before, loop_before = (0.0, 0.0) if saved is None else saved["seconds"].tolist()
    limit, tolerance = engine.max_checks(state), case.settled_below
    loop_began = perf_counter()
    save_at = loop_began + SAVE_EVERY_S

    def seconds() -> tuple[float, float]:
        return before + perf_counter() - began, loop_before + perf_counter() - loop_began

    while len(residual) < limit and not (residual and residual[-1] < tolerance):
        state, reached = stepped(engine, state)
        if reached is not None:
            residual.append(reached)
            if progress is not None:
                progress(_progress(residual, limit, tolerance, seconds()[1]))
        if save is not None and perf_counter() >= save_at:
            save_began, arrays = perf_counter(), engine.save(state)
            if arrays is not None:
                save(arrays | {"residual": np.array(residual), "seconds": np.array(seconds())})
            now = perf_counter()
            save_at = now + max(SAVE_EVERY_S, (now - save_began) / SAVE_SHARE)
    return engine.result(state, Outcome(residual[-1] < tolerance, tuple(residual), *seconds()))


def stepped(engine: AbstractEngine[State], state: State) -> tuple[State, float | None]:
    """Advance an engine once, and return its state and the residual there; None between checks.

    A Ctrl-C inside a compiled kernel, a SystemError there, becomes a KeyboardInterrupt.
    """
    try:
        state = engine.step(state)
    except SystemError as error:
        if isinstance(error.__cause__ or error.__context__, KeyboardInterrupt):
            raise KeyboardInterrupt from error
        raise
    residual = engine.terminate(state)
    if residual is not None and np.isnan(residual):
        raise DivergenceError(engine.trouble(state))
    return state, residual


def _progress(residual: list[float], limit: int, tolerance: float, seconds: float) -> Progress:
    """Estimate the progress by extrapolating the decay of the residual over the last half of the checks."""
    done = len(residual)
    total = float(limit)
    half = residual[done // 2 :]
    if len(half) >= 3 and np.isfinite(half).all():
        rate = np.log(max(half[0], 1e-12) / max(half[-1], 1e-12)) / (len(half) - 1)
        if rate > 0:
            total = min(total, done + max(0.0, np.log(residual[-1] / tolerance) / rate))
    return Progress(done / max(total, done), residual[-1], seconds * (total / done - 1))
