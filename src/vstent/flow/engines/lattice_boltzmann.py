"""The embedded engine for steady flow: sparse lattice-Boltzmann, D3Q19, single precision, interpolated walls."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from vstent.flow import close_up as close_ups
from vstent.flow.close_up import CloseUp
from vstent.flow.cost import estimate, refuse_too_large
from vstent.flow.engines import AbstractEngine, Outcome, Saved
from vstent.flow.engines.lattice_checkpoint import pack, unpack
from vstent.flow.engines.lattice_pace import longest_step_s, peak_speed_m_s
from vstent.flow.engines.lattice_state import State, build, field_of, is_at_check, read, step
from vstent.flow.engines.lattice_trouble import trouble
from vstent.flow.gpu import require_gpu
from vstent.flow.types import FlowCase, FlowField
from vstent.kernels.arrays import Floats
from vstent.units import M_PER_MM

CHECK_DIAMETERS = 0.5
"""Flow time between checks, in inlet diameters over mean inlet speed."""
LEAST_CHECKS = 24
"""The limit of time steps leaves room for at least this many checks: fewer cannot tell whether the flow has settled."""
CHECKS_AGREEING = 3
"""Checks that must agree: a quantity that swings passes its end by chance."""
CHECKS_AVERAGED = 8
"""Checks whose mean is the result where the flow does not settle."""
SHARE_AFTER_SWINGING = 2 / 3
"""Part of the time steps that a close-up makes at most where what surrounds it swings to its end: it begins from the
mean of that, and will not settle either."""
CHECKS_APART = 3
"""Checks between the fields whose difference tells what the velocity has left to go."""
SHARE_OF_FIELD = 0.5
"""What means have left to go, at most, over what the field has (behind Silk and Enterprise: 0.1 to 0.5)."""

SLOWER: Final = 0.5
"""A run that diverged is tried once more with a time step so much shorter."""


class AbstractLattice(AbstractEngine[State]):
    """Sparse D3Q19 in single precision with shifted populations, two relaxation times and interpolated walls.

    It writes no file. A coarse run costs a sixteenth per second of flow, and so sound and vortices are led out cheaply.
    """

    coarsening: ClassVar[float | None] = 2.0
    refined_by: ClassVar[tuple[str, ...]] = ("cell_size_mm", "lattice_speed")
    closes_up: ClassVar[bool] = True
    runs_on_gpu: ClassVar[bool] = True

    def cost(self, case: FlowCase) -> str:
        """Say how many cells and steps, how much memory and time."""
        if case.settings.device_gpu:
            require_gpu()
        refuse_too_large(case)
        return str(estimate(case))

    def calmer(self, case: FlowCase) -> FlowCase:
        """Return the case with a shorter time step: a narrow place inside may hold faster blood than the openings."""
        return replace(case, settings=replace(case.settings, lattice_speed=SLOWER * case.settings.lattice_speed))

    def close_up(self, case: FlowCase) -> CloseUp | None:
        """Return what of the vessel is computed; None: all of it."""
        return None if self.outer is None else close_ups.close_up(case, self.outer)

    def save(self, state: State) -> Saved:
        """Return the run as arrays."""
        return pack(state)

    def resume(self, case: FlowCase, saved: Saved) -> State:
        """Build the run anew and put it where it was."""
        return unpack(case, self.cell_size_mm, saved, self.close_up(case))

    def step(self, state: State) -> State:
        """Advance towards the next check."""
        step(state)
        return state

    def trouble(self, state: State) -> str:
        """Say why the run diverged."""
        return trouble(state)


@dataclass(frozen=True)
class LatticeBoltzmann(AbstractLattice):
    """The sparse D3Q19 engine at constant inflow."""

    def init(self, case: FlowCase, start: FlowField | None) -> State:
        """Choose the time step so that the fastest blood moves `lattice_speed` cells a step."""
        close_up, kept = self.close_up(case), CHECKS_AVERAGED
        step_s = longest_step_s(case, self.cell_size_mm, peak_speed_m_s(case, start, close_up))
        steps = _steps_per_check(case, step_s)
        pace = np.array([steps])
        return build(case, self.cell_size_mm, steps * step_s, pace, close_up=close_up, start=start, kept=kept)

    def terminate(self, state: State) -> float | None:
        """Fraction that the monitored quantities have left to go, the worst of the last checks."""
        if not is_at_check(state):
            return None
        if state.snapshots[-1].is_lost:
            return float("nan")
        history = np.array(state.history)
        agreeing = range(min(CHECKS_AGREEING, len(history)))
        velocity = [one.velocity[state.probe.cells] for one in state.snapshots]
        return max(
            *(fraction_left(history[: len(history) - k]) for k in agreeing), SHARE_OF_FIELD * field_left(velocity)
        )

    def max_checks(self, state: State) -> int:
        """Checks within the limit of time steps."""
        is_in_swing = self.outer is not None and not self.outer.is_converged
        steps = state.case.settings.max_steps * (SHARE_AFTER_SWINGING if is_in_swing else 1)
        return max(4, int(steps // state.steps_per_check))

    def result(self, state: State, outcome: Outcome) -> FlowField:
        """Return the last check, or the mean of the last ones where the flow has not settled."""
        kept = [state.snapshots[-1]] if outcome.is_converged else list(state.snapshots)
        range_and_drift = swings(np.array(state.history))
        left = outcome.residual[-1] if outcome.is_converged else float(np.nanmax(range_and_drift))
        return field_of(state, read(state, kept), outcome, left, _advice(state, outcome))


def _steps_per_check(case: FlowCase, step_s: float) -> int:
    inlet = case.vessel.inlet
    speed_m_s = case.inflow_mL_s / inlet.area_mm2
    steps = CHECK_DIAMETERS * inlet.diameter_mm * M_PER_MM / speed_m_s / step_s
    return 2 * max(1, round(0.5 * min(steps, case.settings.max_steps / LEAST_CHECKS)))


def fraction_left(history: Floats) -> float:
    """Largest fraction that any column of a history (checks, quantities) has left to go; nan when one is not finite.

    What a quantity ranged over in the last third of the checks is compared with the third before: if it goes on
    shrinking so from each third to the next, a geometric series is left. Of a quantity that swings as it settles, the
    range tells how much; the change of its mean would pass through zero and tell nothing.
    """
    if not np.isfinite(history[-1]).all():
        return float("nan")
    window = (len(history) - 1) // 3
    if window < 3:
        return float("inf")
    last, before = (
        np.ptp(history[len(history) - 1 - (k + 1) * window : len(history) - k * window], axis=0) for k in range(2)
    )
    scale = np.maximum(np.abs(history[-1]), 1e-12)
    return float((_series(last, before) / scale).max())


def field_left(velocity: Sequence[NDArray[np.float32]]) -> float:
    """Fraction that a field has left to go, root mean square; `velocity` (n, 3) at every one of the last checks.

    The mean speed behind a braid falls at once and then rises for half a second as the vortex finds its place: at the
    turn nothing of the mean seems to be left, but 5 % is. A field's change does not pass through zero.
    """
    if len(velocity) < 2 * CHECKS_APART + 1:
        return float("inf")
    now, then, before = (velocity[-1 - k * CHECKS_APART] for k in range(3))
    last, earlier = np.linalg.norm(now - then), np.linalg.norm(then - before)
    return float(_series(last, earlier) / max(float(np.linalg.norm(now)), 1e-30))


def _series(last: Any, before: Any) -> Any:
    """What is left of changes that go on shrinking as from the one before to the last: a geometric series."""
    shrinking = np.clip(last / np.maximum(before, 1e-30), 0.3, 0.9)
    return last * shrinking / (1 - shrinking)


def _advice(state: State, outcome: Outcome) -> str:
    if outcome.is_converged:
        return "The flow has settled."
    swing, moved = swings(np.array(state.history))
    drift = "" if np.isnan(moved) else f"; from the means of as long before, they differ by up to {100 * moved:.1f} %"
    span_ms = 1e3 * min(len(state.history), CHECKS_AVERAGED) * state.check_s
    return (
        f"The flow has not settled in {state.steps} time steps and may be unsteady by nature: these are means over its "
        f"last {span_ms:.0f} ms, in which what is monitored ranged over up to {100 * swing:.1f} % of its mean"
        f"{drift}."
    )


def swings(history: Floats) -> tuple[float, float]:
    """What any column of a history (checks, quantities) ranged over at most in the checks that a mean is taken of.

    And how far that mean is from the one of as many checks before, nan where there are none: fractions of the mean.
    """
    last, before = history[-CHECKS_AVERAGED:], history[-2 * CHECKS_AVERAGED : -CHECKS_AVERAGED]
    mean = last.mean(axis=0)
    scale = np.maximum(np.abs(mean), 1e-12)
    moved = np.abs(mean - before.mean(axis=0)) / scale if len(before) == len(last) else np.full(len(mean), np.nan)
    return float((np.ptp(last, axis=0) / scale).max()), float(moved.max())
