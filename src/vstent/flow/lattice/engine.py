"""The embedded engine: sparse D3Q19 lattice-Boltzmann, single precision, interpolated walls; steady or pulsatile."""

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar, Final

import numpy as np

from vstent.flow.case import PHASES, FlowCase, FlowField, Phase
from vstent.flow.engines import AbstractEngine, Outcome, Saved
from vstent.flow.lattice import stepping
from vstent.flow.lattice.checkpoint import pack, unpack
from vstent.flow.lattice.cost import estimate, memory_bytes, part_of_steps, refuse_too_large
from vstent.flow.lattice.gpu import require_gpu
from vstent.flow.lattice.kernels import d3q19
from vstent.flow.lattice.levels import WIDTH, sizes_mm
from vstent.flow.lattice.pace import longest_step_s, pace, peak_speed_m_s
from vstent.flow.lattice.reading import field_of, joined, neck_mL_s, read, read_moving
from vstent.flow.lattice.settling import CHECKS_APART, SHARE_OF_FIELD, Mean, field_left, mean_of, with_check
from vstent.flow.lattice.setup import CELL_REYNOLDS, CELL_REYNOLDS_AT_END
from vstent.flow.lattice.state import Snapshot, State
from vstent.flow.stopping import SURE, cycle_change, cycles_advice, quantities_left, swings
from vstent.kernels.arrays import Floats
from vstent.units import M_PER_MM, place

CHECK_DIAMETERS = 0.5
"""Flow time between checks, in units of inlet diameter divided by mean inlet speed."""
LEAST_CHECKS = 24
"""Minimum number of checks within the limit of time steps; convergence cannot be judged with fewer."""
INFLOW_WEIGHT: Final = 3
"""Weight of the relative error of the inflow among the convergence criteria. It is larger than 1 because this error is
measured, whereas the others are estimated."""
SLOWER: Final = 0.5
"""Ratio by which the time step is reduced after a run has diverged."""
FAST: Final = 0.4
"""Speed in cells per time step above which the time step is reported as too long: it is close to the speed of sound."""


class AbstractLattice(AbstractEngine[State]):
    """Common part of the lattice engines: sparse D3Q19, single precision, two relaxation times, interpolated walls.

    It writes no files. On a grid with twice the spacing a second of flow takes a sixteenth of the run time, so that
    sound and start-up vortices decay there first.
    """

    coarsening: ClassVar[float | None] = 2.0
    refined_by: ClassVar[tuple[str, ...]] = ("cell_size_mm", "lattice_speed")
    has_levels: ClassVar[bool] = True
    runs_on_gpu: ClassVar[bool] = True
    has_all_ends: ClassVar[bool] = True

    def cost(self, case: FlowCase) -> str:
        """Return a sentence with grid spacing, memory and run time of a case; refuse it if it cannot run."""
        if case.numerics.device_gpu:
            require_gpu()
        refuse_too_large(case)
        return str(estimate(case))

    def memory_bytes(self, case: FlowCase) -> float:
        """Return the expected peak memory of a flow."""
        return memory_bytes(case)

    def calmer(self, case: FlowCase) -> FlowCase:
        """Return the case with a shorter time step, for a second attempt after a run has diverged.

        A narrow place in the vessel may hold faster blood than the openings suggest.
        """
        return replace(case, numerics=replace(case.numerics, lattice_speed=SLOWER * case.numerics.lattice_speed))

    def coarsest_mm(self, case: FlowCase) -> float:
        """Return the grid spacing of the coarsest level."""
        return sizes_mm(case, self.cell_size_mm)[0]

    def prepare(self, case: FlowCase) -> None:
        """Build the grids."""
        stepping.prepare(case, self.cell_size_mm)

    def save(self, state: State) -> Saved:
        """Return the run as arrays."""
        return pack(state)

    def resume(self, case: FlowCase, saved: Saved) -> State:
        """Rebuild a run from its case and the saved arrays."""
        return unpack(case, self.cell_size_mm, saved)

    def step(self, state: State) -> State:
        """Advance the run towards its next check."""
        stepping.step(state)
        return state

    def terminate(self, state: State) -> float | None:
        """Return what is `left` at a check; None between checks; nan when the run has diverged."""
        if state.since_check:
            return None
        return float("nan") if any(level.snapshots[-1].is_lost for level in state.kept) else self.left(state)

    @abstractmethod
    def left(self, state: State) -> float:
        """Return the residual at a check."""

    def trouble(self, state: State) -> str:
        """Return a sentence that says why the run diverged."""
        return trouble(state)


