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

from vstent.flow.lattice.gpu_tables import PAIRS, START, correction_of, joined, layout_of, rates_of, tables_of
from vstent.flow.lattice.kernels import d3q19, gpu as kernels
from vstent.flow.lattice.kernels.gpu import THREADS
from vstent.flow.lattice.levels import CARRIED_CELLS, OF_SHEAR, WIDTH, Interface, Stencil
from vstent.flow.lattice.recording import SEQUENCES, NotRecordedError, Pairs, plan, recorded
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

    def __call__(self, stream: Any, *further: Any) -> None:
        """Launch the kernel on a stream, with further arguments."""
        if self.threads:
            self.kernel[-(-self.threads // THREADS), THREADS, stream](*self.arguments, *further)


class Device:
    """The arrays of a level on the GPU and its kernels; that of the coarsest level makes the steps of all."""

    def __init__(self, state: State) -> None:
        """Copy all arrays that the time steps need to the GPU; those of finer levels are there already."""
        a, links, at = state.addressing, state.links, tables_of(state)
        cells, ends = len(a.place), int(links.start[-1])
        self._at, self._slot = at, layout_of(state).slot
        finer: Device | None = None if state.finer is None else state.finer.device
        self.stream: Any = cuda.stream() if finer is None else finer.stream
        self._populations, self._shape = put(state.populations), put(links.shape)
        self._integers, self._singles, self._doubles = put(at.integers), put(at.singles), put(at.doubles)
        blocks = len(layout_of(state).tables[kernels.BLOCKS])
        common, layout = (self._populations, self._integers, self._singles), (a.stride, at.places["code"].start)
        of_cells, of_links = (a.stride, cells, at.places["code"].start), common[:2]
        # The kernels of a pair of steps, the last without its last argument: openings, even step, septa, odd step.
        self._steps = (
            Launch(kernels.drive, blocks * THREADS, (*common, self._doubles, *layout)),
            Launch(kernels.even_step, cells, (*common, self._doubles, self._shape, *of_cells)),
            Launch(kernels.swap, a.septa.shape[1], of_links),
            Launch(kernels.odd_step, cells, (*common, *of_cells)),
        )
        # Those of the walls without their last argument: deferred correction and mass balance.
        self._settle = (
            Launch(kernels.defer, len(links.address) - ends, common),
            Launch(kernels.balance, max(1, len(state.refill.groups[0]) - 1), common[1:]),
        )
        crossing = links.path[0, len(links.address) :, :2].T
        self.grid, self.passed = (self._populations, a.stride, self._singles), put(np.zeros(crossing.shape[1]))
        self._cross = Launch(kernels.add_crossed, crossing.shape[1], (self._populations, put(crossing), self.passed))
        self._border = None
        if finer is not None and state.interface is not None:
            self._border = Border(self, finer, state.interface, crossing.shape[1])
        density, velocity = put(np.zeros(cells, np.float32)), put(np.zeros((cells, 3), np.float32))
        through_ends = put(np.zeros(ends))
        self._read = (
            Launch(kernels.moments, cells, (*common, *layout, density, velocity)),
            Launch(kernels.sent, ends, (*of_links, through_ends)),
        )
        self._moments, self._starts = ReadBack((density, velocity, through_ends)), links.start[:-1]
        screened = state.screen.cell.astype(np.int32)
        self._times = put(np.zeros(len(screened), np.float32))
        self._read_times = Launch(kernels.times, len(screened), (*common, *layout, put(screened), self._times))
        self._through = put(np.zeros(len(links.address), np.float32))
        # Those of a longer time step, of which the second and third take their factors.
        self._lengthen = (
            Launch(kernels.sent, len(links.address), (*of_links, self._through)),
            Launch(kernels.rescale, cells, (*of_links, *of_cells)),
            Launch(kernels.resend, len(links.address), (*of_links, self._through)),
        )
        self._replay: dict[tuple[Pairs, int], Any] | None = None
        self._why = ""
        self._begun = 0

    @property
    def how(self) -> str:
        """Return in words how the host launches the time steps."""
        return "as a CUDA graph" if self._replay else f"one by one{self._why}"

    @property
    def nbytes(self) -> int:
        """Return the memory of the run on the GPU, in bytes."""
        launches = *self._read, *self._lengthen, *(launch for launch, _ in self.launches(Pairs.LAST, 0))
        arrays = {id(array): array for launch in launches for array in launch.arguments if hasattr(array, "nbytes")}
        return sum(array.nbytes for array in arrays.values())

    def advance(self, wanted: Floats, moments: Floats, first_pair: int) -> None:
        """Make one pair of time steps per row of `wanted` (pairs, k) and `moments` (pairs, 3) from `stepping.imposed`.

        The number of the first pair counts from the last check.
        """
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
        """Queue the first pairs of the next `advance` without waiting for them; return whether there are any.

        Until then only `fetch` may be called, which counts them as made. Launches one by one would keep the host from
        its own work, so only a replay is queued.
        """
        if self._replay:
            rows = np.column_stack([wanted, moments])[:PAIRS]
            self._queue(rows, first_pair)
            self._begun = len(rows)
        return self._begun > 0

    def _queue(self, rows: Floats, first_pair: int) -> None:
        """Queue pairs of time steps with these boundary values; populations are at home before the first."""
        whole = np.repeat(rows[-1:], PAIRS, axis=0)
        whole[: len(rows)] = rows
        self._doubles[self._at.places[kernels.IMPOSED]].copy_to_device(whole.ravel())
        self._integers[: len(START)].copy_to_device(np.array(START, np.int32))
        for sequence in plan(first_pair, len(rows)):
            if self._replay:
                self._replay[sequence]()
            else:
                self.make(*sequence)

    def _recorded(self) -> dict[tuple[Pairs, int], Any]:
        """Return functions that replay each sequence of pairs; empty where they cannot be recorded."""
        try:
            return {sequence: recorded(partial(self.make, *sequence), self.stream) for sequence in SEQUENCES}
        except NotRecordedError as reason:
            self._why, self.stream, level = f", because {reason}", cuda.stream(), self
            while level._border is not None:
                level = level._border.finer
                level.stream = self.stream
            return {}

    def make(self, pairs: Pairs, number: int) -> None:
        """Launch the kernels of pairs of time steps one by one."""
        for launch, further in self.launches(pairs, number):
            launch(self.stream, *further)

    def launches(self, pairs: Pairs, number: int) -> Iterator[tuple[Launch, tuple[Any, ...]]]:
        """Yield the kernels of pairs of time steps on this level and finer ones in order, with their further arguments.

        `number` is that of the first pair. Where there is a finer level, populations come home for the exchange.
        """
        if pairs is Pairs.ROUND:
            for k in range(DEFER_PAIRS):
                yield from self.launches(Pairs.PLAIN, k)
            return
        drive, even_step, swap, odd_step = self._steps
        is_due = number % DEFER_PAIRS == 0
        goes_home = is_due or pairs is Pairs.LAST or self._border is not None
        yield drive, ()
        if self._border is not None:
            yield self._border.take, ()
        yield from ((even_step, ()), (self._cross, (1,)), (swap, ()))
        yield from ((odd_step, (int(goes_home),)), (self._cross, (-1,)), (swap, ()))
        if goes_home:  # 0 brings populations home and leaves the walls as they are
            part = np.float32(DEFER_PART if is_due else 0.0)
            yield from ((launch, (part,)) for launch in self._settle)
        if self._border is not None:
            for half, of_half in enumerate((Pairs.PLAIN, Pairs.LAST)):
                yield from self._border.finer.launches(of_half, WIDTH * number + half)
            yield from ((launch, ()) for launch in self._border.couple)

    def rescale(self, state: State, stretch: float, stress: float) -> None:
        """Take links and screen of `state`, and convert populations to its time step."""
        sent, rescale, resend = self._lengthen
        sent(self.stream)
        rescale(self.stream, np.float32(stretch), np.float32(stress))
        resend(self.stream, np.float32(stretch))
        self.stream.synchronize()
        places, openings = self._at.places, self._openings()
        openings[:, d3q19.OWN_DENSITIES] *= stretch**2
        for there, here in (
            (self._doubles[places["openings"]], openings),
            (self._singles[places["rates"]], rates_of(state)),
            (self._singles[places["entries"]], state.screen.entry),
            (self._shape, state.links.shape),
            (self._singles[places[kernels.CORRECTION]], correction_of(state.links)),
        ):
            if here.size:
                there.copy_to_device(np.ascontiguousarray(here).reshape(there.shape))
        for launch in self._settle:
            launch(self.stream, np.float32(1.0))

    def read(self) -> tuple[NDArray[np.float32], NDArray[np.float32], Floats]:
        """Return density deviation (n,), momentum (n, 3), and the flow rate (k,) out of every end."""
        for launch in self._read:
            launch(self.stream)
        density, velocity, through = self._moments.after(self.stream)
        return density, velocity, np.add.reduceat(through, self._starts)

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
        places = self._at.places
        link = self._singles[places[kernels.LINK]].copy_to_host().reshape(-1, 2)
        state.links.source[: len(self._slot)] = link[self._slot, 1]
        state.refill.refill[:] = self._singles[places[kernels.REFILL]].copy_to_host()[self._at.refilled]
        if self._border is not None and state.interface is not None:
            state.interface.lack[:], *state.interface.push[:] = self._border.held.copy_to_host()

    def _openings(self) -> Floats:
        """Return `Links.openings` as they are on the GPU."""
        return np.asarray(self._doubles[self._at.places["openings"]].copy_to_host()).reshape(-1, d3q19.OPENING)


class Border:
    """What a level exchanges with the next finer one."""

    def __init__(self, coarse: Device, fine: Device, between: Interface, links: int) -> None:
        """Copy the coupling to the GPU; `links` is the number of links across borders of the coarser level."""
        self.finer, (place, finer, group) = fine, between.between
        order, of_coarse, of_fine = np.argsort(group, kind="stable"), *(one.start for one in between.border)
        of_cells = np.searchsorted(group[order], np.arange(len(of_fine)))
        first = np.stack([of_fine, links - of_coarse[-1] + of_coarse, of_cells]).astype(np.int32)
        self.held, found = put(np.stack([between.lack, *between.push])), put(np.zeros((2, len(place))))
        beside = (put(array) for array in (between.beside, between.group.astype(np.int32), between.share))
        jumping = *coarse.grid[:2], *fine.grid[:2], put(place[order]), put(finer[order].T), OF_SHEAR, found
        answering = put(first), coarse.passed, fine.passed, found, self.held, CARRIED_CELLS, 1 / WIDTH**3
        self.take = Launch(kernels.take, len(between.beside), (coarse.grid[0], *beside, self.held))
        up = *fine.grid, *coarse.grid, *stencil_of(between.up, WIDTH), self.held[2]
        down = *coarse.grid, *fine.grid, *stencil_of(between.down, 1 / WIDTH), self.held[1]
        self.couple = (
            Launch(kernels.jumps, len(place), jumping),
            Launch(kernels.answer, len(between.lack) * THREADS, answering),
            Launch(kernels.carry, len(between.up.target), up),
            Launch(kernels.carry, len(between.down.target), down),
        )


def stencil_of(along: Stencil, ratio: float) -> tuple[Any, Any]:
    """Return a stencil of n cells with k entries at most on the GPU; neighbouring threads read neighbouring values.

    It is (3 + k, n) storage place, group, number of entries, and storage places of the cells read, and (5 + 2 k, n)
    limit, shares, ratio of the spacings, and weights.
    """
    count = np.diff(along.start)
    target = np.repeat(np.arange(len(count)), count)
    entry, most = np.arange(len(target)) - along.start[target], int(count.max(initial=0))
    cells, parts = np.zeros((3 + most, len(count)), np.int32), np.zeros((5 + 2 * most, len(count)), np.float32)
    cells[:3], parts[0], parts[1:4], parts[4] = (along.target, along.group, count), along.limit, along.share.T, ratio
    cells[3 + entry, target] = along.place[along.cell]
    parts[5 + 2 * entry, target], parts[6 + 2 * entry, target] = along.weight.T
    return put(cells), put(parts)


def seconds_of_update(place: Ints, length: Ints, stride: int, relaxation: Sequence[Any]) -> float:
    """Return the run time of an update of segments of cells (s,) without walls, the best of several."""
    time, law, limit, odd_rate = relaxation
    rows = np.zeros((len(length), 9), np.int32)
    rows[:, 0] = place - (np.cumsum(length) - length)
    code = np.repeat(np.arange(len(length), dtype=np.int32), length)
    integers, places = joined({"head": np.zeros(kernels.HEAD), "rows": rows, "code": code}, np.int32)
    singles, _ = joined({"rates": np.array([time, *law, odd_rate]), "limit": limit}, np.float32)
    arrays = (put(array) for array in (np.zeros(19 * stride, np.float32), integers, singles, np.zeros(1)))
    further = put(np.zeros((1, 0, 2))), stride, len(code), places["code"].start
    launch = Launch(kernels.even_step, len(code), (*arrays, *further))
    times, stream = [], cuda.stream()
    for _ in range(UPDATES_TIMED):
        cuda.synchronize()
        began = perf_counter()
        launch(stream)
        cuda.synchronize()
        times.append(perf_counter() - began)
    return min(times)


class ReadBack:
    """Copies of some arrays of a GPU, through buffers on the host that are allocated at the first use."""

    def __init__(self, arrays: tuple[Any, ...]) -> None:
        """Keep the arrays of the GPU."""
        self._arrays = arrays
        self._buffers: tuple[NDArray[Any], ...] = ()
        self._stream, self._written = cuda.stream(), cuda.event()
        self._read = [cuda.event() for _ in arrays]

    def after(self, stream: Any) -> Iterator[NDArray[Any]]:
        """Yield each array as it is after what a stream has queued; later arrays are on their way meanwhile."""
        self._buffers = self._buffers or tuple(_pinned(array) for array in self._arrays)
        self._written.record(stream)
        self._written.wait(self._stream)
        for array, buffer, read in zip(self._arrays, self._buffers, self._read, strict=True):
            array.copy_to_host(buffer, stream=self._stream)
            read.record(self._stream)
        for buffer, read in zip(self._buffers, self._read, strict=True):
            read.synchronize()
            yield buffer.copy()


def _pinned(array: Any) -> NDArray[Any]:
    """Return a buffer on the host for an array of the GPU; ordinary memory where the system pins no more."""
    try:
        return np.asarray(cuda.pinned_array(array.shape, array.dtype))
    except Exception:  # noqa: BLE001 drivers and packages each have their own exception classes
        return np.zeros(array.shape, array.dtype)


def put(array: NDArray[Any]) -> Any:
    """Copy an array to the GPU; an empty one, which cannot be stored there, becomes a zero that is never read."""
    whole = array if array.size else np.zeros([max(n, 1) for n in array.shape], array.dtype)
    return cuda.to_device(np.ascontiguousarray(whole))
