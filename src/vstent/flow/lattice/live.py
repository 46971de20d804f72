"""Live flow: two lattices that never stop, one without a device and one whose screen is exchanged while blood flows.

The sac and a piece of the artery are computed on a fine grid, inside a coarse grid of the whole vessel (`levels`). Both
start from the flow on the coarse grid alone, without a device, once the blood of the vessel has been exchanged. Both
lattices then step in turn. With resistances at the outlets, the flow out follows the pressure there. Every value is
known at any time with an uncertainty, which falls while the flow develops and its averages grow longer.

The flow without a device can be computed in advance (`LiveFlow.prepare`) and stored (`LiveFlow.stored`). Only the
flow with the device is then left to compute.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Final

import numpy as np

from vstent.flow.case import FlowCase, FlowField, Level, Sheet, Target
from vstent.flow.domain import default_cell_size_mm, extended_volume_mm3
from vstent.flow.ends import Resistance, outflows
from vstent.flow.engines import DivergenceError, Outcome, Saved, stepped
from vstent.flow.indices import neck_diameter_mm, parent_diameter_mm
from vstent.flow.lattice.checkpoint import pack
from vstent.flow.lattice.engine import LatticeBoltzmann, trouble
from vstent.flow.lattice.kernels import d3q19
from vstent.flow.lattice.levels import WIDTH, require_sac
from vstent.flow.lattice.state import NECK_INFLOW, Snapshot, State
from vstent.flow.lattice.stepping import FOLLOWED, advance, monitored, place_screen, snapshot, snapshots, twin
from vstent.flow.stopping import SURE, fraction_left, standard_error
from vstent.kernels.arrays import Floats
from vstent.units import M3_PER_ML, M_PER_MM

CELLS_ACROSS_NECK: Final = 28.0
"""Number of cells across the neck: with 20 the reductions of the demo are 12 points too small, with 28 within 2."""
CELLS_ACROSS_PARENT: Final = 18.0
"""Number of cells across the parent artery."""
TOLERANCE: Final = 0.02
"""Residual below which the coarse flow counts as converged, and uncertainty below which a value counts as steady."""
KNOWN: Final = 0.01
"""Uncertainty of the flow without a device below which only the flow with the device is continued."""
LATEST: Final = 8
"""Number of readings that are averaged in a flow that converges."""
CAUTION: Final = 3.5
"""Factor on the estimated remaining change: slow modes of sac and artery make it up to three times too small."""
WINDOWS: Final = 4
"""Number of averaging windows that are compared, each half as long as the one before."""
LEAST_IN_THIRD: Final = 3
"""Least number of readings in a third of the course, from which its range is used."""
DRIFT: Final = 0.4
"""Largest shift between the means of the last two thirds, over their range, of a flow that does not drift."""
RANGES: Final = 4.5
"""Uncertainty of the mean of a few readings, in ranges."""
RECENT: Final = 4
"""Number of last readings of which the surest counts (see `known`). Without it 7 % of the readings after the first with
a band had none (twelve flows; of two in turn, often one)."""
KEPT: Final = 4096
"""Number of readings that are kept."""
READINGS_PER_CHECK: Final = 4
"""Number of readings between two checks of the lattice: blood moves an eighth of an inlet diameter between readings."""


@dataclass(frozen=True)
class Reading:
    """What is known of a flow: averages, and how far they may be from those of an unlimited run on the same grid."""

    neck_inflow_mL_s: float
    """Neck inflow."""
    sac_velocity_m_s: float
    """Mean speed in the sac."""
    error: dict[str, float]
    """Uncertainty of both values by their names, as a fraction; inf with too few readings."""

    @property
    def is_settled(self) -> bool:
        """Whether both values are known to within the tolerance of a preview."""
        return max(self.error.values()) < TOLERANCE


@dataclass(frozen=True, eq=False)
class BareFlow:
    """A flow without a device that was computed before; a live flow continues from it."""

    outer: FlowField
    """Flow of the whole vessel on the coarse grid, from which it began."""
    saved: Saved
    """State of the lattice (see `checkpoint.pack`)."""
    readings: Floats
    """(n, 2 + 2 k) values read at equal intervals of time (see `Stepping.readings`)."""


class Stepping:
    """A lattice and the values read from it since its device was placed.

    Readings are `reading_steps` time steps apart, an even number: neck inflow in mL/s, sac velocity in m/s, and for
    each of k ends of the grid the pressure in Pa and then the flow rate out in mL/s.
    """

    def __init__(self, state: State, reading_steps: int) -> None:
        self.state, self.reading_steps = state, reading_steps
        self.readings: deque[Floats] = deque(maxlen=KEPT)
        self._read: Reading | None = None

    def advance(self) -> None:
        """Make the time steps up to the next reading; raise a `DivergenceError` if the flow diverges."""
        advance(self.state, self.reading_steps)
        self.state.since_check = 0
        now = snapshots(self.state)
        if any(one.is_lost for one in now):
            raise DivergenceError(trouble(self.state))
        self.readings.append(self._values(now))
        self._read = None

    def _values(self, now: Sequence[Snapshot]) -> Floats:
        """Return the values of a reading."""
        domain, pressure_Pa = self.state.domain, now[0].pressure_Pa
        at_ends_Pa = [pressure_Pa[domain.link_cell[domain.link_patch == k]].mean() for k in self.state.links.patch]
        return np.concatenate([monitored(self.state, now)[[NECK_INFLOW, 0]], at_ends_Pa, now[0].outflow_mL_s])

    def answer(self, bare: Floats, common_Pa: float) -> None:
        """Let the flow out through every end follow its pressure, with the resistance of a flow without a device.

        `bare` is a reading of that, and `common_Pa` the pressure common to its outlets. The widest takes the rest.
        """
        links, scales = self.state.links, self.state.scales
        leaves = np.flatnonzero(~links.is_inflow)
        before_Pa, before_mL_s = bare[2:].reshape(2, -1)[:, leaves]
        ends = [
            Resistance(flow_mL_s, common_Pa, resistance_Pa_s_mL=(common_Pa + pressure_Pa) / flow_mL_s)
            for pressure_Pa, flow_mL_s in zip(before_Pa.tolist(), before_mL_s.tolist(), strict=True)
        ]
        now_Pa = self.readings[-1][2:].reshape(2, -1)[0, leaves]
        flow_mL_s = outflows(ends, before_mL_s.sum(keepdims=True), now_Pa[None])[0][0]
        wanted = flow_mL_s / scales.flow_mL_s / links.openings[leaves, d3q19.AREA]
        is_set = links.openings[leaves, d3q19.KIND] == d3q19.OUTFLOW
        leaves, wanted = leaves[is_set], wanted[is_set]
        links.course[0, leaves] += FOLLOWED * (wanted - links.wanted[leaves] - links.course[0, leaves])

    def forget(self) -> None:
        """Forget all readings."""
        self.readings.clear()
        self._read = None

    def read(self) -> Reading:
        """Return the averages of neck inflow and sac velocity."""
        if self._read is None:
            values = np.array(self.readings or [self._values(snapshots(self.state))])
            (inflow, inflow_error), (velocity, velocity_error) = map(known, values.T[:2])
            errors = {"neck_inflow_mL_s": inflow_error, "sac_velocity_m_s": velocity_error}
            self._read = Reading(inflow, velocity, errors)
        return self._read


def known(values: Floats) -> tuple[float, float]:
    """Return the average of values (n,) and its uncertainty as a fraction, the surest of the last few readings.

    What one of the `RECENT` last readings said of the limit holds still: its uncertainty plus the distance from it.
    """
    recent = [average(values[:n]) for n in range(len(values), max(len(values) - RECENT, 0), -1)]
    mean = recent[0][0]
    reach = min(error * max(abs(one), 1e-300) + abs(one - mean) for one, error in recent)
    return mean, reach / max(abs(mean), 1e-300)


def average(values: Floats) -> tuple[float, float]:
    """Return the average of the last values (n,) that is known best, and its uncertainty as a fraction.

    Of a flow that converges the last `LATEST` values count, and `CAUTION` times the change that is still expected. Of
    one that oscillates the window counts whose standard error, times `SURE`, is smallest, or before that the last two
    thirds and `RANGES` times their range; neither of a flow that drifts. The smallest of these uncertainties is
    returned; inf with too few values.
    """
    late = float(values[-LATEST:].mean())
    # A change passes through zero where a value turns: the worst estimate of the last third counts.
    agreeing = {round(len(values) * part) for part in (0.7, 0.8, 0.9, 1.0)}
    left = CAUTION * max(fraction_left(values[:n, None]) for n in agreeing)
    lengths = {max(1, len(values) >> halvings) for halvings in range(WINDOWS)}
    ends = [values[-n:] for n in lengths]
    errors = [float("inf") if _drifts(end) else SURE * standard_error(end[:, None]) for end in ends]
    means = [(float(end.mean()), error) for end, error in zip(ends, errors, strict=True)]
    return min([(late, left), *means, _by_range(values)], key=lambda one: one[1])


def _drifts(values: Floats) -> bool:
    """Return whether the means of both halves of values (n,) differ by more than `DRIFT` times their range."""
    before, last = np.array_split(values, 2)
    return bool(abs(last.mean() - before.mean()) > DRIFT * np.ptp(values)) if len(before) and len(last) else True


def _by_range(values: Floats) -> tuple[float, float]:
    """Return the mean of the last two thirds and `RANGES` times their range, as a fraction; inf where they drift."""
    both = values[len(values) // 3 :]
    mean = float(both.mean())
    if len(both) // 2 < LEAST_IN_THIRD or _drifts(both):
        return mean, float("inf")
    return mean, RANGES * float(np.ptp(both)) / max(abs(mean), 1e-12)


class LiveFlow:
    """The flow in one vessel, without a device until `place` is called.

    The case without a device must have a sac and an ostium. `told` is called with the fraction that is done while the
    flow of the artery is computed, unless it was `stored` before.
    """

    def __init__(
        self, case: FlowCase, told: Callable[[float], None] | None = None, stored: BareFlow | None = None
    ) -> None:
        numerics = replace(case.numerics, refine=("sac",), wires="screen", device_gpu=False, tolerance=TOLERANCE)
        self.case = replace(case, waveform=None, numerics=replace(numerics, cells_across_neck=0.0))
        self.cell_size_mm = preview_spacing_mm(self.case)
        self.outer = self._around(told) if stored is None else stored.outer
        engine = LatticeBoltzmann(self.cell_size_mm)
        state = engine.init(self.case, self.outer) if stored is None else engine.resume(self.case, stored.saved)
        self._bare = Stepping(state, 2 * max(1, round(0.5 * state.steps_per_check / READINGS_PER_CHECK)))
        self._bare.readings.extend([] if stored is None else stored.readings)
        self._shown = self._bare

    def _around(self, told: Callable[[float], None] | None) -> FlowField:
        """Return the flow of the whole vessel on the coarse grid once its blood has been exchanged."""
        # Oscillations at the neck would need most of the steps, and the fine grid computes the neck.
        numerics = replace(self.case.numerics, refine=())
        case = replace(self.case, target=Target(require_sac(self.case), None), numerics=numerics)
        engine = LatticeBoltzmann(WIDTH * self.cell_size_mm)
        state, left = engine.init(case, None), None
        exchange_s = extended_volume_mm3(case.vessel) * M_PER_MM**3 / (case.inflow_mL_s * M3_PER_ML)
        while left is None or (state.time_s < exchange_s and not left < TOLERANCE):
            state, left = stepped(engine, state)
            if told is not None:
                told(min(state.time_s / exchange_s, 1.0))
        return engine.result(state, Outcome(left < TOLERANCE, (left,), 0.0, 0.0))

    def place(self, media: tuple[Sheet, ...]) -> None:
        """Exchange the device for other media; without media it is removed.

        The flow with a device continues from its present state; the first one continues from the flow without a device.
        """
        if not media:
            self._shown = self._bare
            return
        if self._shown is self._bare:
            self._shown = Stepping(twin(self._bare.state), self._bare.reading_steps)
        place_screen(self._shown.state, replace(self.case, media=media))
        self._shown.forget()

    def advance(self, seconds: float) -> int:
        """Make time steps for about a wall-clock time, take one reading at least, and return the number of steps."""
        began, done = perf_counter(), 0
        while not done or perf_counter() - began < seconds:
            for one in self._unknown:
                one.advance()
                done += one.reading_steps
                if self.case.resistances and one is not self._bare and self._bare.readings:
                    bare = np.mean(list(self._bare.readings)[-LATEST:], axis=0)
                    one.answer(bare, self.outer.common_pressure_Pa)
        return done

    def prepare(self, seconds: float) -> None:
        """Make time steps of the flow without a device for about a wall-clock time, or until it is known well."""
        began = perf_counter()
        while not self.is_prepared and perf_counter() - began < seconds:
            self._bare.advance()

    @property
    def is_prepared(self) -> bool:
        """Whether the flow without a device is known well, so that only the one with the device is continued."""
        return bool(self._bare.readings) and max(self._bare.read().error.values()) < KNOWN

    def stored(self) -> BareFlow:
        """Return the flow without a device, from which another live flow can continue; its arrays change with it."""
        return BareFlow(self.outer, pack(self._bare.state), np.array(self._bare.readings))

    @property
    def _unknown(self) -> tuple[Stepping, ...]:
        """The flow that is shown, and the one without a device while it is not known well and no better than it."""
        if self._shown is self._bare or self.is_prepared:
            return (self._shown,)
        is_better = max(self.bare.error.values()) < max(self.read().error.values())
        return (self._shown,) if is_better else (self._bare, self._shown)

    @property
    def state(self) -> State:
        """The lattice of the flow that is shown."""
        return self._shown.state

    @property
    def bare(self) -> Reading:
        """What is known of the flow without a device."""
        return self._bare.read()

    def read(self) -> Reading:
        """Return what is known of the flow that is shown."""
        return self._shown.read()

    def change(self, name: str) -> tuple[float, float]:
        """Return the change of a value against the flow without a device, in percent, and its uncertainty in points."""
        if self._shown is self._bare:
            return 0.0, 0.0
        now, bare = self.read(), self.bare
        ratio = getattr(now, name) / max(getattr(bare, name), 1e-12)
        return 100 * (ratio - 1), 100 * ratio * (now.error[name] + bare.error[name])

    def field(self) -> FlowField:
        """Return the present flow in the refined region, for streamlines: only its velocity is meaningful."""
        main, wall = self.state.main, self.case.vessel.lumen
        now, domain = snapshot(main), main.domain
        n, outer = len(wall.vertices_mm), self.outer
        return replace(
            outer,
            levels=(Level.of(domain, now.velocity_m_s.astype(np.float64), now.pressure_Pa.astype(np.float64)),),
            wall_shear_stress_Pa=np.zeros((n, 3)),
            mean_shear_Pa=None,
        )


def preview_spacing_mm(case: FlowCase) -> float:
    """Return the grid spacing of a preview: as coarse as neck and artery allow, not finer than by default."""
    assert case.ostium is not None
    coarsest_mm = min(neck_diameter_mm(case.ostium) / CELLS_ACROSS_NECK, parent_diameter_mm(case) / CELLS_ACROSS_PARENT)
    return max(coarsest_mm, default_cell_size_mm(replace(case, numerics=replace(case.numerics, cell_size_mm=None))))
