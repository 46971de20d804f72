"""A lattice-Boltzmann run as arrays, and going on from them as if it had never stopped."""

from collections import deque
from dataclasses import replace

import numpy as np

from vstent.flow.close_up import CloseUp
from vstent.flow.engines import Saved
from vstent.flow.engines.lattice_state import Snapshot, State, build, take_pace
from vstent.flow.types import FlowCase


def pack(state: State) -> Saved:
    """All of a run that its case and grid do not say."""
    if state.device is not None:
        state.device.fetch(state)
    snapshots = state.snapshots
    n = len(state.domain.cells)
    return {
        "check_s": np.array(state.check_s),
        "pace": state.pace,
        "kept": np.array(snapshots.maxlen or 0),
        "steps": np.array(state.steps),
        "since_check": np.array(state.since_check),
        "loop_seconds": np.array(state.loop_seconds),
        "populations": state.populations[: 19 * state.addressing.stride],
        "source": state.links.source,
        "openings": state.links.openings,
        "refill": state.refill.refill,
        "history": np.array(state.history),
        "step_s": np.array([one.scales.step_s for one in snapshots]),
        "velocity": np.array([one.velocity for one in snapshots], np.float32).reshape(len(snapshots), n, 3),
        "density": np.array([one.density for one in snapshots], np.float32).reshape(len(snapshots), n),
        "outflow": np.array([one.outflow for one in snapshots]),
    }


def unpack(case: FlowCase, cell_size_mm: float, saved: Saved, close_up: CloseUp | None) -> State:
    """Build the run of a case anew and put it where it was."""
    check_s, kept = float(saved["check_s"]), int(saved["kept"])
    state = build(case, cell_size_mm, check_s, saved["pace"], close_up=close_up, start=None, kept=kept)
    state.history = list(saved["history"])
    take_pace(state)
    state.populations[: 19 * state.addressing.stride] = saved["populations"]
    state.links.source[:] = saved["source"]
    state.links.openings[:] = saved["openings"]
    state.refill.refill[:] = saved["refill"]
    units = [replace(state.scales, step_s=float(step_s)) for step_s in saved["step_s"]]
    columns = units, saved["velocity"], saved["density"], saved["outflow"]
    state.snapshots = deque((Snapshot(*one) for one in zip(*columns, strict=True)), maxlen=kept)
    state.steps, state.since_check = int(saved["steps"]), int(saved["since_check"])
    state.loop_seconds = float(saved["loop_seconds"])
    return state
