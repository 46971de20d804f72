"""Pairs of time steps that a GPU makes as a whole, recorded once as CUDA graphs.

The host then launches a graph instead of every kernel.
"""

import weakref
from collections.abc import Callable, Iterator
from enum import Enum
from itertools import product
from typing import Any, Final

from numba import config

from vstent.flow.lattice.state import DEFER_PAIRS


class Pairs(Enum):
    """Sequences of pairs of time steps that are launched as a whole."""

    PLAIN = 1
    """One pair; populations near walls are not at home afterwards (see `kernels`)."""
    LAST = 2
    """One pair, after which populations are at home; where it is due, walls are updated."""
    ROUND = 3
    """`DEFER_PAIRS` pairs, of which walls are updated after the first."""


SEQUENCES: Final = ((Pairs.ROUND, 0), *product((Pairs.LAST, Pairs.PLAIN), range(DEFER_PAIRS)))
"""All that `plan` yields: pairs, and the number of the first since walls were last due to be updated."""


def plan(first_pair: int, count: int) -> Iterator[tuple[Pairs, int]]:
    """Yield the sequences that make up `count` pairs of steps; populations are at home after the last.

    The number of the first pair counts from the last check; walls are due to be updated after every `DEFER_PAIRS`-th.
    """
    pair, end = first_pair, first_pair + count
    while pair < end:
        number = pair % DEFER_PAIRS
        is_round = number == 0 and end - pair > DEFER_PAIRS
        yield Pairs.ROUND if is_round else Pairs.LAST if pair + 1 == end else Pairs.PLAIN, number
        pair += DEFER_PAIRS if is_round else 1


class NotRecordedError(Exception):
    """Kernel launches cannot be recorded with this driver or these packages."""


def recorded(launches: Callable[[], None], stream: Any) -> Callable[[], None]:
    """Return a function that replays what `launches` launches on a stream.

    All kernels must have been loaded before; the replay is queued on the stream. Where recording is not possible, a
    `NotRecordedError` is raised and the stream must not be used again.

    References
    ----------
    CUDA driver API, "Graph Management": cuStreamBeginCapture, cuGraphInstantiate, cuGraphLaunch.
    """
    if config.ENABLE_CUDASIM:
        raise NotRecordedError("numba simulates the GPU")
    try:
        from cuda.bindings import driver
    except ImportError as error:
        raise NotRecordedError(f"cuda.bindings cannot be imported: {error}") from error
    handle = driver.CUstream(int(stream.handle))
    # The collector may free an array of another flow meanwhile: only a relaxed capture allows that.
    _checked(driver.cuStreamBeginCapture(handle, driver.CUstreamCaptureMode.CU_STREAM_CAPTURE_MODE_RELAXED))
    try:
        launches()
    except Exception as error:  # driver, compiler and numba each have their own exception classes
        driver.cuStreamEndCapture(handle)
        raise NotRecordedError(f"a kernel could not be launched: {error}") from error
    (graph,) = _checked(driver.cuStreamEndCapture(handle))
    try:
        (graph_exec,) = _checked(driver.cuGraphInstantiate(graph, 0))
    finally:
        driver.cuGraphDestroy(graph)

    def replay() -> None:
        _checked(driver.cuGraphLaunch(graph_exec, handle))

    weakref.finalize(replay, driver.cuGraphExecDestroy, graph_exec).atexit = False
    return replay


def _checked(result: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the values of a call of CUDA's driver; a failed one raises a `NotRecordedError`."""
    code, *values = result
    if int(code) != 0:
        raise NotRecordedError(f"the CUDA driver returned {getattr(code, 'name', code)}")
    return tuple(values)
