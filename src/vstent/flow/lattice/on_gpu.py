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

from vstent.flow.lattice.kernels import d3q19
from vstent.flow.lattice.kernels import gpu as kernels
from vstent.flow.lattice.kernels.gpu import THREADS
from vstent.flow.lattice.packing import Packed, pack
from vstent.flow.lattice.recording import NotRecordedError, Pairs, plan, recorded
from vstent.flow.lattice.scales import ODD_RATE
from vstent.flow.lattice.state import DEFER_PAIRS, DEFER_PART, State
from vstent.kernels.arrays import Floats, Ints

# Each opening is few blocks, so that numba's warning about low occupancy does not apply.
numba.config.CUDA_LOW_OCCUPANCY_WARNINGS = 0

PAIRS: Final = 1024
"""Number of pairs of time steps whose boundary values are copied to the GPU at once."""
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
        self._packed, self._cells, self.stream = packed, len(packed.code), cuda.stream()
        self._populations, self._clock = put(state.populations), put(np.array([0, 1], np.int32))
        self._link, self._refill = put(packed.link), put(_refill(state, packed))
        self._of_cells = put(packed.code), put(packed.rows), put(state.limit), a.stride
        self._walls = put(packed.special), self._link, self._refill
        self._screen, self._number = put(state.screen.entry), put(_numbers(state))
        self._openings, self._shape = put(links.openings), put(links.shape)
        self._imposed = put(np.zeros((PAIRS, len(links.openings) + 3)))
        of_ends = put(packed.end_of_link), put(packed.opening_of_end)
        answer = put(np.zeros(len(links.openings)))
        self._opening = *of_ends, self._shape, self._openings, answer, self._imposed, self._clock
        self._address, self._correction = put(links.address), put(links.correction[links.start[-1] :])
        self._through = put(np.zeros(len(links.address), np.float32))
        self._density, self._velocity = (put(np.zeros((self._cells, *n), np.float32)) for n in ((), (3,)))
        self._outflow, self._times = (
            put(np.zeros(len(links.openings))),
            put(np.zeros(len(state.screen.cell), np.float32)),
        )
        self._steps = self._kernels_of_pair(state)
        self._settle = self._kernels_of_walls(state)
        self._read, self._read_times = self._kernels_of_reading(state)
        self._replay: dict[Pairs, Any] | None = None

    @property
    def how(self) -> str:
        """Return in words how the host launches the time steps."""
        return "as a CUDA graph" if self._replay else "one by one"

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
        packed, start, blocks = self._packed, state.links.start, self._packed.blocks(THREADS)
        f, of_cells, walls, numbers = self._populations, self._of_cells, self._walls, (self._screen, self._number)
        first_block = np.searchsorted(blocks[:, 0], np.arange(len(start))).astype(np.int32)
        done, count = np.zeros(len(start) - 1, np.int32), np.diff(start).astype(np.int32)
        sums = put(np.zeros(len(blocks))), put(done), put(first_block), put(count)
        of_blocks = put(blocks), put(packed.end_cell), sums
        septa = state.addressing.septa
        return (
            Launch(kernels.drive, len(blocks) * THREADS, (f, of_cells, walls, self._opening, *of_blocks)),
            Launch(kernels.even_step, self._cells, (f, of_cells, walls, *numbers, self._opening)),
            Launch(kernels.swap, septa.shape[1], (f, put(septa))),
            Launch(kernels.odd_step, self._cells, (f, of_cells, walls, *numbers, self._clock)),
        )

    def _kernels_of_walls(self, state: State) -> tuple[Launch, Launch]:
        """Return the kernels of the deferred wall correction and of the mass balance, without their last argument."""
        walls, packed, ends = state.refill, self._packed, int(state.links.start[-1])
        slot = np.where(packed.is_near, -1 - packed.slot, packed.slot)[ends:]
        of_wall = self._address[ends:] if len(slot) else self._address
        lost, groups = put(walls.lost), tuple(map(put, (*walls.groups[:3], packed.refilled[walls.groups[3]])))
        slots = put(slot.astype(np.int32)), self._link
        of_links = of_wall, self._correction, slots, lost, self._clock
        of_groups = lost, groups, self._refill, self._clock
        return (
            Launch(kernels.defer, len(slot), (self._populations, *of_links)),
            Launch(kernels.balance, max(1, len(walls.groups[0]) - 1), of_groups),
        )

    def _kernels_of_reading(self, state: State) -> tuple[tuple[Launch, Launch], Launch]:
        """Return the kernels that write density, velocity and flow rates, and the one that writes relaxation times."""
        packed, everywhere = self._packed, (self._populations, self._of_cells, self._walls, self._clock)
        ends = self._opening[:2], put(packed.end_cell), put(packed.end_cell_start), self._outflow
        screened = put(state.screen.cell.astype(np.int32)), self._number, self._times
        return (
            Launch(kernels.moments, self._cells, (*everywhere, self._density, self._velocity)),
            Launch(kernels.outflow, len(state.links.openings) * THREADS, (*everywhere, *ends)),
        ), Launch(kernels.times, len(state.screen.cell), (*everywhere, *screened))

    def advance(self, wanted: Floats, moments: Floats, first_pair: int) -> None:
        """Make one pair of time steps per row of `wanted` (see `state.OnDevice`)."""
        imposed, first = np.column_stack([wanted, moments]), 0
        while first < len(imposed):
            rows = imposed[first : first + (1 if self._replay is None else PAIRS)]
            self._impose(rows)
            for pairs in plan(first_pair + first, len(rows)):
                self._make(pairs)
            self.stream.synchronize()
            first += len(rows)
            if self._replay is None:  # kernels are loaded now
                self._replay = self._recorded()

    def _impose(self, rows: Floats) -> None:
        """Copy the boundary values of the next pairs of steps to the GPU; populations are at home before the first."""
        whole = np.repeat(rows[-1:], PAIRS, axis=0)
        whole[: len(rows)] = rows
        self._imposed.copy_to_device(whole)
        self._clock.copy_to_device(np.array([0, 1], np.int32))

    def _recorded(self) -> dict[Pairs, Any]:
        """Return functions that replay each sequence of pairs; empty where they cannot be recorded."""
        try:
            return {pairs: recorded(partial(self._make, pairs), self.stream) for pairs in Pairs}
        except NotRecordedError:
            self.stream = cuda.stream()
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
        everywhere = f, self._of_cells, self._walls
        of_links = f, self._address, self._through
        Launch(kernels.sent, len(state.links.address), of_links)(self.stream)
        Launch(kernels.rescale, self._cells, everywhere)(self.stream, factor, np.float32(stress))
        Launch(kernels.resend, len(state.links.address), of_links)(self.stream, factor)
        self.stream.synchronize()
        openings = self._openings.copy_to_host()
        openings[:, d3q19.OWN_DENSITIES] *= stretch**2
        for there, here in (
            (self._openings, openings),
            (self._number, _numbers(state)),
            (self._screen, state.screen.entry),
            (self._shape, state.links.shape),
            (self._correction, state.links.correction[state.links.start[-1] :]),
        ):
            if here.size:
                there.copy_to_device(np.ascontiguousarray(here))
        self._launch_all(self._updates_of_walls(1.0))

    def read(self) -> tuple[NDArray[np.float32], NDArray[np.float32], Floats]:
        """Return density deviation (n,), momentum (n, 3), and the flow rate (k,) out of every end."""
        for launch in self._read:
            launch(self.stream)
        self.stream.synchronize()
        return self._density.copy_to_host(), self._velocity.copy_to_host(), self._outflow.copy_to_host()

    def read_times(self) -> NDArray[np.float32]:
        """Return the relaxation times (e,) of shear-thinning blood in the cells of the screen."""
        self._read_times(self.stream)
        self.stream.synchronize()
        return np.asarray(self._times.copy_to_host())

    def fetch(self, state: State) -> None:
        """Copy the arrays that the time steps change back to `state`."""
        self.stream.synchronize()
        state.populations[:] = self._populations.copy_to_host()
        state.links.openings[:] = self._openings.copy_to_host()
        state.links.source[:] = self._link.copy_to_host()[self._packed.slot, 1]
        state.refill.refill[:] = self._refill.copy_to_host()[self._packed.refilled]


