"""A lattice-Boltzmann run on a GPU: its arrays stay there between checks, without transfers in between."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from time import perf_counter
from typing import Any, Final

import numba
import numpy as np
from numba import cuda
from numpy.typing import NDArray

from vstent.flow.lattice.gpu_tables import PAIRS, START, Numbers, correction_of, numbers_of, single_of, tables
from vstent.flow.lattice.kernels import d3q19
from vstent.flow.lattice.kernels import gpu as kernels
from vstent.flow.lattice.kernels.gpu import THREADS
from vstent.flow.lattice.packing import Layout, Packed, pack
from vstent.flow.lattice.readback import ReadBack
from vstent.flow.lattice.recording import NotRecordedError, Pairs, plan, recorded
from vstent.flow.lattice.state import DEFER_PAIRS, DEFER_PART, State
from vstent.kernels.arrays import Floats, Ints

# Each opening is few blocks, so that numba's warning about low occupancy does not apply.
numba.config.CUDA_LOW_OCCUPANCY_WARNINGS = 0

UPDATES_TIMED: Final = 8
"""Number of updates timed, of which the fastest counts; the first includes compilation."""


@dataclass(frozen=True, eq=False)
class Launch:
    """A kernel with its arguments."""

    kernel: Any
    """Compiled kernel."""
    threads: int
    """Least number of threads; nothing is launched for 0."""
    arguments: tuple[Any, ...]
    """Its first arguments."""

    @property
    def name(self) -> str:
        """Return the name of the kernel."""
        return str(self.kernel.__name__)

    def __call__(self, stream: Any, *further: Any) -> None:
        """Launch the kernel on a stream, with further arguments."""
        if self.threads:
            self.kernel[-(-self.threads // THREADS), THREADS, stream](*self.arguments, *further)


class Device:
    """The arrays of a run on the GPU and its kernels."""

    def __init__(self, state: State) -> None:
        """Copy all arrays that the time steps need to the GPU."""
        a, links, packed = state.addressing, state.links, pack(state)
        at = tables(packed, numbers_of(state, packed))
        self._packed, self._at, self._cells, self.stream = packed, at, len(packed.code), cuda.stream()
        self._populations, self._shape = put(state.populations), put(links.shape)
        self._integers, self._singles, self._doubles = put(at.integers), put(at.singles), put(at.doubles)
        self._common = self._populations, self._integers, self._singles
        self._layout = a.stride, at.code_at
        self._through = put(np.zeros(len(links.address), np.float32))
        self._density, self._velocity = (put(np.zeros((self._cells, *n), np.float32)) for n in ((), (3,)))
        self._outflow, self._times = (
            put(np.zeros(len(links.openings))),
            put(np.zeros(len(state.screen.cell), np.float32)),
        )
        self._moments = ReadBack((self._density, self._velocity, self._outflow))
        self._steps = self._kernels_of_pair(state)
        self._settle = self._kernels_of_walls()
        self._read, self._read_times = self._kernels_of_reading(state)
        self._replay: dict[Pairs, Any] | None = None
        self._why = ""
        self._begun = 0

    @property
    def how(self) -> str:
        """Return in words how the host launches the time steps."""
        return "as a CUDA graph" if self._replay else f"one by one{self._why}"

    @property
    def nbytes(self) -> int:
        """Return the memory of the run on the GPU, in bytes."""
        known = {
            id(array): array
            for launch in (*self._steps, *self._settle, *self._read)
            for array in _arrays(launch.arguments)
        }
        return sum(array.nbytes for array in (*known.values(), self._through))

    def _kernels_of_pair(self, state: State) -> tuple[Launch, Launch, Launch, Launch]:
        """Return the kernels of a pair of steps: openings, even step, septa, and odd step without its last argument."""
        septa, (stride, code_at) = state.addressing.septa.shape[1], self._layout
        cells = stride, self._cells, code_at
        drive = *self._common, self._doubles, *self._layout
        return (
            Launch(kernels.drive, self._at.blocks * THREADS, drive),
            Launch(kernels.even_step, self._cells, (*self._common, self._doubles, self._shape, *cells)),
            Launch(kernels.swap, septa, self._common[:2]),
            Launch(kernels.odd_step, self._cells, (*self._common, *cells)),
        )

    def _kernels_of_walls(self) -> tuple[Launch, Launch]:
        """Return the kernels of the deferred wall correction and of the mass balance, without their last argument."""
        layout = self._packed.layout
        return (
            Launch(kernels.defer, len(layout.slot) - len(layout.opening_of_end), self._common),
            Launch(kernels.balance, max(1, len(layout.groups[0]) - 1), self._common[1:]),
        )

    def _kernels_of_reading(self, state: State) -> tuple[tuple[Launch, Launch], Launch]:
        """Return the kernels that write density, velocity and flow rates, and the one that writes relaxation times."""
        packed, everywhere = self._packed, (*self._common, *self._layout)
        ends = put(packed.layout.end_cell), put(packed.layout.end_cell_start), self._outflow
        screened = put(state.screen.cell.astype(np.int32)), self._times
        return (
            Launch(kernels.moments, self._cells, (*everywhere, self._density, self._velocity)),
            Launch(kernels.outflow, len(state.links.openings) * THREADS, (*everywhere, *ends)),
        ), Launch(kernels.times, len(state.screen.cell), (*everywhere, *screened))

    def advance(self, wanted: Floats, moments: Floats, first_pair: int) -> None:
        """Make one pair of time steps per row of `wanted` (see `state.OnDevice`)."""
        imposed = np.column_stack([wanted, moments])
        first, self._begun = self._begun, 0
        self.stream.synchronize()
        while first < len(imposed):
            rows = imposed[first : first + (1 if self._replay is None else PAIRS)]
            self._queue(rows, first_pair + first)
            self.stream.synchronize()
            first += len(rows)
            if self._replay is None:  # kernels are loaded now
                self._replay = self._recorded()

    def begin(self, wanted: Floats, moments: Floats, first_pair: int) -> bool:
        """Queue the first pairs of the next `advance` (see `state.OnDevice`).

        Launches one by one would keep the host from its own work, so there only a replay is queued.
        """
        if self._replay:
            rows = np.column_stack([wanted, moments])[:PAIRS]
            self._queue(rows, first_pair)
            self._begun = len(rows)
        return self._begun > 0

    def _queue(self, rows: Floats, first_pair: int) -> None:
        """Queue pairs of time steps with these boundary values."""
        self._impose(rows)
        for pairs in plan(first_pair, len(rows)):
            self._make(pairs)

    def _impose(self, rows: Floats) -> None:
        """Copy the boundary values of the next pairs of steps to the GPU; populations are at home before the first."""
        whole = np.repeat(rows[-1:], PAIRS, axis=0)
        whole[: len(rows)] = rows
        self._doubles[self._at.imposed].copy_to_device(whole.ravel())
        self._integers[: len(START)].copy_to_device(np.array(START, np.int32))

    def _recorded(self) -> dict[Pairs, Any]:
        """Return functions that replay each sequence of pairs; empty where they cannot be recorded."""
        try:
            return {pairs: recorded(partial(self._make, pairs), self.stream) for pairs in Pairs}
        except NotRecordedError as reason:
            self.stream, self._why = cuda.stream(), f", because {reason}"
            return {}

    def _make(self, pairs: Pairs) -> None:
        """Make pairs of time steps: by a replay, or by the same launches where there is none."""
        if self._replay:
            self._replay[pairs]()
        else:
            self._launch_all(self.launches(pairs))

    def launches(self, pairs: Pairs) -> Iterator[tuple[Launch, tuple[Any, ...]]]:
        """Yield the kernels of pairs of time steps in their order, with their further arguments."""
        if pairs is Pairs.ROUND:
            for one in (Pairs.CORRECTED, *(DEFER_PAIRS - 1) * (Pairs.PLAIN,)):
                yield from self.launches(one)
            return
        drive, even_step, swap, odd_step = self._steps
        last = odd_step, (int(pairs is not Pairs.PLAIN),)
        yield from ((drive, ()), (even_step, ()), (swap, ()), last, (swap, ()))
        if pairs is not Pairs.PLAIN:
            yield from self._updates_of_walls(DEFER_PART if pairs is Pairs.CORRECTED else 0.0)

    def _updates_of_walls(self, part: float) -> Iterator[tuple[Launch, tuple[Any, ...]]]:
        """Yield the kernels that bring populations home and update walls, with their under-relaxation factor.

        The factor 0 leaves the walls as they are.
        """
        for launch in self._settle:
            yield launch, (np.float32(part),)

    def _launch_all(self, launches: Iterator[tuple[Launch, tuple[Any, ...]]]) -> None:
        """Launch kernels one by one."""
        for launch, further in launches:
            launch(self.stream, *further)

    def rescale(self, state: State, stretch: float, stress: float) -> None:
        """Take links and screen of `state`, and convert populations to its time step (see `state.OnDevice`)."""
        factor, f = np.float32(stretch), self._populations
        stride, code_at = self._layout
        everywhere = f, self._integers, stride, self._cells, code_at
        of_links = f, self._integers, self._through
        Launch(kernels.sent, len(state.links.address), of_links)(self.stream)
        Launch(kernels.rescale, self._cells, everywhere)(self.stream, factor, np.float32(stress))
        Launch(kernels.resend, len(state.links.address), of_links)(self.stream, factor)
        self.stream.synchronize()
        at, openings = self._at, self._openings()
        openings[:, d3q19.OWN_DENSITIES] *= stretch**2
        for there, here in (
            (self._doubles[at.opening], openings),
            (self._singles[at.number], single_of(state)),
            (self._singles[at.entry], state.screen.entry),
            (self._shape, state.links.shape),
            (self._singles[at.correction], correction_of(state.links)),
        ):
            if here.size:
                there.copy_to_device(np.ascontiguousarray(here).reshape(there.shape))
        self._launch_all(self._updates_of_walls(1.0))

    def read(self) -> tuple[NDArray[np.float32], NDArray[np.float32], Floats]:
        """Return density deviation (n,), momentum (n, 3), and the flow rate (k,) out of every end."""
        for launch in self._read:
            launch(self.stream)
        density, velocity, outflow = self._moments.after(self.stream)
        return density, velocity, outflow

    def read_times(self) -> NDArray[np.float32]:
        """Return the relaxation times (e,) of shear-thinning blood in the cells of the screen."""
        self._read_times(self.stream)
        self.stream.synchronize()
        return np.asarray(self._times.copy_to_host())

    def fetch(self, state: State) -> None:
        """Copy the arrays that the time steps change back to `state`, and count the pairs that were begun."""
        self.stream.synchronize()
        state.steps += 2 * self._begun
        state.since_check += 2 * self._begun
        self._begun = 0
        self._populations.copy_to_host(state.populations)
        state.links.openings[:] = self._openings()
        slot = self._packed.layout.slot
        if len(slot):
            link = self._singles[self._at.link].copy_to_host().reshape(-1, 2)
            state.links.source[:] = link[slot, 1]
            state.refill.refill[:] = self._singles[self._at.refill].copy_to_host()[self._packed.refilled]

    def _openings(self) -> Floats:
        """Return `Links.openings` as they are on the GPU."""
        return np.asarray(self._doubles[self._at.opening].copy_to_host()).reshape(-1, d3q19.OPENING)


def _arrays(arguments: Sequence[Any]) -> Iterator[Any]:
    """Yield the arrays among arguments and in their tuples."""
    for argument in arguments:
        if isinstance(argument, tuple):
            yield from _arrays(argument)
        elif hasattr(argument, "copy_to_host"):
            yield argument


def seconds_of_update(place: Ints, length: Ints, stride: int, relaxation: Sequence[Any]) -> float:
    """Return the run time of an update of cells without walls, the best of several.

    Shapes: `place` (s,), `length` (s,).
    """
    time, law, limit, odd_rate = relaxation
    rows, none = np.zeros((len(length), 9), np.int32), np.zeros(0, np.int32)
    rows[:, 0] = place - (np.cumsum(length) - length)
    code = np.repeat(np.arange(len(length), dtype=np.int32), length)
    nothing = np.zeros(0, np.float32)
    one, pairs = np.zeros(1, np.int32), np.zeros((6, 0), np.int32)
    by_link = none, none, none > 0, pairs, pairs[:2], (one, none, one, none), none, none, none
    layout = Layout(code, rows, none, pairs[:4], none, *by_link, one)
    packed = Packed(layout, code, pairs, none, nothing.reshape(0, 2))
    single = np.array([time, *law, odd_rate], np.float32)
    numbers = Numbers(
        single,
        limit,
        nothing,
        np.zeros((0, d3q19.ENTRY), np.float32),
        np.zeros((5, 0), np.float32),
        np.zeros((0, d3q19.OPENING)),
        np.zeros(1, np.int32),
    )
    at = tables(packed, numbers)
    arrays = put(np.zeros(19 * stride, np.float32)), put(at.integers), put(at.singles), put(at.doubles)
    cells = stride, len(code), at.code_at
    launch = Launch(kernels.even_step, len(code), (*arrays, put(np.zeros((1, 0, 2))), *cells))
    times, stream = [], cuda.stream()
    for _ in range(UPDATES_TIMED):
        cuda.synchronize()
        began = perf_counter()
        launch(stream)
        cuda.synchronize()
        times.append(perf_counter() - began)
    return min(times)


def put(array: NDArray[Any]) -> Any:
    """Copy an array to the GPU; an empty one, which cannot be stored there, becomes a zero that is never read."""
    whole = array if array.size else np.zeros([max(n, 1) for n in array.shape], array.dtype)
    return cuda.to_device(np.ascontiguousarray(whole))
