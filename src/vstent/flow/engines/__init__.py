"""Flow engines: one protocol, one driver (init / step / terminate / result).

An engine turns a FlowCase into a FlowField. It only knows how to begin, how to advance to the next check, what it has
left to go, and how to say its result; the loop, its limit, the clock, the check for divergence and the progress are
the driver's.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Generic, TypeVar

import numpy as np

from vstent.errors import FlowError
from vstent.flow.types import FlowCase, FlowField

State = TypeVar("State")


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


class AbstractEngine(ABC, Generic[State]):
    """A way to compute a steady flow."""

    @abstractmethod
    def init(self, case: FlowCase, start: FlowField | None) -> State:
        """Build the domain and the first guess: at rest, or a field on any grid."""

    @abstractmethod
    def step(self, state: State) -> State:
        """Advance to the next check."""

    @abstractmethod
    def terminate(self, state: State) -> float:
        """Return the largest fraction that any monitored quantity has left to go; nan when diverged."""

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
) -> FlowField:
    """Drive an engine until its residual is below the case's tolerance or its limit is reached.

    Raises
    ------
    FlowError
        When the computation diverges.
    """
    began = perf_counter()
    state = engine.init(case, start)
    loop_began = perf_counter()
    limit = engine.max_checks(state)
    residual: list[float] = []
    while len(residual) < limit:
        state = _step(engine, state)
        residual.append(engine.terminate(state))
        if np.isnan(residual[-1]):
            raise FlowError(
                f"the flow diverged at check {len(residual)} of {limit}: the time step is too long for this grid; "
                "halve the lattice speed or the cell size"
            )
        if progress is not None:
            progress(_progress(residual, limit, case.settings.tolerance, perf_counter() - loop_began))
        if residual[-1] < case.settings.tolerance:
            break
    now = perf_counter()
    is_converged = residual[-1] < case.settings.tolerance
    return engine.result(state, Outcome(is_converged, tuple(residual), now - began, now - loop_began))


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