def _arrays(arguments: Sequence[Any]) -> Iterator[Any]:
    """Yield the arrays among arguments and in their tuples."""
    for argument in arguments:
        if isinstance(argument, tuple):
            yield from _arrays(argument)
        elif hasattr(argument, "copy_to_host"):
            yield argument


def _refill(state: State, packed: Packed) -> NDArray[np.float32]:
    """Return what is added to the rest population of every special cell (m,)."""
    refill = np.zeros(packed.special.shape[1], np.float32)
    refill[packed.refilled] = state.refill.refill
    return refill


def _numbers(state: State) -> NDArray[np.float32]:
    """Return the argument `number` of `kernels.even_step`."""
    return np.array([state.scales.relaxation_steps, *state.scales.thinning, ODD_RATE], np.float32)


def seconds_of_update(place: Ints, length: Ints, stride: int, relaxation: Sequence[Any]) -> float:
    """Return the run time of an update of cells without walls, the best of several.

    Parameters
    ----------
    place : (s,) int
        Storage place of the first cell of every segment.
    length : (s,) int
        Number of cells of every segment.
    stride : int
        Distance between two populations of a cell.
    relaxation
        As in `d3q19.update`.
    """
    time, law, limit, odd_rate = relaxation
    rows = np.zeros((len(length), 9), np.int32)
    rows[:, 0] = place - (np.cumsum(length) - length)
    code = np.repeat(np.arange(len(length), dtype=np.int32), length)
    of_cells = put(code), put(rows), put(limit), stride
    no_links = put(np.zeros((6, 0), np.int32)), put(np.zeros((0, 2), np.float32)), put(np.zeros(0, np.float32))
    none, no_course = put(np.zeros(0, np.int32)), put(np.zeros((1, 0, 2)))
    no_opening = none, none, no_course, put(np.zeros((0, 9))), put(np.zeros(0)), put(np.zeros((1, 3)))
    numbers = put(np.zeros((0, d3q19.ENTRY), np.float32)), put(np.array([time, *law, odd_rate], np.float32))
    clock = put(np.array([0, 1], np.int32))
    arguments = put(np.zeros(19 * stride, np.float32)), of_cells, no_links, *numbers, (*no_opening, clock)
    launch = Launch(kernels.even_step, len(code), arguments)
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
