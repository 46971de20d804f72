"""Save a lattice-Boltzmann run as arrays, and resume it with the same result as without an interruption."""

from collections import deque
from collections.abc import Collection, Iterator
from dataclasses import replace

import numpy as np

from vstent.flow.case import FlowCase
from vstent.flow.engines import Saved
from vstent.flow.lattice.scales import Scales
from vstent.flow.lattice.state import Snapshot, State
from vstent.flow.lattice.stepping import build, take_pace


def pack(state: State) -> Saved:
    """Return the arrays of a run that cannot be rebuilt from its case and grids."""
    for level in state.levels:
        level.fetch()
    saved = {
        "check_s": np.array(state.check_s),
        "pace": state.pace,
        "kept": np.array(state.snapshots.maxlen or 0),
        "steps": np.array(state.steps),
        "since_check": np.array(state.since_check),
        "loop_seconds": np.array(state.loop_seconds),
        "history": np.array(state.history),
    }
    for number, level in enumerate(state.levels):
        saved |= {f"{number} {name}": values for name, values in _of_level(level).items()}
    return saved


def _of_level(level: State) -> Saved:
    """Return the arrays of one level."""
    between = level.interface
    return {
        "populations": level.populations[: 19 * level.addressing.stride],
        "source": level.links.source,
        "openings": level.links.openings,
        "course": level.built[0].course,
        "refill": level.refill.refill,
        "lack": np.zeros(0) if between is None else between.lack,
        "push": np.zeros(0) if between is None else between.push,
        **_columns("last", level.snapshots, len(level.domain.cells)),
        **_columns("means", level.blocks, len(level.domain.cells)),
    }


def _columns(name: str, snapshots: Collection[Snapshot], cells: int) -> Saved:
    """Return snapshots as arrays whose keys start with `name`."""
    count = len(snapshots)
    return {
        f"{name} step_s": np.array([one.scales.step_s for one in snapshots]),
        f"{name} velocity": np.array([one.velocity for one in snapshots], np.float32).reshape(count, cells, 3),
        f"{name} density": np.array([one.density for one in snapshots], np.float32).reshape(count, cells),
        f"{name} outflow": np.array([one.outflow for one in snapshots]),
        f"{name} checks": np.array([one.checks for one in snapshots]),
        f"{name} speed": np.array([one.speed for one in snapshots if one.checks > 1], np.float32).reshape(-1, cells),
    }


def _snapshots(name: str, saved: Saved, scales: Scales) -> Iterator[Snapshot]:
    """Yield the snapshots that were saved under `name`."""
    columns = (saved[f"{name} {what}"] for what in ("step_s", "velocity", "density", "outflow", "checks"))
    speeds = iter(saved[f"{name} speed"])
    for step_s, velocity, density, outflow, checks in zip(*columns, strict=True):
        speed = next(speeds) if checks > 1 else None
        yield Snapshot(replace(scales, step_s=float(step_s)), velocity, density, outflow, int(checks), speed)


def unpack(case: FlowCase, cell_size_mm: float, saved: Saved) -> State:
    """Rebuild a run from its case and the arrays of `pack`."""
    check_s, kept = float(saved["check_s"]), int(saved["kept"])
    state = build(case, cell_size_mm, check_s, saved["pace"], start=None, kept=kept)
    state.history[:] = list(saved["history"])
    for number, level in enumerate(state.levels):
        level.built[0].course[:] = saved[f"{number} course"]
    take_pace(state)
    for number, level in enumerate(state.levels):
        level.populations[: 19 * level.addressing.stride] = saved[f"{number} populations"]
        level.links.source[:] = saved[f"{number} source"]
        level.links.openings[:] = saved[f"{number} openings"]
        level.refill.refill[:] = saved[f"{number} refill"]
        if level.interface is not None:
            level.interface.lack[:] = saved[f"{number} lack"]
            level.interface.push[:] = saved[f"{number} push"]
        level.snapshots = deque(_snapshots(f"{number} last", saved, level.scales), maxlen=kept)
        level.blocks = tuple(_snapshots(f"{number} means", saved, level.scales))
    state.steps, state.since_check = int(saved["steps"]), int(saved["since_check"])
    state.loop_seconds = float(saved["loop_seconds"])
    return state
