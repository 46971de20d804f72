"""Count the time steps of steady flows by what they begin from, and with extrapolation of the whole field.

Usage: python benchmarks/steps.py [--case NAME ...]

Every flow is computed from rest, from a coarser grid, with a device from the flow without one (as vstent does), from
the flow with another device, and once more as vstent does with reduced-rank extrapolation of all populations (Eddy
1979; Smith, Ford and Sidi 1987, SIAM Rev. 29, 199). Steps on a grid of twice the spacing count a sixteenth. The
reference is the flow of vstent's own start, continued at a tolerance of 0.05 %. Steps do not depend on the load.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from grades import anatomy_of

import vstent
from vstent.errors import FlowError
from vstent.flow import simulation
from vstent.flow.case import FlowCase, FlowField
from vstent.flow.engines import Outcome, run, stepped
from vstent.flow.indices import indices
from vstent.flow.lattice.engine import LatticeBoltzmann
from vstent.flow.lattice.kernels import d3q19
from vstent.flow.lattice.state import TOO_FAST, State
from vstent.flow.lattice.stepping import snapshot
from vstent.flow.problem import flow_case
from vstent.flow.settings import FlowSettings, Numerics
from vstent.flow.simulation import simulate_case

CASES = {
    "demo 0.3": ("demo", 0.3),
    "demo 0.22": ("demo", 0.22),
    "t 0.3": ("t", 0.3),
    "arc 0.3": ("arc", 0.3),
    "C0038 0.4": ("aneurisk_C0038.vtp", 0.4),
}
"""Vessel and grid spacing in mm."""
DEVICES = ("silk", "enterprise")
QUANTITIES = ("neck_inflow_mL_s", "mean_sac_velocity_m_s", "mean_sac_wss_Pa")
REFERENCE = 0.0005
"""Tolerance of the reference."""
SNAPSHOTS = 6
"""Number of checks whose populations are combined into an extrapolated one."""
CYCLE = 14
"""Number of checks from one extrapolation to the next: convergence cannot be judged with fewer."""
LARGEST = 20.0
"""Largest sum of the absolute weights of a combination; a larger one amplifies what is not yet linear."""


@dataclass
class Counted:
    """Runs of one flow with their cost."""

    spacing_mm: float
    extrapolates: bool = False
    steps: float = 0.0
    """Time steps on the finest grid, with those of coarser grids by their cost."""

    def run(self, engine: LatticeBoltzmann, case: FlowCase, **given: Any) -> FlowField:
        """Run an engine as `vstent.flow.engines.run` does, and count."""
        is_finest = engine.cell_size_mm < 1.01 * self.spacing_mm
        found = (
            extrapolated(engine, case, given["start"])
            if is_finest and self.extrapolates
            else run(engine, case, start=given.get("start"))
        )
        self.steps += found.steps * (self.spacing_mm / engine.cell_size_mm) ** 4
        return found


def extrapolated(engine: LatticeBoltzmann, case: FlowCase, start: FlowField | None) -> FlowField:
    """Run an engine and replace its populations every `CYCLE` checks by the combination that changes least.

    What is known of the course before is dropped, because convergence is judged by a course without jumps.
    """
    state, residual, kept = engine.init(case, start), [np.inf], []
    while len(residual) < engine.max_checks(state) and residual[-1] >= case.numerics.tolerance:
        state, left = stepped(engine, state)
        if left is None:
            continue
        residual.append(left)
        kept.append(tuple(one.copy() for one in changing(state)))
        if len(kept) == CYCLE and left >= case.numerics.tolerance:
            if combine(state, kept[-SNAPSHOTS:]):
                state.history.clear()
                state.snapshots.clear()
                state.blocks = ()
            kept = []
    return engine.result(state, Outcome(residual[-1] < case.numerics.tolerance, tuple(residual), 0.0, 0.0))


def changing(state: State) -> tuple[np.ndarray, ...]:
    """Return the arrays that the time steps change, populations first."""
    return state.populations, state.links.source, state.refill.refill


def combine(state: State, kept: list[tuple[np.ndarray, ...]]) -> bool:
    """Set the reduced-rank extrapolation of the last checks, unless its weights are large or its blood too fast.

    The weights sum to 1, so that the mass of the combination is that of the flow.
    """
    changes = [after[0] - before[0] for before, after in pairwise(kept)]
    gram = np.array([[float(np.vdot(a, b)) for b in changes] for a in changes])
    gram += 1e-10 * np.trace(gram) * np.eye(len(gram))
    weights = np.linalg.solve(gram, np.ones(len(gram)))
    weights /= weights.sum()
    if np.abs(weights).sum() > LARGEST:
        return False
    before = [one.copy() for one in changing(state)]
    for k, target in enumerate(changing(state)):
        target[:] = sum(weight * one[k] for weight, one in zip(weights, kept[1:], strict=True))
    now = snapshot(state)
    is_good = bool(np.abs(now.velocity).max() < TOO_FAST * d3q19.SOUND)
    if not is_good:
        for target, old in zip(changing(state), before, strict=True):
            target[:] = old
    return is_good


def values(case: FlowCase, field: FlowField) -> np.ndarray:
    """Return the compared quantities of a flow."""
    found = indices(field, case.sac, case.ostium)
    return np.array([found[key] for key in QUANTITIES], dtype=float)


def counted(case: FlowCase, start: FlowField | None, *, extrapolates: bool = False) -> tuple[float, FlowField]:
    """Return the steps and the flow of vstent's own way to begin."""
    one = Counted(case.numerics.cell_size_mm, extrapolates)
    simulation.run = one.run
    try:
        found = simulate_case(case, start=start)
        return one.steps, found
    finally:
        simulation.run = run


