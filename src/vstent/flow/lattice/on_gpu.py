"""A lattice-Boltzmann run on a GPU: its arrays stay there between checks, without transfers in between."""

from collections.abc import Sequence
from functools import partial
from time import perf_counter
from typing import Any, Final

import numba
import numpy as np
from numba import cuda
from numpy.typing import NDArray

from vstent.flow.lattice.kernels import gpu as kernels
from vstent.flow.lattice.kernels.gpu import THREADS
from vstent.flow.lattice.scales import ODD_RATE
from vstent.flow.lattice.state import DEFER_PAIRS, DEFER_PART, State
from vstent.kernels.arrays import Floats, Ints

# Each opening is one block and there are few, so that numba's warning about low occupancy does not apply.
numba.config.CUDA_LOW_OCCUPANCY_WARNINGS = 0

PART: Final = np.float32(DEFER_PART)
"""Under-relaxation factor of the deferred updates, in single precision."""
UPDATES_TIMED: Final = 8
"""Number of updates timed, of which the fastest counts; the first includes compilation."""


class Device:
    """The arrays of a run on the GPU and its kernels."""

    def __init__(self, state: State) -> None:
        """Copy all arrays that the time steps need to the GPU."""
        a, links, screen, scales = state.addressing, state.links, state.screen, state.scales
        self._populations, self._openings = put(state.populations), put(links.openings)
        self._source, self._refill = put(links.source), put(state.refill.refill)
        f, start = self._populations, put(links.start)
        cells = int(a.length.sum())
        relaxation = np.float32(scales.relaxation_steps), put(scales.thinning), put(state.limit), np.float32(ODD_RATE)
        update = (*_cells_of(a.length), *relaxation, put(screen.start), put(screen.place), put(screen.entry))
        reflect = put(links.weight), self._source, put(state.refill.place), self._refill
        address = put(links.address[: links.start[-1]])
        of_openings = start, address, put(links.place), put(links.direction), put(links.shape)
        drive = partial(_launch, kernels.drive, len(links.openings) * THREADS)
        self._drive = partial(drive, f, a.stride, self._openings, of_openings, self._source)
        swap = partial(_launch, kernels.swap, a.septa.shape[1], f, put(a.septa))
        self._steps = []
        for address_of, path in zip(a.address, links.path, strict=True):
            self._steps += [
                partial(_launch, kernels.update, cells, f, put(address_of), *update),
                partial(_launch, kernels.reflect, max(len(path), len(state.refill.refill)), f, put(path), *reflect),
                swap,
            ]
        self._settle = _settling(state, f, self._source, self._refill)
        self._place, self._moments = put(a.place), put(np.zeros((len(a.place), 4), np.float32))
        self._outflow = put(np.zeros(len(links.openings)))
        self._read = (
            partial(_launch, kernels.moments, len(a.place), f, a.stride, self._place, self._moments),
            partial(_launch, kernels.outflow, len(links.openings) * THREADS, f, start, address, self._outflow),
        )

    def advance(self, wanted: Floats, moments: Floats, first_pair: int) -> None:
        """Make one pair of time steps per row of `wanted` (see `state.OnDevice`)."""
        imposed = put(wanted), put(moments)
        for pair in range(len(wanted)):
            self._drive(*imposed, pair)
            for kernel in self._steps:
                kernel()
            if (first_pair + pair) % DEFER_PAIRS == 0:
                for kernel in self._settle:
                    kernel()
        cuda.synchronize()

    def read(self) -> tuple[NDArray[np.float32], Floats]:
        """Return density deviation and momentum (n, 4) of every cell, and the flow rate (k,) out of every end."""
        for kernel in self._read:
            kernel()
        return self._moments.copy_to_host(), self._outflow.copy_to_host()

    def fetch(self, state: State) -> None:
        """Copy the arrays that the time steps change back to `state`."""
        for here, there in (
            (self._populations, state.populations),
            (self._openings, state.links.openings),
            (self._source, state.links.source),
            (self._refill, state.refill.refill),
        ):
            there[:] = here.copy_to_host()[: len(there)]


def seconds_of_update(
    f: NDArray[np.float32],
    address: Ints,
    length: Ints,
    relaxation: Sequence[Any],
    screen: Sequence[NDArray[Any]],
) -> float:
    """Return the run time of an update of all cells, the best of several.

    Parameters
    ----------
    f, address, length, relaxation, screen
        Arguments of `d3q19.update`.
    """
    time, law, limit, odd_rate = relaxation
    segments = (*_cells_of(length), time, put(law), put(limit), odd_rate)
    launch = partial(_launch, kernels.update, int(length.sum()), put(f), put(address), *segments, *map(put, screen))
    times = []
    for _ in range(UPDATES_TIMED):
        cuda.synchronize()
        began = perf_counter()
        launch()
        cuda.synchronize()
        times.append(perf_counter() - began)
    return min(times)


def _cells_of(length: Ints) -> tuple[Any, Any]:
    """Return, on the GPU, the segment of every cell and the first cell of every segment, from segment lengths (s,)."""
    segment = np.repeat(np.arange(len(length), dtype=np.int32), length)
    return put(segment), put((np.cumsum(length) - length).astype(np.int32))


def _settling(state: State, f: Any, source: Any, refill: Any) -> tuple[partial[None], ...]:
    """Return the kernels that run every few step pairs: the deferred wall correction and the mass balance."""
    links, walls = state.links, state.refill
    of_wall = slice(int(links.start[-1]), None)
    address = links.address[of_wall]
    correction, lost, groups = put(links.correction[of_wall]), put(walls.lost), tuple(map(put, walls.groups))
    defer = partial(_launch, kernels.defer, len(address), f, put(address), correction, source[of_wall], lost, PART)
    balance = partial(_launch, kernels.balance, len(walls.groups[0]) - 1, lost, groups, refill, PART)
    return defer, balance


def put(array: NDArray[Any]) -> Any:
    """Copy an array to the GPU; an empty one, which cannot be stored there, becomes a zero that is never read."""
    whole = array if array.size else np.zeros([max(n, 1) for n in array.shape], array.dtype)
    return cuda.to_device(np.ascontiguousarray(whole))


def _launch(kernel: Any, threads: int, *arguments: Any) -> None:
    """Run a kernel with at least `threads` threads."""
    if threads:
        kernel[-(-threads // THREADS), THREADS](*arguments)