@dataclass(frozen=True)
class LatticeBoltzmann(AbstractLattice):
    """The sparse D3Q19 engine with constant inflow."""

    def init(self, case: FlowCase, start: FlowField | None) -> State:
        """Set up a run whose fastest blood moves `lattice_speed` cells a step."""
        step_s = longest_step_s(case, self.coarsest_mm(case), peak_speed_m_s(case, start))
        check_s = CHECK_DIAMETERS * case.vessel.inlet.diameter_mm * M_PER_MM / float(case.inlet_speeds_m_s[0])
        most = case.numerics.max_steps / WIDTH**case.numerics.coarser_levels
        steps = 2 * max(1, round(0.5 * min(check_s / step_s, most / LEAST_CHECKS)))
        kept = 2 * CHECKS_APART + 1
        return stepping.build(case, self.cell_size_mm, steps * step_s, np.array([steps]), start=start, kept=kept)

    def step(self, state: State) -> State:
        """Advance the run towards its next check and, at a check, update the block means."""
        super().step(state)
        if not state.since_check:
            for level in state.kept:
                level.blocks = with_check(level.blocks, level.snapshots[-1])
        return state

    def left(self, state: State) -> float:
        """Return the distance from convergence or the error of the time averages, whichever is smaller."""
        return min(_left(state), _mean(state).left)

    def max_checks(self, state: State) -> int:
        """Return the maximum number of checks within the limit of time steps."""
        steps = part_of_steps(state.case, len(state.levels)) * state.case.numerics.max_steps
        return max(4, int(steps // state.kept[-1].steps_per_check))

    def result(self, state: State, outcome: Outcome) -> FlowField:
        """Return the last check of a converged flow, or the time average of an unsteady one."""
        left = _left(state)
        if left < state.case.numerics.tolerance:
            finer = stepping.snapshots(state)[len(state.kept) :] if state.levels != state.kept else []
            last = [*(level.snapshots[-1] for level in state.kept), *finer]
            flows = [read(level, [one]) for level, one in zip(state.levels, last, strict=True)]
            return field_of(state, flows, outcome, left, "The flow has converged.")
        mean = _mean(state)
        uncertain, advice = _of_mean(state, mean, is_converged=outcome.is_converged)
        flows = [read_moving(level, level.blocks[-mean.blocks :]) for level in state.kept]
        return field_of(state, flows, outcome, uncertain, advice)


@dataclass(frozen=True)
class PulsatileLatticeBoltzmann(AbstractLattice):
    """The sparse D3Q19 engine whose inflow follows a waveform until two cycles agree."""

    def init(self, case: FlowCase, start: FlowField | None) -> State:
        """Set up a run whose time steps divide each phase, with a peak speed below `lattice_speed` cells per step."""
        phase_s, steps = case.pulse.period_s / PHASES, pace(case, self.coarsest_mm(case), start)
        return stepping.build(case, self.cell_size_mm, phase_s, steps, start=start, kept=PHASES)

    def left(self, state: State) -> float:
        """Return the relative difference of the monitored quantities between the last two cycles; inf within one."""
        change = cycle_change(np.array(state.history))
        return max(change, _outflow_error(state)) if state.case.resistances and np.isfinite(change) else change

    def max_checks(self, state: State) -> int:
        """Return the number of phases in the maximum number of cycles."""
        return PHASES * state.case.numerics.max_cycles

    def result(self, state: State, outcome: Outcome) -> FlowField:
        """Return the mean flow of the last cycle, with its phases."""
        levels, phases = state.kept, []
        for k in range(len(state.snapshots)):
            flows = [read(level, [level.snapshots[k]]) for level in levels]
            flow = joined(state, flows)
            moment = tuple(one.velocity_m_s for one in flows), tuple(one.pressure_Pa for one in flows)
            ends_mL_s = flow.inlets_mL_s, flow.outlets_mL_s
            at_neck_mL_s = neck_mL_s(state, k - len(state.snapshots))
            phases.append(Phase((k + 1) * state.check_s, *ends_mL_s, *moment, flow.wall_shear_stress_Pa, at_neck_mL_s))
        changes = np.array([change for change in outcome.residual if np.isfinite(change)])
        advice = cycles_advice(changes, len(state.history) // PHASES, is_converged=outcome.is_converged)
        # For shear-thinning blood the wall shear stress of the mean flow differs from the mean wall shear stress.
        mean_Pa = np.asarray(np.mean([phase.wall_shear_stress_Pa for phase in phases], axis=0, dtype=np.float64))
        flows = [read(level, list(level.snapshots)) for level in levels]
        field = field_of(state, flows, outcome, outcome.residual[-1], advice, tuple(phases))
        return replace(field, wall_shear_stress_Pa=mean_Pa)


def _left(state: State) -> float:
    """Return the estimated relative distance of the run from convergence."""
    fields = [one.velocity[state.main.sac_cells] for one in state.main.snapshots]
    links, enters = state.links, state.links.is_inflow
    wanted = (links.wanted * links.openings[:, d3q19.AREA])[enters]
    # Not zero while sound waves leave through the openings.
    inflow_error = float(np.abs(state.snapshots[-1].outflow[enters] + wanted).sum() / wanted.sum())
    of_field = SHARE_OF_FIELD * field_left(fields)
    left = max(quantities_left(np.array(state.history)), of_field, INFLOW_WEIGHT * inflow_error)
    return max(left, INFLOW_WEIGHT * _outflow_error(state)) if state.case.resistances else left


def _outflow_error(state: State) -> float:
    """Return how much the flow through an outlet differs from what its resistance answers, as a fraction of its mean.

    It is the root mean square over the last cycle, or that of the last check. The widest outlet takes the rest.
    """
    wanted_mL_s = stepping.answered_mL_s(state, stepping.at_outlets_Pa(state))
    is_set, outlet, _ = stepping.of_outlets(state)
    last = list(state.snapshots)[-len(wanted_mL_s) :]
    wrong_mL_s = np.array([one.outflow_mL_s[is_set] for one in last]) - wanted_mL_s[:, outlet]
    means_mL_s = np.abs(wanted_mL_s[:, outlet].mean(axis=0))
    return float((np.sqrt((wrong_mL_s**2).mean(axis=0)) / means_mL_s).max(initial=0.0))


def _mean(state: State) -> Mean:
    """Return the best time average of the run so far."""
    return mean_of(state.main.blocks, np.array(state.history), state.main.sac_cells)


def _of_mean(state: State, mean: Mean, *, is_converged: bool) -> tuple[float, str]:
    """Return the statistical uncertainty of the means of an unconverged flow, as a fraction and in words."""
    swing, moved = swings(np.array(state.history), mean.checks)
    means = (
        f"averages over the last {1e3 * mean.checks * state.check_s:.0f} ms, in which the monitored quantities "
        f"varied by up to {100 * swing:.1f} % of their mean"
    )
    of_means, of_field = (100 * SURE * error for error in (mean.standard_error, mean.field_error))
    known = (
        f"their statistical uncertainty ({SURE} standard errors) is {of_means:.1f} %, and {of_field:.0f} % for "
        "the local velocity in the sac"
    )
    if is_converged:
        return of_means / 100, f"The flow is unsteady. The results are {means}; {known}."
    unsettled = f"The flow has not converged in {state.steps} time steps and may be unsteady. The results are {means}"
    if np.isfinite(mean.left):
        return of_means / 100, f"{unsettled}; {known}. Allow more steps to reduce it."
    drift = (
        ""
        if np.isnan(moved)
        else (f"; they differ by up to {100 * moved:.1f} % from the averages over an equal time before")
    )
    return float(np.nanmax([swing, moved])), f"{unsettled}{drift}."


def trouble(state: State) -> str:
    """Return one sentence: when the run diverged, where the flow was fastest, the likely cause and what to do."""
    lost = next((level for level in state.kept if level.snapshots and level.snapshots[-1].is_lost), state.main)
    good = [one for one in lost.snapshots if not one.is_lost]
    when_ms = 1e3 * state.time_s
    if not good:
        return (
            f"the flow diverged within the first {when_ms:.3g} ms, because the time step is too long for its "
            "speed: use half the lattice speed or half the grid spacing"
        )
    last = good[-1]
    speed = np.linalg.norm(last.velocity, axis=1)
    fastest = int(speed.argmax())
    behind = next(k for k, one in enumerate(reversed(lost.snapshots)) if one is last)
    good_ms = when_ms - 1e3 * behind * state.check_s
    return (
        f"the flow diverged between {good_ms:.3g} and {when_ms:.3g} ms; the fastest blood before was "
        f"{speed[fastest] * last.scales.speed_m_s:.2g} m/s at {place(lost.domain.centers_mm[fastest])}: "
        + _cause(lost, last, speed, fastest)
    )


def _cause(state: State, last: Snapshot, speed: Floats, fastest: int) -> str:
    """Return the likely cause and what to do about it."""
    if speed[fastest] > FAST:
        return (
            f"the time step is too long ({speed[fastest]:.2g} cells per step): use half the lattice speed "
            f"({state.case.numerics.lattice_speed:.3g})"
        )
    for k, opening in enumerate(state.case.vessel.openings):
        velocity = last.velocity[state.domain.link_cell[state.domain.link_patch == k + 1]]
        if not opening.is_inlet and -(velocity @ opening.normal).min(initial=0.0) > FAST * speed[fastest]:
            role = opening.role
            return f"blood flows back through {role}: cut the vessel further away, or split the outflow by Murray's law"
    cell_reynolds = speed[fastest] / last.scales.viscosity
    return (
        f"the grid is too coarse (grid Reynolds number {cell_reynolds:.0f}; the viscosity is raised above "
        f"{CELL_REYNOLDS:.0f}, and above {CELL_REYNOLDS_AT_END:.0f} beyond the openings): use a grid spacing "
        f"of {0.7 * state.domain.cell_size_mm:.2g} mm"
    )