def direct(case: FlowCase, start: FlowField | None) -> tuple[float, FlowField]:
    """Return the steps and the flow of a run on the grid itself."""
    found = run(LatticeBoltzmann(case.numerics.cell_size_mm), case, start=start)
    return found.steps, found


def main() -> None:
    """Run the benchmark and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--case", nargs="*", default=list(CASES), choices=list(CASES))
    given = parser.parse_args()
    print("| case | device | begins from | steps | difference from the reference, % | converged |\n" + 6 * "|---" + "|")
    for name in given.case:
        compare(name)


def compare(name: str) -> None:
    """Print the rows of one case."""
    vessel, spacing_mm = CASES[name]
    anatomy = anatomy_of(vessel)
    stents = {one: vstent.deploy(vstent.find_design(one), anatomy).stent for one in DEVICES}
    cases = {
        one: flow_case(anatomy, (stent,), FlowSettings(numerics=Numerics(cell_size_mm=spacing_mm)))
        for one, stent in ({"bare": None} | stents).items()
    }
    fields: dict[str, FlowField] = {}
    ways: dict[str, dict[str, Callable[[], tuple[float, FlowField]]]] = {}
    for device, case in cases.items():
        bare = fields.get("bare")
        steps, fields[device] = counted(case, bare)
        ways[device] = {"as vstent": lambda steps=steps, device=device: (steps, fields[device])}
    for device, case in cases.items():
        bare = None if device == "bare" else fields["bare"]
        more = {
            "rest": lambda case=case: direct(case, None),
            "as vstent, extrapolated": lambda case=case, bare=bare: counted(case, bare, extrapolates=True),
        }
        if bare is not None:
            other = next(one for one in DEVICES if one != device)
            more |= {
                "coarser grid": lambda case=case: counted(case, None),
                "bare": lambda case=case, bare=bare: direct(case, bare),
                other: lambda case=case, other=other: direct(case, fields[other]),
            }
        show(name, device, case, fields[device], ways[device] | more)


def show(
    name: str, device: str, case: FlowCase, known: FlowField, ways: dict[str, Callable[[], tuple[float, FlowField]]]
) -> None:
    """Print the rows of one flow."""
    _, reference = direct(replace(case, numerics=replace(case.numerics, tolerance=REFERENCE)), known)
    wanted = values(case, reference)
    for way, compute in ways.items():
        try:
            steps, field = compute()
        except FlowError:
            print(f"| {name} | {device} | {way} | | diverged | |", flush=True)
            continue
        apart = 100 * np.abs(values(case, field) / wanted - 1).max()
        print(f"| {name} | {device} | {way} | {steps:.0f} | {apart:.1f} | {field.is_converged} |", flush=True)


if __name__ == "__main__":
    main()
