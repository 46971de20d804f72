"""A lattice-Boltzmann run as arrays, and going on from them as if it had never stopped."""

from collections import deque

import numpy as np

from vstent.flow.close_up import CloseUp
from vstent.flow.engines import Saved
from vstent.flow.engines.lattice_scales import Scales
from vstent.flow.engines.lattice_state import Snapshot, State, build
from vstent.flow.types import FlowCase
from vstent.units import M_PER_MM


def pack(state: State) -> Saved:
    """All of a run that its case and grid do not say."""
    if state.device is not None:
        state.device.fetch(state)
    snapshots = state.snapshots
    n = len(state.domain.cells)
    return {
        "step_s": np.array(state.scales.step_s),
        "steps_per_check": np.array(state.steps_per_check),
        "kept": np.array(snapshots.maxlen or 0),
        "steps": np.array(state.steps),
        "loop_seconds": np.array(state.loop_seconds),
        "populations": state.populations[: 19 * state.addressing.stride],
        "source": state.links.source,
        "openings": state.links.openings,
        "refill": state.refill.refill,
        "history": np.array(state.history),
        "velocity": np.array([one.velocity for one in snapshots], np.float32).reshape(len(snapshots), n, 3),
        "density": np.array([one.density for one in snapshots], np.float32).reshape(len(snapshots), n),
        "outflow": np.array([one.outflow for one in snapshots]),
    }


def unpack(case: FlowCase, cell_size_mm: float, saved: Saved, close_up: CloseUp | None) -> State:
    """Build the run of a case anew and put it where it was."""
    scales = Scales(cell_size_mm * M_PER_MM, float(saved["step_s"]), case.blood)
    state = build(case, scales, int(saved["steps_per_check"]), close_up=close_up, start=None, kept=int(saved["kept"]))
    state.populations[: 19 * state.addressing.stride] = saved["populations"]
    state.links.source[:] = saved["source"]
    state.links.openings[:] = saved["openings"]
    state.refill.refill[:] = saved["refill"]
    columns = (saved["velocity"], saved["density"], saved["outflow"])
    state.snapshots = deque((Snapshot(*one) for one in zip(*columns, strict=True)), maxlen=int(saved["kept"]))
    state.history = list(saved["history"])
    state.steps, state.loop_seconds = int(saved["steps"]), float(saved["loop_seconds"])
    return state
